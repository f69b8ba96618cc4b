"""The camera from its own movies: what dark counts, the growth of variance with light, neighbours and histograms tell.

At constant light the variance of a pixel in time grows with its mean: slope = F²·(ADU per photoelectron), with
the excess noise factor F² = 2 for electron multiplication and 1 without (docs/camera.md). Differences of successive
frames take slow changes of the light out of the variance; medians over pixels of like mean take blinking out. A
read-out that mixes neighbours makes that slope wrong by the sum of the correlations it gives them; it is put right.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.calibrate import histogram, rows, transfer, unlit
from napari_mufasa.calibrate.codes import code_widths, saturated_pixels, saturation_adu
from napari_mufasa.calibrate.dark import Dark, checked_dark, measure_dark
from napari_mufasa.calibrate.found import Calibration, Readout
from napari_mufasa.calibrate.histogram import Fit
from napari_mufasa.calibrate.instrument import camera_of
from napari_mufasa.calibrate.kind import doubt
from napari_mufasa.calibrate.law import Law
from napari_mufasa.calibrate.light import Light
from napari_mufasa.calibrate.sample import leading_dark_frames, lit_chunks, shadow
from napari_mufasa.calibrate.value import NORMAL, UNKNOWN, Value
from napari_mufasa.camera.darkness import FRAMES as LOOKED_AT
from napari_mufasa.camera.darkness import light_in_dark
from napari_mufasa.errors import MufasaError

Array = NDArray[np.float64]
CameraType = Literal["CCD", "EMCCD", "CMOS"]
LARGEST_MISFIT = 0.006  # share of counts elsewhere than the law says, above which its shape tells no excess noise
REJECTED = 0.006  # p-value below which a histogram is not believed: three tests at 2 %
COARSE_ADU = 0.5  # read noise below which dark counts tell level and variance only as the baseline lies between them
COARSE_LEVEL_ADU, COARSE_VARIANCE = 0.2, 0.1  # whole counts: rms errors of both, by rounding a noise of 0.2 ADU
MOST_UNSURE = 1.0  # of the light's variance, that of a read noise anywhere in its interval: no conversion is told then
LEAST_UNSATURATED = 0.02  # share of the pixels that must be free of saturation for the others to be left out
WIDE_PX = 32  # frames from which on the first columns can be spared
DARK_CHARGE_E = 1.0  # electrons per pixel and frame below which a shadow counts as dark


@dataclass(frozen=True)
class Assumed:
    """What is not measured but taken as given; None: measured (the excess noise: 2 for an EMCCD, 1 else)."""

    excess_noise_factor: float | None = None
    readout_kernel: tuple[float, ...] | None = None
    clock_induced_charge_e: float | None = None
    baseline_adu: float | None = None
    read_noise_adu: float | None = None


def calibrate(
    movie: Any,
    dark: Any = None,
    *,
    camera_type: CameraType = "EMCCD",
    em_gain: float | None = None,
    electrons_per_adu: float | None = None,
    quantum_efficiency: float = 0.9,
    excess_noise_factor: float | None = None,
    readout_kernel: Sequence[float] | None = None,
    clock_induced_charge_e: float | None = None,
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
        for, then a part of the chip in shadow, and failing that the baseline is where the fitted variance vanishes,
        with the read noise that the histogram shows: intervals are wider then
    em_gain, electrons_per_adu : photon transfer measures only their ratio; give one (default: gain 300 for
        an EMCCD) and the other follows
    excess_noise_factor : F² of the multiplication; None: 2 for an EMCCD, 1 else
    readout_kernel, clock_induced_charge_e : taken so instead of measured; () and 0: none, () of the read noise, too
    baseline_adu, read_noise_adu : known values, instead of dark frames; with the baseline alone the read noise is what
        the histogram shows

    Raises
    ------
    MufasaError : too few frames; a movie no brighter than the dark; an EM gain of a camera that has none; no dark
        frames and too little range of light for a line, or a baseline alone that leaves the read noise open.
    """
    movie = checks.stack(movie)
    shape = tuple(movie.shape)
    if shape[0] < 4:
        raise MufasaError(f"movie has shape {shape}: calibration needs at least 4 frames (frame, y, x)")
    check_given(camera_type, em_gain, electrons_per_adu, quantum_efficiency, excess_noise_factor, baseline_adu)
    if dark is not None:
        dark = checks.stack(dark, "dark")
        if dark.shape[1:] == shape[1:] and (told := light_in_dark(movie, dark)):
            warnings.warn(told, stacklevel=2)
    kernel = None if readout_kernel is None else tuple(float(share) for share in readout_kernel)
    assumed = Assumed(excess_noise_factor, kernel, clock_induced_charge_e, baseline_adu, read_noise_adu)
    register, notes = camera_type == "EMCCD", []
    first = 0
    if dark is None and baseline_adu is None:
        first = leading_dark_frames(movie)
        dark = np.asarray(movie[:first]) if first else None
        if first and light_in_dark(_spread(movie, first), dark):
            notes.append(
                f"frames 0 to {first - 1} are darker, but show what the others show: not taken for dark frames"
            )
            first, dark = 0, None
        elif first:
            notes.append(f"frames 0 to {first - 1} are dark and were used as dark frames")
    chunks = lit_chunks(movie, first, progress, cancel)
    lit = np.ones(shape[1:], dtype=bool)
    if shape[2] >= WIDE_PX:
        lit[:, : rows.LAGS] = False  # what was read before them is not in the movie
    frames, shaded, seen_dark = None, None, None
    if dark is not None:
        frames = checked_dark(dark, shape[1:])
    elif baseline_adu is None and register:
        shaded = shadow(chunks)
        frames = None if shaded is None else np.concatenate(chunks).astype(np.float64)
    if frames is not None:
        seen_dark = measure_dark(frames, register, shaded, clock_induced_charge_e)
        if shaded is not None and not _is_dark(seen_dark):
            frames, shaded, seen_dark = None, None, None
    if shaded is not None:
        lit &= ~shaded
        notes.append(f"{100 * shaded.mean():.0f} % of the pixels lie in shadow and were used in place of dark frames")
    full = saturation_adu([chunk[:, lit] for chunk in chunks])
    if full is not None:
        notes.append(f"counts pile up at {full:g} ADU: the movie is saturated there; {_spared(chunks, lit, full)}")
    seen = Light(chunks, lit, shape[0] - first)
    if seen_dark is not None and frames is not None and (seen_dark.charge.value > 0 or seen_dark.stray):
        # What an electron looks like in the dark depends on the kernel, which the light tells.
        weights = _weights(_kernel(seen, seen_dark, seen_dark.variance, assumed)[0])
        if len(weights) > 1:
            seen_dark = measure_dark(frames, register, shaded, clock_induced_charge_e, weights)
    factor = excess_noise_factor or (2.0 if register else 1.0)
    notes.append(f"excess noise factor {factor:g} " + ("given" if excess_noise_factor else f"assumed ({camera_type})"))
    found = _measured(seen, seen_dark, assumed, factor, notes)
    stacks = [chunk[:, lit] for chunk in chunks]
    camera, gains = camera_of(
        camera_type, found, em_gain, electrons_per_adu, quantum_efficiency, seen_dark, assumed, adc_max,
        code_widths(stacks), notes,
    )  # fmt: skip
    if register and (told := doubt(found)) is not None:
        notes.insert(0, told)
    if full is not None:
        camera = camera.model_copy(update={"adc_max": min(int(full), camera.adc_max)})
    return replace(found, camera=camera, em_gain=gains[0], electrons_per_adu=gains[1], saturation_adu=full)


def check_given(
    camera_type: Any, em_gain: Any, electrons_per_adu: Any, quantum_efficiency: Any, excess_noise_factor: Any = None,
    baseline_adu: Any = None,
) -> None:  # fmt: skip
    """Values that the user knows, within what a camera can have."""
    checks.choice(camera_type, "camera_type", get_args(CameraType))
    checks.number(quantum_efficiency, "quantum_efficiency", 1e-3, 1)
    known = {
        "em_gain": (em_gain, 1, 1e5), "electrons_per_adu": (electrons_per_adu, 1e-6, 1e6),
        "excess_noise_factor": (excess_noise_factor, 1, 4), "baseline_adu": (baseline_adu, 0, 65535),
    }  # fmt: skip
    for name, (value, least, most) in known.items():
        if value is not None:
            checks.number(value, name, least, most)
    if em_gain is not None and em_gain > 1 and camera_type != "EMCCD":
        raise MufasaError(f"em_gain = {em_gain:g}: a {camera_type} does not multiply; drop it, or choose EMCCD")


def _spread(movie: Any, first: int) -> NDArray[Any]:
    """Some frames (frame, y, x) of those from `first` on."""
    chosen = np.linspace(first, movie.shape[0] - 1, LOOKED_AT).astype(int)
    return np.stack([np.asarray(movie[int(t)]) for t in chosen])


def _spared(chunks: list[NDArray[np.float32]], lit: NDArray[np.bool_], full: float) -> str:
    """Take the pixels that reach `full` out of `lit` (y, x), in place, as long as enough are left; words for it."""
    kept = lit & ~saturated_pixels(chunks, full)
    if kept.sum() <= max(9, LEAST_UNSATURATED * lit.sum()):
        return "hardly a pixel is free of it, so that ADU per photoelectron cannot be right: record with less light"
    words = f"{100 * (1 - kept.sum() / lit.sum()):.2g} % of the pixels come near it and were left out"
    lit &= kept
    return words


def _is_dark(shaded: Dark) -> bool:
    """Whether a part of the chip is dark, not just dim and even: electrons would show, one by one or as stray ones."""
    electrons = shaded.charge if shaded.stray is None else shaded.stray.electrons
    return shaded.fit is not None and not electrons.value > DARK_CHARGE_E


def _weights(kernel: tuple[float, ...]) -> tuple[float, ...]:
    weights = np.array([1.0, *kernel])
    return tuple(float(w) for w in weights / weights.sum())


def _measured(light: Light, dark: Dark | None, assumed: Assumed, factor: float, notes: list[str]) -> Calibration:
    """Everything but the camera that is made of it."""
    read, dark_variance = _read_noise(dark, assumed)
    kernel, of_light = _kernel(light, dark, dark_variance, assumed)
    correction = 1 + 2 * float(np.sum(of_light))
    kernel_sd = light.kernel_sd(None if dark is None else dark.rows, dark_variance)
    believed = kernel_sd[of_light != 0] if assumed.readout_kernel is None else np.zeros(0)
    doubt = 2 * float(np.sqrt(np.sum(believed**2))) / max(correction, 0.05)
    law = Law(1.0, factor, 0.0, 0.0, _weights(kernel))
    fits: list[Fit] = [dark.fit] if dark is not None and dark.fit is not None else []
    known = dark is not None or assumed.baseline_adu is not None
    seen = histogram.of_light(light.chunks, light.quiet)
    if known:
        base, level = _base(dark, assumed)
        _check_brighter(light, level, base.sd)
        if dark is None and assumed.read_noise_adu is None:
            read = _read_noise_above(light, seen, law, level, notes)
            dark_variance = read.value**2 + 1 / 12
        slope, curve = _slope(light, level, base.sd, dark_variance, read, correction, doubt)
        if dark is not None and read.value < COARSE_ADU:
            notes.append(
                f"the read noise is below {COARSE_ADU:g} ADU: whole counts hide how dark frames scatter, and the "
                "interval of ADU per photoelectron is wider for it; fewer electrons per ADU would tell more"
            )
        charge = dark.charge if dark is not None else Value(assumed.clock_induced_charge_e or 0.0, float("nan"))
        law = replace(law, read_noise_adu=read.value, charge_e=float(np.nan_to_num(charge.value)))
    else:
        charge = UNKNOWN
        slopes, zeros = transfer.line(*light.wider)
        means, variances = light.wider
        others = [float(np.mean(found)) for found in transfer.line(means, variances + light.common)]
        left = abs(others[0] / float(np.mean(slopes)) - 1)
        slope = transfer.mean_of(list(slopes * correction), float(np.hypot(doubt, left)), light.counts_each)
        base, curve = UNKNOWN, (np.empty(0), np.empty(0))
    law = replace(law, adu_per_electron=slope.value / factor)
    excess = UNKNOWN
    per_electron = slope.over(factor)
    if known and seen is not None:
        law = replace(law, adu_per_electron=slope.value / factor)
        beneath = base.value
        if dark is not None and dark.stray is not None:
            beneath = dark.stray.offset_adu.value
            law = replace(law, read_noise_adu=dark.stray.read_noise_adu.value, charge_e=0.0)
            notes.append(_stray_words(dark))
        fit = histogram.fit("light", seen, law, ("adu_per_electron",), beneath)
        if factor > 1:
            start = replace(law, excess_noise_factor=1.8)
            free = histogram.fit("light", seen, start, ("adu_per_electron", "excess_noise_factor"), beneath)
            excess = free.values["excess_noise_factor"] if _tells_shape(free) else UNKNOWN
            told = assumed.excess_noise_factor is None and np.isfinite(excess.value)
            if told and fit.p_value < REJECTED < free.p_value:
                fit, per_electron = free, _either(slope, factor, excess)
                notes.append(_excess_words(slope, factor, excess))
        fits.append(fit)
    elif not known:
        base, read, darkest = _without_dark(
            light, unlit.level_of_no_variance(zeros, others[1]), seen, law, slope, assumed, notes
        )
        fits += [] if darkest is None else [darkest]
        level = base.value - 0.5
        curve = transfer.curve(light.means.mean(axis=0) - level, light.variances.mean(axis=0) - read.value**2)
    readout = Readout(
        kernel=kernel,
        noise_kernel=() if assumed.readout_kernel == () else _noise_kernel(dark, of_light, dark_variance, slope.value),
        shares=() if assumed.readout_kernel is not None else rows.shares_of(of_light, kernel_sd),
        row_correlations=light.rows.row,
        column_correlations=light.rows.column,
        everywhere_row=_over_parts(light.everywhere.row, [part.row for part in light.everywhere_of_parts], light),
        everywhere_column=_over_parts(
            light.everywhere.column, [part.column for part in light.everywhere_of_parts], light
        ),
        correlations_sd=light.rows.sd,
        dark_row_correlations=None if dark is None or dark.rows is None else dark.rows.row,
        alternation_adu=UNKNOWN if dark is None else dark.alternation,
        jitter_adu=UNKNOWN if dark is None else dark.jitter,
    )
    return Calibration(
        baseline_adu=base, read_noise_adu=read, slope_adu=slope, adu_per_photoelectron=per_electron,
        excess_noise_factor=factor, excess_noise_measured=excess, clock_induced_charge_e=charge,
        tail_fraction=float("nan") if dark is None else dark.tail_share, readout=readout, fits=tuple(fits),
        row_p_value=_row_p_value(light, of_light, dark, dark_variance, assumed), curve=curve, notes=notes,
        stray=None if dark is None else dark.stray,
    )  # fmt: skip


def _over_parts(whole: Array, parts: list[Array], light: Light) -> tuple[Value, ...]:
    """Correlations (lag,) of the whole movie with what its parts say of their error."""
    sd = np.full(len(whole), light.everywhere.sd)
    if len(parts) > 1:
        sd = np.maximum(sd, np.std(parts, axis=0, ddof=1) / np.sqrt(len(parts)))
    return tuple(Value(float(value), float(error)) for value, error in zip(whole, sd, strict=True))


def _stray_words(dark: Dark) -> str:
    assert dark.stray is not None
    stray = dark.stray
    return (
        f"the dark frames are not quite dark: their histogram is that of {stray.electrons} electrons per pixel and "
        f"frame, {stray.adu_per_electron} ADU each, above an offset of {stray.offset_adu} ADU with a read noise of "
        f"{stray.read_noise_adu} ADU (stray light or dark current); baseline and read noise are told as the frames "
        "have them, electrons included"
    )


def _either(slope: Value, factor: float, excess: Value) -> Value:
    """ADU per photoelectron where the excess noise may be as assumed or as the histogram has it."""
    one, other = slope.over(factor), slope.over(excess.value)
    low = min(one.interval[0], slope.interval[0] / excess.interval[1])
    high = max(one.interval[1], slope.interval[1] / excess.interval[0])
    return Value(one.value, max(one.sd, abs(one.value - other.value) / 2), low, high)


def _excess_words(slope: Value, factor: float, excess: Value) -> str:
    low, high = excess.interval
    return (
        f"by the shape of the histograms F² is {excess.value:.3g} ({low:.3g} to {high:.3g}), not {factor:g}: a "
        f"photoelectron then makes {slope.value / excess.value:.3g} ADU instead of {slope.value / factor:.3g}; the "
        "interval holds both"
    )


def _tells_shape(fit: Fit) -> bool:
    """Whether a histogram is so much as its law that a number may be read off its shape."""
    low, high = fit.values["excess_noise_factor"].interval
    return (fit.p_value > 1e-4 or fit.distance < LARGEST_MISFIT) and high < 4 * low


def _read_noise(dark: Dark | None, assumed: Assumed) -> tuple[Value, float]:
    """Read noise, and the variance that is not of the light."""
    if assumed.read_noise_adu is not None:
        given = float(assumed.read_noise_adu)
        return Value(given, float("nan")), given**2 + 1 / 12
    if dark is None:
        return Value(0.0, float("nan")), 0.0
    return dark.read_noise, dark.variance


def _kernel(light: Light, dark: Dark | None, dark_variance: float, assumed: Assumed) -> tuple[tuple[float, ...], Array]:
    """Shares of the pixels before, and the correlations (lag,) that they give to light."""
    if assumed.readout_kernel is not None:
        weights = np.array([1.0, *assumed.readout_kernel])
        law = np.zeros(rows.LAGS)
        given = np.correlate(weights, weights, "full")[len(weights) :] / np.sum(weights**2)
        law[: len(given)] = given[: rows.LAGS]
        return assumed.readout_kernel, law
    found = rows.of_light(light.rows, None if dark is None else dark.rows, dark_variance)
    return rows.kernel_of(found), found


def _noise_kernel(dark: Dark | None, of_light: Array, dark_variance: float, slope: float) -> tuple[float, ...]:
    """The kernel of the read noise: dark correlations without what spurious electrons, as light, have of them."""
    if dark is None or dark.rows is None:
        return rows.kernel_of(of_light)  # the best guess: the same amplifier
    own = np.zeros(rows.LAGS)
    own[: len(dark.rows.kernel)] = dark.rows.kernel
    if not own.any():
        return ()
    read = dark.read_noise.value**2
    electrons = max(dark_variance - read, 0.0) if dark.charge.value > 0 else 0.0
    return rows.kernel_of((own * (read + electrons) - of_light[: rows.LAGS] * electrons) / max(read, 1e-9))


def _base(dark: Dark | None, assumed: Assumed) -> tuple[Value, float]:
    """BL, and the recorded mean without light."""
    if assumed.baseline_adu is not None:
        return Value(float(assumed.baseline_adu), float("nan")), float(assumed.baseline_adu) - 0.5
    assert dark is not None
    return dark.baseline, float(dark.mean_map.mean()) if dark.fit is None else dark.level


def _check_brighter(light: Light, level: float, level_sd: float) -> None:
    signal = float(np.mean(light.means)) - level
    if signal <= NORMAL * float(np.nan_to_num(level_sd)):
        raise MufasaError(
            f"the movie is no brighter than the dark ({signal + level:.6g} and {level:.6g} ADU): give frames without "
            "light as dark frames, and a movie under light"
        )


def _slope(
    light: Light, level: float, level_sd: float, dark_variance: float, read: Value, correction: float, doubt: float
) -> tuple[Value, tuple[Array, Array]]:
    slopes = [
        correction * transfer.slope_through_origin(m - level, v - dark_variance)
        for m, v in zip(light.means, light.variances, strict=True)
    ]
    signal = float(np.mean(light.means)) - level
    shared = float(np.nan_to_num(level_sd)) / max(abs(signal), 1e-9)
    grown = max(float(np.mean(light.variances)) - dark_variance, 1e-9)
    low, high = (float(np.nan_to_num(end, nan=read.value)) for end in read.interval)
    unsure = max(high**2 - read.value**2, read.value**2 - max(low, 0.0) ** 2) / NORMAL
    shared = float(np.hypot(shared, unsure / grown))
    if read.value < COARSE_ADU:
        shared = float(np.hypot(shared, np.hypot(COARSE_LEVEL_ADU / max(abs(signal), 1e-9), COARSE_VARIANCE / grown)))
    slope = transfer.mean_of(slopes, float(np.hypot(shared, doubt)), light.counts_each)
    curve = transfer.curve(light.means.mean(axis=0) - level, light.variances.mean(axis=0) - dark_variance)
    return slope, curve


def _without_dark(
    light: Light, zero: tuple[float, float], seen: histogram.Histogram | None, law: Law, slope: Value,
    assumed: Assumed, notes: list[str],
) -> tuple[Value, Value, Fit | None]:  # fmt: skip
    """Baseline and read noise of a movie that is lit everywhere.

    The line of variance against mean tells the level at which there would be no variance; the baseline lies higher, by
    the read noise's variance over the slope. How much read noise there is, the histogram of the darkest pixels shows.
    """
    raw_slope = slope.value * float(np.sum(np.square(law.weights)))
    level, error = zero
    notes.append("baseline extrapolated to zero variance: dark frames would be far more certain")
    if assumed.read_noise_adu is not None or seen is None:
        read, fit = Value(assumed.read_noise_adu or 0.0, float("nan")), None
        highest = read.value
    else:
        read, level, fit = unlit.read_noise(seen, law, zero, raw_slope, _most_read_noise(light))
        highest = read.interval[1]
        notes.append("read noise from the histogram of the darkest pixels: dark frames would be far more certain")
    low, high = zero[0] + 0.5 - NORMAL * error, zero[0] + 0.5 + highest**2 / raw_slope + NORMAL * error
    base = min(max(level + 0.5 + read.value**2 / raw_slope, low, 0.0), high)
    return Value(base, float((high - low) / (2 * NORMAL)), min(max(low, 0.0), base), max(high, base)), read, fit


def _read_noise_above(
    light: Light, seen: histogram.Histogram | None, law: Law, level: float, notes: list[str]
) -> Value:
    """Read noise of a movie without dark frames whose baseline is known: what the histogram of the darkest pixels
    leaves of it, by its shape and by how its variance grows above `level` (recorded mean without light, ADU).

    Raises `MufasaError` where it leaves too much open."""
    most, total = _most_read_noise(light), float(light.variances.mean())
    read = Value(0.0, most / NORMAL, 0.0, most)
    if seen is not None:
        signal = float(light.means.mean()) - level
        start = replace(law, adu_per_electron=total / signal / law.excess_noise_factor)
        read, _, _ = unlit.read_noise(seen, start, (level, 0.0), np.inf, most)
    low, high = read.interval
    if high**2 - low**2 > MOST_UNSURE * max(total - read.value**2, 0.0):
        raise MufasaError(
            f"the movie does not tell its light's noise from the read noise, which may be {low:.3g} to {high:.3g} ADU: "
            "give dark frames, or calibrate's read_noise_adu beside the baseline_adu"
        )
    notes.append("read noise from the histogram of the darkest pixels: dark frames would be far more certain")
    return read


def _most_read_noise(light: Light) -> float:
    """The most read noise (ADU) there can be: all noise of the darkest pixels, and room for what is not known of it. Of
    many pixels, because each has shown only some of its noise in so few frames."""
    darkest = transfer.bins_of(light.means.mean(axis=0))[0]
    return 1.1 * float(np.sqrt(light.variances[:, darkest].mean()))


def _row_p_value(light: Light, of_light: Array, dark: Dark | None, dark_variance: float, assumed: Assumed) -> float:
    """Chance of the correlations along rows that neither the light's kernel nor the read noise explains; lags that the
    kernel was measured on say nothing."""
    from scipy import stats

    seen = light.rows
    expected, variance = of_light, np.full(rows.LAGS, 2 * seen.sd**2)
    if dark is not None and dark.rows is not None:
        share = min(dark_variance / seen.variance, 1.0)
        of_noise = np.zeros(rows.LAGS) if assumed.readout_kernel == () else dark.rows.row - dark.rows.column
        expected = of_light * (1 - share) + of_noise * share
        variance += 2 * (share * dark.rows.sd) ** 2
    tested = np.ones(rows.LAGS, dtype=bool) if assumed.readout_kernel is not None else of_light == 0
    if not tested.any():
        return 1.0
    left = (seen.row - seen.column - expected) ** 2 / variance
    return float(stats.chi2.sf(left[tested].sum(), int(tested.sum())))
