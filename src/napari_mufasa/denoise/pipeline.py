"""From recorded counts to photons: the camera's inverse and the denoiser between its steps (docs/denoising.md)."""

from __future__ import annotations

import copy
import math
import os
import warnings
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from napari_mufasa import camera as cam
from napari_mufasa import checks
from napari_mufasa.cluster import in_order
from napari_mufasa.errors import Cancelled, MufasaError

from .reel import Reel, block_frames

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from distributed import Client
    from numpy.typing import NDArray

    from napari_mufasa.model.setup import Camera

    from .temporal import Learnt

    Array = NDArray[Any]

Method = Literal["pure-let", "pure-let-movie", "pure-let-patches", "source", "none"]
#: Frames whose pooled risk sets the weights of a movie.
SAMPLES = 16
#: Frames that settle how far the second pass goes.
PATCH_SAMPLES = 4
#: Of the noise that the camera says, where there cannot be as much: the least that is tried, and how often the way to
#: it is halved (each time in logarithms: to 2 %).
LEAST_SHARE, HALVINGS = 0.25, 6
#: Frames in work at once.
WORKERS = max(1, min(4, os.cpu_count() or 1))


def denoise(
    movie: Any,
    camera: Camera | None = None,
    *,
    dark: Any = None,
    method: Method = "pure-let-movie",
    excess_noise: bool = True,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
    out: Any = None,
    client: Client | None = None,
) -> NDArray[np.float32]:
    """Estimate the light that reached the detector: photons per pixel and frame.

    Parameters
    ----------
    movie : array (frame, y, x) or (y, x), ADU
        numpy, dask or zarr; read in pieces of 32 frames, fewer above 512 x 512 pixels.
        Memory on top of the program's does not grow with the number of frames: about 1.2 GB for frames of 1024 x 1024
        pixels, in proportion for smaller ones (`python -m benchmarks.speed --only memory`), and the result unless
        ``out`` is on disk.
    camera : Camera, optional
        Gain, read noise, baseline, quantum efficiency and maps. Without one they are measured on the movie and
        ``dark`` (`napari_mufasa.calibrate.measure`, an EMCCD assumed): say what you know with a camera of your own.
    dark : array (frame, y, x), optional
        Dark frames, for the measurement of a camera that is not given.
    method : str
        "pure-let-movie": mixed-noise PURE-LET with neighbouring frames as predictors, a single frame as the next but
        one; "pure-let": the same, frame by frame; "pure-let-patches": each frame by itself, like patches filtered
        together: the best for single frames, and much slower; "source": the recipe of the source note, step by step;
        "none": only the camera's inverse.
    excess_noise : bool
        An EMCCD's multiplication doubles the variance; False treats its signal as plain Poisson, as the source does.
    progress : callable (done, total), optional
        Called after every block with frames done and in all.
    cancel : callable, optional
        Asked before every block; True stops with `Cancelled`.
    out : array-like (frame, y, x), optional
        Written to instead of a new array, for example a zarr array for a movie larger than memory.
    client : distributed.Client, optional
        Of a cluster whose workers denoise the blocks; the movie is read, and the weights are learnt, here
        (docs/clusters.md).

    Returns
    -------
    float32 (frame, y, x), or ``out``.

    Raises
    ------
    MufasaError
        Wrong number of dimensions, an empty movie, values that are not finite, maps of another shape; no camera and
        a movie that shows none.
    Cancelled
        ``cancel`` returned True.
    """
    movie = checks.stack(movie, single=True)
    shape = tuple(movie.shape)
    if out is None:
        checks.affordable(4 * math.prod(shape), f"{shape[0]} denoised frames", "give `out`, an array on disk")
    result = np.empty(shape, np.float32) if out is None else out
    if (room := tuple(getattr(result, "shape", ()))) != shape:
        raise MufasaError(f"out has shape {room}, the movie {shape}; give the same shape")
    shared: dict[str, Any] = {"dark": dark, "method": method, "excess_noise": excess_noise}
    for start, block in denoised(movie, camera, **shared, progress=progress, cancel=cancel, client=client):
        result[start : start + len(block)] = block
    return result


def denoised(
    movie: Any,
    camera: Camera | None = None,
    *,
    dark: Any = None,
    method: Method = "pure-let-movie",
    excess_noise: bool = True,
    first: int = 0,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
    client: Client | None = None,
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """`denoise`, piece by piece: (first frame of the piece, photons (frame, y, x)) in order, for movies larger than
    memory. Begins with the block of `block_frames` that frame ``first`` lies in."""
    checks.choice(method, "method", get_args(Method))
    from napari_mufasa.model.setup import Camera

    movie = checks.stack(movie, single=True)
    if camera is None:
        camera = measured_camera(movie, dark, cancel)
    elif dark is not None:
        warnings.warn("the camera given is used: dark frames are for measuring one where none is given", stacklevel=3)
    checks.need(camera, Camera, "camera", "give model.camera")
    shape = tuple(movie.shape)
    frames = _Frames(movie, camera, shape, method, excess_noise)
    frames.learn(cancel)
    size = block_frames(shape)
    spans = [(start, min(start + size, shape[0])) for start in range(first // size * size, shape[0], size)]
    _stop_if(cancel)
    pieces: Iterator[tuple[int, NDArray[np.float32]]]
    if client is None:
        reel = Reel(frames.read, shape, frames.neighbours)
        pieces = (piece for span in spans for piece in frames.pieces(reel, *span))
    else:
        counts = (frames.block(*span) for span in spans)
        blocks = in_order(frames.without_movie().photons, counts, client=client, cancel=cancel)
        pieces = zip((start for start, _ in spans), blocks, strict=True)
    for begin, piece in pieces:
        yield begin, piece
        done = begin + len(piece)
        if progress is not None:
            progress(done, shape[0])
        if done < shape[0]:
            _stop_if(cancel)


@dataclass(frozen=True)
class _Block:
    """Recorded frames `begins` … of which start … stop − 1 are to be denoised; the others are their neighbours."""

    counts: Array
    begins: int
    start: int
    stop: int


def measured_camera(
    movie: Any,
    dark: Any = None,
    cancel: Callable[[], bool] | None = None,
    camera_type: Literal["CCD", "EMCCD", "CMOS"] | None = None,
) -> Camera:
    """Baseline, read noise and gain, measured on the movie and its dark frames.

    camera_type : None: an EMCCD, unless the histogram, or how few counts a photoelectron makes, say that it has no
        register: a CCD then
    """
    from napari_mufasa.calibrate.measure import calibrate

    try:
        return calibrate(movie, dark, camera_type=camera_type, cancel=cancel).camera
    except MufasaError as error:
        raise MufasaError(f"no camera was given and it cannot be measured: {error}") from None


def _stop_if(cancel: Callable[[], bool] | None) -> None:
    if cancel is not None and cancel():
        raise Cancelled("denoising was cancelled")


class _Frames:
    """A movie read in blocks, its noise in photoelectrons, and the weights learnt from samples of it."""

    def __init__(self, movie: Any, camera: Camera, shape: tuple[int, ...], method: Method, excess_noise: bool) -> None:
        self.movie, self.camera, self.shape = movie, camera, shape
        self.workers = WORKERS
        # A single frame has no past or future: what is best for single frames is best for it.
        self.method = "pure-let-patches" if method == "pure-let-movie" and shape[0] == 1 else method
        self.alpha = cam.multiplication_noise(camera) if excess_noise else 1.0
        self.multiplied = self.alpha > 1
        from .temporal import NEIGHBOURS, Learnt

        self.learnt = Learnt(None, 1.0, 0.0, 0.0)
        self.share = 1.0  # of the noise that the camera says
        self.way = 0.0
        self.gain_db = 0.0

        self.neighbours = NEIGHBOURS if self.method == "pure-let-movie" else 0

    def read(self, start: int, stop: int, tile: tuple[slice, ...] = ()) -> NDArray[np.float32]:
        """Recorded frames, or a tile of them, as photoelectrons."""
        return self.electrons(np.asarray(self.movie[(slice(start, stop), *tile)]), start, tile)

    def electrons(self, counts: Array, start: int, tile: tuple[slice, ...] = ()) -> NDArray[np.float32]:
        """Counts of recorded frames from `start` on, or of a tile of them, as photoelectrons."""
        camera = self.camera.of_part(*tile) if tile else self.camera
        _check(counts, camera, start)
        return cam.photoelectrons(counts, camera, start)

    def noise(self, electrons: Array, tile: tuple[slice, ...] = ()) -> Any:
        """Noise of one frame of photoelectrons, or a tile of it; the read noise is seen through the gain's slope."""
        from .noise import Noise

        variance = cam.read_variance(electrons, self.camera.of_part(*tile) if tile else self.camera)
        return Noise(self.alpha * self.share, variance * np.float32(self.share), self.multiplied)

    def learn(self, cancel: Callable[[], bool] | None) -> None:
        """Weights of least pooled risk over frames spread evenly through the movie; where there is less noise than the
        camera says, with as much as there can be."""
        if self.method in ("source", "none"):
            return
        from . import temporal
        from .purelet import LEVELS, depth_for

        chosen = temporal.sample_frames(self.shape[0], SAMPLES)

        def seen(number: int, t: int) -> list[Any]:
            _stop_if(cancel)
            first, last = self.reach(t, t + 1)
            found = []
            for tile in temporal.sample_windows(self.shape[1:], number, len(chosen)):
                data = self.read(first, last, tile)
                noise = self.noise(data[t - first], tile)
                found += [one for _, one in temporal.sights(data, t - first, t - first + 1, noise, self.neighbours)]
            return found

        def learnt() -> Learnt:
            with ThreadPoolExecutor(max_workers=WORKERS) as pool:
                sights = [one for found in pool.map(seen, range(len(chosen)), chosen) for one in found]
                return temporal.learn(sights, depth_for(self.shape[1:], LEVELS, False), pool.map)

        self.learnt = learnt()
        if self.learnt.is_impossible:
            self._learn_with_less_noise(learnt)
        if (wrong := self._wrong_noise()) is not None:
            warnings.warn(f"{wrong}; {self._why_wrong(chosen)}", stacklevel=4)
        if self.learnt.weights is not None:
            gain = self.learnt.untouched / max(self.learnt.risk, 1e-3 * self.learnt.untouched)
            self.gain_db = float(10 * np.log10(gain))
        if self.method == "pure-let-patches" and self.learnt.weights is not None:
            some = temporal.sample_frames(self.shape[0], PATCH_SAMPLES)
            self.way = float(np.mean([self._way(t, cancel) for t in some]))

    def _learn_with_less_noise(self, learnt: Callable[[], Learnt]) -> None:
        """Find the most noise with which the risk is not estimated below zero; nothing changes where there is none."""
        low, high = LEAST_SHARE, 1.0
        self.share = low
        if (best := learnt()).risk < 0:
            return
        for _ in range(HALVINGS):
            self.share = math.sqrt(low * high)
            tried = learnt()
            if tried.risk < 0:
                high = self.share
            else:
                low, best = self.share, tried
        self.share, self.learnt = low, best

    def _wrong_noise(self) -> str | None:
        """In words, that the camera's noise is not the movie's; None where it may be."""
        if self.learnt.is_impossible:
            return "the movie is left as it was recorded: its noise is not what the camera says"
        if self.share < 1.0:
            return f"the movie has some {100 * (1 - self.share):.0f} % less noise than its camera says, and is taken so"
        return None

    def _why_wrong(self, frames: Sequence[int]) -> str:
        """In words, where less noise may come from, and what to do: values at the largest count have none."""
        full = np.mean([(np.asarray(self.movie[t]) >= self.camera.adc_max).mean() for t in frames])
        if full > 0:
            return f"{100 * full:.2g} % of its values are at the largest count, which have none: record with less light"
        return "measure that (`calibrate`), or set its read noise and electrons per count to what they are"

    def _way(self, t: int, cancel: Callable[[], bool] | None) -> float:
        """How far the second pass should go, judged on the middle of frame ``t``."""
        _stop_if(cancel)
        from . import patches
        from .purelet import LEVELS, applied, central

        frame = self.read(t, t + 1)[0]
        noise = self.noise(frame).within(central(frame.shape))
        part = np.ascontiguousarray(frame[central(frame.shape)])
        if not patches.big_enough(part.shape):
            return 0.0
        return patches.judge(part, noise, lambda y: applied(y, noise, LEVELS, False, self.learnt.weights))[0]

    def reach(self, start: int, stop: int) -> tuple[int, int]:
        """The frames start … stop - 1 with the neighbours that they look at."""
        return max(0, start - self.neighbours), min(self.shape[0], stop + self.neighbours)

    def pieces(self, reel: Reel, start: int, stop: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """The block of frames start … stop - 1: (first frame of a piece, photons (frame, y, x)) in order."""
        if self.method in ("none", "source"):
            for begin in range(start, stop, reel.piece):
                yield begin, self.recorded(np.asarray(self.movie[begin : min(begin + reel.piece, stop)]), begin)
        else:
            yield from self.worked(reel, start, stop, reel.piece)

    def block(self, start: int, stop: int) -> _Block:
        """Frames start … stop - 1 as they are recorded, with the neighbours that they look at."""
        first, last = self.reach(start, stop)
        return _Block(np.asarray(self.movie[first:last]), first, start, stop)

    def without_movie(self) -> _Frames:
        """What another process needs to denoise blocks, one thread each: its cores may have other blocks."""
        frames = copy.copy(self)
        frames.movie, frames.workers = None, 1
        return frames

    def photons(self, block: _Block) -> NDArray[np.float32]:
        """Denoised photons (frame, y, x) of a block's frames."""
        if self.method in ("none", "source"):
            return self.recorded(block.counts, block.start)
        start, stop = block.start - block.begins, block.stop - block.begins
        ((_, photons),) = self.worked(self.electrons(block.counts, block.begins), start, stop, stop - start)
        return photons

    def recorded(self, counts: Array, start: int) -> NDArray[np.float32]:
        """Photons of frames from `start` on by the methods that know no neighbours and learn nothing."""
        if self.method == "none":
            return cam.photons(self.electrons(counts, start), self.camera)
        _check(counts, self.camera, start)
        return cam.photons(source_recipe(counts, self.camera, start), self.camera)

    def worked(self, data: Array | Reel, start: int, stop: int, size: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Photons of frames start … stop - 1 of ``data`` by the methods that learn, in pieces of ``size`` frames."""
        from . import patches
        from .purelet import LEVELS
        from .temporal import apply_frame, sights

        def one(sight: Any, room: Array) -> None:
            sight = replace(sight, noise=self.noise(sight.frame))
            result = apply_frame(sight, LEVELS, self.learnt)
            patched = patches.towards(sight.frame, result, sight.noise, self.way) if self.way > 0 else result
            room[...] = cam.photons(patched, self.camera)

        typical = self.noise(data[(start + stop) // 2])
        # The kernels release the interpreter: threads share the block's frames.
        with ThreadPoolExecutor(max_workers=min(self.workers, stop - start)) as pool:
            work: deque[Any] = deque()
            pieces: deque[tuple[int, Array]] = deque()
            for t, sight in sights(data, start, stop, typical, self.neighbours, size):
                if (t - start) % size == 0:
                    pieces.append((t, np.empty((min(size, stop - t), *self.shape[1:]), np.float32)))
                begin, piece = pieces[-1]
                work.append(pool.submit(one, sight, piece[t - begin]))
                # What the past and future show of a frame is let go as soon as the frame is done.
                if len(work) > self.workers + 1:
                    work.popleft().result()
                while pieces and t + 1 - len(work) >= pieces[0][0] + len(pieces[0][1]):
                    yield pieces.popleft()
            for done in work:
                done.result()
            yield from pieces


def _check(counts: Array, camera: Camera, start: int) -> None:
    """Raises `MufasaError` on frames, from `start` on, that this camera cannot have recorded."""
    if counts.dtype.kind == "f" and not np.all(np.isfinite(counts)):
        raise MufasaError(
            f"movie frames {start} to {start + len(counts) - 1} hold values that are not finite: "
            "crop or fill them first"
        )
    cam.check_counts(counts, camera)


def source_recipe(counts: Array, camera: Camera, first_frame: int = 0) -> NDArray[np.float32]:
    """The source note's pipeline, literally: shrinkage of the read noise, gain undone, plain Poisson denoiser."""
    from .wavelet import anscombe_wavelet, bayes_shrink

    electrons = cam.output_electrons(counts, camera, first_frame)
    sigma = float(np.sqrt(np.mean(np.square(cam.read_noise_map_e(camera)))))
    smooth = np.stack([bayes_shrink(frame, sigma) for frame in electrons])
    # The camera module inverts counts: hand the smoothed electrons back as (fractional) counts.
    as_counts = (smooth + camera.read_noise_mean_e) / camera.electrons_per_adu + cam.baseline_map_adu(camera) - 0.5
    inputs = cam.photoelectrons(as_counts, camera.model_copy(update={"baseline_alternation_adu": 0.0}))
    return np.stack([anscombe_wavelet(frame) for frame in inputs])
