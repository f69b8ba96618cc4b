"""The blind trial: hidden effects from the independent generator, diagnosed from movie, dark frames and model.

    python -m tests.blind.trial                                  the whole trial (hours), rows into build/trial.jsonl
    python -m tests.blind.trial --minutes 60 --share 1/2         its second half, for an hour
    python -m tests.blind.trial --groups single:26,null:20       so many cases of these groups
    python -m tests.blind.trial --quick                          short movies, minutes
    python -m tests.blind.trial --table build/trial.jsonl        docs/blind_trial.md from these rows, which are kept

The truth stays with this script. Every case appends a row as it ends, so a stopped trial goes on where it was; groups
are interleaved, so one cut short is balanced. Nothing but `--table` writes the page.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from . import running
from .bases import BASE_NAMES
from .cases import PLAN, key, planned
from .page import how_many, page, summary

PAGE = running.ROOT / "docs" / "blind_trial.md"
ROWS = running.ROOT / "benchmarks" / "results" / "blind_trial.jsonl"  # those that the page was written from
QUICK = {"single": 26, "null": 5}


def counts(words: str) -> dict[str, int]:
    """ "single:26,null" → {"single": 26, "null": 200}: as many as planned where no number is given."""
    found = {}
    for word in words.split(","):
        name, _, number = word.partition(":")
        if name not in PLAN or (number and not number.isdigit()):
            raise argparse.ArgumentTypeError(f"{word!r}: give groups of {', '.join(PLAN)}, as single or single:26")
        found[name] = int(number) if number else PLAN[name]
    return found


def share(words: str) -> tuple[int, int]:
    mine, _, of = words.partition("/")
    if not (mine.isdigit() and of.isdigit() and int(mine) < int(of)):
        raise argparse.ArgumentTypeError(f"{words!r}: give 0/2 and 1/2 for two processes")
    return int(mine), int(of)


def once(rows: list[running.Row]) -> list[running.Row]:
    """Of a movie that was diagnosed twice, the later row."""
    return list({key(row): row for row in rows}.values())


def main(arguments: Sequence[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", type=counts, help=f"default: {','.join(f'{k}:{n}' for k, n in PLAN.items())}")
    parser.add_argument("--seed", type=int, default=0, help="another seed, other movies")
    parser.add_argument("--base", choices=BASE_NAMES, help="one base model for all cases")
    parser.add_argument("--minutes", type=float, help="stop after the case that exceeds them")
    parser.add_argument("--share", type=share, default=(0, 1), help="1/2: the second half, for two processes at once")
    parser.add_argument("--quick", action="store_true", help="short movies, each effect once, five nulls")
    parser.add_argument("--results", type=Path, help="rows (default: build/trial.jsonl, or build/quick.jsonl)")
    parser.add_argument("--table", type=Path, nargs="+", metavar="ROWS", help="write the page from rows, run nothing")
    options = parser.parse_args(arguments)
    if options.table is not None:
        if not (rows := once(running.read(*options.table))):
            parser.error(f"{options.table[0]} has no rows: give the files that a trial wrote (--results)")
        ROWS.write_text("".join(json.dumps(row) + "\n" for row in rows))
        PAGE.write_text(page(rows, shlex.join(["python", "-m", "tests.blind.trial", *arguments])))
        return
    plan = options.groups or (QUICK if options.quick else PLAN)
    results = options.results or running.ROOT / "build" / ("quick.jsonl" if options.quick else "trial.jsonl")
    cases = planned(plan, options.seed, options.base or ("emccd_short" if options.quick else None))
    finished = {key(row) for row in running.read(results)}
    mine, shares = options.share
    running.state_of_the_code()
    began = time.monotonic()
    for case in cases:
        if case["number"] % shares != mine or key(case) in finished:
            continue
        row = running.run(case) | {"plan": plan}
        running.append(results, row)
        print(json.dumps({k: row[k] for k in ("group", "base", "effects", "off", "verdict", "chosen")}), flush=True)
        if options.minutes is not None and time.monotonic() - began > 60 * options.minutes:
            break
    wanted = {key(case) for case in cases}
    rows = [row for row in once(running.read(results)) if key(row) in wanted]
    print(f"\n{how_many(rows)}\n\n{summary(rows)}")


if __name__ == "__main__":
    main()
