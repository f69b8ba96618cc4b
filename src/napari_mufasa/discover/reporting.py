"""From an investigation to a report: verdict, errors, tables and curves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from napari_mufasa.discover import nuisance
from napari_mufasa.discover.null import ALARM, MISFIT_ALARM
from napari_mufasa.discover.result import ERROR_UNIT, Candidate, Report, Verdict
from napari_mufasa.discover.standing import Standing
from napari_mufasa.discover.state import SCALES, State, scaled
from napari_mufasa.model.model import Model

OFF = 3.0  # an observable further off than so many standard deviations is called failing
EXPLAINED = 0.6  # share of the removable error that an explanation must remove
FAR = 1.35  # an error above so many floors is not explained, however far it fell
STILL_OFF = 0.001  # chance level of what an explanation leaves: of its misfit, and of the observable farthest off
CURVE_SEED, CURVE_SIMULATIONS = 7_000, 6
NOT_HERE = "not measurable here"  # where an observable is that the measurement or some simulation does not show


def compile_report(inquiry: Standing, verdict: Verdict | None = None) -> Report:
    """Everything a report holds, from the investigation as it stands."""
    base, x, final, model = inquiry.first_view.state, inquiry.x, inquiry.state, inquiry.model
    states = [view.state for view in inquiry.views]
    errors = [state.held_out_error(x) for state in states]
    floor = final.floor
    history: list[dict[str, Any]] = [{"model": "base", "error": errors[0]}]
    history += [{"added": kind, "error": error} for kind, error in zip(inquiry.chosen, errors[1:], strict=True)]
    table = _table(inquiry, final)
    numbers = range(CURVE_SEED, CURVE_SEED + CURVE_SIMULATIONS)
    before = inquiry.bench.observations([(base.model, k) for k in numbers])
    after = inquiry.bench.observations([(model, k) for k in numbers]) if inquiry.chosen else before
    verdict = verdict or verdict_of(inquiry, errors, floor)
    completed = inquiry.bench.restored(model, inquiry.believed)
    return Report(
        verdict=verdict,
        error={"before": errors[0], "after": errors[-1], "floor": floor, "unit": ERROR_UNIT},
        failing=_failing(table),
        ranking=[_as_it_stands(candidate, model) for candidate in inquiry.ranking],
        chosen=inquiry.chosen,
        history=history,
        model=completed,
        base=inquiry.bench.restored(base.model, inquiry.believed),
        observables=table,
        curves=inquiry.bench.curves(before, after),
        seconds=inquiry.seconds,
        seed=inquiry.seed,
        evidence_needed=inquiry.null.evidence.at(ALARM),
        detectable=detectable(inquiry) if verdict == "adequate" else {},
        w1=inquiry.bench.w1(before, after),
        notes=[*inquiry.bench.notes, *_notes(inquiry, verdict, table, completed)],
    )


def _as_it_stands(candidate: Candidate, model: Model) -> Candidate:
    """An effect that was added has the parameters it has in the model: later steps may have moved them."""
    effect = next((e for e in model.effects if e.kind == candidate.effect), None)
    return candidate if effect is None else replace(candidate, parameters=effect.parameters())


def verdict_of(inquiry: Standing, errors: list[float], floor: float) -> Verdict:
    """adequate, missing_effect or unexplained (docs/discovery.md)."""
    if not inquiry.chosen:
        if not inquiry.alarmed():
            return "adequate"
        if not inquiry.ranking:
            return "unexplained"
        # Effects were fitted and none was added (yet). An alarm of the emulator that no fit confirms, or that more
        # simulations of the fit refute, is chance, unless the misfit as a whole is beyond chance, too.
        if inquiry.convincing(inquiry.ranking[0]):
            return "missing_effect"
        return "unexplained" if inquiry.null.misfit.p(inquiry.state.misfit(inquiry.x)) < MISFIT_ALARM else "adequate"
    share = (errors[0] - errors[-1]) / max(errors[0] - floor, 1e-9)
    left = inquiry.null.misfit.p(inquiry.state.misfit(inquiry.x))
    far = share < EXPLAINED or errors[-1] > FAR * floor
    return "unexplained" if (left < STILL_OFF and far) or _one_is_off(inquiry.state, inquiry.x) else "missing_effect"


def _one_is_off(state: State, x: NDArray[np.float64]) -> bool:
    """Is one observable so far off that chance would leave none of them there?"""
    off = np.abs(state.adjusted(x).soft[state.measurable])
    return bool(off.max() > stats.norm.isf(STILL_OFF / (2 * off.size)))


def detectable(inquiry: Standing) -> dict[str, float | None]:
    """The smallest strength of each effect that this data would have shown with 80 % power, by the emulator."""
    state, null = inquiry.state, inquiry.null
    threshold = null.evidence.at(ALARM)
    w, spread = state.whiten[0], state.spread[0]
    slope = np.vstack([w @ (state.slopes[0] / spread[:, None]), np.diag(1 / state.prior)])
    q, _ = np.linalg.qr(slope)
    found: dict[str, float | None] = {}
    for kind, rays in inquiry.library.rays.items():
        strengths = []
        for ray in rays:
            for scale in sorted({*SCALES, 0.03, 0.06}):
                step = np.pad(w @ (8.0 * np.arcsinh(ray.shift[0] * scale / spread / 8.0)), (0, len(state.prior)))
                power = float(((step - q @ (q.T @ step)) ** 2).sum())
                if power - 0.84 * 2 * np.sqrt(power) > threshold:
                    strengths.append(abs(float(getattr(scaled(ray.effect, scale, ray.none), ray.effect.strength))))
                    break
        found[kind] = float(np.median(strengths)) if len(strengths) > len(rays) / 2 else None
    return found


def _table(inquiry: Standing, final: State) -> pd.DataFrame:
    """One row per observable: measured, models, z-scores, free values at their best."""
    measured, base = inquiry.bench.measured, inquiry.first_view.state
    rows = []
    means, scores = [], []
    for state in (base, final):
        moves = state.adjusted(inquiry.x).moves
        mean = state.mean[0] + state.slopes[0] @ moves
        means.append(np.where(state.measurable, mean, np.nan))
        scores.append(np.where(state.measurable, (inquiry.x[0] - mean) / state.spread[0], np.nan))
    for i, name in enumerate(measured.names):
        meaning, known = measured.meanings[name], base.measurable[i] and final.measurable[i]
        rows.append(
            {
                "observable": name, "title": meaning.title, "unit": meaning.unit,
                "where": meaning.where if known else NOT_HERE,
                "measured": measured.values[0, i], "sd": base.spread[0, i] if known else np.nan,
                "before": means[0][i], "after": means[1][i],
                "z_before": scores[0][i], "z_after": scores[1][i],
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def _failing(table: pd.DataFrame) -> list[dict[str, Any]]:
    off = table[table.z_before.abs() > OFF].sort_values("z_before", key=np.abs, ascending=False)
    return [
        {
            "observable": row.observable, "title": row.title, "unit": row.unit, "z": float(row.z_before),
            "z_after": float(row.z_after), "where": row["where"],
        }
        for _, row in off.iterrows()
    ]  # fmt: skip


def _notes(inquiry: Standing, verdict: Verdict, table: pd.DataFrame, completed: Model) -> list[str]:
    notes = []
    if changes := nuisance.told(inquiry.believed, completed):
        notes.append(f"Values of the model fitted beside the effects: {changes}.")
    if len(unknown := table[table["where"] == NOT_HERE].title):
        notes.append(f"Not measurable here, and left out of every error and decision: {'; '.join(unknown)}.")
    if gaps := table[table.observable.isin(inquiry.bench.gaps)].title.tolist():
        notes.append(
            f"Not shown by every simulation with an effect, and no evidence for or against it there: {'; '.join(gaps)}."
        )
    left = table[table.z_after.abs() > OFF]
    if inquiry.chosen and len(left):
        worst = left.sort_values("z_after", key=np.abs, ascending=False).title.head(4)
        notes.append(f"Still off after the additions: {'; '.join(worst)}.")
    if verdict == "unexplained" and inquiry.ranking:
        notes.append(
            f"No effect in the catalogue explains this. The nearest resemblance is {inquiry.ranking[0].effect}."
        )
    return notes
