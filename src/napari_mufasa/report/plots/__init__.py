"""Every figure of the project: functions that draw on given Axes, in a dark or a light theme.

Used by the reports and by the viewer's widgets, which own their figures:

    with plotting.style("dark"):
        figure = plotting.figure(3.5, 2.5)
        plotting.staircase(figure.add_subplot(), report)

Nothing here computes physics; arrays and reports come in, ink goes out. pyplot is not used, so that no window
system and no global figure is involved.
"""

from napari_mufasa.report.plots.calibration import calibration
from napari_mufasa.report.plots.channels import donor_and_acceptor, efficiencies, pair_sheet, registration
from napari_mufasa.report.plots.design import JUDGED_BY, power_curve, predictions
from napari_mufasa.report.plots.diagnosis import (
    count_strengths,
    curve,
    curves,
    evidence,
    staircase,
    strengths,
    z_scores,
)
from napari_mufasa.report.plots.emission import (
    contact_sheet,
    distribution,
    distributions,
    lit_trace,
    side_by_side,
    trace,
    w1_bars,
)
from napari_mufasa.report.plots.movies import molecules, montage
from napari_mufasa.report.plots.themes import PALETTES, Palette, Theme, figure, image_bytes, style

__all__ = [
    "JUDGED_BY", "PALETTES", "Palette", "Theme", "calibration", "contact_sheet", "count_strengths", "curve", "curves",
    "distribution", "distributions", "donor_and_acceptor", "efficiencies", "evidence", "figure", "image_bytes",
    "lit_trace", "molecules", "montage", "pair_sheet", "power_curve", "predictions", "registration", "side_by_side",
    "staircase", "strengths", "style", "trace", "w1_bars", "z_scores",
]  # fmt: skip
