"""Where in the image a model fails: maps, molecules and frames, each in standard deviations of the model. No Qt here.

A few movies of the model are simulated with molecules at the measured places and seen like the measurement. What the
measurement has beyond them, divided by their spread, is what the model cannot explain there.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.model.extent import Extent
from napari_mufasa.model.model import Model

if TYPE_CHECKING:
    import pandas as pd

Progress = Callable[[int, int], None]
Cancel = Callable[[], bool]
Stack = NDArray[np.float32]
SIMULATIONS = 6
BINS = 5  # stretches of the movie, each with an image of its own
BLUR_PX = 1.0  # maps of light are as sharp as a spot; patterns of pixels stay sharp
SEED = 90_000
NOT_MOLECULES = ("narrower than the PSF", "never on")

#: Beginnings of observables' names and the map, molecule number or course that shows them; the longest counts.
PLACES: dict[str, str] = {
    "dark_": "dark", "background": "light", "background_variance": "noise", "background_skewness": "noise",
    "background_time": "course", "photon_transfer": "noise", "peak_quantile": "light", "pixel_lag": "memory",
    "neighbour": "noise", "pixel_pattern": "pixels", "pixel_gain": "noise", "column_pattern": "pixels",
    "row_pattern": "pixels", "row_noise": "frames", "column_noise": "frames", "narrow_bright": "pixels",
    "single_frame": "frames", "digits": "pixels", "common_mode": "frames", "repeated_frames": "memory",
    "common_shift": "course", "individual_shift": "course", "spot_": "course", "ensemble": "course",
    "spots": "light", "level": "molecules:brightness", "level_position": "light", "level_trend": "molecules:trend",
    "level_time": "course",
    "count": "molecules:flicker", "autocorrelation": "molecules:memory", "gap": "molecules:gaps",
    "steps": "molecules:steps", "last_level": "molecules:steps", "first_seen": "course",
    "survival": "molecules:last",
}  # fmt: skip
WORDS = {
    "light": "mean image", "pixels": "mean image, pixel by pixel", "noise": "variance between frames",
    "memory": "what a frame keeps of the last one", "course": "mean of each fifth of the movie",
    "dark": "mean of the dark frames", "frames": "frame by frame",
}  # fmt: skip
MOLECULE_WORDS = {
    "brightness": "brightness while on", "trend": "change of brightness", "flicker": "fluctuation while on",
    "memory": "correlation with the next frame", "gaps": "dark gaps", "steps": "steps", "last": "last frame with light",
}  # fmt: skip
#: Numbers that a model may never vary (no molecule blinks) are granted this spread.
LEAST_SD = {
    "brightness": 0.02, "trend": 0.02, "flicker": 0.05, "memory": 0.003, "gaps": 0.5, "steps": 0.5, "last": 0.05,
}  # fmt: skip


@dataclass(frozen=True)
class Places:
    """Misfit of a model by place, in standard deviations.

    Attributes
    ----------
    maps : name → (y, x), "course" (bin, y, x); frames : (frame,) mean of each frame
    molecules : table with y_px, x_px and one column per molecule number
    offset_px : (y, x) of the maps' first pixel in the movie; first_frame : their first frame in it
    n_frames : frames looked at
    simulated : (frame, y, x) a movie of the model, its molecules at the measured places; model : what it shows
    """

    maps: dict[str, Stack]
    frames: NDArray[np.float64]
    molecules: pd.DataFrame
    offset_px: tuple[int, int]
    first_frame: int
    n_frames: int
    simulated: NDArray[np.uint16]
    model: Model


def place_of(observable: str) -> str:
    """The name of the map, of the molecules' number ("molecules:…") or of the course for an observable."""
    fitting = [start for start in PLACES if observable.startswith(start)]
    return PLACES[max(fitting, key=len)] if fitting else "light"


def find_places(
    measurement: Any, model: Model, shape_px: tuple[int, int], first_frame: int = 0, *, seed: int = 1,
    progress: Progress | None = None, cancel: Cancel | None = None,
) -> Places:  # fmt: skip
    """Compare a measurement with a few movies of `model`.

    Parameters
    ----------
    measurement : has movie (frame, y, x) and dark (frame, y, x) or None, ADU, part, which says what part of the whole
        they are, first_frame in it, and model, whose camera maps have the movie's shape
    model : the model judged; shape_px : (height, width) of the whole field; first_frame : of a longer movie, from which
        the whole begins
    progress, cancel : see `simulate`
    """
    from napari_mufasa.errors import Cancelled
    from napari_mufasa.simulate.movie import simulate, simulate_dark
    from napari_mufasa.traces import extract_traces

    movie, dark = measurement.movie, measurement.dark
    frames, height, width = movie.shape
    extent = (model.effects_refer_to or Extent()).seen_from(measurement.part)
    model = model.in_shape(n_frames=frames, shape_px=(height, width), maps=measurement.model.camera)
    model = model.referring_to(extent)
    options: dict[str, Any] = {"psf_sigma_px": model.sigma_px, "cancel": cancel}
    found = extract_traces(movie, model.camera, dark, **options)
    # What is no molecule is not simulated: it shall stand out.
    chosen = np.flatnonzero(~found.molecules["reason"].isin(NOT_MOLECULES).to_numpy())
    positions = found.positions_px[chosen]
    seen = _maps(movie, dark)
    numbers = _numbers(found).iloc[chosen].reset_index(drop=True)
    spread = _Spread()
    simulated: Any = None
    reference = []
    for k in range(SIMULATIONS):
        if cancel is not None and cancel():
            raise Cancelled
        made = simulate(model, positions, SEED + 1000 * seed + k, cancel=cancel).movie
        simulated = made if simulated is None else simulated
        made_dark = None if dark is None else simulate_dark(model, len(dark), SEED + 1000 * seed + k)
        spread.add(_maps(made, made_dark))
        if len(positions):
            reference.append(_numbers(extract_traces(made, model.camera, positions_px=positions, **options)))
        if progress is not None:
            progress(k + 1, SIMULATIONS)
    z = spread.scores(seen)
    offset = ((shape_px[0] - movie.shape[1]) // 2, (shape_px[1] - movie.shape[2]) // 2)
    table = _scores(numbers, reference)
    table.insert(0, "y_px", positions[:, 0] + offset[0])
    table.insert(1, "x_px", positions[:, 1] + offset[1])
    frames = z.pop("frames")
    maps = {name: values.astype(np.float32) for name, values in z.items()}
    first = first_frame + measurement.first_frame
    return Places(maps, np.asarray(frames, float), table, offset, first, len(movie), simulated, model)


def _maps(movie: NDArray[Any], dark: NDArray[Any] | None) -> dict[str, NDArray[np.float64]]:
    """All maps of one movie, by blocks of frames, so that no second movie is held."""
    n, height, width = movie.shape
    edges = np.linspace(0, n, min(BINS, n) + 1).astype(int)
    bins = np.zeros((len(edges) - 1, height, width))
    steps, products = np.zeros((height, width)), np.zeros((height, width))
    frames = np.zeros(n)
    sharp = np.zeros((height, width))
    for b, (start, stop) in enumerate(itertools.pairwise(edges)):
        for at in range(start, stop, 32):
            end = min(at + 32, stop)
            block = movie[max(at - 1, 0) : end].astype(np.float32)
            own = block[1:] if at else block
            bins[b] += own.sum(axis=0)
            frames[at:end] = own.mean(axis=(1, 2))
            difference = np.diff(block, axis=0)
            steps += np.square(difference).sum(axis=0)
        sharp += bins[b]
        bins[b] /= stop - start
    sharp /= n
    for at in range(0, n - 1, 32):
        block = movie[at : min(at + 33, n)].astype(np.float32) - sharp.astype(np.float32)
        products += (block[1:] * block[:-1]).sum(axis=0)
    blur = ndimage.gaussian_filter
    found = {
        "light": blur(sharp, BLUR_PX), "pixels": sharp, "noise": blur(steps / max(n - 1, 1) / 2, BLUR_PX),
        "memory": blur(products / max(n - 1, 1), BLUR_PX), "course": blur(bins, (0, BLUR_PX, BLUR_PX)),
        "frames": frames,
    }  # fmt: skip
    if dark is not None:
        found["dark"] = np.asarray(dark, dtype=np.float64).mean(axis=0)
    return found


class _Spread:
    """Mean and spread of the maps of several movies, added one by one."""

    def __init__(self) -> None:
        self.n = 0
        self.sums: dict[str, NDArray[np.float64]] = {}
        self.squares: dict[str, NDArray[np.float64]] = {}

    def add(self, maps: dict[str, NDArray[np.float64]]) -> None:
        self.n += 1
        for name, values in maps.items():
            self.sums[name] = self.sums.get(name, 0.0) + values
            self.squares[name] = self.squares.get(name, 0.0) + values**2

    def scores(self, seen: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
        """(measured − mean) / spread. The spread of few movies is noisy: neighbours share theirs."""
        found = {}
        for name, total in self.sums.items():
            mean = total / self.n
            variance = np.maximum(self.squares[name] / self.n - mean**2, 0.0) * self.n / max(self.n - 1, 1)
            width = (0.0,) * (variance.ndim - 2) + (1.5,) * 2 if variance.ndim > 1 else 20.0
            variance = ndimage.gaussian_filter(variance, width)
            # The mean of few movies is uncertain itself; what never varies (a count) is granted a little.
            least = 1e-12 + 1e-3 * float(np.median(variance))
            found[name] = (seen[name] - mean) / np.sqrt(np.maximum(variance, least) * (1 + 1 / self.n))
        return found


def _numbers(traces: Any) -> pd.DataFrame:
    """One row per molecule: what its trace shows, in numbers whose noise is about even."""
    import pandas as pd

    from napari_mufasa.traces.correlation import lagged

    light, lit = traces.all_traces.astype(np.float64), traces.lit
    table = traces.molecules
    count = np.maximum(lit.sum(axis=1), 1)
    level = np.maximum((light * lit).sum(axis=1) / count, 1e-3)
    deviation = np.where(lit, light / level[:, None] - 1, 0.0)
    products, pairs = lagged(deviation, lit, 1)
    frame = np.arange(light.shape[1])
    middle = (lit * frame).sum(axis=1) / count
    from_middle = np.where(lit, frame - middle[:, None], 0.0)
    slope = (deviation * from_middle).sum(axis=1) / np.maximum((from_middle**2).sum(axis=1), 1e-9)
    last = np.where(lit.any(axis=1), light.shape[1] - np.argmax(lit[:, ::-1], axis=1), 0)
    return pd.DataFrame(
        {
            "brightness": np.log(level),
            "trend": slope * light.shape[1],
            "flicker": np.log((deviation**2).sum(axis=1) / count + 1e-6),
            "memory": products / np.maximum(pairs, 1),
            "gaps": np.sqrt(table["n_blinks"].to_numpy(float)),
            "steps": np.sqrt(table["n_steps"].to_numpy(float)),
            "last": last / light.shape[1],
        }
    )


def _scores(numbers: pd.DataFrame, reference: list[pd.DataFrame]) -> pd.DataFrame:
    """Each molecule against the simulated ones, by their median and quartiles."""
    import pandas as pd

    if not reference:
        return numbers
    known = pd.concat(reference)
    scores = {}
    for name in numbers:
        low, middle, high = np.quantile(known[name], [0.25, 0.5, 0.75])
        sd = max((high - low) / 1.35, 0.3 * float(known[name].std()), LEAST_SD[name])
        scores[name] = (numbers[name] - middle) / sd
    return pd.DataFrame(scores)
