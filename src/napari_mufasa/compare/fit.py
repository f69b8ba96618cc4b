"""A quick fit by moments: what a comparison needs so that a wrong brightness is not read as wrong physics.

Fitted in this order, each from one number of the traces: background (local background level), bleaching (how often
light ends for good, beyond the simulation), brightness (mean on level), spread of brightness (spread of on levels
beyond that of the simulation); last, the brightness that makes W1 smallest. The elaborate fit, with every effect and
its evidence, is `discover`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.detector import multiplication_noise
from napari_mufasa.compare.baselines import two_state_of
from napari_mufasa.effects import effect_from_data
from napari_mufasa.model.model import Model
from napari_mufasa.photophysics.rates import FEW_EVENTS, most_per_s
from napari_mufasa.traces import TraceSet
from napari_mufasa.traces.correlation import lagged
from napari_mufasa.traces.darkness import dark_level
from napari_mufasa.traces.dynamics import Dynamics, dynamics
from napari_mufasa.traces.select import Choice

ROUNDS = 3
QUANTILES = 4000
CHANCE_SD = 2.0  # of a difference of two variances: one in 20 is larger by chance


@dataclass(frozen=True)
class Fit:
    """The fitted model, the fitted values by name (dotted model path or effect.parameter), and what the measurement
    did not tell."""

    model: Model
    values: dict[str, float]
    notes: tuple[str, ...] = ()


def fit_model(
    measured: TraceSet | NDArray[np.floating],
    model: Model,
    simulate: Callable[[Model], Any],
    *,
    rounds: int = ROUNDS,
) -> Fit:
    """Fit brightness, background, bleaching rate and spread of brightness by moments (docs/comparison.md).

    `simulate` gives what a model shows through the same chain as the measurement: traces (molecule, frame), or, where
    they were extracted, one or more trace sets.
    """
    values: dict[str, float] = {}
    fitted, interval_s = model, model.acquisition.interval_s
    real, real_ends = _moments(_light(measured)), Ends.of(measured)
    rate = _bleaching_rate(model)
    if real_ends.molecules:
        values["photobleaching.rate_per_s"] = rate
    for i in range(rounds):
        shown, last = simulate(fitted), i == rounds - 1
        traces = _light(shown)
        made = _moments(traces)
        if isinstance(measured, TraceSet) and not last:
            level_e = background_level_e(fitted)
            fitted = _with_background(
                fitted, level_e + measured.background_e - _read_background(shown, level_e), values
            )
        if made.n == 0:  # nothing detected: brighten until something is
            fitted = _brightened(fitted, 2.0, values)
            continue
        scale = _nearest_scale(_light(measured), traces) if last else real.level / made.level
        fitted = _brightened(fitted, scale, values)
        if made.n > 1 and not last:
            fitted = _with_spread(fitted, real.spread**2 - made.spread**2, values)
        if more := real_ends.more_often_than(Ends.of(shown)):
            rate = max(0.0, rate + more / interval_s)
            fitted = _with_bleaching(fitted, rate, values)
    return Fit(fitted, values, real_ends.notes(interval_s))


def fit_raw_traces(
    measured: NDArray[np.floating], model: Model, simulate: Callable[[Model], Any], weight: float = 1.0, *,
    rounds: int = ROUNDS,
) -> Fit:  # fmt: skip
    """Fit traces (molecule, frame) from which no background was taken off, by moments.

    Their mean over molecules is b + A·exp(−kt): b, the background (`weight` pixels' worth of it), is what they fall to
    when molecules go dark, or that of the model where too few do; k gives the bleaching rate, A (by comparison with the
    simulation) the brightness. The spread of brightness is what the slow variation between molecules (covariance of
    successive frames about the mean course) needs beyond the simulation; where it needs less, part of A is put into a
    background that fades smoothly (many dim molecules instead of a bright one). Neither where that may be chance.
    """
    from scipy.optimize import curve_fit

    values: dict[str, float] = {}
    measured = np.asarray(measured, dtype=np.float64)
    course, n_frames = measured.mean(axis=0), measured.shape[1]
    t = np.arange(n_frames) / n_frames
    b = max(background_held(measured, weight * background_level_e(model))[0], 1e-3)

    def curve(t: NDArray[np.float64], a: float, k: float) -> NDArray[np.float64]:
        return np.asarray(a * np.exp(-k * t))

    start = (max(float(course[0]) - b, 1e-3), 1.0)
    a, k = (float(v) for v in curve_fit(curve, t, course - b, p0=start, bounds=((0, 0), (np.inf, 20)))[0])
    fitted = _with_background(model, b / weight, values)
    fitted = _with_bleaching(fitted, k / (n_frames * model.acquisition.interval_s), values)
    notes = Ends.of(measured - b).notes(model.acquisition.interval_s)
    remaining, slow = float(np.mean(np.exp(-k * t))), _slow_variances(measured)
    for i in range(rounds + 1):
        made: NDArray[np.float64] = np.asarray(simulate(fitted), dtype=np.float64)
        per_molecule = float(made.mean() - weight * background_level_e(fitted) * _mean_background(fitted)) / remaining
        if per_molecule <= 0:
            fitted = _brightened(fitted, 2.0, values)
            continue
        wanted = a
        if i > 0:  # the first round only brings the brightness to A
            slow_made = _slow_variances(made)
            missing = _beyond_chance(slow, slow_made)
            wanted = min(a, per_molecule * float(np.sqrt(max(1 + missing / max(slow_made.mean(), 1e-9), 0.01))))
            if wanted == a and missing > 0:
                fitted = _with_spread(fitted, missing / (a * remaining) ** 2, values)
        fitted = _brightened(fitted, wanted / per_molecule, values)
        fitted = _with_fading(fitted, b / weight, (a - wanted) / weight, k, values)
    return Fit(fitted, values, notes)


def _mean_background(model: Model) -> float:
    """Mean over the movie of the background relative to its start, as `_with_fading` has set it."""
    fading = next((e for e in model.effects if e.kind == "background_decay"), None)
    if fading is None:
        return 1.0
    progress = np.linspace(0.0, 1.0, model.acquisition.n_frames)
    left = np.exp(-progress / fading.time_constant_movies)  # type: ignore[attr-defined]
    return float(np.mean(1 - fading.fraction + fading.fraction * left))  # type: ignore[attr-defined]


def _with_fading(model: Model, constant_e: float, fading_e: float, rate: float, values: dict[str, float]) -> Model:
    """A background of a constant and a fading part; `rate` per movie."""
    model = _with_background(model, constant_e + fading_e, values)
    fraction = fading_e / (constant_e + fading_e)
    values["background_decay.fraction"] = fraction
    effect = {"kind": "background_decay", "fraction": fraction, "time_constant_movies": 1 / max(rate, 1e-3)}
    return model.with_effects(effect_from_data(effect))


def background_held(traces: NDArray[np.floating], believed_e: float, own: bool = True) -> tuple[float, str]:
    """Photoelectrons per frame that traces (molecule, frame) hold beside their molecules' light: what they fall to, or,
    where too few go dark or without `own`, what is believed, and a note that says so."""
    if own and (dark := dark_level(traces)) is not None:
        return dark, ""
    dimmest = float(np.min(np.mean(traces, axis=1), initial=np.inf))
    taken = f"{believed_e:.4g} photoelectrons per frame as the model has it"
    if dimmest < believed_e:
        taken = f"{dimmest:.4g} photoelectrons per frame, those of the dimmest trace (the model has {believed_e:.4g})"
    note = f"too few molecules go dark, or to no common level, to tell the background in the traces: {taken}"
    return min(believed_e, dimmest), note


def background_level_e(model: Model) -> float:
    """Photoelectrons per pixel and frame that the model has without any molecule."""
    camera = model.camera
    return camera.quantum_efficiency * model.optics.background_photons_per_px + camera.clock_induced_charge_e


def fit_gain(traces_adu: NDArray[np.floating], model: Model) -> tuple[Model, float]:
    """The EM gain that the noise of ADU traces (molecule, frame) asks for, and its ratio to the model's.

    Variance from second differences in time over signal = F²·ADU per photoelectron, all traces together.
    """
    camera = model.camera
    second = np.diff(np.asarray(traces_adu, dtype=np.float64), n=2, axis=1)
    variance = float(np.mean(second**2)) / 6 - (camera.read_noise_e / camera.electrons_per_adu) ** 2
    signal = float(np.mean(traces_adu)) + 0.5 - camera.baseline_adu
    if camera.type != "EMCCD" or signal <= 0 or not variance > 0:  # nor is it told by fewer than three frames
        return model, 1.0
    per_electron = variance / signal / multiplication_noise(camera)
    gain = max(1.0, per_electron * camera.electrons_per_adu)
    return model.with_values({"camera.em_gain": gain}), gain / float(camera.em_gain or 1.0)


def _slow_variances(traces: NDArray[np.floating]) -> NDArray[np.float64]:
    """(molecule,) product of successive frames about the mean course of all: their mean is the variance that is not
    noise of single frames."""
    about = traces - traces.mean(axis=0)
    products, pairs = lagged(about, np.ones(about.shape, dtype=bool), 1)
    return np.asarray(products / np.maximum(pairs, 1))


def _beyond_chance(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """How much larger the mean of one is than that of the other; 0 where that is within `CHANCE_SD` standard errors."""
    more = float(one.mean() - other.mean())
    error = np.sqrt(one.var() / len(one) + other.var() / len(other))
    return more if abs(more) > CHANCE_SD * error else 0.0


def _light(shown: Any) -> NDArray[np.floating]:
    """Traces (molecule, frame) of an array, or of one or more trace sets."""
    if isinstance(shown, TraceSet):
        return shown.traces
    if isinstance(shown, list):
        return np.concatenate([found.traces for found in shown])
    return np.asarray(shown)


def _read_background(shown: Any, level_e: float) -> float:
    """Photoelectrons per pixel that extraction finds in a simulation with this level; of traces alone, that level."""
    if isinstance(shown, TraceSet):
        return shown.background_e
    return float(np.mean([found.background_e for found in shown])) if isinstance(shown, list) else level_e


def _nearest_scale(measured: NDArray[np.floating], made: NDArray[np.floating]) -> float:
    """The factor by which simulated traces come nearest to the measured ones in W1 over frames."""
    ordered = [np.sort(np.asarray(values, dtype=np.float64), axis=None) for values in (measured, made)]
    at = (np.arange(QUANTILES) + 0.5) / QUANTILES
    target, source = (values[(at * len(values)).astype(int)] for values in ordered)
    factors = np.geomspace(0.5, 2.0, 141)
    distances = np.abs(target - factors[:, None] * source).mean(axis=1)
    return float(factors[np.argmin(distances)])


@dataclass(frozen=True)
class _Moments:
    n: int
    level: float
    spread: float  # relative, between molecules


def _moments(traces: NDArray[np.floating]) -> _Moments:
    array = np.asarray(traces, dtype=float)
    if len(array) == 0:
        return _Moments(0, 0.0, 0.0)
    dyn: Dynamics = dynamics(array)
    on = dyn.on_level[dyn.on_level > 0]
    if len(on) == 0:
        return _Moments(0, 0.0, 0.0)
    return _Moments(len(on), float(on.mean()), float(on.std() / on.mean()))


@dataclass(frozen=True)
class Ends:
    """How often the light of molecules ends and does not come back: of so many molecules `events`, in the `frames` that
    all of them were watched until then, or until the movie's end.

    They are bleachings and the dark times that the movie's end cuts off, which only a simulation tells apart. A
    molecule that must shine for some frames to be seen, or for a window to be kept, could not have bleached in them:
    they are not counted. One that is dark from the first frame on, as a table of traces may hold, says nothing.
    """

    molecules: int
    events: int
    frames: float

    @classmethod
    def of(cls, shown: Any) -> Ends:
        """Of traces (molecule, frame), or of one or more trace sets."""
        if isinstance(shown, list):
            each = [cls.of(found) for found in shown]
            return cls(*(sum(getattr(ends, f.name) for ends in each) for f in fields(cls)))
        least = Choice.min_lit_frames
        if isinstance(shown, TraceSet):
            n_frames, least = shown.all_traces.shape[1], max(shown.options.window or 0, shown.options.min_lit_frames)
            ends = shown.molecules["bleaching_frame"].to_numpy()[shown.kept]
        else:
            n_frames = np.shape(shown)[1]
            dyn = dynamics(np.asarray(shown, dtype=float))
            ends = dyn.bleaching_frame[(dyn.snr >= Choice.min_snr) & (dyn.lit.sum(axis=1) >= least)]
        if n_frames <= least:
            return cls(0, 0, 0.0)
        watched = np.maximum(np.where(ends >= 0, ends, n_frames) - least, 0) + 0.5  # ends are amid a frame
        return cls(len(ends), int(np.count_nonzero(ends >= 0)), float(watched.sum()))

    def more_often_than(self, other: Ends) -> float:
        """Ends per frame beyond those of another, less what of it chance makes: nothing within a standard error."""
        if not self.frames or not other.frames:
            return 0.0
        more = self.events / self.frames - other.events / other.frames
        common = (self.events + other.events) / (self.frames + other.frames)
        by_chance = common * (1 / self.frames + 1 / other.frames)
        return more * (1 - by_chance / more**2) if more**2 > by_chance else 0.0

    def notes(self, interval_s: float) -> tuple[str, ...]:
        """What the measurement does not tell of bleaching."""
        if not self.frames:
            return ("no molecule tells how fast they bleach",)
        if self.events >= FEW_EVENTS:
            return ()
        most = most_per_s(self.events, self.frames * interval_s)
        return (
            f"{self.events} of {self.molecules} molecules bleach: their rate is hardly known, it may be up to "
            f"{most:.3g} 1/s",
        )


def _bleaching_rate(model: Model) -> float:
    """Bleachings per second of light that a model has, by its cycles and by the effect."""
    by_effect = sum(e.rate_per_s for e in model.effects if e.kind == "photobleaching")  # type: ignore[attr-defined]
    return 1 / two_state_of(model, 1.0).bleach_s + by_effect


def _with_background(model: Model, background_e: float, values: dict[str, float]) -> Model:
    camera = model.camera
    photons = max(0.0, (background_e - camera.clock_induced_charge_e) / camera.quantum_efficiency)
    values["optics.background_photons_per_px"] = photons
    return model.with_values({"optics.background_photons_per_px": photons})


def _with_bleaching(model: Model, rate_per_s: float, values: dict[str, float]) -> Model:
    """Bleaching at this rate, also between frames, where the light stays on; the model's own is replaced."""
    values["photobleaching.rate_per_s"] = rate_per_s
    plain = model.with_values({"fluorophore.cycles_before_bleaching": None})
    kept = tuple(effect for effect in plain.effects if effect.kind != "photobleaching")
    plain = plain.model_copy(update={"effects": kept})
    if rate_per_s <= 0:
        return plain
    return plain.with_effects(effect_from_data({"kind": "photobleaching", "rate_per_s": rate_per_s}))


def _brightened(model: Model, ratio: float, values: dict[str, float]) -> Model:
    factor = model.optics.brightness_correction * float(np.clip(ratio, 0.1, 10.0))
    factor = float(np.clip(factor, 1e-4, 1e5))
    values["optics.brightness_correction"] = factor
    return model.with_values({"optics.brightness_correction": factor})


def _with_spread(model: Model, missing_variance: float, values: dict[str, float]) -> Model:
    """Add what is missing of the relative variance of levels to what the model has already."""
    have = next((e.spread for e in model.effects if e.kind == "brightness_heterogeneity"), 0.0)  # type: ignore[attr-defined]
    spread = min(float(np.sqrt(max(0.0, have**2 + missing_variance))), 3.0)
    values["brightness_heterogeneity.spread"] = spread
    return model.with_effects(effect_from_data({"kind": "brightness_heterogeneity", "spread": spread}))
