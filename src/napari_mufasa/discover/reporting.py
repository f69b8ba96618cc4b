"""From an investigation to a report: verdict, errors, tables and curves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from napari_mufasa.discover import camera, joint, nuisance
from napari_mufasa.discover.metric import soften, stretch
from napari_mufasa.discover.result import ERROR_UNIT, Report, Verdict
from napari_mufasa.discover.rules import CURVES, EXPLAINED, FAR, MISFIT_ALARM, OFF, SCALES, STILL_OFF, UNSURE
from napari_mufasa.discover.stand import Stand
from napari_mufasa.discover.standing import Standing
from napari_mufasa.effects import effect_class
from napari_mufasa.model.model import Model
from napari_mufasa.one_thread import one_thread

CURVE_SEED = 7_000
DETECTABLE = np.geomspace(0.01, max(SCALES), 100)  # of a setting: strengths that are asked for, 5 % apart
NOT_HERE = "not measurable here"  # where an observable is that the measurement or many simulations do not show


def compile_report(inquiry: Standing, verdict: Verdict | None = None) -> Report:
    """Everything a report holds, from the investigation as it stands."""
    base, final, stand, model = inquiry.first.state, inquiry.state, inquiry.stand, inquiry.model
    table = _table(inquiry)
    numbers = range(CURVE_SEED, CURVE_SEED + CURVES)
    before = inquiry.bench.observations([(base.model, k) for k in numbers])
    after = inquiry.bench.observations([(model, k) for k in numbers]) if stand.added else before
    verdict = verdict or verdict_of(inquiry)
    completed = inquiry.bench.restored(model, inquiry.believed)
    names = sure_of_names(stand)
    cut_short = verdict != "adequate" and not stand.content and not inquiry.affords(1)
    ranking = [*inquiry.candidates(), *(c for c in inquiry.ranking if c.effect not in stand.added)]
    return Report(
        verdict=verdict,
        error={"before": inquiry.first.error, "after": stand.error, "floor": final.floor, "unit": ERROR_UNIT},
        failing=_failing(table),
        ranking=ranking,
        chosen=list(stand.added),
        history=_history(inquiry),
        model=completed,
        base=inquiry.bench.restored(base.model, inquiry.believed),
        observables=table,
        curves=inquiry.bench.curves(before, after),
        seconds=inquiry.seconds,
        seed=inquiry.seed,
        evidence_needed=stand.null.needed(ranking[0].effect) if ranking else None,
        detectable=detectable(inquiry),
        w1=inquiry.bench.w1(before, after),
        notes=[*inquiry.bench.notes, *_notes(inquiry, verdict, cut_short, table, completed)],
        inclusion={kind: round(sure, 4) for kind, (sure, _) in names.items()},
        alternatives=[[kind, *others] for kind, (_, others) in names.items() if others],
        explained=_explained(inquiry),
        credibility=credibility(stand),
        credibility_before=credibility(inquiry.first),
        remaining=_remaining(table),
        simulations={"spent": inquiry.bench.done, "budget": inquiry.budget},
        cut_short=cut_short,
        suspects=list(inquiry.suspects),
        camera=camera.contradicted(inquiry.believed, model) if inquiry.camera_is_off else "",
    )


def verdict_of(inquiry: Standing) -> Verdict:
    """adequate, missing_effect or unexplained (docs/discovery.md)."""
    first, stand = inquiry.first, inquiry.stand
    left = stand.null.misfit.p(stand.misfit)
    if not stand.added:
        tried = [c for c in inquiry.ranking[:1] if c.error_after is not None]
        if any(c.evidence > stand.needed(c.effect) and (c.error_after or 0.0) < stand.error for c in tried):
            return "missing_effect"
        # An alarm of the emulator that no fit confirms is chance, unless the misfit as a whole is beyond chance, too,
        # or the budget was spent before any fit.
        untried = not tried and stand.alarmed and not inquiry.affords(1)
        # An error far above its floor is not chance, whatever a few simulations have been seen to do.
        return "unexplained" if left < MISFIT_ALARM or untried or stand.far_off else "adequate"
    share = (first.error - stand.error) / max(first.error - stand.state.floor, 1e-9)
    far = share < EXPLAINED or stand.error > FAR * stand.state.floor
    return "unexplained" if (left < STILL_OFF and far) or stand.one_is_off else "missing_effect"


def _history(inquiry: Standing) -> list[dict[str, Any]]:
    """The error after each addition: with several, of the final model with the first of its effects, the first two, …,
    its other values adjusted."""
    stand = inquiry.stand
    found: list[dict[str, Any]] = [{"model": "base", "error": inquiry.first.error}]
    for n, kind in enumerate(stand.added, 1):
        later = stand.added[n:]
        error = joint.removed(stand.library, *later).held_out_error(stand.x) if later else stand.error
        found.append({"added": kind, "error": error})
    return found


def sure_of_names(stand: Stand) -> dict[str, tuple[float, tuple[str, ...]]]:
    """How sure the name of each effect in the model is, and its alternatives where it is not.

    Against it stand the model without it, and each rival that explains its share in its place; evidence is twice the
    log of their odds, divided by Birge's ratio squared where misfit is left. And it may stand in for what nothing
    explains: only so sure can it be as the share which it takes away of the error beyond the floor without it.
    """
    found = {}
    for kind, worth in stand.worths.items():
        scale, rivals = 2 * stand.birge**2, stand.in_place_of(kind)
        odds = [np.exp(-max(d, 0.0) / scale) for d in (worth.evidence, *rivals.values())]
        sure = float(1 / (1 + sum(odds))) * stand.share(kind)
        found[kind] = (sure, tuple(rivals) if sure < UNSURE else ())
    return found


def _excess(stand: Stand, misfit: float) -> float:
    """A misfit beyond what chance leaves, in units of what can just be told from chance."""
    usual = float(stand.null.misfit.law.median())
    return max(misfit - usual, 0.0) / max(stand.null.misfit.at(MISFIT_ALARM) - usual, 1e-9)


def credibility(stand: Stand) -> float:
    """How many times fewer molecules or frames before model and movie could not be told apart: the square of what is
    off, in standard deviations, grows with their number, what chance leaves does not. Near that all is small, so that
    residuals count in full, however large they are now."""
    there = stand.state.adjusted(stand.x)
    in_full = stand.state.whiten[0] @ stretch(there.soft)
    return max(1.0, _excess(stand, there.chi2 + float(in_full @ in_full - there.residual @ there.residual)))


def _explained(inquiry: Standing) -> float:
    before, after = (_excess(stand, stand.misfit) for stand in (inquiry.first, inquiry.stand))
    return float(np.clip(1 - after / before, 0.0, 1.0)) if before > 0 else 0.0


def _remaining(table: pd.DataFrame) -> list[dict[str, Any]]:
    off = table[table.z_after.abs() > OFF].sort_values("z_after", key=np.abs, ascending=False)
    return [
        {
            "observable": row.observable, "title": row.title, "z": float(row.z_after),
            "measured": float(row.measured), "simulated": float(row.after), "unit": row.unit,
        }
        for _, row in off.iterrows()
    ]  # fmt: skip


@one_thread
def detectable(inquiry: Standing) -> dict[str, float | None]:
    """The smallest strength of each effect not in the model that this data would have shown with 80 % power, by the
    emulator; where nothing is another strength than 0, above that."""
    state = inquiry.state
    w, spread = state.whiten[0], state.spread[0]
    slope = np.vstack([w @ (state.slopes[0] / spread[:, None]), np.diag(1 / state.prior)])
    q, _ = np.linalg.qr(slope)
    found: dict[str, float | None] = {}
    for kind, rays in inquiry.stand.library.rays.items():
        distances, threshold = [], inquiry.stand.needed(kind)
        for ray in rays:
            for scale in DETECTABLE:
                step = np.pad(w @ soften(ray.shift[0] * scale / spread), (0, len(state.prior)))
                power = float(((step - q @ (q.T @ step)) ** 2).sum())
                if power - 0.84 * 2 * np.sqrt(power) > threshold:
                    distances.append(scale * abs(float(getattr(ray.effect, ray.effect.strength)) - ray.none))
                    break
        # The middle one of all settings, those that would not be seen being the farthest.
        found[kind] = rays[0].none + sorted(distances)[len(rays) // 2] if len(distances) > len(rays) / 2 else None
    return found


def _table(inquiry: Standing) -> pd.DataFrame:
    """One row per observable: measured, models, z-scores, free values at their best."""
    measured, base, final, x = inquiry.bench.measured, inquiry.first.state, inquiry.state, inquiry.bench.x
    rows = []
    means, scores = [], []
    for state in (base, final):
        moves = state.adjusted(x).moves
        mean = state.mean[0] + state.slopes[0] @ moves
        means.append(np.where(state.measurable, mean, np.nan))
        scores.append(np.where(state.measurable, (x[0] - mean) / state.spread[0], np.nan))
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


def _notes(inquiry: Standing, verdict: Verdict, cut_short: bool, table: pd.DataFrame, completed: Model) -> list[str]:
    notes = []
    if changes := nuisance.told(inquiry.believed, completed):
        notes.append(f"Values of the model fitted beside the effects: {changes}.")
    if completed.effects_refer_to is not None:
        notes.append(
            "Values of the effects speak of the part looked at; the completed model carries their laws beyond it."
        )
    if len(unknown := table[table["where"] == NOT_HERE].title):
        notes.append(f"Not measurable here, and left out of every error and decision: {'; '.join(unknown)}.")
    if gaps := table[table.observable.isin(inquiry.bench.gaps)].title.tolist():
        notes.append(
            f"Not shown by every simulation, and no evidence for or against anything there: {'; '.join(gaps)}."
        )
    if cut_short:
        spent = inquiry.bench.done
        looked = f" (looking took {spent} already)" if spent > inquiry.budget else ""
        room = f"The budget of {inquiry.budget} simulations has no room for a further effect"
        notes.append(f"{room}{looked}: more may be missing.")
    left = table[table.z_after.abs() > OFF]
    if inquiry.chosen and len(left):
        worst = left.sort_values("z_after", key=np.abs, ascending=False).title.head(4)
        notes.append(f"Still off after the additions: {'; '.join(worst)}.")
    if verdict == "unexplained":
        nearest = [c.effect for c in inquiry.ranking] if not inquiry.chosen else list(inquiry.stand.leads)
        what = "the rest" if inquiry.chosen else "this"
        likest = f" It is most like: {effect_class(nearest[0]).title}." if nearest else ""
        none = "No effect of those that were considered" if inquiry.suspects else "No effect in the catalogue"
        notes.append(f"{'No effect was tried that' if cut_short else none} explains {what}.{likest}")
    return notes
