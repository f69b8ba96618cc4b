"""Which figures a report has, their sizes and captions; how each is drawn is in `plots`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from napari_mufasa.report import plots as plotting
from napari_mufasa.report.words import chosen_candidates, effect_title

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray
    from pandas import DataFrame

    from napari_mufasa.calibrate.found import Calibration
    from napari_mufasa.channels import Channels, PairedTraces
    from napari_mufasa.compare import Comparison
    from napari_mufasa.discover.result import Candidate, Curve, Report
    from napari_mufasa.model.model import Model
    from napari_mufasa.traces import TraceSet

MOST_CURVES = 6


@dataclass(frozen=True)
class Drawing:
    """A figure yet to be drawn in some theme: its file name, what it shows, its size, and how."""

    name: str
    caption: str
    size_in: tuple[float, float]
    draw: Callable[[Figure], None]
    kind: Literal["png", "svg"] = "svg"

    def render(self, theme: str, kind: Literal["png", "svg"] = "png") -> bytes:
        with plotting.style(theme):
            figure = plotting.figure(*self.size_in)
            self.draw(figure)
            return plotting.image_bytes(figure, kind)


def diagnosis_drawings(report: Report, traces: NDArray[Any] | None = None) -> list[Drawing]:
    """The figures of a diagnosis, in the order a reader wants them."""
    made = [
        Drawing(
            "error_staircase", "Error on data that were not used for fitting, step by step.", (6.4, 3.2),
            lambda f: plotting.staircase(f.add_subplot(), report),
        ),
        Drawing(
            "evidence", "How much of the misfit each effect explains.",
            (6.4, 1.0 + 0.36 * max(1, min(8, len(report.ranking)))),
            lambda f: plotting.evidence(f.add_subplot(), report.ranking, report.evidence_needed),
        ),
        Drawing(
            "observables", "The observables farthest from the base model, before and after.",
            (6.4, 1.2 + 0.32 * max(1, min(10, len(report.observables)))),
            lambda f: plotting.z_scores(f.add_subplot(), report.observables),
        ),
    ]  # fmt: skip
    if report.curves:
        shown = telling_curves(report)[:MOST_CURVES]
        height = 0.5 + 2.2 * -(-len(shown) // 2)
        made.insert(2, Drawing(
            "curves", "Measured, base model and completed model; bands are ± 2 sd.", (6.4, height),
            lambda f: plotting.curves(f, shown),
        ))  # fmt: skip
    for candidate in chosen_candidates(report):
        if plotting.count_strengths(candidate):
            made.append(_strengths(candidate))
    if traces is not None and len(traces):
        made.append(
            Drawing(
                "traces",
                "Traces of the measured molecules.",
                (6.4, 4.6),
                lambda f: plotting.contact_sheet(f, traces),
                "png",
            )
        )
    return made


def _strengths(candidate: Candidate) -> Drawing:
    return Drawing(
        f"strength_{candidate.effect}", f"{effect_title(candidate.effect)}: the numbers found.",
        (6.4, 0.4 + 0.75 * plotting.count_strengths(candidate)),
        lambda f: plotting.strengths(f, candidate),
    )  # fmt: skip


def telling_curves(report: Report) -> list[Curve]:
    """The curves in the order of what they show: those the added effects move first, then the farthest off."""
    from napari_mufasa.effects import catalogue

    known = catalogue()
    moved = {name for kind in report.chosen if kind in known for name in known[kind].observables}

    def rank(curve: Curve) -> tuple[bool, float]:
        spread = np.maximum(curve.before_sd, 0.02 * (np.ptp(curve.measured) + 1e-12))
        return curve.name not in moved, -float(np.sqrt(np.mean(((curve.measured - curve.before) / spread) ** 2)))

    return sorted(report.curves, key=rank)


def comparison_drawings(comparison: Comparison) -> list[Drawing]:
    """The figures of a comparison: distances, distributions, measured traces."""
    shown = list(comparison.distributions.values())
    return [
        Drawing(
            "w1", "Distance W1 to the measurement.", (6.4, 2.6),
            lambda f: plotting.w1_bars(f.add_subplot(), comparison.w1),
        ),
        Drawing(
            "counts", "Distribution of the signal per frame.", (6.4, 3.6),
            lambda f: plotting.distribution(f.add_subplot(), comparison.distributions["counts"], comparison.w1),
        ),
        Drawing("distributions", "", (7.2, 7.2), lambda f: plotting.distributions(f, shown)),
        Drawing(
            "measured_traces", "Measured traces.", (7.2, 5.4),
            lambda f: plotting.contact_sheet(f, comparison.samples["measured"].traces), "png",
        ),
    ]  # fmt: skip


def calibration_drawing(found: Calibration) -> Drawing:
    """What a camera was measured from, and how well its law fits."""
    return Drawing(
        "calibration", "The camera measured, and the laws against the histograms.", (7.2, 5.6),
        lambda f: plotting.calibration(f, found),
    )  # fmt: skip


def design_drawing(
    table: DataFrame, varied: Sequence[str], shown: Sequence[str] = (), targets: Mapping[str, float] | None = None
) -> Drawing:
    """Predictions over the one or two values that were varied: all that a plan is judged by, or those `shown`."""
    quantities = tuple(shown) or plotting.JUDGED_BY
    return Drawing(
        "design", "What the model predicts.", (8.4, 0.4 + 2.4 * -(-len(quantities) // 3)),
        lambda f: plotting.predictions(f, table, varied, quantities, targets),
    )  # fmt: skip


def power_drawing(table: DataFrame, kind: str) -> Drawing:
    """How often an effect is seen, over its strength."""
    return Drawing(
        "power", "In how many movies the effect is seen.", (5.4, 3.6), lambda f: plotting.power_curve(f, table, kind)
    )


def movie_drawing(name: str, movie: NDArray[Any], unit: str) -> Drawing:
    """Frames spread over a movie."""
    title = f"{name.capitalize()} ({unit})"
    return Drawing(name, title, (6.4, 4.4), lambda f: plotting.montage(f, movie, unit=unit, title=title), "png")


def molecule_drawings(movie: Any, found: TraceSet) -> list[Drawing]:
    """Where the candidates of a movie are, and traces of the kept ones."""
    picture, kept = mean_image(movie), found.molecules["molecule"][found.kept].tolist()
    return [
        Drawing("molecules", "", (5.4, 5.0), lambda f: plotting.molecules(f.add_subplot(), picture, found.molecules)),
        Drawing("traces", "", (7.2, 6.2), lambda f: plotting.contact_sheet(f, found.traces, kept, most=24)),
    ]


def pair_drawings(movie: Any, paired: PairedTraces) -> list[Drawing]:
    """The candidates in the donor's channel of a movie of whole frames, both traces of the kept ones, efficiencies."""
    picture = mean_image(paired.channels.donor.crop(movie))
    kept, donor, acceptor = paired.kept, paired.donor.traces, paired.acceptor.traces
    names = [
        f"{row.molecule}, E {row.efficiency:.2f} ± {row.efficiency_sd:.2f}"
        for row in paired.molecules[kept].itertuples()
    ]
    return [
        Drawing("molecules", "", (5.4, 5.0), lambda f: plotting.molecules(f.add_subplot(), picture, paired.molecules)),
        Drawing("traces", "", (7.2, 6.2), lambda f: plotting.pair_sheet(f, donor, acceptor, names)),
        Drawing(
            "efficiency", "", (5.4, 3.2), lambda f: plotting.efficiencies(f.add_subplot(), paired.efficiency[kept])
        ),
    ]


def registration_drawing(channels: Channels) -> Drawing:
    """The beads that two channels were registered by, and what is left of their distances."""
    return Drawing("registration", "", (5.4, 5.0), lambda f: plotting.registration(f.add_subplot(), channels))


def write(folder: Path, drawings: Sequence[Drawing]) -> None:
    """Each as NAME.png."""
    for drawing in drawings:
        (folder / f"{drawing.name}.png").write_bytes(drawing.render("light"))


def mean_image(movie: Any, most_frames: int = 200) -> NDArray[Any]:
    """The time mean (y, x) of frames spread over the movie."""
    frames = np.unique(np.linspace(0, movie.shape[0] - 1, min(most_frames, movie.shape[0])).astype(int))
    total = np.zeros(movie.shape[1:])
    for frame in frames:
        total += np.asarray(movie[int(frame)])
    return total / len(frames)


def traces_to_show(movie: Any, model: Model, dark: Any = None) -> NDArray[Any] | None:
    """Measured traces for the report's contact sheet; None where no molecule is found."""
    from napari_mufasa.traces import extract_traces

    found = extract_traces(movie, model.camera, dark, psf_sigma_px=model.sigma_px)
    return found.traces if len(found.traces) else None
