"""A quick fit by moments: what a comparison needs so that a wrong brightness is not read as wrong physics.

Fitted in this order, each from one number of the traces: background (local background level), bleaching (share of
molecules bleached by the end), brightness (mean on level), spread of brightness (spread of on levels beyond that of
the simulation); last, the brightness that makes W1 smallest. The elaborate fit, with every effect and its evidence,
is `discover`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.detector import multiplication_noise
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

    `simulate` gives the traces (molecule, frame) of a model through the same chain as the measurement.
    """
    values: dict[str, float] = {}
    fitted = model
    if isinstance(measured, TraceSet):
        fitted = _with_background(fitted, measured.background_e, values)
    real = _moments(measured)
    rate, notes = _bleaching_rate(measured, model)
    if rate is not None:
        fitted = _with_bleaching(fitted, rate, values)
    for i in range(rounds):
        traces = np.asarray(simulate(fitted))
        made = _moments(traces)
        if made.n == 0:  # nothing detected: brighten until something is
            fitted = _brightened(fitted, 2.0, values)
            continue
        last = i == rounds - 1
        fitted = _brightened(fitted, _nearest_scale(measured, traces) if last else real.level / made.level, values)
        if made.n > 1 and not last:
            fitted = _with_spread(fitted, real.spread**2 - made.spread**2, values)
    return Fit(fitted, values, notes)


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
    notes = _bleaching_rate(measured - b, model)[1]
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


def _nearest_scale(measured: Any, made: NDArray[np.floating]) -> float:
    """The factor by which simulated traces come nearest to the measured ones in W1 over frames."""
    real = np.asarray(getattr(measured, "traces", measured), dtype=np.float64).ravel()
    ordered = [np.sort(values, axis=None) for values in (real, made)]
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


def _moments(traces: Any) -> _Moments:
    array = np.asarray(traces.traces if isinstance(traces, TraceSet) else traces, dtype=float)
    if len(array) == 0:
        return _Moments(0, 0.0, 0.0)
    dyn: Dynamics = dynamics(array)
    on = dyn.on_level[dyn.on_level > 0]
    if len(on) == 0:
        return _Moments(0, 0.0, 0.0)
    return _Moments(len(on), float(on.mean()), float(on.std() / on.mean()))


def _bleaching_rate(measured: Any, model: Model) -> tuple[float | None, tuple[str, ...]]:
    """The rate, 1/s, at which as many of the molecules seen have bleached by the end of the movie as were found to, and
    what the measurement does not tell of it. None, where no molecule tells anything, keeps what is believed.

    A molecule seen in a window before it bleached could not have bleached earlier: the movie is shorter by the window.
    One that is dark from the first frame on, as a table of traces may hold, was never seen and says nothing.
    """
    interval_s, window = model.acquisition.interval_s, 0
    if isinstance(measured, TraceSet):
        whole, window = measured.all_traces[measured.kept], measured.options.window or 0
        bleached = measured.molecules["bleaching_frame"].to_numpy()[measured.kept] >= 0
    else:
        whole = np.asarray(measured, dtype=float)
        dyn = dynamics(whole)
        seen = (dyn.snr >= Choice.min_snr) & (dyn.lit.sum(axis=1) >= Choice.min_lit_frames)
        bleached = dyn.bleaching_frame[seen] >= 0
    n, n_frames = len(bleached), whole.shape[1] - window
    if n == 0 or n_frames < 1:
        return None, ("no molecule tells how fast they bleach",)
    share = min(float(bleached.mean()), 1 - 0.5 / n)
    rate, events = float(-np.log1p(-share) / (n_frames * interval_s)), int(bleached.sum())
    if events >= FEW_EVENTS:
        return rate, ()
    most = most_per_s(events, (n - events / 2) * n_frames * interval_s)
    return rate, (f"{events} of {n} molecules bleach: their rate is hardly known, it may be up to {most:.3g} 1/s",)


def _with_background(model: Model, background_e: float, values: dict[str, float]) -> Model:
    camera = model.camera
    photons = max(0.0, (background_e - camera.clock_induced_charge_e) / camera.quantum_efficiency)
    values["optics.background_photons_per_px"] = photons
    return model.with_values({"optics.background_photons_per_px": photons})


def _with_bleaching(model: Model, rate_per_s: float, values: dict[str, float]) -> Model:
    """Bleaching at this rate in the time of the movie; the model's own bleaching is replaced."""
    values["photobleaching.rate_per_s"] = rate_per_s
    plain = model.with_values({"fluorophore.cycles_before_bleaching": None})
    kept = tuple(effect for effect in plain.effects if effect.kind != "photobleaching")
    plain = plain.model_copy(update={"effects": kept})
    if rate_per_s <= 0:
        return plain
    lit_share = model.acquisition.frame_length_s / model.acquisition.interval_s
    return plain.with_effects(effect_from_data({"kind": "photobleaching", "rate_per_s": rate_per_s / lit_share}))


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
