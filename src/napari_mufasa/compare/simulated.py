"""Traces that a model would give in the same acquisition, through the same camera and extraction (SPEC.md §7)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.compare.baselines import poisson_emission, sofi_emission, two_state_of
from napari_mufasa.model import Model
from napari_mufasa.simulation import Acquisition
from napari_mufasa.streams import Streams
from napari_mufasa.traces import Options, TraceSet, extract_traces
from napari_mufasa.traces.profile import pixel_shares

Cancel = Callable[[], bool]
IN_MEMORY_BYTES = 2**29  # larger movies are simulated anew for every block that extraction asks for


class SimulatedMovie:
    """An acquisition that is recorded when a block of it is read: a movie (frame, y, x) that needs no memory."""

    def __init__(self, acquisition: Acquisition) -> None:
        self.acquisition = acquisition
        self.shape = (acquisition.n_frames, *acquisition.scene.shape_px)
        self.dtype = np.dtype(np.uint16)

    def __getitem__(self, key: slice) -> NDArray[np.uint16]:
        start, stop, _ = key.indices(self.shape[0])
        return self.acquisition.scene.record(self.acquisition.emission, start, stop).movie


def acquisitions(model: Model, positions_px: NDArray[np.float64], seed: int) -> dict[str, Acquisition]:
    """The acquisition by the model ("mufasa") and by the two baselines, of molecules at the same places.

    The baselines know nothing of the model's effects. SOFI's I_on is the largest photon number of a frame in
    the MUFASA emission; its on, off and bleaching times are those of the model's chain.
    """
    mufasa = Acquisition(model, positions_px, seed)
    plain = model.model_copy(update={"effects": ()})
    poisson = Acquisition(plain, positions_px, seed + 1)
    sofi = Acquisition(plain, positions_px, seed + 2)
    n = len(positions_px)
    poisson.emission = poisson_emission(model, n, Streams(seed + 1).of("poisson baseline"))
    timing = model.acquisition
    largest = float(mufasa.emission.max()) if mufasa.emission.size else 0.0
    two_state = two_state_of(model, largest, mufasa.scene.chain)
    sofi.emission = sofi_emission(  # type: ignore[assignment]
        two_state, n, timing.n_frames, timing.frame_length_s, timing.interval_s, Streams(seed + 2).of("sofi baseline")
    )
    return {"mufasa": mufasa, "poisson": poisson, "sofi": sofi}


def recorded(acquisition: Acquisition, cancel: Cancel | None = None) -> Any:
    """The movie of an acquisition: in memory when it fits, else recorded on reading."""
    height, width = acquisition.scene.shape_px
    if 2 * acquisition.n_frames * height * width > IN_MEMORY_BYTES:
        return SimulatedMovie(acquisition)
    return np.concatenate([block.movie for _, block in acquisition.blocks(cancel=cancel)])


def extract_simulated(
    acquisition: Acquisition, options: Options, positions_px: NDArray[np.float64] | None = None,
    cancel: Cancel | None = None,
) -> TraceSet:  # fmt: skip
    """Traces of an acquisition, detected like a measurement, or at known positions."""
    movie = recorded(acquisition, cancel)
    camera = acquisition.model.camera
    return extract_traces(movie, camera, options=options, positions_px=positions_px, cancel=cancel)


@dataclass(frozen=True)
class FarApart:
    """Molecules far from each other, each anywhere within its pixel: how traces without a movie are simulated.

    positions_px : (molecule, 2); shape_px : the field that holds them; brightening : factor on the light, so
    that a pixel holds the share of it that was asked for
    """

    positions_px: NDArray[np.float64]
    shape_px: tuple[int, int]
    brightening: float = 1.0

    def model(self, model: Model) -> Model:
        """The model in this field."""
        maps = {"offset_map_adu": None, "gain_map": None, "variance_map_e2": None}
        camera = model.camera.model_copy(update=maps)  # maps belong to the real field
        acquisition = model.acquisition.model_copy(update={"shape_px": self.shape_px})
        factor = model.optics.brightness_correction * self.brightening
        optics = model.optics.model_copy(update={"brightness_correction": factor})
        return model.model_copy(update={"camera": camera, "acquisition": acquisition, "optics": optics})

    def acquisitions(self, model: Model, seed: int) -> dict[str, Acquisition]:
        return acquisitions(self.model(model), self.positions_px, seed)

    def traces(self, acquisition: Acquisition, options: Options, cancel: Cancel | None = None) -> NDArray[np.float32]:
        """(molecule, frame) photoelectrons at the known positions."""
        return extract_simulated(acquisition, options, self.positions_px, cancel).all_traces


def far_apart(
    sigma_px: float, n_molecules: int, options: Options, seed: int, pixel_share: float | None = None
) -> FarApart:
    """n molecules so far apart that neither light nor background rings overlap.

    With `pixel_share`, molecules sit at pixel centres and are brightened so that this share of a molecule's
    light falls in its brightest pixel (1: a detector that collects a molecule in one pixel).
    """
    spacing = int(np.ceil(8 * sigma_px)) + 3
    if options.subtract_background:
        spacing += int(np.ceil(2 * max(3.0, 2 * sigma_px)))
    columns = int(np.ceil(np.sqrt(n_molecules)))
    rows = -(-n_molecules // columns)
    place = np.stack(np.divmod(np.arange(n_molecules), columns), axis=1) * float(spacing) + spacing // 2
    if pixel_share is not None:
        zero = np.zeros(1)
        return FarApart(place, (rows * spacing, columns * spacing), pixel_share / _share_at(zero, sigma_px))
    place = place + Streams(seed).of("place in the pixel").uniform(-0.5, 0.5, place.shape)
    return FarApart(place, (rows * spacing, columns * spacing))


def _share_at(offset_px: NDArray[np.float64], sigma_px: float) -> float:
    return float(pixel_shares(offset_px, offset_px, sigma_px)[0])
