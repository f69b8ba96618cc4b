"""What a diagnosis says: plain data, ready for JSON, tables, figures and the viewer (docs/files.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

    from napari_mufasa.model.model import Model

Verdict = Literal["adequate", "missing_effect", "unexplained"]
ERROR_UNIT = "rms whitened residual of the held-out observables (1 = noise of the measurement)"


@dataclass(frozen=True)
class Candidate:
    """One effect's case: how much of the misfit it explains, with which parameters.

    `p_value` is the calibrated probability of so much evidence when nothing is missing; `error_after` the
    held-out error with the effect in the model; `error_without` of one that is in it: without it, the others adjusted;
    `share_explained` the part of the removable error it removes.
    """

    effect: str
    p_value: float
    evidence: float
    error_after: float | None
    share_explained: float | None
    parameters: dict[str, Any]
    parameters_sd: dict[str, float]
    indistinguishable_from: tuple[str, ...] = ()
    error_without: float | None = None

    def to_dict(self) -> dict[str, Any]:
        return {
            "effect": self.effect,
            "p_value": self.p_value,
            "evidence": self.evidence,
            "error_after": self.error_after,
            "error_without": self.error_without,
            "share_explained": self.share_explained,
            "parameters": self.parameters,
            "parameters_sd": self.parameters_sd,
            "indistinguishable_from": list(self.indistinguishable_from),
        }


@dataclass(frozen=True)
class Curve:
    """An observable as a curve: measured, base model and completed model, with one standard deviation."""

    name: str
    title: str
    x_label: str
    y_label: str
    x: NDArray[np.float64]
    measured: NDArray[np.float64]
    before: NDArray[np.float64]
    before_sd: NDArray[np.float64]
    after: NDArray[np.float64]
    after_sd: NDArray[np.float64]


@dataclass(frozen=True)
class Report:
    """The answer of `diagnose` and of a hand-made refinement.

    Attributes
    ----------
    verdict : "adequate", "missing_effect" or "unexplained"
    error : before, after, floor and their unit, all on data not used for fitting
    failing : observables off in the base model, worst first: observable, title, unit, z, z_after, where
    ranking : candidates, best first
    chosen : effects added, in order
    history : error after each step, the base model first
    model : the completed model, ready to simulate; `base` : the model believed, nuisance values re-fitted
    observables : table of all observables: observable, title, unit, where, measured, sd, before, after,
        z_before, z_after
    curves : what to draw
    evidence_needed : what the best effect must bring for an alarm (a chance of 2 % when nothing is missing)
    detectable : for each effect not in the model, the smallest strength this data would have shown with 80 % power (or
        None)
    notes : sentences about choices made (crop, subset, what stays off)
    seconds, seed : time by the clock; what chance was drawn from
    w1 : of a table of traces, W1 per frame between it and simulations: before, after, floor, unit; empty for movies
    inclusion : for each effect added, how sure its name is, 0 … 1, against what would explain as much in its place
        and what nothing explains
    alternatives : sets of kinds, each of an effect added and those that the data cannot tell it from
    explained : share of the misfit beyond chance that the additions take away, 0 … 1
    credibility : how many times fewer molecules or frames before nobody could tell completed model and movie apart
        (1: they cannot be told apart now); `credibility_before`: of the model believed
    remaining : observables still off, worst first: observable, title, z, measured, simulated and their unit
    simulations : spent, and the budget · cut_short : the budget left no room for what might explain the rest
    suspects : the only kinds that were considered; [] where all of the catalogue were
    camera : what of the camera the movie contradicts, and what is found in its place; "" where nothing
    check : what data that the finding has not seen say of it (`Confirmation.to_dict`, "against" what); {} where nobody
        asked
    """

    verdict: Verdict
    error: dict[str, Any]
    failing: list[dict[str, Any]]
    ranking: list[Candidate]
    chosen: list[str]
    history: list[dict[str, Any]]
    model: Model
    base: Model
    observables: pd.DataFrame
    curves: list[Curve]
    seconds: float
    seed: int
    evidence_needed: float | None = None
    detectable: dict[str, float | None] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    w1: dict[str, Any] = field(default_factory=dict)
    inclusion: dict[str, float] = field(default_factory=dict)
    alternatives: list[list[str]] = field(default_factory=list)
    explained: float = 0.0
    credibility: float = 1.0
    credibility_before: float = 1.0
    remaining: list[dict[str, Any]] = field(default_factory=list)
    simulations: dict[str, int] = field(default_factory=dict)
    cut_short: bool = False
    check: dict[str, Any] = field(default_factory=dict)
    suspects: list[str] = field(default_factory=list)
    camera: str = ""

    def to_dict(self) -> dict[str, Any]:
        """report.json of docs/files.md, with the additions a reader wants."""
        return {
            "verdict": self.verdict,
            "error": self.error,
            "failing": self.failing,
            "ranking": [candidate.to_dict() for candidate in self.ranking],
            "chosen": self.chosen,
            "history": self.history,
            "model": self.model.to_dict(),
            "seconds": self.seconds,
            "seed": self.seed,
            "evidence_needed": self.evidence_needed,
            "detectable": self.detectable,
            "notes": self.notes,
            "inclusion": self.inclusion,
            "alternatives": self.alternatives,
            "explained": self.explained,
            "credibility": self.credibility,
            "credibility_before": self.credibility_before,
            "remaining": self.remaining,
            "simulations": self.simulations,
            "cut_short": self.cut_short,
            "suspects": self.suspects,
            "camera": self.camera,
            "check": self.check,
            **({"w1": self.w1} if self.w1 else {}),
        }

    def to_json(self, path: str) -> None:
        """Write report.json, whole or not at all."""
        from napari_mufasa.files.whole import write_json

        write_json(path, self.to_dict())
