"""The camera from its own movies: baseline, read noise, digital counts per photoelectron (photon transfer).

At constant light the variance of a pixel in time grows with its mean: slope = F²·(ADU per photoelectron), with
the excess noise factor F² = 2 for electron multiplication and 1 without (SPEC.md §4). Differences of successive
frames take slow changes of the light out of the variance; medians over pixels of like mean take blinking out.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import Cancelled, MufasaError

if TYPE_CHECKING:
    from napari_mufasa.model.setup import Camera

CHUNKS = 10  # parts of the movie whose spread gives the uncertainties
CHUNK_BYTES = 2**27  # of each at most, as float32
BINS = 30
TAIL_SD = 5.0
CameraType = Literal["CCD", "EMCCD", "CMOS"]


@dataclass(frozen=True)
class Value:
    """A measured number and its standard error (nan where it was given or cannot be known)."""

    value: float
    sd: float

    def __str__(self) -> str:
        return f"{self.value:.4g} ± {self.sd:.2g}"


@dataclass(frozen=True)
class Calibration:
    """What `calibrate` found.

    Attributes
    ----------
    baseline_adu, read_noise_adu : from dark frames, or (baseline) where the variance vanishes
    slope_adu : variance over signal, F²·ADU per photoelectron
    adu_per_photoelectron : slope / excess_noise_factor
    clock_induced_charge_e : electrons per pixel and frame from the tail of the dark frames (nan: unknown)
    tail_fraction : share of dark pixels more than 5 sd above the baseline
    camera : a `Camera` with these values; curve : photon transfer (mean − baseline, variance − dark) in ADU
    notes : what was assumed
    """

    baseline_adu: Value
    read_noise_adu: Value
    slope_adu: Value
    adu_per_photoelectron: Value
    excess_noise_factor: float
    clock_induced_charge_e: Value
    tail_fraction: float
    camera: Camera
    curve: tuple[NDArray[np.float64], NDArray[np.float64]]
    notes: list[str] = field(default_factory=list)

    def report(self) -> dict[str, Any]:
        """Plain data: every value with its standard error, the camera, the assumptions."""
        names = ("baseline_adu", "read_noise_adu", "slope_adu", "adu_per_photoelectron", "clock_induced_charge_e")
        return {
            **{name: {"value": getattr(self, name).value, "sd": getattr(self, name).sd} for name in names},
            "excess_noise_factor": self.excess_noise_factor,
            "tail_fraction": self.tail_fraction,
            "camera": self.camera.model_dump(mode="json"),
            "curve": {"signal_adu": self.curve[0].tolist(), "variance_adu2": self.curve[1].tolist()},
            "notes": self.notes,
        }


def calibrate(
    movie: Any,
    dark: Any = None,
    *,
    camera_type: CameraType = "EMCCD",
    em_gain: float | None = None,
    electrons_per_adu: float | None = None,
    quantum_efficiency: float = 0.9,
    excess_noise_factor: float | None = None,
    baseline_adu: float | None = None,
    read_noise_adu: float | None = None,
    adc_max: int = 65535,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Calibration:
    """Measure the camera from a movie and its dark frames.

    Parameters
    ----------
    movie : (frame, y, x) ADU under light that is steady from frame to frame
    dark : (frame, y, x) frames without light; without them dark frames at the movie's beginning are looked
        for, and failing that the baseline is where the fitted variance vanishes (then it is a lower bound:
        read noise is taken as `read_noise_adu` or 0)
    em_gain, electrons_per_adu : photon transfer measures only their ratio; give one (default: gain 300 for
        an EMCCD) and the other follows
    excess_noise_factor : F² of the multiplication; None: 2 for an EMCCD, 1 else
    baseline_adu, read_noise_adu : known values, instead of dark frames

    Raises
    ------
    MufasaError : too few frames, or no dark frames and too little range of light for a line.
    """
    shape = tuple(getattr(movie, "shape", ()))
    if len(shape) != 3 or shape[0] < 4:
        raise MufasaError(f"movie has shape {shape}: calibration needs at least 4 frames (frame, y, x)")
    notes: list[str] = []
    first = 0
    if dark is None and baseline_adu is None:
        first = leading_dark_frames(movie)
        if first:
            dark = np.asarray(movie[:first])
            notes.append(f"frames 0 to {first - 1} are dark and were used as dark frames")
    base, read, tail, values = _dark(dark, baseline_adu, read_noise_adu, shape[1:], notes)
    means, variances = _photon_transfer(movie, first, progress, cancel)
    steady = _steady(means, variances)
    means, variances = means[:, steady], variances[:, steady]
    if np.isnan(base.value):
        base, slopes = _line(means, variances, int(shape[0]) - first, read.value, notes)
    else:
        slopes = np.array([_slope(m - base.value, v - read.value**2) for m, v in zip(means, variances, strict=True)])
    slopes = slopes[np.isfinite(slopes)]
    if len(slopes) == 0 or np.median(slopes) <= 0:
        raise MufasaError(
            "the variance does not grow with the signal: the movie is dark, saturated or already processed; "
            "give raw frames under light"
        )
    slope = Value(float(np.mean(slopes)), float(np.std(slopes) / np.sqrt(max(len(slopes) - 1, 1))))
    factor = excess_noise_factor or (2.0 if camera_type == "EMCCD" else 1.0)
    notes.append(f"excess noise factor {factor:g} " + ("given" if excess_noise_factor else f"assumed ({camera_type})"))
    per_electron = Value(slope.value / factor, slope.sd / factor)
    charge = _clock_induced(values, base.value, read.value, per_electron.value)
    camera = _camera(
        camera_type, per_electron.value, em_gain, electrons_per_adu, quantum_efficiency, base.value, read.value,
        charge.value, adc_max, notes,
    )  # fmt: skip
    return Calibration(
        base, read, slope, per_electron, factor, charge, tail, camera,
        _curve(means.mean(axis=0) - base.value, variances.mean(axis=0) - np.nan_to_num(read.value) ** 2), notes,
    )  # fmt: skip


def _counts(data: Any, what: str) -> NDArray[Any]:
    """Raw counts; raises `MufasaError` for what no camera records."""
    counts: NDArray[Any] = np.asarray(data)
    if counts.dtype.kind not in "uif" or not np.isfinite(counts).all() or (counts.size and counts.min() < 0):
        raise MufasaError(f"{what} hold values that are negative or no numbers: give the raw counts (ADU)")
    return counts


def leading_dark_frames(movie: Any) -> int:
    """How many frames at the beginning are dark: before a sudden, lasting rise of the mean; 0 if none."""
    n = int(movie.shape[0])
    step = max(1, int(np.sqrt(movie.shape[1] * movie.shape[2] / 4096)))
    level = np.array([float(np.mean(np.asarray(movie[i])[::step, ::step])) for i in range(min(n, 500))])
    if len(level) < 8:
        return 0
    jumps = np.diff(level)
    at = int(np.argmax(jumps))
    before, after = level[: at + 1], level[at + 1 :]
    if len(before) < 3 or len(after) < 3:
        return 0
    usual = max(float(np.std(before)), 1e-9)
    # The first lit frame may be lit in part; the dark ones are alike and all below all lit ones.
    return at + 1 if before.max() + 10 * usual < after.min() else 0


def _dark(
    dark: Any, baseline: float | None, read_noise: float | None, shape: tuple[int, ...], notes: list[str]
) -> tuple[Value, Value, float, NDArray[np.float64] | None]:
    """Baseline (BL of SPEC.md §4, half a count above the recorded mean), read noise, tail, dark values."""
    nan = float("nan")
    if dark is None:
        base = Value(nan if baseline is None else float(baseline), nan)
        read = Value(0.0 if read_noise is None else float(read_noise), nan)
        if baseline is None:
            notes.append(f"no dark frames: read noise taken as {read.value:g} ADU, baseline from the variance")
        return base, read, nan, None
    dark = _counts(dark, "dark frames").astype(np.float64)
    if np.ndim(dark) != 3 or dark.shape[1:] != tuple(shape):
        raise MufasaError(f"dark has shape {dark.shape}, the movie's frames are {tuple(shape)}: give the same region")
    if dark.size == 0:
        raise MufasaError(f"dark has shape {dark.shape}: give at least one dark frame, better 50")
    pixel = np.median(dark, axis=0) if len(dark) > 4 else np.full(shape, np.median(dark))
    values = (dark - pixel).ravel()
    # Whole counts make the median deviation coarse: a random part of a count smooths it, and is taken off again.
    smooth = values + np.random.default_rng(0).uniform(-0.5, 0.5, values.size)
    sd = np.sqrt(max(float(1.4826 * np.median(np.abs(smooth))) ** 2 - 1 / 12, 0.0))
    sd *= np.sqrt(len(dark) / max(len(dark) - 1.57, 1.0)) if len(dark) > 4 else 1.0  # the median took its part
    core = values[np.abs(values) < TAIL_SD * max(sd, 0.5)]
    # Each frame's own offset (it wanders together) is the uncertainty of the mean, not the number of pixels.
    per_frame = np.array([np.mean(f[np.abs(f - np.median(f)) < TAIL_SD * max(sd, 0.5)]) for f in dark])
    base = Value(
        float(baseline) if baseline is not None else float(per_frame.mean()) + 0.5,
        float(per_frame.std() / np.sqrt(len(per_frame))) if len(per_frame) > 1 else nan,
    )
    read = Value(
        float(read_noise) if read_noise is not None else float(np.sqrt(max(sd**2 - 1 / 12, 0.0))),
        float(sd / np.sqrt(2 * len(core))),
    )
    return base, read, float(np.mean(values > TAIL_SD * max(sd, 0.5))), values


def _photon_transfer(
    movie: Any, first: int, progress: Callable[[int, int], None] | None, cancel: Callable[[], bool] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance of every pixel in every chunk of the movie, each (chunk, pixel)."""
    edges = np.linspace(first, movie.shape[0], CHUNKS + 1).astype(int)
    if edges[1] - edges[0] < 4:
        edges = np.array([first, movie.shape[0]])
    means, variances = [], []
    for i, (start, stop) in enumerate(itertools.pairwise(edges)):
        if cancel is not None and cancel():
            raise Cancelled
        most = max(4, CHUNK_BYTES // (4 * movie.shape[1] * movie.shape[2]))
        stack = _counts(movie[start : min(stop, start + most)], "the movie's frames").astype(np.float32)
        if len(stack) < 4:
            continue
        # Second differences take a steady change of light out as well: var = mean(d²)/6.
        second = stack[2:] - 2 * stack[1:-1] + stack[:-2]
        means.append(stack.mean(axis=0, dtype=np.float64).ravel())
        variances.append((second**2).mean(axis=0, dtype=np.float64).ravel() / 6)
        if progress is not None:
            progress(i + 1, len(edges) - 1)
    if not means:
        raise MufasaError("fewer than 4 lit frames: record more frames under light")
    return np.array(means), np.array(variances)


def _steady(means: NDArray[np.float64], variances: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(pixel,) True where the variance over the whole movie is like that of pixels with the same mean.

    Blinking, bleaching and moving molecules add variance of their own. They are flagged on the whole movie,
    where the variance of a pixel is well known, so that the parts of the movie can then be averaged plainly:
    a median over pixels with few frames each would be too low, the sample variance being skewed.
    """
    mean, variance = means.mean(axis=0), variances.mean(axis=0)
    if len(mean) < 40:
        return np.ones(len(mean), dtype=bool)
    steady = np.zeros(len(mean), dtype=bool)
    for members in _bins(mean):
        middle = np.median(variance[members])
        spread = 1.4826 * np.median(np.abs(variance[members] - middle))
        steady[members] = np.abs(variance[members] - middle) <= 3 * spread
    return steady


def _bins(mean: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Pixels grouped by their mean."""
    return np.array_split(np.argsort(mean), min(BINS, max(1, len(mean) // 20)))


def _curve(
    signal: NDArray[np.float64], variance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean signal and mean variance of each bin."""
    bins = _bins(signal)
    return np.array([signal[b].mean() for b in bins]), np.array([variance[b].mean() for b in bins])


def _slope(signal: NDArray[np.float64], variance: NDArray[np.float64]) -> float:
    """Slope through the origin: the median over bins of variance over signal."""
    x, y = _curve(signal, variance)
    lit = x > 0.2 * np.percentile(x, 90)
    return float(np.median(y[lit] / x[lit])) if lit.any() else float("nan")


def _line(
    means: NDArray[np.float64], variances: NDArray[np.float64], n_frames: int, read_noise: float, notes: list[str]
) -> tuple[Value, NDArray[np.float64]]:
    """Baseline and slope from a robust line of variance against mean, chunk by chunk."""
    from scipy.stats import theilslopes

    fits = []
    # Pixels are grouped by their mean over the whole movie: grouped by the noise of a part of it, the noise
    # itself would look like light.
    overall = means.mean(axis=0)
    own_noise = np.sqrt(variances.mean() / n_frames)
    bins = _bins(overall) if np.std(overall) > 2 * own_noise else []
    for m, v in zip(means, variances, strict=True):
        x, y = np.array([m[b].mean() for b in bins]), np.array([v[b].mean() for b in bins])
        if len(x) == 0:
            break
        keep = x <= np.percentile(x, 90)  # the brightest bins hold the molecules, which blink
        if keep.sum() < 5 or np.ptp(x[keep]) < 0.02 * abs(x[keep].mean()):
            continue
        slope, intercept = theilslopes(y[keep], x[keep])[:2]
        fits.append((float(slope), -(float(intercept) - read_noise**2) / float(slope) if slope else float("nan")))
    if not fits:
        raise MufasaError(
            "without dark frames the light must differ between pixels, and here it does not: "
            "record dark frames (shutter closed), or give baseline_adu (--baseline-adu)"
        )
    slopes, baselines = np.array(fits).T
    notes.append("baseline extrapolated to zero variance: dark frames would be far more certain")
    return Value(float(np.median(baselines)) + 0.5, float(np.std(baselines) / np.sqrt(len(baselines)))), slopes


def _clock_induced(
    values: NDArray[np.float64] | None, base: float, read_noise: float, adu_per_electron: float
) -> Value:
    """Electrons per pixel from the tail: one spurious electron gives an exponential of mean one gain."""
    nan = float("nan")
    threshold = TAIL_SD * max(read_noise, 0.5)
    if values is None or threshold > 3 * adu_per_electron:  # the tail of one electron hides in the read noise
        return Value(nan, nan)
    n = int(np.count_nonzero(values > threshold))
    weight = np.exp(threshold / adu_per_electron) / values.size
    return Value(float(n * weight), float(np.sqrt(max(n, 1)) * weight))


def _camera(
    kind: CameraType, adu_per_electron: float, em_gain: float | None, electrons_per_adu: float | None,
    quantum_efficiency: float, baseline: float, read_noise_adu: float, charge: float, adc_max: int, notes: list[str],
) -> Camera:  # fmt: skip
    from napari_mufasa.model.setup import Camera

    if kind == "EMCCD":
        if em_gain is None and electrons_per_adu is None:
            em_gain = 300.0
            notes.append("EM gain 300 assumed: only gain over electrons per ADU is measured")
        if electrons_per_adu is None:
            electrons_per_adu = float(em_gain or 1) / adu_per_electron
        elif em_gain is None:
            em_gain = electrons_per_adu * adu_per_electron
    else:
        em_gain, electrons_per_adu = None, 1 / adu_per_electron
    curve = {"cmos_gain_curve": ((0.0, 0.0), (1.0, 1.0))} if kind == "CMOS" else {}
    return Camera(
        type=kind,
        quantum_efficiency=quantum_efficiency,
        read_noise_e=float(np.nan_to_num(read_noise_adu) * electrons_per_adu),
        clock_induced_charge_e=float(np.nan_to_num(charge)),
        electrons_per_adu=electrons_per_adu,
        baseline_adu=max(baseline, 0.0),
        adc_max=adc_max,
        em_gain=max(em_gain, 1.0) if em_gain is not None else None,
        **curve,
    )
