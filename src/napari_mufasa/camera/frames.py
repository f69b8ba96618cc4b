"""A movie as blocks of photoelectron frames, whatever it is stored in and whatever unit it has."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import camera as detector
from napari_mufasa import checks
from napari_mufasa.camera.darkness import light_in_dark
from napari_mufasa.camera.readout import code_shifts_adu
from napari_mufasa.cluster import in_order
from napari_mufasa.errors import Cancelled, MufasaError

if TYPE_CHECKING:
    from distributed import Client

    from napari_mufasa.model.setup import Camera

Unit = Literal["adu", "photoelectrons", "photons"]
Progress = Callable[[int, int], None]
Stack = NDArray[np.float32]
Done = TypeVar("Done")
BLOCK_BYTES = 16 * 2**20  # float32 pixels held at once


class Frames:
    """Photoelectrons of a movie (frame, y, x), read block by block; at most one block is in memory.

    Parameters
    ----------
    movie : array-like (frame, y, x): NumPy, dask, zarr, or anything that slices by frame
    camera : the detector, to get from ADU to photoelectrons
    dark : dark frames (frame, y, x) or (y, x) in the movie's unit; they replace the camera's baseline
    unit : what the movie's numbers are
    client : of a cluster that does what is to be done to each block (see `worked`)
    """

    def __init__(
        self, movie: Any, camera: Camera, dark: Any = None, unit: Unit = "adu", client: Client | None = None
    ) -> None:
        from napari_mufasa.model.setup import Camera

        self.movie = movie = checks.stack(movie)
        checks.choice(unit, "unit", get_args(Unit))
        checks.need(camera, Camera, "camera", "give model.camera")
        self.unit, self.client = unit, client
        self.shape: tuple[int, int, int] = (int(movie.shape[0]), int(movie.shape[1]), int(movie.shape[2]))
        self.camera = camera if dark is None else with_dark_baseline(camera, dark, self.shape[1:], unit)
        if dark is not None and (told := light_in_dark(movie, checks.stack(dark, "dark", single=True))):
            warnings.warn(told, stacklevel=3)

    @property
    def n_frames(self) -> int:
        return self.shape[0]

    def block_frames(self) -> int:
        return max(1, min(self.n_frames, BLOCK_BYTES // (4 * self.shape[1] * self.shape[2])))

    def counts(
        self, multiple: int = 1, report: Callable[[int], None] | None = None, cancel: Callable[[], bool] | None = None
    ) -> Iterator[tuple[int, NDArray[Any]]]:
        """(first frame, numbers as they are stored) in order; every block but the last has a multiple of `multiple`
        frames. Raises `MufasaError` for numbers that this camera cannot have recorded."""
        for start, raw in self._stored(multiple):
            if cancel is not None and cancel():
                raise Cancelled
            self.check(raw)
            yield start, raw
            if report is not None:
                report(len(raw))

    def _stored(self, multiple: int = 1) -> Iterator[tuple[int, NDArray[Any]]]:
        size = max(multiple, self.block_frames() // multiple * multiple)
        for start in range(0, self.n_frames, size):
            yield start, np.asarray(self.movie[start : start + size])

    def worked(
        self,
        work: Callable[[Frames, int, NDArray[Any], Any], Done],
        beside: Callable[[slice], Any] = lambda span: None,
        multiple: int = 1,
        report: Callable[[int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
    ) -> Iterator[tuple[int, Done]]:
        """(first frame, ``work(frames, first frame, counts, beside)``) of the same blocks, in order. `beside` tells
        what else is known of a block's frames. Workers of a cluster are sent these and the block, not the movie."""
        frames = copy.copy(self)
        frames.movie = frames.client = None
        jobs = ((start, counts, beside(slice(start, start + len(counts)))) for start, counts in self._stored(multiple))
        for start, n, done in in_order(_Pass(frames, work), jobs, client=self.client, workers=0, cancel=cancel):
            yield start, done
            if report is not None:
                report(n)

    def check_light(self) -> None:
        """Raise `MufasaError` for a movie that shows nothing: saturated, or the same in all pixels or all frames.

        Reads no further than it must: two frames of a movie that shows something.
        """
        full = self._full()
        saturated = uniform = still = True
        first: NDArray[Any] | None = None
        for start in (0, *range(min(2, self.n_frames), self.n_frames, self.block_frames())):
            stop = min(2, self.n_frames) if start == 0 else start + self.block_frames()
            raw = np.asarray(self.movie[start:stop])
            first = raw[0] if first is None else first
            low, high = raw.min(axis=(1, 2)), raw.max(axis=(1, 2))
            saturated = saturated and full is not None and bool((low >= full).all())
            uniform = uniform and bool((low == high).all())
            still = still and bool((raw == first).all())
            if not (saturated or uniform or (still and self.n_frames > 1)):
                return
        if saturated:
            raise MufasaError(f"every pixel of the movie is saturated (at {full:g} or above): record with less light")
        what = f"every pixel of the movie is {raw.flat[0]:g}" if uniform and still else ""
        what = what or ("all pixels of a frame are equal" if uniform else "all frames of the movie are equal")
        raise MufasaError(f"{what}: nothing was recorded; give the camera's raw movie")

    def _full(self) -> float | None:
        """The largest number that the movie can hold, where it is known."""
        kind = np.dtype(self.movie.dtype)
        limits = [float(np.iinfo(kind).max)] if kind.kind == "u" else []
        limits += [float(self.camera.adc_max)] if self.unit == "adu" else []
        return min(limits, default=None)

    def blocks(
        self, report: Callable[[int], None] | None = None, cancel: Callable[[], bool] | None = None
    ) -> Iterator[tuple[int, Stack]]:
        """(first frame, photoelectrons) in order."""
        for start, raw in self.counts(report=report, cancel=cancel):
            yield start, self.electrons(raw, start)

    def photoelectrons(self, raw: NDArray[Any], first_frame: int = 0) -> Stack:
        self.check(raw)
        return self.electrons(raw, first_frame)

    def flat(self, counts: Stack) -> Stack:
        """Counts, or means of them, as if all pixels had the same offset and gain: what finding spots needs, in any
        unit. A detector's curve is left in: it keeps the order of brightness."""
        camera = self.camera
        if self.unit == "adu" and camera.offset_map_adu is not None:
            counts = counts - camera.offset_map_adu.astype(np.float32)
        if self.unit == "adu" and camera.gain_map is not None:
            counts = (counts - np.float32(camera.baseline_adu)) / camera.gain_map.astype(np.float32)
        return counts

    def check(self, raw: NDArray[Any]) -> None:
        """Raise `MufasaError` for numbers that this camera cannot have recorded."""
        if raw.dtype.kind == "f" and not np.isfinite(raw).all():
            raise MufasaError("movie has values that are not finite: mask or crop those frames first")
        if self.unit == "adu":
            detector.check_counts(raw, self.camera)

    def electrons(self, raw: NDArray[Any], first_frame: int) -> Stack:
        """The same of counts that have been checked."""
        if self.unit == "adu":
            return detector.photoelectrons(raw, self.camera, first_frame)
        if self.unit == "photons":
            return np.asarray(raw, np.float32) * np.float32(self.camera.quantum_efficiency)
        return np.asarray(raw, np.float32)


@dataclass(frozen=True)
class _Pass:
    """What is done to each block, on its way to a worker."""

    frames: Frames
    work: Callable[[Frames, int, NDArray[Any], Any], Any]

    def __call__(self, block: tuple[int, NDArray[Any], Any]) -> tuple[int, int, Any]:
        start, counts, beside = block
        self.frames.check(counts)
        return start, len(counts), self.work(self.frames, start, counts, beside)


def with_dark_baseline(camera: Camera, dark: Any, shape_px: tuple[int, ...], unit: Unit = "adu") -> Camera:
    """The camera with the baseline that the dark frames show (clock-induced charge stays signal).

    The recorded dark mean is BL − ½ (the ADC rounds down) + what clock-induced charge adds.
    """
    dark = checks.dark_stack(dark, shape_px)
    recorded = _mean_adu(dark, camera)
    if not (np.isfinite(recorded) and recorded >= -0.5):
        raise MufasaError("dark frames hold values that are negative or no numbers: give the raw counts (ADU)")
    if unit != "adu":
        raise MufasaError("dark frames correct the baseline of a movie in ADU; this one is already in " + unit)
    gain = float(camera.em_gain or 1.0)
    charge_adu = (camera.clock_induced_charge_e * gain + camera.read_noise_mean_e) / camera.electrons_per_adu
    baseline = recorded + 0.5 - charge_adu
    if camera.offset_map_adu is not None:
        baseline -= float(camera.offset_map_adu.mean())
    return camera.model_copy(update={"baseline_adu": max(baseline, 0.0)})


def _mean_adu(dark: Any, camera: Camera) -> float:
    """The mean of dark frames (frame, y, x) with uneven codes undone: that of their even and of their odd frames, for
    baselines that alternate. One is read after the other."""
    frames = (np.asarray(dark[t : t + 1]) for t in range(int(dark.shape[0])))
    levels = [np.mean(f, dtype=np.float64) + np.mean(code_shifts_adu(f, camera), dtype=np.float64) for f in frames]
    return float(np.mean([np.mean(levels[turn::2]) for turn in range(min(2, len(levels)))]))
