"""The bench for a table of traces alone: molecules far from each other, seen one by one (docs/comparison.md,
docs/discovery.md).

There is no image: simulated molecules are one pixel or one aperture each, through the same camera, as many as the table
has. What needs a place is neither fitted nor asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera import photoelectrons
from napari_mufasa.camera.readout import without_readout
from napari_mufasa.compare.comparison import described, to_photoelectrons
from napari_mufasa.compare.fit import background_level_e, fit_gain
from napari_mufasa.compare.simulated import FarApart
from napari_mufasa.compare.wasserstein import floor, wasserstein
from napari_mufasa.discover import curves
from napari_mufasa.discover.bench import Bench, Job
from napari_mufasa.discover.nuisance import Nuisance, nuisances
from napari_mufasa.discover.result import Curve
from napari_mufasa.effects import catalogue
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.observe import photoelectrons_per_adu
from napari_mufasa.observe.lone_traces import RUN, Eyes, TraceNumbers, observe_traces, views
from napari_mufasa.traces import Options
from napari_mufasa.traces.dynamics import dynamics

if TYPE_CHECKING:
    from distributed import Client

Array = NDArray[np.float64]
LEAST_MOLECULES, LEAST_FRAMES = 4 * RUN, 8
VALUES = 200_000  # a diagnosis looks at no more molecules times frames than this
LIGHT = ("optics.brightness_correction", "optics.background_photons_per_px")
LIGHT_PRIOR = 0.35  # of the value matched: in reach are an eighth of it and nearly twice as much
LIGHT_NUMBERS = ("signal_", "level", "ensemble")  # observables that say how much light, in levels
LEAST_SPREAD = (0.02, 0.005)  # of them, and of others: light is never more even than that from place to place
FIELDS = 8  # draws of the places within the pixels: simulations of one number share theirs
MATCHING_SEED = 10_000
SHARES = (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)  # of the mean signal that may be a molecule's …
CLOSER = ((0.75, 1.33), (0.9, 1.1))  # … and then around the best of them
LEVEL_ROUNDS = 4
QUANTILES, SPLITS = 200, 20  # of the distance that matching goes by
ELSEWHERE = ("illumination_profile",)  # light that depends on where a molecule is
NOT_SHOWN = ("optics.psf_fwhm_nm", "camera.baseline_adu", "sample.n_molecules")  # by a trace without an image


def candidate_kinds() -> list[str]:
    """Effects that change a lone trace: photophysics and light, but nothing that depends on where a molecule is."""
    return [
        kind
        for kind, effect in catalogue().items()
        if (effect.stage in ("photophysics", "illumination") or kind == "background_decay") and kind not in ELSEWHERE
    ]


@dataclass(frozen=True)
class SimulatedTables:
    """What simulated tables show to these `eyes`: molecules in `fields`, counts turned into photoelectrons as the
    measured ones were, by the camera believed (`photoelectrons_per_adu`)."""

    fields: tuple[FarApart, ...]
    eyes: Eyes
    photoelectrons_per_adu: float

    def __call__(self, job: Job) -> TraceNumbers:
        return observe_traces(self.traces(*job), self.eyes)

    def traces(self, model: Model, seed: int) -> Array:
        """(molecule, frame) photoelectrons."""
        field = self.fields[seed % FIELDS]
        made = field.traces(field.acquisition(model, seed)).astype(np.float64)
        traces: Array = made * (self.photoelectrons_per_adu / photoelectrons_per_adu(model))
        return traces


class TraceBench(Bench[TraceNumbers]):
    """Simulates and observes tables of traces (molecule, frame); parameters as in `diagnose_traces`."""

    matching_simulations = 0  # none is observed
    is_cheap = True

    def __init__(
        self,
        traces: Any,
        model: Model,
        unit: str | None = None,
        profile: str | None = None,
        background_subtracted: bool | None = None,
        pixel_share: float | None = None,
        *,
        seed: int = 1,
        progress: Callable[[int, int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
        client: Client | None = None,
    ) -> None:
        traces, unit, profile, background_subtracted = described(traces, unit, profile, background_subtracted)
        electrons = to_photoelectrons(traces, model, unit, background_subtracted=background_subtracted)
        if len(electrons) < LEAST_MOLECULES or electrons.shape[1] < LEAST_FRAMES:
            raise MufasaError(
                f"{electrons.shape[0]} traces of {electrons.shape[1]} frames: needs at least {LEAST_MOLECULES} traces "
                f"of {LEAST_FRAMES} frames to fit on some and judge on others; use compare"
            )
        if unit == "adu" and not background_subtracted:  # a photoelectron is worth what the noise of the traces says
            model, gain = fit_gain(np.asarray(traces), model)
            electrons = electrons / gain
        if not electrons.std() > 0:
            raise MufasaError(f"all traces are {electrons.flat[0]:g} throughout: give measured ones")
        electrons, notes = _affordable(electrons)
        n, n_frames = electrons.shape
        timing = model.acquisition.model_copy(update={"n_frames": n_frames})
        start = model.model_copy(update={"acquisition": timing})
        self.background_subtracted = background_subtracted
        options = Options(
            psf_sigma_px=model.sigma_px, profile=cast(Any, profile), subtract_background=background_subtracted
        )
        sigma = model.sigma_px
        fields = [FarApart(sigma, n, options, seed * FIELDS + k, pixel_share, quick=True) for k in range(FIELDS)]
        eyes = Eyes.of(electrons, background_subtracted)
        notes += _cut_off(fields[0], start, _level(electrons), background_subtracted)
        self._simulated = SimulatedTables(tuple(fields), eyes, photoelectrons_per_adu(start))
        self._electrons, self._matching_seed, self._level = electrons, MATCHING_SEED + 97 * seed, _level(electrons)
        self._quantiles, self._floors = _quantiles(electrons), _floors(electrons, np.random.default_rng(seed))
        super().__init__(start, observe_traces(electrons, eyes), seed, notes, progress, cancel, client)

    @property
    def simulated(self) -> SimulatedTables:
        return self._simulated

    @property
    def size(self) -> int:
        """Molecules times frames."""
        return int(self._electrons.size)

    def free_values(self, model: Model) -> list[Nuisance]:
        return [_in_proportion(value) for value in nuisances(model) if value.path not in NOT_SHOWN]

    def matched(self, model: Model) -> Model:
        """Brightness by the level of molecules; where the background is in the traces, how much of the signal is a
        molecule's by what comes nearest to the table at all time scales (W1)."""
        if self.background_subtracted:
            for turn in range(LEVEL_ROUNDS):
                level = _level(self._simulated.traces(model, self._matching_seed + turn))
                ratio = self._level / max(level, 1e-3 * self._level, 1e-9)  # a model far too dim shows none
                model = _with_light(model, model.optics.brightness_correction * float(np.clip(ratio, 0.2, 5.0)), None)
            return model
        wanted = float(self._electrons.mean())
        per_photon = model.camera.quantum_efficiency * self._background_weight
        background_e = background_level_e(model) * self._background_weight
        light_e = float(self._simulated.traces(model, self._matching_seed).mean()) - background_e
        brightness = model.optics.brightness_correction / max(light_e, 1e-3 * wanted)

        def of(share: float) -> Model:
            return _with_light(model, brightness * share * wanted, (1 - share) * wanted / per_photon)

        def distance(share: float) -> float:
            return self._distance(self._simulated.traces(of(share), self._matching_seed + 1))

        found = {share: distance(share) for share in SHARES}
        for factors in CLOSER:
            best = min(found, key=lambda share: found[share])
            found |= {share: distance(share) for share in (min(best * f, 0.99) for f in factors)}
        return of(min(found, key=lambda share: found[share]))

    @property
    def _background_weight(self) -> float:
        """Pixels' worth of background in a trace that keeps it."""
        weighing = self._simulated.fields[0].weighing
        return 1.0 if weighing is None else float(weighing.weight.mean())

    def _distance(self, traces: Array) -> float:
        """W1 over its floor, mean over time scales."""
        gaps = [np.abs(a - b).mean() for a, b in zip(self._quantiles, _quantiles(traces), strict=True)]
        return float(np.mean(np.array(gaps) / self._floors))

    def least_spread(self) -> Array:
        of_light = np.array([name.startswith(LIGHT_NUMBERS) for name in self.names])
        least: Array = np.maximum(super().least_spread(), np.where(of_light, *LEAST_SPREAD))
        return least

    def read_off(self, kind: str, beside: Model | None = None, part: str = "all") -> dict[str, Any]:
        return {}  # courses and directions are those of a field

    def curves(self, before: Sequence[TraceNumbers], after: Sequence[TraceNumbers]) -> list[Curve]:
        return curves.draw_traces(self.measured, before, after, self.start.acquisition.interval_s)

    def w1(self, before: Sequence[TraceNumbers], after: Sequence[TraceNumbers]) -> dict[str, Any]:
        def to(simulations: Sequence[TraceNumbers]) -> float:
            return float(np.mean([wasserstein(self._electrons, seen.traces) for seen in simulations]))

        least = floor(self._electrons, rng=np.random.default_rng(self.seed)).value
        return {"before": to(before), "after": to(after), "floor": least, "unit": "photoelectrons per frame"}

    def restored(self, model: Model, believed: Model) -> Model:
        """As long as the table: courses are told in shares of its length."""
        return model


def _affordable(electrons: Array) -> tuple[Array, list[str]]:
    """As many molecules as a diagnosis can afford, and what was left out in words."""
    n, n_frames = electrons.shape
    most = max(LEAST_MOLECULES, VALUES // n_frames // RUN * RUN)
    if n <= most:
        return electrons, []
    return electrons[:most], [f"The first {most} of {n} traces were used."]


def _cut_off(field: FarApart, model: Model, level_e: float, background_subtracted: bool) -> list[str]:
    """What a simulation of apertures without images has not: the end of the camera's scale, in words."""
    if field.weighing is None:
        return []
    background_e = background_level_e(model)
    held_e = 0.0 if background_subtracted else background_e * float(field.weighing.weight.mean())
    light_e = (level_e - held_e) / float(field.weighing.share.mean())
    peak_e = background_e + light_e * float(field.shares.mean())
    camera = model.in_shape(maps=None).camera
    full_e = float(photoelectrons(np.full((1, 1, 1), camera.adc_max), without_readout(camera))[0, 0, 0])
    if peak_e < full_e:
        return []
    return [
        f"The brightest pixel of a usual molecule has {peak_e:.0f} photoelectrons, the camera believed ends at "
        f"{full_e:.0f}: such traces are cut off, and simulated ones are not, so that what is found may be the camera's "
        "doing."
    ]


def _with_light(model: Model, brightness: float, background_photons: float | None) -> Model:
    values = {"optics.brightness_correction": float(np.clip(brightness, 1e-4, 1e5))}
    if background_photons is not None:
        values["optics.background_photons_per_px"] = max(background_photons, 0.0)
    return model.with_values(values)


def _in_proportion(value: Nuisance) -> Nuisance:
    """Light as a coordinate that signals are proportional to: tables are so precise that a logarithm would not be
    linear far enough."""
    if value.path not in LIGHT or value.origin <= 0:
        return value
    return replace(value, log=False, step=0.08 * value.origin, prior=LIGHT_PRIOR * value.origin)


def _level(traces: Array) -> float:
    """The usual level of molecules while on."""
    return float(np.median(dynamics(traces).on_level))


def _each_view(traces: Array) -> Iterable[Array]:
    for _, means, steps in views(traces):
        yield means
        if steps.shape[1]:
            yield steps


def _quantiles(traces: Array) -> list[Array]:
    """Values that split each view of traces into equal shares."""
    shares = (np.arange(QUANTILES) + 0.5) / QUANTILES
    return [np.sort(view, axis=None)[(shares * view.size).astype(int)] for view in _each_view(traces)]


def _floors(electrons: Array, rng: np.random.Generator) -> Array:
    """Distance of random halves (in runs of neighbours) of the table, for each view."""
    runs = np.arange(len(electrons)) // RUN
    n_runs = int(runs[-1]) + 1
    found = []
    for _ in range(SPLITS):
        first = np.isin(runs, rng.permutation(n_runs)[: n_runs // 2])
        halves = _quantiles(electrons[first]), _quantiles(electrons[~first])
        found.append([np.abs(a - b).mean() for a, b in zip(*halves, strict=True)])
    least: Array = np.maximum(np.mean(found, axis=0), 1e-9)
    return least
