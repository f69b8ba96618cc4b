"""Which effect a trace table asks for, when there is no movie (SPEC.md §7, §9).

The distance is W1 at many time scales: of means over 1, 2, 4 … frames and of differences between successive means, each
divided by its floor (W1 between halves of the measured molecules). A part of the molecules is fitted, the rest judges.
Molecules are split in runs of neighbours: neighbours in a table often lie side by side in the image and share light.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.compare.comparison import to_photoelectrons
from napari_mufasa.compare.distributions import Distribution, Sample, distributions
from napari_mufasa.compare.fit import background_level_e, fit_gain
from napari_mufasa.compare.simulated import FarApart
from napari_mufasa.compare.wasserstein import Pooled, floor, wasserstein
from napari_mufasa.effects import catalogue, effect_class
from napari_mufasa.errors import Cancelled, MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.traces import Options
from napari_mufasa.traces.dynamics import dynamics

Traces = NDArray[np.floating]
Progress = Callable[[int, int], None]
Cancel = Callable[[], bool]
RUN = 8  # neighbouring molecules that stay together when the table is split
LEAST_MOLECULES = 4 * RUN
SPLITS = 40  # random halves behind every floor
RESAMPLINGS = 200
QUANTILES = 1000
FALSE_ALARM = 0.01  # of all candidates of a round together
ENOUGH = 1.0  # error that halves of the measurement have on average: nothing to look for below it
ROUNDS = 3
LIGHT = ("optics.brightness_correction", "optics.background_photons_per_px")  # fitted beside every effect
ERROR_UNIT = "W1 over its floor, mean over time scales, molecules not used to fit"


def views(traces: Traces) -> dict[str, NDArray[np.float64]]:
    """Name → (molecule, value): means over 1, 2, 4 … frames and the differences between successive ones."""
    values = np.asarray(traces, dtype=np.float64)
    found, scale = {}, 1
    while True:
        found[f"mean_{scale}"] = values
        if values.shape[1] < 2:
            return found
        found[f"step_{scale}"] = np.diff(values, axis=1)
        even = values.shape[1] // 2 * 2
        values, scale = values[:, :even].reshape(len(values), -1, 2).mean(axis=2), 2 * scale


@dataclass(frozen=True)
class Row:
    """One effect tried: its fitted values, the error and W1 on the judging molecules with it, and the evidence.

    gains : error that adding it took away, in every resampling; p_value : that it takes nothing away
    """

    effect: str
    parameters: dict[str, Any]
    error_after: float
    w1_after: float
    gains: NDArray[np.float64]
    p_value: float
    model: Model

    @property
    def gain_95(self) -> tuple[float, float]:
        low, high = np.percentile(self.gains, [2.5, 97.5])
        return float(low), float(high)

    def like(self, other: Row) -> bool:
        """Whether both took away error, and resampling does not tell which of them more."""
        low, high = np.percentile(self.gains - other.gains, [2.5, 97.5])
        return bool(low <= 0 <= high) and max(self.p_value, other.p_value) < FALSE_ALARM

    def as_dict(self, before: float, rows: list[Row]) -> dict[str, Any]:
        share = (before - self.error_after) / before
        alike = [row.effect for row in rows if row is not self and self.like(row)]
        return {
            "effect": self.effect, "p_value": self.p_value, "error_after": self.error_after, "share_explained": share,
            "parameters": self.parameters, "parameters_sd": {}, "indistinguishable_from": alike,
            "w1_after": self.w1_after, "gain_95": list(self.gain_95),
        }  # fmt: skip


@dataclass
class TraceReport:
    """What a trace table asks for; `as_dict` has the keys of SPEC.md §10 and W1 over frames beside them.

    error, w1 : {"before", "after", "floor", "unit"}; rounds : the candidates tried in each round, best first
    traces : "measured", "before", "after" (molecule, frame) photoelectrons, the judging molecules
    """

    verdict: str
    error: dict[str, Any]
    w1: dict[str, Any]
    failing: list[dict[str, Any]]
    rounds: list[list[Row]]
    chosen: list[str]
    history: list[dict[str, Any]]
    base: Model
    model: Model
    traces: dict[str, Traces]
    background_e: float
    seed: int
    seconds: float
    notes: list[str] = field(default_factory=list)

    def distributions(self) -> dict[str, Distribution]:
        """Counts, autocorrelation, levels … of the judging molecules, the model fitted as it is, and completed."""
        background = self.background_e
        names = {"measured": "measured", "before": "mufasa", "after": "fitted"}
        samples = {names[n]: Sample(made, dynamics(made - background)) for n, made in self.traces.items()}
        return distributions(samples, "photoelectrons", self.model.acquisition.interval_s)

    def as_dict(self) -> dict[str, Any]:
        before = self.error["before"]
        tried = [[row.as_dict(before, rows) for row in rows] for rows in self.rounds]
        return {
            "verdict": self.verdict, "error": self.error, "failing": self.failing,
            "ranking": tried[0] if tried else [],
            "chosen": self.chosen, "history": self.history, "model": self.model.to_dict(), "seconds": self.seconds,
            "seed": self.seed, "w1": self.w1, "base": self.base.to_dict(), "notes": self.notes,
            "rounds": tried,
        }  # fmt: skip


def diagnose_traces(
    traces: Traces,
    model: Model,
    *,
    unit: str = "photoelectrons",
    profile: str = "psf",
    background_subtracted: bool = True,
    pixel_share: float | None = None,
    effects: Iterable[str] | None = None,
    seed: int = 1,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
) -> TraceReport:
    """Find the effects without which a model does not give these traces (molecule, frame).

    Brightness and background are fitted first (from ADU also the EM gain), then again with every effect. An effect is
    added while it takes error away on molecules that no fit has seen, with a false-alarm rate of 1 % per round.

    Parameters
    ----------
    traces … pixel_share : as for `compare_traces`
    effects : kinds to try (None: every effect of photophysics and light that a lone trace can show)
    progress : called with (fits done, fits at most); cancel : True stops (raises `Cancelled`)

    Raises
    ------
    MufasaError : traces that are too few or unusable, an unknown effect or option.
    """
    started = time.perf_counter()
    kinds = candidate_kinds(model) if effects is None else [_known(kind) for kind in effects]
    bench = _Bench(traces, model, unit, profile, background_subtracted, pixel_share, seed, cancel)
    report = _counter(progress, 1 + len(kinds) * ROUNDS)
    base = bench.fit(bench.start, None, {})
    report()
    before, made_before = bench.judge(base)
    history: list[dict[str, Any]] = [{"model": "base", "error": before, "w1": bench.w1(made_before)}]
    current, chosen, rounds, made = base, list[str](), list[list[Row]](), made_before
    while bench.error(made) > ENOUGH and len(rounds) < ROUNDS:
        rows = []
        for kind in (k for k in kinds if k not in chosen):
            rows.append(bench.try_effect(current, made, kind))
            report()
        if not rows:
            break
        rows.sort(key=lambda row: row.error_after)
        rounds.append(rows)
        best = rows[0]
        if best.p_value > FALSE_ALARM / len(rows):
            break
        current, chosen = best.model, [*chosen, best.effect]
        made = bench.simulate(current, bench.seed + 10)
        history.append({"added": best.effect, "error": best.error_after, "w1": best.w1_after})
    after = bench.error(made)
    verdict = "missing_effect" if chosen else "adequate" if before <= bench.error_limit else "unexplained"
    notes = [
        f"{len(bench.fitted)} molecules fitted, {len(bench.judging)} others judged; simulated {bench.n_simulated}."
    ]
    if chosen and after > bench.error_limit:
        notes.append("The completed model is still above the floor: something else is missing.")
    return TraceReport(
        verdict=verdict,
        error={"before": before, "after": after, "floor": 1.0, "unit": ERROR_UNIT},
        w1={"before": bench.w1(made_before), "after": bench.w1(made), "floor": bench.w1_floor,
            "unit": "photoelectrons per frame"},
        failing=bench.failing(made_before),
        rounds=rounds, chosen=chosen, history=history, base=base, model=current,
        traces={"measured": bench.judging, "before": made_before, "after": made},
        background_e=0.0 if background_subtracted else background_level_e(current),
        seed=seed, seconds=time.perf_counter() - started, notes=notes,
    )  # fmt: skip


def candidate_kinds(model: Model) -> list[str]:
    """Effects that change a lone trace: photophysics and light, but nothing that depends on where a molecule is."""
    elsewhere = ("illumination_profile",)
    have = {effect.kind for effect in model.effects}
    return [
        kind
        for kind, effect in catalogue().items()
        if (effect.stage in ("photophysics", "illumination") or kind == "background_decay")
        and kind not in elsewhere and kind not in have and effect.suits(model)
    ]  # fmt: skip


class _Bench:
    """Measured traces split in two, the same chain for simulated ones, and the distance between them."""

    def __init__(
        self, traces: Traces, model: Model, unit: str, profile: str, background_subtracted: bool,
        pixel_share: float | None, seed: int, cancel: Cancel | None,
    ) -> None:  # fmt: skip
        electrons = to_photoelectrons(np.asarray(traces), model, unit)
        if len(electrons) < LEAST_MOLECULES or electrons.shape[1] < 8:
            raise MufasaError(
                f"{electrons.shape[0]} traces of {electrons.shape[1]} frames: needs at least {LEAST_MOLECULES} traces "
                "of 8 frames to fit on some and judge on others; use compare"
            )
        gain = 1.0
        if unit == "adu":  # a photoelectron is worth what the noise of the traces says
            model, gain = fit_gain(np.asarray(traces), model)
        self.seed, self.cancel, self.background_subtracted = seed, cancel, background_subtracted
        timing = model.acquisition.model_copy(update={"n_frames": electrons.shape[1]})
        self.start = model.model_copy(update={"acquisition": timing})
        rng = np.random.default_rng(seed)
        self.fitted, self.judging = _halves(electrons / gain, rng)
        self.n_simulated = int(np.clip(40_000 // electrons.shape[1], 200, 1000))
        options = Options(psf_sigma_px=model.sigma_px, profile=profile, subtract_background=background_subtracted)  # type: ignore[arg-type]
        self.field = FarApart(model.sigma_px, self.n_simulated, options, seed, pixel_share, quick=True)
        self.quantiles = {name: _quantiles(view) for name, view in views(self.fitted).items()}
        self.judge_target = views(self.judging)
        splits = [_halves(electrons / gain, rng) for _ in range(SPLITS)]
        between = [{n: wasserstein(v, views(b)[n]) for n, v in views(a).items()} for a, b in splits]
        self.floor = {name: float(np.mean([d[name] for d in between])) for name in self.judge_target}
        ratios = np.array([[d[name] / self.floor[name] for name in self.judge_target] for d in between])
        self.error_limit = float(np.quantile(ratios.mean(axis=1), 1 - FALSE_ALARM))
        self.floor_sd = dict(zip(self.judge_target, ratios.std(axis=0), strict=True))
        self.w1_floor = floor(electrons / gain, rng=rng).value

    def simulate(self, model: Model, seed: int) -> Traces:
        if self.cancel is not None and self.cancel():
            raise Cancelled
        return self.field.traces(self.field.acquisition(model, seed))

    def distances(self, made: Traces) -> dict[str, float]:
        """W1 over floor of every view, on the judging molecules."""
        return {name: wasserstein(self.judge_target[name], v) / self.floor[name] for name, v in views(made).items()}

    def error(self, made: Traces) -> float:
        """The error on the judging molecules."""
        return float(np.mean(list(self.distances(made).values())))

    def judge(self, model: Model) -> tuple[float, Traces]:
        # Another seed than the fit's: a fit must not profit from its own chance.
        made = self.simulate(model, self.seed + 10)
        return self.error(made), made

    def w1(self, made: Traces) -> float:
        return wasserstein(self.judging, made)

    def failing(self, made: Traces) -> list[dict[str, Any]]:
        """The views that differ most, with their distance in spreads of the floor."""
        found = []
        for name, ratio in self.distances(made).items():
            what, scale = name.split("_")
            z = (ratio - 1) / max(self.floor_sd[name], 1e-9)
            words = "mean over" if what == "mean" else "difference of means over"
            if z > 3:
                found.append({"observable": name, "z": float(z), "where": f"{words} {scale} frames"})
        return sorted(found, key=lambda row: -float(row["z"]))

    def fit(self, model: Model, kind: str | None, shape: dict[str, Any]) -> Model:
        """Brightness, background and the effect's numbers that bring the fitted molecules nearest (Nelder-Mead)."""
        from scipy.optimize import minimize

        spans = {} if kind is None else effect_class(kind).plausible(model)
        spans = {n: span for n, span in spans.items() if not _unused(kind, n, shape)}
        n_light = 1 if self.background_subtracted else 2

        def build(x: NDArray[np.float64]) -> Model:
            light = np.exp(np.clip(x[:n_light], -8, 12))
            values = dict(zip(LIGHT, light.tolist(), strict=False))
            built = model.with_values(values)
            if kind is None:
                return built
            numbers = {n: _inside(u, span) for u, (n, span) in zip(x[n_light:], spans.items(), strict=True)}
            return built.with_effects(effect_class(kind)(**shape, **numbers))

        def cost(x: NDArray[np.float64]) -> float:
            try:
                return self.fit_error(build(x))
            except MufasaError:  # values that the simulator refuses
                return 1e6

        places = (0.15, 0.5, 0.85) if spans else (0.5,)
        guesses = [np.append(light, np.full(len(spans), u)) for light in self._light_guesses(model) for u in places]
        best = min(guesses, key=cost)
        steps = np.append(np.full(n_light, 0.2), np.full(len(spans), 0.25 if best[-1] < 0.6 else -0.25))
        found = minimize(
            cost, best, method="Nelder-Mead",
            options={"initial_simplex": np.vstack([best, best + np.diag(steps)]), "maxfev": 30 + 25 * len(best),
                     "xatol": 2e-3, "fatol": 2e-3},
        )  # fmt: skip
        return build(found.x)

    def fit_error(self, model: Model) -> float:
        """The error on the fitted molecules, by the fit's own seed; W1 from quantiles, for speed."""
        made = {name: _quantiles(view) for name, view in views(self.simulate(model, self.seed)).items()}
        return float(np.mean([np.abs(self.quantiles[n] - q).mean() / self.floor[n] for n, q in made.items()]))

    def _light_guesses(self, model: Model) -> list[NDArray[np.float64]]:
        """Log brightness and log background: as they are, and sharing the mean of the traces in several ways."""
        optics, camera = model.optics, model.camera
        made, wanted = float(self.simulate(model, self.seed).mean()), max(float(self.fitted.mean()), 1e-3)
        if self.background_subtracted:
            ratio = wanted / made if made > 0 else 1.0
            return [np.log([optics.brightness_correction * r]) for r in (1.0, ratio)]
        background = max(optics.background_photons_per_px, 1e-2)
        light = max(made - camera.quantum_efficiency * optics.background_photons_per_px, 1e-3)
        guesses = [np.log([optics.brightness_correction, background])]
        for share in (0.1, 0.3, 0.6, 0.95):  # of the molecule in the mean
            brightness = optics.brightness_correction * share * wanted / light
            guesses.append(np.log([brightness, (1 - share) * wanted / camera.quantum_efficiency]))
        return guesses

    def try_effect(self, model: Model, made: Traces, kind: str) -> Row:
        """Fit an effect in each of its forms and judge the better one."""
        forms = effect_class(kind).forms()
        shapes: list[dict[str, Any]] = [{"form": form} if form else {} for form in forms[:2]]
        fits = [self.fit(model, kind, shape) for shape in shapes]
        fitted = min(fits, key=self.fit_error)
        error, new = self.judge(fitted)
        gains = self._gains(made, new)
        parameters = next(e for e in reversed(fitted.effects) if e.kind == kind).model_dump()
        form = {"form": parameters["form"]} if "form" in parameters else {}
        parameters = {n: v for n, v in parameters.items() if n != "kind" and not _unused(kind, n, form)}
        p_value = float((1 + np.count_nonzero(gains <= 0)) / (1 + len(gains)))
        spread = float(gains.std())
        if p_value < 0.05 and spread > 0:  # beyond what resampling can count, by the normal tail
            from scipy.stats import norm

            p_value = float(norm.sf(gains.mean() / spread))
        return Row(kind, parameters, error, self.w1(new), gains, float(p_value), fitted)

    def _gains(self, old: Traces, new: Traces) -> NDArray[np.float64]:
        """Error taken away, (resampling,): runs of judging molecules and the simulated ones are drawn again."""
        rng = np.random.default_rng(self.seed)
        n, m = len(self.judging), self.n_simulated
        runs = -(-n // RUN)
        of_run = np.arange(n) // RUN
        real = rng.multinomial(runs, np.full(runs, 1 / runs), RESAMPLINGS)[:, of_run].astype(float)
        real /= real.sum(axis=1, keepdims=True)
        drawn = rng.multinomial(m, np.full(m, 1 / m), (2, RESAMPLINGS)) / m
        gains = np.zeros(RESAMPLINGS)
        for sign, made, weights in ((1, old, drawn[0]), (-1, new, drawn[1])):
            for name, view in views(made).items():
                pooled = Pooled(np.concatenate([self.judge_target[name], view]))
                for i in range(RESAMPLINGS):
                    distance = pooled.w1(np.concatenate([real[i], -weights[i]]))
                    gains[i] += sign * distance / self.floor[name] / len(self.floor)
        return gains


def _halves(traces: Traces, rng: np.random.Generator) -> tuple[Traces, Traces]:
    """Two random halves of a table, in runs of neighbours."""
    runs = np.arange(len(traces)) // RUN
    n_runs = int(runs[-1]) + 1
    first = np.isin(runs, rng.permutation(n_runs)[: n_runs // 2])
    return traces[first], traces[~first]


def _quantiles(view: NDArray[np.float64]) -> NDArray[np.float64]:
    """(QUANTILES,) values that split a view into equal shares."""
    ordered = np.sort(view, axis=None)
    at = ((np.arange(QUANTILES) + 0.5) / QUANTILES * len(ordered)).astype(int)
    return np.asarray(ordered[at])


def _inside(u: float, span: tuple[float, float, bool]) -> float:
    """A number at this place of its plausible range; places outside 0 … 1 are reflected."""
    low, high, log = span
    u = abs(u) % 2
    u = 2 - u if u > 1 else u
    return float(low * (high / low) ** u if log else low + u * (high - low))


def _unused(kind: str | None, name: str, shape: dict[str, Any]) -> bool:
    """A parameter of another form of the effect, by what its description says: "… (two_populations)"."""
    if kind is None:
        return False
    words = effect_class(kind).model_fields[name].description or ""
    others = [form for form in effect_class(kind).forms() if form and form != shape.get("form")]
    return any(f"({form})" in words for form in others)


def _known(kind: str) -> str:
    try:
        return effect_class(kind).kind
    except ValueError as error:
        raise MufasaError(str(error)) from None


def _counter(progress: Progress | None, total: int) -> Callable[[], None]:
    done = itertools.count(1)

    def report() -> None:
        if progress is not None:
            progress(next(done), total)

    return report
