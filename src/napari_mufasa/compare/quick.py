"""How far a model is from measured traces, within a second: for the eye while a value is being changed. No Qt here.

About 64 molecules on a grid, emission of the whole movie by the fast engine, but images of a few stretches of frames
only, read by the same extraction. The Compare button's answer is the one to quote: it detects, selects and uses all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from napari_mufasa.compare import Distribution, Floor
    from napari_mufasa.model.model import Model
    from napari_mufasa.traces import TraceSet

VOXELS = 4_000_000  # pixels × frames that are imaged: half a second
MOLECULES = 64
STRETCHES = 12
SAMPLES = 200_000  # of the measurement that are looked at: a tenth of a second
LEAST = 32  # of each molecule's frames, however many molecules there are


@dataclass(frozen=True)
class Known:
    """What stays the same while a model is edited: the measured traces thinned, and their floor."""

    thin: NDArray[np.float32]
    floor: Floor


@dataclass(frozen=True)
class QuickDistance:
    """W1 over frames beside its floor; traces (molecule, frame) photoelectrons of both sides; both on one axis."""

    w1: float
    known: Known
    measured: NDArray[np.float32]
    simulated: NDArray[np.float32]
    distribution: Distribution

    @property
    def floor(self) -> Floor:
        return self.known.floor


def quick_distance(
    measured: TraceSet, model: Model, seed: int = 0, known: Known | None = None,
    cancel: Callable[[], bool] | None = None,
) -> QuickDistance:  # fmt: skip
    """The distance of `model` from `measured`; `known` from an earlier distance to the same measurement.

    Raises `MufasaError` when no molecule was kept, or where molecules were followed, cut to windows, or chosen as the
    best of them: a model's molecules are whole traces of all that shine.
    """
    from napari_mufasa import compare
    from napari_mufasa.errors import MufasaError

    if measured.options.follow_molecules:
        raise MufasaError(
            "a model's molecules are read in their places: extract traces without following each molecule"
        )
    if measured.options.window is not None or measured.options.best is not None:
        raise MufasaError(
            "a model's molecules are whole traces of all that shine: extract traces without window and best, or compare"
        )
    traces = measured.traces
    if not len(traces):
        raise MufasaError("no molecule was kept: lower the threshold or relax the selection in step Molecules")
    if known is None:
        thin = thinned(traces)
        known = Known(thin, compare.floor(thin, n_splits=30, rng=np.random.default_rng(seed)))
    simulated = simulate_traces(measured, model, seed, cancel)
    fewer = thinned(simulated)
    w1 = compare.wasserstein(known.thin, fewer)
    return QuickDistance(w1, known, traces, simulated, _distribution(known.thin, fewer))


def thinned(traces: NDArray[np.float32], most: int = SAMPLES) -> NDArray[np.float32]:
    """Each molecule's frames in order, stood for by the means of equal parts of them; about `most` in all.

    A distance to what is left differs from the one to all by no more than W1(left, all), and the mean stays. Frames
    left out at random would add their own chance.
    """
    keep = max(LEAST, most // max(len(traces), 1))
    n_frames = traces.shape[1]
    if n_frames <= keep:
        return traces
    starts = (np.arange(keep) * n_frames) // keep
    sums = np.add.reduceat(np.sort(traces, axis=1), starts, axis=1)
    return np.asarray(sums / np.diff(starts, append=n_frames), np.float32)


def _distribution(measured: NDArray[np.float32], simulated: NDArray[np.float32]) -> Distribution:
    """The signal per frame of both, on one axis."""
    from napari_mufasa.compare import Distribution

    low, high = np.percentile(np.concatenate([measured.ravel(), simulated.ravel()]), [0.05, 99.95])
    edges = np.linspace(low, max(high, low + 1.0), 61)
    curves = {
        name: np.histogram(values, edges, density=True)[0].astype(np.float64)
        for name, values in (("measured", measured), ("mufasa", simulated))
    }
    return Distribution("counts", (edges[:-1] + edges[1:]) / 2, "signal per frame (photoelectrons)", "density", curves)


def simulate_traces(
    measured: TraceSet, model: Model, seed: int, cancel: Callable[[], bool] | None = None
) -> NDArray[np.float32]:
    """Traces (molecule, frame) of a model, read like the measured ones; some frames of the movie."""
    from napari_mufasa.errors import Cancelled
    from napari_mufasa.simulate.movie import SimulatedAcquisition
    from napari_mufasa.traces import extract_traces

    sigma = measured.sigma_px
    positions, shape = _grid(int(np.clip(len(measured.traces), 49, MOLECULES)), sigma, np.random.default_rng(seed))
    n_frames = measured.all_traces.shape[1]
    here = model.in_shape(n_frames=n_frames, shape_px=shape, maps=None)
    acquisition = SimulatedAcquisition(here, positions, seed)
    blocks = []
    for start, stop in _stretches(n_frames, VOXELS // (shape[0] * shape[1])):
        if cancel is not None and cancel():
            raise Cancelled
        blocks.append(acquisition.scene.record(acquisition.photons, start, stop).movie)
    options = replace(measured.options, window=None, best=None, follow_drift=False, psf_sigma_px=sigma, roi=None)
    movie = np.concatenate(blocks)
    found = extract_traces(movie, here.camera, options=options, positions_px=positions, cancel=cancel)
    # Molecules that never shine are not detected in a measurement either.
    seen = found.lit.any(axis=1)
    return found.all_traces[seen] if seen.any() else found.all_traces


def _grid(n: int, sigma_px: float, rng: Any) -> tuple[NDArray[np.float64], tuple[int, int]]:
    """Places far apart, anywhere within their pixel, and the field they need."""
    spacing = int(np.ceil(8 * sigma_px)) + 3 + int(np.ceil(2 * max(3.0, 2 * sigma_px)))
    columns = int(np.ceil(np.sqrt(n)))
    rows = -(-n // columns)
    places = np.stack(np.divmod(np.arange(n), columns), axis=1) * spacing + spacing // 2
    return places + rng.uniform(-0.5, 0.5, (n, 2)), (rows * spacing, columns * spacing)


def _stretches(n_frames: int, most: int) -> list[tuple[int, int]]:
    """Stretches of frames spread evenly over the movie, `most` frames together."""
    if most >= n_frames:
        return [(0, n_frames)]
    length = max(1, most // STRETCHES)
    starts = np.linspace(0, n_frames - length, STRETCHES).astype(int)
    return [(int(start), int(start) + length) for start in starts]
