"""A made-up diagnosis with every field filled: what reports and figures are tested on without running one."""

from __future__ import annotations

import numpy as np
import pandas as pd
from tests.spec_example import MODEL

from napari_mufasa.discover.detection import Look, Power
from napari_mufasa.discover.result import ERROR_UNIT, Candidate, Curve, Report
from napari_mufasa.effects import Effect
from napari_mufasa.model.model import Model


def candidate(effect: str, evidence: float, after: float | None, alike: tuple[str, ...] = ()) -> Candidate:
    values = {
        "triplet_blinking": ({"off_rate_per_s": 5.2, "dark_time_s": 0.041, "form": "exponential"}, (0.4, 0.003)),
        "long_dark_state": ({"off_rate_per_s": 0.9, "dark_time_s": 0.5, "form": "exponential"}, (0.2, 0.1)),
    }
    parameters, sd = values.get(effect, ({}, (0.0, 0.0)))
    return Candidate(
        effect=effect,
        p_value=1e-6 if evidence > 12 else 0.4,
        evidence=evidence,
        error_after=after,
        share_explained=None if after is None else (2.93 - after) / (2.93 - 0.98),
        parameters=parameters,
        parameters_sd={"off_rate_per_s": sd[0], "dark_time_s": sd[1]} if parameters else {},
        indistinguishable_from=alike,
    )


def report(verdict: str = "missing_effect") -> Report:
    base = Model.from_dict(MODEL)
    effect = {"kind": "triplet_blinking", "off_rate_per_s": 5.2, "dark_time_s": 0.041}
    lags = np.array([1.0, 2, 3, 5, 10, 20, 50])
    truth, flat = 0.4 * np.exp(-lags / 2.5), np.zeros(7)
    rng = np.random.default_rng(1)
    sd = np.full(7, 0.012)
    names = [f"trace_autocorrelation_{int(lag)}" for lag in lags] + ["level_spread", "background_mean", "spot_width"]
    before = np.concatenate([(truth / sd), [4.1, -0.6, 1.3]])
    table = pd.DataFrame(
        {
            "observable": names,
            "title": [f"Trace autocorrelation at lag {int(lag)}" for lag in lags]
            + ["Spread of levels across molecules", "Background <mean>", "Spot width"],
            "unit": [""] * 8 + ["photoelectrons", "px"],
            "where": [f"lag {int(lag)} frames" for lag in lags] + ["all frames"] * 3,
            "measured": np.concatenate([truth, [0.31, 9.0, 1.29]]),
            "sd": np.concatenate([sd, [0.02, 0.1, 0.01]]),
            "before": np.concatenate([flat, [0.22, 9.06, 1.28]]),
            "after": np.concatenate([truth, [0.3, 9.0, 1.28]]),
            "z_before": before,
            "z_after": rng.standard_normal(10),
        }
    )
    adequate = verdict == "adequate"
    chosen = ["triplet_blinking"] if verdict == "missing_effect" else []
    history = [{"model": "base", "error": 1.01 if adequate else 2.93}]
    if chosen:
        history.append({"added": "triplet_blinking", "error": 1.04})
    worst = table.sort_values("z_before", ascending=False).head(4)
    failing = [
        {"observable": r.observable, "title": r.title, "unit": r.unit, "z": r.z_before, "z_after": r.z_after,
         "where": r.where}
        for r in worst.itertuples()
    ]  # fmt: skip
    return Report(
        verdict=verdict,  # type: ignore[arg-type]
        error={"before": history[0]["error"], "after": history[-1]["error"], "floor": 0.98, "unit": ERROR_UNIT},
        failing=[] if adequate else failing,
        ranking=[
            candidate("triplet_blinking", 260.0, 1.04, ("long_dark_state",)),
            candidate("long_dark_state", 240.0, 1.31),
            candidate("em_excess_noise", 80.0, 2.4),
            candidate("molecule_diffusion", 30.0, 2.7),
            candidate("stage_drift", 2.0, None),
        ],
        chosen=chosen,
        history=history,
        model=base.with_values({"effects": [effect]}) if chosen else base,
        base=base,
        observables=table,
        curves=[
            Curve("autocorrelation", "Trace autocorrelation", "lag (frames)", "correlation", lags,
                  truth + 0.01 * rng.standard_normal(7), flat, sd, truth, sd),
            Curve("survival", "Molecules still shining", "frame", "share", lags * 6,
                  np.exp(-lags / 200), np.exp(-lags / 190), sd, np.exp(-lags / 200), sd),
        ],
        seconds=41.0,
        seed=1,
        evidence_needed=12.0,
        alternatives=[["triplet_blinking", "long_dark_state"]] if chosen else [],
        explained=0.994 if chosen else 0.0,
        credibility=1.0 if adequate else 1.4 if chosen else 21.3,
        credibility_before=1.0 if adequate else 21.3,
        remaining=[{"observable": "spot_width", "title": "Spot width", "z": 4.2, "measured": 1.29, "simulated": 1.28,
                    "unit": "px"}] if chosen else [],
        detectable={"stage_drift": 0.3, "focus_drift": 0.1, "cosmic_rays": None},
        notes=["Fitted on frames 0–199, judged on frames 200–299."],
    )  # fmt: skip


def power(effect: Effect, movies: int, *seen: int) -> Power:
    """How often an effect is seen, made up: each look sees it in so many of its movies, and then before any other."""
    sees = [np.arange(movies) < n for n in seen]
    return Power(effect, tuple(Look(12.0, np.where(s, 20.0, 3.0), s) for s in sees))
