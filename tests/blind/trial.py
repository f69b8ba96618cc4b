"""The blind trial: hidden effects from the independent generator, diagnosed from movie, dark frames and model.

    python -m tests.blind.trial                       the whole trial (hours); writes docs/blind_trial.md when it ends
    python -m tests.blind.trial --quick               a few minutes: short movies, one seed; writes no page
    python -m tests.blind.trial --groups several --seeds 10    ten movies that lack three to five effects; no page
    python -m tests.blind.trial --table ROWS.jsonl    docs/blind_trial.md from the rows of a trial, nothing is run

The truth stays with this script; `diagnose` gets the movie, the dark frames and the believed model only. Every case
appends a row to `--results` as it ends, so that a stopped trial goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import napari_mufasa as nm

from . import generator

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "blind_trial.md"
GROUPS = "single,null,pair,off"
STRENGTHS = (0.4, 0.6, 0.8)  # "visible": 0.5 is clearly visible by the generator's own scale
PAIRS = (
    ("photobleaching", "stage_drift"), ("triplet_blinking", "background_decay"), ("laser_drift", "row_noise"),
    ("illumination_profile", "hot_pixels"), ("focus_drift", "column_offset"), ("molecule_diffusion", "laser_flicker"),
    ("delayed_activation", "image_lag"), ("brightness_heterogeneity", "baseline_drift"),
    ("long_dark_state", "background_gradient"), ("astigmatism", "periodic_modulation"),
)  # fmt: skip


APART = ({"em_excess_noise", "detector_saturation"}, {"multiple_emitters", "photobleaching"})

# Parameters that the catalogue and the generator mean alike, in the generator's first form of each effect.
SAME_MEANING = {
    "triplet_blinking": {"off_rate_per_s": "to_dark_rate_per_s", "dark_time_s": "mean_dark_s"},
    "long_dark_state": {"off_rate_per_s": "to_dark_rate_per_s", "dark_time_s": "mean_dark_s"},
    "photobleaching": {"rate_per_s": "bleaching_rate_per_s"},
    "delayed_activation": {"fraction": "inactive_fraction", "activation_rate_per_s": "activation_rate_per_s"},
    "brightness_heterogeneity": {"spread": "cv_in_this_movie"},
    "multiple_emitters": {"fraction": "multiple_fraction"},
    "laser_drift": {"change": "relative_change"},
    "laser_flicker": {"rms": "rms"},
    "periodic_modulation": {"amplitude": "amplitude", "period_frames": "period_frames"},
    "stage_drift": {"distance_px": "total_px"},
    "focus_drift": {"widening": "relative_widening"},
    "background_decay": {"fraction": "decaying_share"},
    "em_excess_noise": {"excess_noise_factor": "excess_noise_factor"},
    "clock_induced_charge": {"electrons": "extra_e_per_px"},
    "pixel_gain_variation": {"rms": "gain_sd"},
    "column_offset": {"rms_adu": "rms_adu"},
    "row_noise": {"rms_adu": "rms_adu"},
    "hot_pixels": {"fraction": "fraction_in_this_movie"},
    "image_lag": {"fraction": "lag_fraction"},
    "baseline_drift": {"drift_adu": "change_adu"},
    "cosmic_rays": {"hits_per_frame": "hits_per_frame"},
}


def cases(seeds: range, nulls: int, groups: set[str]) -> Iterator[dict[str, Any]]:
    """All cases, seed by seed, so that a trial cut short is still balanced."""
    for seed in seeds:
        if "single" in groups:
            for i, kind in enumerate(generator.EFFECTS):
                strength = STRENGTHS[(seed + i) % len(STRENGTHS)]
                yield {"group": "single", "effects": [[kind, strength]], "seed": 1000 + 37 * seed + i}
        if "pair" in groups:
            for i, pair in enumerate(PAIRS):
                yield {"group": "pair", "effects": [[k, 0.5] for k in pair], "seed": 3000 + 37 * seed + i}
        if "several" in groups:
            yield {"group": "several", "effects": several(seed), "seed": 7000 + seed}
        if "off" in groups:
            for i, kind in enumerate(generator.OFF_CATALOGUE):
                yield {"group": "off", "off": kind, "effects": [], "seed": 4000 + 37 * seed + i}
        if "null" in groups:
            for i in range(-(-nulls // len(seeds))):
                yield {"group": "null", "effects": [], "seed": 2000 + 101 * seed + i}


def several(seed: int) -> list[list[Any]]:
    """Three to five effects, clearly visible each alone. Two that are alike by definition are not drawn together, nor
    several emitters with a bleaching that their base has already."""
    rng = np.random.default_rng(7000 + seed)
    while True:
        kinds = [str(kind) for kind in rng.choice(list(generator.EFFECTS), 3 + seed % 3, replace=False)]
        if not any(pair <= set(kinds) for pair in APART):
            return [[kind, 0.5] for kind in kinds]


def run(case: dict[str, Any], base: str | None) -> dict[str, Any]:
    """Make the movie, diagnose it without the truth, then compare."""
    kinds = [kind for kind, _ in case["effects"]]
    name = base or ("emccd_bleach" if "multiple_emitters" in kinds else "emccd")
    believed = generator.base_model(name)
    n = 25 if name == "emccd_short" else 50
    if case["group"] == "off":
        hidden = generator.off_catalogue(believed, case["off"], case["seed"], n_molecules=n)
    else:
        hidden = generator.make(believed, effects=[tuple(e) for e in case["effects"]], seed=case["seed"], n_molecules=n)
    report = nm.diagnose(hidden.movie, nm.Model.from_dict(believed), hidden.dark, seed=case["seed"])
    ranking = [c.effect for c in report.ranking]
    return case | {
        "base": name,
        "forms": [e["form"] for e in hidden.truth["effects"]],
        "verdict": report.verdict,
        "chosen": report.chosen,
        "ranking": ranking[:5],
        "error": {k: v for k, v in report.error.items() if k != "unit"},
        "seconds": report.seconds,
        "z": [f["observable"] for f in report.failing[:5]],
        "pulls": pulls(hidden.truth["effects"], report),
        "state": state_of_the_code(),
    }


def state_of_the_code() -> str:
    """The commit that ran, "+" behind it where files differ from it."""
    told = subprocess.run(
        ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+"], capture_output=True, text=True, check=False
    )
    return told.stdout.strip() or f"version {nm.__version__}"


def pulls(truths: list[dict[str, Any]], report: Any) -> dict[str, float]:
    """(found − true) / stated sd of the parameters of effects rightly added, where both mean the same."""
    found = {c.effect: c for c in report.ranking if c.effect in report.chosen}
    result = {}
    for truth in truths:
        if truth["kind"] not in found or truth["form_index"] != 0:
            continue
        candidate = found[truth["kind"]]
        for name, its_name in SAME_MEANING.get(truth["kind"], {}).items():
            if name in candidate.parameters_sd:
                off = candidate.parameters[name] - truth["parameters"][its_name]
                result[f"{truth['kind']}.{name}"] = off / candidate.parameters_sd[name]
    return result


def summary(results: list[dict[str, Any]]) -> str:
    """The confusion table and the rates of DISCOVERY's targets, as Markdown."""
    lines = []
    groups = defaultdict(list)
    for r in results:
        groups[r["group"]].append(r)

    def rate(rows: list[dict[str, Any]], test: Any) -> str:
        hits = sum(bool(test(r)) for r in rows)
        return f"{hits} / {len(rows)} ({hits / max(len(rows), 1):.0%})"

    lines += ["| what | rate |", "|---|---|"]
    if single := groups["single"]:
        lines += [
            f"| right effect first | {rate(single, lambda r: r['ranking'][:1] == [r['effects'][0][0]])} |",
            f"| among the first three | {rate(single, lambda r: r['effects'][0][0] in r['ranking'][:3])} |",
            f"| exactly the right set chosen | {rate(single, lambda r: r['chosen'] == [r['effects'][0][0]])} |",
            f"| error after ≤ 1.25 × floor | {rate(single, _at_the_floor)} |",
        ]

    if groups["null"]:
        lines.append(f"| nothing hidden: adequate | {rate(groups['null'], lambda r: r['verdict'] == 'adequate')} |")
    if groups["off"]:
        lines.append(
            f"| off the catalogue: unexplained | {rate(groups['off'], lambda r: r['verdict'] == 'unexplained')} |"
        )
    if groups["pair"]:
        both = lambda r: {k for k, _ in r["effects"]} <= set(r["chosen"])  # noqa: E731
        lines.append(f"| two effects: both named | {rate(groups['pair'], both)} |")
    if many := groups["several"]:
        hidden = [{k for k, _ in r["effects"]} for r in many]
        found = sum(len(true & set(r["chosen"])) for true, r in zip(hidden, many, strict=True))
        named = sum(len(r["chosen"]) for r in many)
        lines += [
            f"| three to five: effects found | {found} / {sum(map(len, hidden))} |",
            f"| three to five: wrong names of those given | {named - found} / {named} |",
            f"| three to five: error after ≤ 1.25 × floor | {rate(many, _at_the_floor)} |",
        ]
    pulled = [pull for r in results for pull in r.get("pulls", {}).values()]
    if pulled:
        inside = sum(abs(pull) <= 1.96 for pull in pulled)
        lines.append(f"| parameters within 95 % | {inside} / {len(pulled)} ({inside / len(pulled):.0%}) |")
    lines += ["", "| hidden | cases | first | chosen | error before → after (floor) |", "|---|---|---|---|---|"]
    table = defaultdict(list)
    for r in results:
        table[r.get("off") or " + ".join(k for k, _ in r["effects"]) or "nothing"].append(r)
    for hidden, rows in table.items():
        first = Counter(r["ranking"][0] if r["ranking"] else r["verdict"] for r in rows)
        chosen = Counter(" + ".join(r["chosen"]) or r["verdict"] for r in rows)
        mean = [sum(r["error"][k] for r in rows) / len(rows) for k in ("before", "after", "floor")]
        lines.append(
            f"| {hidden} | {len(rows)} | {_counted(first)} | {_counted(chosen)} | "
            f"{mean[0]:.2f} → {mean[1]:.2f} ({mean[2]:.2f}) |"
        )
    return "\n".join(lines) + "\n"


def _at_the_floor(result: dict[str, Any]) -> bool:
    return bool(result["error"]["after"] <= 1.25 * result["error"]["floor"])


def _counted(counter: Counter[str]) -> str:
    return ", ".join(f"{name} {n}" if n > 1 else name for name, n in counter.most_common())


def page(rows: list[dict[str, Any]], command: str) -> str:
    """docs/blind_trial.md: which command wrote it, from which state of the code, and the tables."""
    states = ", ".join(sorted({row.get("state", "one that its rows do not tell") for row in rows}))
    head = f"`{command}` wrote this page from {len(rows)} cases; a case is one movie. State of the code: {states}."
    return f"# Blind trial\n\n{head}\n\n{summary(rows)}"


def read_rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _name(case: dict[str, Any]) -> tuple[Any, ...]:
    return case["group"], case["seed"], case.get("off")


def main(arguments: Sequence[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0, help="other seeds, other movies")
    parser.add_argument("--nulls", type=int, default=40)
    parser.add_argument("--base", help="one base model for all cases, e.g. emccd_short")
    parser.add_argument("--groups", default=GROUPS)
    parser.add_argument("--quick", action="store_true", help="short movies, one seed, five nulls, no pairs, no page")
    parser.add_argument("--results", type=Path, help="rows of the cases (default: build/trial.jsonl or …/quick.jsonl)")
    parser.add_argument("--share", default="0/1", help="1/2: the second half of the cases, for two processes at once")
    parser.add_argument("--table", type=Path, metavar="ROWS.jsonl", help="write the page from these rows, run nothing")
    options = parser.parse_args(arguments)
    command = shlex.join(["python", "-m", "tests.blind.trial", *arguments])
    if options.table is not None:
        if not (rows := read_rows(options.table)):
            parser.error(f"{options.table} has no rows: give the file that a trial wrote (--results)")
        PAGE.write_text(page(rows, command))
        return
    if options.quick:
        options.seeds, options.nulls, options.base, options.groups = 1, 5, "emccd_short", "single,null"
    results = options.results or ROOT / "build" / ("quick.jsonl" if options.quick else "trial.jsonl")
    results.parent.mkdir(parents=True, exist_ok=True)
    mine, shares = (int(n) for n in options.share.split("/"))
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    planned = list(cases(seeds, options.nulls, set(options.groups.split(","))))
    finished = {_name(row) for row in read_rows(results)}
    for i, case in enumerate(planned):
        if i % shares != mine or _name(case) in finished:
            continue
        row = json.dumps(run(case, options.base))
        with results.open("a") as file:
            file.write(row + "\n")
        print(row, flush=True)
    wanted = {_name(case) for case in planned}
    rows = [row for row in read_rows(results) if _name(row) in wanted]
    print(summary(rows))
    # Of two processes that share the cases, the one that ends last has them all.
    whole = not options.quick and options.base is None and set(options.groups.split(",")) == set(GROUPS.split(","))
    if whole and len(rows) == len(planned):
        PAGE.write_text(page(rows, command))


if __name__ == "__main__":
    main()
