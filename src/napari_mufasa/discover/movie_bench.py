"""The bench for movies: simulated movies, found and followed like the measured one."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import blake2b
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate.codes import code_widths
from napari_mufasa.calibrate.rows import dark_rows
from napari_mufasa.discover import curves, nuisance
from napari_mufasa.discover.bench import Bench, Job, as_table
from napari_mufasa.discover.measurement import Measurement
from napari_mufasa.discover.nuisance import Nuisance
from napari_mufasa.discover.read_off import (
    COURSES,
    READ_LAST,
    RELIEFS,
    background_beyond,
    drift_beyond,
    in_scale_of,
    read_off,
    relief_beyond,
    repeats_a_course,
    told_for,
)
from napari_mufasa.discover.result import Curve
from napari_mufasa.discover.rules import LINEAR, MATCHING_ROUNDS
from napari_mufasa.discover.seen_courses import dark_course, stands_still
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.extent import Extent
from napari_mufasa.model.model import Model
from napari_mufasa.observe import PART_LABELS, PARTS, DarkView, Observation, checkerboard, observe, view_dark
from napari_mufasa.simulate.movie import SimulatedAcquisition, simulate_dark

if TYPE_CHECKING:
    from distributed import Client

CAMERA_STAGE = "camera"
MATCHING_SEED = 10_000
BEYOND_SEED, BEYOND = 20_000, 3  # simulations that tell what a model shows already
FEWEST_MOLECULES = 3


@dataclass(frozen=True)
class SimulatedMovies:
    """What simulated movies show to these `eyes` (units and PSF width believed), beside so many `dark_frames`."""

    eyes: Model
    dark_frames: int
    _dark: dict[Hashable, DarkView] = field(default_factory=dict)

    def __call__(self, job: Job) -> Observation:
        model, seed = job
        movie = SimulatedAcquisition(model, seed=seed).movie()
        return observe(movie, self.eyes, self.dark_view(model, seed) if self.dark_frames else None)

    def dark_view(self, model: Model, seed: int) -> DarkView:
        """Dark frames depend on the camera and its effects only: made once for each."""
        camera_effects = tuple(e for e in model.effects if e.stage == CAMERA_STAGE)
        model = model.model_copy(update={"effects": camera_effects})
        key = (_everything_in(model.camera), tuple(e.model_dump_json() for e in camera_effects), seed)
        if key not in self._dark:
            self._dark[key] = view_dark(simulate_dark(model, self.dark_frames, seed), self.eyes)
        return self._dark[key]


class MovieBench(Bench[Observation]):
    """Simulates and observes movies, with dark frames where the measurement has some."""

    shows_camera = True
    read_last = READ_LAST

    def __init__(
        self,
        measurement: Measurement,
        seed: int,
        progress: Callable[[int, int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
        client: Client | None = None,
    ) -> None:
        self.measurement = measurement
        self._beyond: dict[str, dict[str, dict[str, Any]]] = {}
        self._left: dict[tuple[bool, str], Observation] = {}
        self._widths: dict[str, tuple[float, ...]] = {}
        self._drifts: dict[str, dict[str, Any]] = {}
        dark_frames = 0 if measurement.dark is None else len(measurement.dark)
        self._simulated = SimulatedMovies(measurement.model, dark_frames)
        measured = observe(measurement.movie, measurement.model, measurement.dark)
        if measured.spots.inside.sum() < FEWEST_MOLECULES:
            raise MufasaError(
                "fewer than three molecules were found in the movie: check psf_fwhm_nm, pixel_size_nm and baseline_adu "
                "in the model, or take a brighter region"
            )
        notes = list(measurement.notes)
        if measurement.dark is None:
            notes.append("No dark frames were given: offset, read noise and clock-induced charge rest on the model.")
        super().__init__(measurement.model, measured, seed, notes, progress, cancel, client)
        self.matching_simulations = 2 * (MATCHING_ROUNDS + self.start.hides_molecules)

    @property
    def simulated(self) -> SimulatedMovies:
        return self._simulated

    @property
    def size(self) -> int:
        """Pixels times frames of a simulation and its dark frames."""
        dark = self.measurement.dark
        return super().size + (0 if dark is None else dark.size)

    def free_values(self, model: Model) -> list[Nuisance]:
        return nuisance.nuisances(model, self.start)

    def matched(self, model: Model) -> Model:
        """Molecules as far apart as the spots tell; brightness, width, density, baseline and background by moments. To
        begin with as many molecules as there are spots, or, where effects of the model hide many, as it has: if it
        shows about as many spots, and as bright, as the movie."""
        measured, spots = as_table(self.names, self.measured.part("all")), self.measured.spots
        height, width = model.acquisition.shape_px
        model = nuisance.spaced(model, spots.positions_px, height * width)
        begun = nuisance.with_molecules(model, 1.15 * measured["spots"] ** 2)
        if model.hides_molecules:
            model = nuisance.with_molecules(model, model.sample.n_molecules)
            shown = self._moments(model, MATCHING_SEED)
            more = 2 * np.log(max(shown["spots"], 0.5) / measured["spots"])
            begun = model if max(abs(more), abs(shown["level"] - measured["level"])) < LINEAR else begun
        for turn in range(MATCHING_ROUNDS):
            shown = self._moments(begun, MATCHING_SEED + 10 * turn)
            begun = nuisance.moment_step(begun, self.start, measured, shown)
        return begun

    def _moments(self, model: Model, seed: int) -> dict[str, float]:
        """What two movies of a model show on average."""
        return as_table(self.names, self.rows([(model, seed + k) for k in range(2)])[:, 0].mean(axis=0))

    def read_off(self, kind: str, beside: Model | None = None, part: str = "all") -> dict[str, Any]:
        if kind == "converter_codes":
            return {"widths": self._code_widths(part)}
        if kind == "serial_readout":
            return self._dark_rows
        if kind == "background_as_measured":
            found = self._background_beyond(beside or self.start)[part]
        else:
            seen = self._beside(kind, beside or self.start)
            found = read_off(kind, seen.only(part))
            if part != "all":
                found = in_scale_of(read_off(kind, seen), found)
            if kind == "baseline_drift":
                found |= self._dark_drift(part)
        extent = self.start.effects_refer_to
        return found if extent is None else told_for(extent, found)

    def _dark_drift(self, part: str) -> dict[str, Any]:
        """A baseline's course in dark frames; it has no part in them where they stand still, for they were then taken
        apart from the movie."""
        dark = self.measurement.dark
        if dark is None:
            return {}
        if part not in self._drifts:
            apart = stands_still(dark)
            self._drifts[part] = (
                {"in_dark": 0.0} if apart else {"dark_course": dark_course(dark[:, self._pixels(part)])}
            )
        return self._drifts[part]

    def _pixels(self, part: str) -> NDArray[np.bool_]:
        """(y, x) those of a part."""
        return np.isin(checkerboard(self.measurement.movie.shape[1:]), PART_LABELS[PARTS.index(part)])

    @cached_property
    def _dark_rows(self) -> dict[str, Any]:
        """How the read noise is mixed along rows, which no fit has to tell where there are dark frames."""
        dark = self.measurement.dark
        if dark is None:
            return {}
        if self.start.camera.read_noise_kernel:
            return {"noise_ratio": 0.0}  # the model believed mixes it as it is
        return {"dark_rows": dark_rows(dark), "noise_ratio": 1.0}

    def _code_widths(self, part: str) -> tuple[float, ...]:
        if part not in self._widths:
            stacks = [stack for stack in (self.measurement.movie, self.measurement.dark) if stack is not None]
            there = self._pixels(part)
            self._widths[part] = code_widths([stack[:, there] for stack in stacks])
        return self._widths[part]

    def _background_beyond(self, model: Model) -> dict[str, dict[str, Any]]:
        """Of each part, what it shows beyond a model."""
        key = model.model_dump_json()
        if key not in self._beyond:
            shown = self._shown(model)
            self._beyond[key] = {
                part: background_beyond(self.measured.only(part), [one.only(part) for one in shown]) for part in PARTS
            }
        return self._beyond[key]

    def _beside(self, kind: str, model: Model) -> Observation:
        """The measurement as an effect is read off it: of two courses, each is what the other leaves; and a relief is
        what all others leave."""
        others = [effect for effect in model.effects if effect.kind != kind]
        drifts = kind in COURSES and any(map(repeats_a_course, others))
        if not (drifts or (kind in RELIEFS and others)):
            return self.measured
        key = (drifts, model.model_dump_json())
        if key not in self._left:
            beyond = drift_beyond if drifts else relief_beyond
            self._left[key] = beyond(self.measured, self._shown(model))
        return self._left[key]

    def _shown(self, model: Model) -> list[Observation]:
        """A few simulations of a model, which are not kept."""
        return self.observations([(model, BEYOND_SEED + k) for k in range(BEYOND)])

    def curves(self, before: Sequence[Observation], after: Sequence[Observation]) -> list[Curve]:
        return curves.draw(self.measured, before, after, self.start.acquisition.interval_s)

    def w1(self, before: Sequence[Observation], after: Sequence[Observation]) -> dict[str, Any]:
        return {}

    def restored(self, model: Model, believed: Model) -> Model:
        """The measurement's crop undone, density per area kept: a model of the whole movie, in its own shape. Effects
        still speak of the part that was measured."""
        n_frames, height, width = self.measurement.whole
        area = height * width / np.prod(model.acquisition.shape_px)
        molecules = max(1, round(model.sample.n_molecules * float(area)))
        sample = believed.sample.model_copy(update={"n_molecules": molecules})
        whole = model.in_shape(n_frames=n_frames, shape_px=(height, width), maps=believed.camera)
        extent = (model.effects_refer_to or Extent()).placed_in(self.measurement.part)
        return whole.model_copy(update={"sample": sample}).referring_to(extent)


def _everything_in(part: Any) -> tuple[Hashable, ...]:
    """All values of a part of a model, to the last pixel of its maps."""
    values = (value for _, value in part)
    return tuple((v.shape, blake2b(v.tobytes()).digest()) if isinstance(v, np.ndarray) else v for v in values)
