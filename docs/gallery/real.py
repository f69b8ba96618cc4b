"""What each effect is worth in real movies: the error on held-out data without it, beside that of the whole model.

    python docs/gallery/real.py [--out DIR] [--quick]

Drawn from what `python -m benchmarks.real_movies --write` has kept; nothing is run.
"""

from __future__ import annotations

import json
from pathlib import Path

from drawing import arguments, save

from napari_mufasa.report.plots.themes import figure, style
from napari_mufasa.report.words import in_text

KEPT = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "real_movies.json"


def main() -> None:
    given = arguments(__doc__)
    movies = json.loads(KEPT.read_text())
    bars = [len(errors["without"]) + 2 for errors in movies.values()]
    with style("light") as colours:
        made = figure(7.0, 0.7 * len(movies) + 0.22 * sum(bars))
        axes = made.subplots(len(movies), 1, height_ratios=bars, squeeze=False)[:, 0]
        for ax, (name, errors) in zip(axes, movies.items(), strict=True):
            without = sorted(errors["without"].items(), key=lambda item: -item[1])
            shown = [
                ("model believed", errors["before"], colours.before),
                *((f"without {in_text(kind)}", error, colours.muted) for kind, error in without),
                ("completed model", errors["after"], colours.after),
            ]
            labels, values, colour = zip(*shown, strict=True)
            ax.barh(range(len(shown)), values, color=colour, height=0.7)
            for at, value in enumerate(values):
                ax.text(value, at, f" {value:.2f}", va="center", fontsize=7)
            ax.axvline(errors["floor"], linestyle="--", color=colours.floor, label=f"floor {errors['floor']:.2f}")
            ax.set_yticks(range(len(shown)), labels)
            ax.invert_yaxis()
            ax.set_title(name)
            ax.legend(loc="lower right")
        axes[-1].set_xlabel("error on held-out data (rms of whitened residuals)")
        save(made, given.out / "real.png")


if __name__ == "__main__":
    main()
