"""What frames without light tell: baseline, read noise, spurious electrons, and what the read-out does to both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate import histogram
from napari_mufasa.calibrate.histogram import Fit
from napari_mufasa.calibrate.law import Law
from napari_mufasa.calibrate.rows import Correlations, Products
from napari_mufasa.calibrate.sample import blocks, counts, window
from napari_mufasa.calibrate.value import NORMAL, UNKNOWN, Value

TAIL_SD = 5.0
MOST_COUNTS = 2**24  # that are looked at one by one …
LEAST_CHOSEN = 16  # … of so many frames at least
LEAST_FRAMES = 5  # for what needs each pixel's own mean
LOOK_FRAMES = 32  # by which hot pixels are told before the others are measured
HOT_SD = 6.0  # robust sd of the pixels' variances above their median, from which on a pixel is hot …
HOT_ALARM = 0.01  # … unless one of so many fields of like pixels has one by chance …
HOT_ADU2 = 1.0  # … or rounding makes it: of little noise it leaves many pixels none and others up to 1/4 ADU²
MEDIAN_ERROR = 1.17  # standard error of a normal sd that is told by the median, times √n over the sd
SURE = 3.5  # standard errors from which on an alternation is believed
JITTER_ALARM = 1e-3  # chance of so much scatter of the frames' means where no baseline jitters
GOOD = 0.01  # p-value of a normal law from which on no tail is looked for
MOST_CHARGE_E = 0.5  # spurious electrons per pixel and frame above which they are no separate tail
LEAST_TAIL = 12.0  # twice the gain in log likelihood that a tail must bring (false alarm about 1e-3)


@dataclass(frozen=True)
class Stray:
    """Electrons in dark frames that are more than single ones: stray light, dark current.

    `electrons` per pixel and frame, `adu_per_electron`, and the `offset_adu` and `read_noise_adu` beneath them, by the
    shape of the histogram.
    """

    electrons: Value
    adu_per_electron: Value
    offset_adu: Value
    read_noise_adu: Value


@dataclass(frozen=True)
class Dark:
    """Of dark frames, hot pixels apart.

    Attributes
    ----------
    baseline, read_noise, alternation, jitter : ADU; the baseline is BL of docs/camera.md: ½ above the recorded mean,
        spurious electrons taken off
    charge : electrons per pixel and frame, `gain` : ADU that one of them makes, both from the tail
    tail_share : share of counts more than 5 sd above the baseline
    variance : of a pixel in time, ADU², all of it
    rows : correlations of neighbours, None where frames are too few
    fit : the law against the histogram, None where frames are too few
    n_frames : how many there are
    stray : where the histogram shows that the frames are not quite dark; baseline and read noise are then those of the
        frames as they are, electrons included
    offset_map, variance_map : (y, x) of each pixel, hot ones too, above the mean and in time (ADU², None where frames
        are too few)
    mean_adu : recorded, electrons included
    """

    baseline: Value
    read_noise: Value
    charge: Value
    gain: Value
    alternation: Value
    jitter: Value
    tail_share: float
    variance: float
    rows: Correlations | None
    fit: Fit | None
    offset_map: NDArray[np.float64]
    variance_map: NDArray[np.float64] | None
    mean_adu: float
    n_frames: int
    stray: Stray | None = None

    @property
    def level(self) -> float:
        """The recorded mean without light, ADU."""
        single = self.charge.value * self.gain.value
        return self.baseline.value - 0.5 + (single if np.isfinite(single) else 0.0)


@dataclass(frozen=True)
class DarkFrames:
    """What is looked at of frames without light, ADU.

    per_frame (frame,) : mean of each, over `pixels` (y, x) · offset_map, variance_map (y, x) : mean of each pixel, and
    variance in time (ADU²), both beside what its frame has in common · some (frame, y, x) : counts that are looked at
    one by one, of frames spread over all, within `region`, what their frame has in common taken off · hot (y, x) : far
    noisier than others, in the maps, but not in `pixels`
    """

    per_frame: NDArray[np.float64]
    offset_map: NDArray[np.float64]
    variance_map: NDArray[np.float64]
    some: NDArray[np.float32]
    region: tuple[slice, slice]
    pixels: NDArray[np.bool_]
    hot: NDArray[np.bool_]

    @classmethod
    def of(
        cls, stacks: Sequence[Any], pixels: NDArray[np.bool_] | None = None,
        cancel: Callable[[], bool] | None = None, register: bool = True,
    ) -> DarkFrames:  # fmt: skip
        """Of stacks of counts (frame, y, x) that follow one another, arrays or lazy ones; `pixels` (y, x): dark is only
        what lies there, else the `window` is looked at. Held are `MOST_COUNTS` of them as float32 and a few maps.

        register : the camera may multiply: pixels are then hot by what lies below their median only, for single
            electrons lie above
        """
        shape = tuple(stacks[0].shape[1:])
        n, region = sum(len(stack) for stack in stacks), window(shape)
        there = np.zeros(shape, dtype=bool)
        there[region] = True
        mask = there if pixels is None else pixels
        hot = _hot(islice(_frames_of(stacks, cancel), LOOK_FRAMES), mask, region, register)
        mask = mask & ~hot
        most = max(LEAST_CHOSEN, MOST_COUNTS // int(there.sum()))
        chosen = set(np.linspace(0, n - 1, most).astype(int).tolist())
        per_frame, some = np.zeros(n), []
        first: NDArray[np.float64] | float = 0.0
        total, squares = np.zeros(shape), np.zeros(shape)
        for t, frame in enumerate(_frames_of(stacks, cancel)):
            per_frame[t] = frame[mask].mean()
            frame -= per_frame[t]
            if t in chosen:
                some.append(frame[region].astype(np.float32))
            first = frame.copy() if t == 0 else first
            frame -= first  # sums of what is small: they keep their digits
            total += frame
            squares += frame**2
        variance = np.maximum(squares - total**2 / n, 0.0) / max(n - 1, 1)
        return cls(per_frame, first + total / n, variance, np.stack(some), region, mask, hot)


def _hot(
    frames: Iterable[NDArray[np.float64]], mask: NDArray[np.bool_], region: tuple[slice, slice], register: bool
) -> NDArray[np.bool_]:
    """(y, x) True within `mask` where the noise is so far above that of the others that a few such pixels would make
    most of a mean variance."""
    from scipy import stats

    looked = np.stack([(frame[region] - np.median(frame[mask])).astype(np.float32) for frame in frames])
    found, n = np.zeros(mask.shape, dtype=bool), len(looked)
    if n < LEAST_FRAMES:
        return found
    looked -= np.median(looked, axis=0)
    noise = np.square(np.minimum(looked, 0) if register else looked).mean(axis=0, dtype=np.float64)
    own = noise[mask[region]]
    middle = float(np.median(own))
    spread = 1.4826 * float(np.median(np.abs(own - middle)))
    known = (n - 1) * (0.4 if register else 1)  # of a side: fewer, and its squares have a longer tail
    by_chance = middle * float(stats.chi2.isf(HOT_ALARM / own.size, known) / stats.chi2.median(known))
    found[region] = noise > max(middle + HOT_SD * spread, by_chance, HOT_ADU2)
    return found & mask


def _frames_of(stacks: Sequence[Any], cancel: Callable[[], bool] | None) -> Iterator[NDArray[np.float64]]:
    """Frame by frame, read a few at a time."""
    for stack in stacks:
        for some in blocks(stack.shape, 0, len(stack), cancel):
            yield from counts(stack[some], "dark frames").astype(np.float64)


def measure_dark(
    dark: DarkFrames, register: bool, charge_e: float | None = None, weights: tuple[float, ...] = (1.0,)
) -> Dark:
    """Everything that dark frames tell.

    register : the camera multiplies, so that single electrons show
    charge_e : spurious electrons are not measured but taken so (0: none)
    weights : what the read-out makes of an electron (see `Law`)
    """
    n, n_some, per_frame = len(dark.per_frame), len(dark.some), dark.per_frame
    mask = dark.pixels[dark.region]
    if n < LEAST_FRAMES:
        return _few(dark)
    flat = dark.some
    rows = Products.of(flat - flat.mean(axis=0), mask).correlations((1.0,))
    variance = rows.variance * n_some / (n_some - 1)
    alternation, jitter = _frames(per_frame, variance, int(dark.pixels.sum()), rows)
    fit, read, single = _law(flat[:, mask][:, None, :], register, charge_e, weights)
    charge = UNKNOWN if charge_e is None else Value(charge_e, 0.0)
    gain, electrons = UNKNOWN, 0.0
    if single:
        gain, charge = (
            fit.values.get(name, other) for name, other in (("adu_per_electron", gain), ("charge_e", charge))
        )
        electrons = fit.law.charge_e * fit.law.adu_per_electron
    own = per_frame - alternation.value * (1 - 2 * (np.arange(n) % 2))
    doubt = np.hypot(own.std(ddof=1) / np.sqrt(n), charge.sd * fit.law.adu_per_electron if charge.sd > 0 else 0.0)
    from scipy import stats

    reach = float(stats.t.ppf(0.975, n - 1)) / NORMAL
    centre = float(own.mean()) + 0.5 - electrons
    baseline = Value(centre, float(doubt), centre - NORMAL * reach * doubt, centre + NORMAL * reach * doubt)
    core = max(read.value, 0.5)
    tail = float(np.mean(flat[:, mask] - np.median(flat[:, mask]) > TAIL_SD * core))
    return Dark(
        baseline, read, charge, gain, alternation, jitter, tail, variance, rows, fit, dark.offset_map,
        dark.variance_map, float(per_frame.mean()), n, None if single else _stray(fit, baseline),
    )  # fmt: skip


def _stray(fit: Fit, baseline: Value) -> Stray:
    one, number = fit.values["adu_per_electron"], fit.values["charge_e"]
    made = one.value * number.value
    # Their variance is known, so that fewer electrons of more counts, or more of fewer, trade with the offset.
    doubt = made * one.sd / one.value
    offset = Value(baseline.value - made, float(np.hypot(doubt, baseline.sd)))
    return Stray(number, one, offset, fit.values["read_noise_adu"])


def _few(dark: DarkFrames) -> Dark:
    """One frame to four: the spread of a pixel between frames, of one frame that over pixels, their pattern included.

    The median of whole counts is whole: they are spread evenly over their codes (rms 1/√12) for it.
    """
    values, per_frame = dark.some[:, dark.pixels[dark.region]], dark.per_frame
    n = len(values)
    about = values + np.random.default_rng(0).uniform(-0.5, 0.5, values.shape)
    if n > 1:
        about = (about - about.mean(axis=0)) * np.sqrt(n / (n - 1))
    sd = 1.4826 * float(np.median(np.abs(about)))
    share = float(np.mean(about > TAIL_SD * max(sd, 0.5)))
    centre = float(per_frame.mean()) + 0.5
    doubt = float(np.hypot(sd / np.sqrt(values.size), per_frame.std() / np.sqrt(n)))
    error = MEDIAN_ERROR * sd / np.sqrt(values.size * (n - 1) / n if n > 1 else values.size)
    variance = max(sd**2 - 1 / 12, 0.0)  # rounding included
    read = max(variance - 1 / 12, 0.0) ** 0.5
    low, high = (max((sd + way * NORMAL * error) ** 2 - 1 / 6, 0.0) ** 0.5 for way in (-1, 1))
    return Dark(
        Value(centre, doubt), Value(read, (high - low) / (2 * NORMAL), low, high), UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN,
        share, variance, None, None, dark.offset_map, None, float(per_frame.mean()), n,
    )  # fmt: skip


def _frames(per_frame: NDArray[np.float64], variance: float, n_pixels: int, rows: Correlations) -> tuple[Value, Value]:
    """How far the baseline alternates between even and odd frames, and how far it jitters beside that."""
    from scipy import stats

    n = len(per_frame)
    about = per_frame - per_frame.mean()
    sign = 1.0 - 2.0 * (np.arange(n) % 2)
    sign -= sign.mean()  # of an odd number of frames one kind has one more
    alternation = float(np.sum(about * sign) / np.sum(sign**2))
    sd = float((about - alternation * sign).std(ddof=2) / np.sqrt(np.sum(sign**2)))
    kept = alternation if abs(alternation) > SURE * sd else 0.0
    own = variance / n_pixels * max(1 + 2 * float(np.sum(rows.kernel)), 0.1)
    known = n - 1 - (kept != 0)
    squares = float(np.sum((about - kept * sign) ** 2))
    # Squares of normal numbers, of which there are few: their sum has the law of chi2.
    low, high = (float(np.sqrt(max(squares / stats.chi2.ppf(p, known) - own, 0.0))) for p in (0.975, 0.025))
    believed = squares > own * stats.chi2.isf(JITTER_ALARM, known)
    jitter = float(np.sqrt(squares / known - own)) if believed else 0.0
    return Value(kept, sd), Value(jitter, (high - low) / (2 * NORMAL), min(low, jitter), high)


def _law(
    flat: NDArray[np.float32], register: bool, charge_e: float | None, weights: tuple[float, ...]
) -> tuple[Fit, Value, bool]:
    """The law of the histogram, the read noise, and whether the law's electrons, if any, stand alone."""
    seen = histogram.of_dark(flat, register)
    n = flat.size
    grown = np.sqrt(len(flat) / (len(flat) - 1))  # the mean took its part
    # By the left side alone: spurious electrons lie on the right.
    left = float(np.median(flat) - np.percentile(flat, 15.87)) * grown
    plain = histogram.fit("dark", seen, Law(1.0, 1.0, max(left, 0.3)), ("read_noise_adu",), 0.0)
    rms = plain.values["read_noise_adu"]
    if plain.p_value > GOOD or not register or charge_e == 0 or left <= 0:
        return plain, rms, True
    beyond = flat[flat > TAIL_SD * left]
    gain = max(float(np.mean(beyond - TAIL_SD * left)) if len(beyond) else 0.0, left)
    charge = max(charge_e or 0.0, len(beyond) / n * np.exp(TAIL_SD * left / gain), 1e-5)
    start = Law(gain / max(weights), 2.0, left, charge, weights)
    free = ("adu_per_electron", "read_noise_adu", "charge_e")
    tailed = histogram.fit("dark", seen, start, free if charge_e is None else free[:2], 0.0)
    clear = (
        tailed.law.adu_per_electron * max(weights) > tailed.law.read_noise_adu and tailed.law.charge_e < MOST_CHARGE_E
    )
    if clear and 2 * (_likelihood(tailed) - _likelihood(plain)) > LEAST_TAIL:
        return tailed, tailed.values["read_noise_adu"], True
    # Neither normal nor with a tail of single electrons: between the core and the rms.
    core = np.sqrt(max(left**2 - 1 / 12, 0.0))
    doubt = 1.3 * left / np.sqrt(n)
    low, high = sorted((core - NORMAL * doubt, max(rms.interval[1], core + NORMAL * doubt)))
    read = Value(float(core), float((high - low) / (2 * NORMAL)), float(low), float(high))
    if charge_e is None:
        many = histogram.fit("dark", seen, Law(left / 2, 2.0, left / 2, 4.0, weights), free, 0.0)
        many = max(many, tailed, key=_likelihood)
        if 2 * (_likelihood(many) - _likelihood(plain)) > LEAST_TAIL and many.distance < plain.distance / 2:
            return many, read, False
    return plain, read, True


def _likelihood(fit: Fit) -> float:
    return float(np.sum(fit.histogram.seen * np.log(fit.expected)))
