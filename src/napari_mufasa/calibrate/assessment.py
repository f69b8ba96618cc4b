"""What the light and the dark of a movie tell of its camera: read-out, conversion, noise, and whether the law fits.

Where the read-out mixes neighbours the slope of variance over mean is wrong by the sum of the correlations it gives
them; it is put right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate import histogram, rows, transfer, unlit
from napari_mufasa.calibrate.dark import Dark
from napari_mufasa.calibrate.found import LEVEL, Calibration, Readout
from napari_mufasa.calibrate.histogram import Fit
from napari_mufasa.calibrate.law import Law
from napari_mufasa.calibrate.light import Light
from napari_mufasa.calibrate.value import NORMAL, UNKNOWN, Value
from napari_mufasa.errors import MufasaError

Array = NDArray[np.float64]
LARGEST_MISFIT = 0.006  # share of counts elsewhere than the law says, above which its shape tells no excess noise
REJECTED = LEVEL / 3  # p-value below which a histogram is not believed: one of three tests
COARSE_ADU = 0.5  # read noise below which dark counts tell level and variance only as the baseline lies between them
COARSE_LEVEL_ADU, COARSE_VARIANCE = 0.2, 0.1  # whole counts: rms errors of both, by rounding a noise of 0.2 ADU
MOST_UNSURE = 1.0  # of the light's variance, that of a read noise anywhere in its interval: no conversion is told then


@dataclass(frozen=True)
class Assumed:
    """What is not measured but taken as given; None: measured (the excess noise: 2 for an EMCCD, 1 else)."""

    excess_noise_factor: float | None = None
    readout_kernel: tuple[float, ...] | None = None
    clock_induced_charge_e: float | None = None
    baseline_adu: float | None = None
    read_noise_adu: float | None = None


def weights_of(kernel: tuple[float, ...]) -> tuple[float, ...]:
    weights = np.array([1.0, *kernel])
    return tuple(float(w) for w in weights / weights.sum())


def assessed(light: Light, dark: Dark | None, assumed: Assumed, factor: float, notes: list[str]) -> Calibration:
    """Everything but the camera that is made of it."""
    read, dark_variance = _read_noise(dark, assumed)
    kernel, of_light = kernel_of(light, dark, dark_variance, assumed)
    correction = 1 + 2 * float(np.sum(of_light))
    kernel_sd = light.kernel_sd(None if dark is None else dark.rows, dark_variance)
    believed = kernel_sd[of_light != 0] if assumed.readout_kernel is None else np.zeros(0)
    doubt = 2 * float(np.sqrt(np.sum(believed**2))) / max(correction, 0.05)
    law = Law(1.0, factor, 0.0, 0.0, weights_of(kernel))
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


def kernel_of(
    light: Light, dark: Dark | None, dark_variance: float, assumed: Assumed
) -> tuple[tuple[float, ...], Array]:
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
    return dark.baseline, dark.mean_adu if dark.fit is None else dark.level


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
    slopes = transfer.slopes_through_origin(light.means - level, light.variances - dark_variance)
    slopes = [correction * slope for slope in slopes]
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
        share = min(dark_variance / max(seen.variance, 1e-9), 1.0)  # a lone pixel has no row
        of_noise = np.zeros(rows.LAGS) if assumed.readout_kernel == () else dark.rows.row - dark.rows.column
        expected = of_light * (1 - share) + of_noise * share
        variance += 2 * (share * dark.rows.sd) ** 2
    tested = np.ones(rows.LAGS, dtype=bool) if assumed.readout_kernel is not None else of_light == 0
    if not tested.any():
        return 1.0
    left = (seen.row - seen.column - expected) ** 2 / variance
    return float(stats.chi2.sf(left[tested].sum(), int(tested.sum())))
