"""What each kind of work writes into its folder: names of files, as patterns. They are replaced together."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

TRUTH = ("emission.csv", "positions.csv", "simulate.provenance.json")
TRACES = (
    "traces.csv", "molecules.csv", "paths.csv", "traces.h5", "traces.openfret.json", "molecules.png",
    "traces.png", "traces.provenance.json",
)  # fmt: skip
#: What traces of two channels writes, too.
PAIR = ("donor.csv", "acceptor.csv", "efficiency.png")
#: … and this, which `register` writes as well: what is another's is not removed.
REGISTRATION = "channels.json"
COMPARISON = (
    "report.json", "w1.png", "counts.png", "distributions.png", "measured_traces.png", "compare.provenance.json",
)  # fmt: skip
DIAGNOSIS = (
    "report.json", "report.html", "model.json", "observables.csv", "error_staircase.png", "evidence.png",
    "observables.png", "curves.png", "strength_*.png", "traces.png", "diagnose.provenance.json",
    "refine.provenance.json",
)  # fmt: skip
DENOISED = ("denoised.ome.tif",)


def is_one_of(name: str, patterns: Sequence[str]) -> bool:
    """Whether a file is an output of that name; what is hidden is none."""
    return not name.startswith(".") and any(fnmatchcase(name, pattern) for pattern in patterns)
