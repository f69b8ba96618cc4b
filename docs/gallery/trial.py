"""What the blind trial shows: each line asked of it, the share found with its 95 % interval, and the bound.

    python docs/gallery/trial.py [--out DIR] [--quick]

Drawn from the rows that docs/blind_trial.md is written from; nothing is run.
"""

from __future__ import annotations

import sys
from pathlib import Path

from drawing import arguments, save

from napari_mufasa.report.plots.themes import figure, style

sys.path.append(str(Path(__file__).resolve().parents[2]))

from tests.blind import judging, running
from tests.blind.trial import ROWS, once


def main() -> None:
    given = arguments(__doc__)
    rows = judging.of_planned_bases(once(running.read(ROWS)))
    lines = [line for line in judging.asked(rows) if line.of]
    at = range(len(lines))
    shares = [100 * line.hits / line.of for line in lines]
    low, high = zip(*[[100 * share for share in line.interval] for line in lines], strict=True)
    with style("light") as colours:
        made = figure(8.5, 1.1 + 0.25 * len(lines))
        ax = made.subplots()
        ax.hlines(at, low, high, color=colours.muted, linewidth=3, label="95 % interval")
        ax.plot([100 * line.bound for line in lines], at, "|", color=colours.before, markersize=13, label="asked")
        ax.plot(shares, at, "o", color=colours.after, label="found")
        for y, line in enumerate(lines):
            ax.text(104, y, f"{line.hits} of {line.of}, asked {line.asked.split(' of ')[0]}", va="center", fontsize=7)
        ax.set_yticks(at, [line.what.replace("`", "") for line in lines])
        ax.set(xlabel="share (%)", xlim=(-3, 103), ylim=(len(lines) - 0.4, -0.6))
        ax.set_title(f"Blind trial: {len(rows)} movies of the independent generator")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.45 / (0.25 * len(lines))), ncols=3)
        save(made, given.out / "trial.png")


if __name__ == "__main__":
    main()
