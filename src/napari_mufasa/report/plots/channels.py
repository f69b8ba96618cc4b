"""Figures of two channels: donor and acceptor side by side, efficiencies, beads and what is left of their distances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.report.plots import parts
from napari_mufasa.report.plots.themes import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from napari_mufasa.channels import Channels

ARROW = 0.12  # of the field, as long as the root mean square residual is drawn
E_RANGE = (-0.3, 1.3)  # noise carries E beyond 0 … 1


def donor_and_acceptor(
    parent: Figure | SubFigure, donor: NDArray[Any], acceptor: NDArray[Any], efficiency: NDArray[Any]
) -> None:
    """One molecule: the light of both channels (frame,), and below it the efficiency where it is on."""
    p = palette()
    light, ratio = parent.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for values, colour, name in ((donor, p.floor, "donor"), (acceptor, p.before, "acceptor")):
        light.plot(values, color=colour, lw=0.9, label=name)
    light.axhline(0, color=p.grid, lw=0.8, zorder=0)
    light.set_ylabel("photoelectrons")
    light.legend(loc="upper right", ncols=2)
    light.set_xlim(0, max(len(donor) - 1, 1))
    ratio.plot(efficiency, color=p.after, lw=0.9)
    for level in (0, 1):
        ratio.axhline(level, color=p.grid, lw=0.8, zorder=0)
    ratio.set_ylim(*E_RANGE)
    ratio.set_ylabel("apparent E")
    ratio.set_xlabel("frame")


def pair_sheet(
    parent: Figure | SubFigure, donor: NDArray[Any], acceptor: NDArray[Any], labels: Sequence[object],
    columns: int = 4, most: int = 24,
) -> None:  # fmt: skip
    """Donor and acceptor (molecule, frame) as small multiples on common axes."""
    p = palette()
    shown = min(len(donor), most)
    axes = parts.sheet(parent, shown, columns, sharex=True, sharey=True)
    for ax, d, a, label in zip(axes, donor, acceptor, labels, strict=False):
        ax.plot(d, color=p.floor, lw=0.7, label="donor")
        ax.plot(a, color=p.before, lw=0.7, label="acceptor")
        ax.axhline(0, color=p.muted, lw=0.5, zorder=0)
        ax.annotate(f"{label}", (0.98, 0.96), xycoords="axes fraction", ha="right", va="top", fontsize=7, color=p.muted)
    if shown:
        parent.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    more = f" ({shown} of {len(donor)})" if len(donor) > shown else ""
    parent.supxlabel("frame", fontsize=8)
    parent.supylabel("photoelectrons per frame", fontsize=8)
    parent.suptitle(f"Donor and acceptor{more}", fontsize=9, fontweight="bold", x=0.02, ha="left")


def efficiencies(ax: Axes, efficiency: NDArray[Any]) -> None:
    """How the efficiency of the frames of all kept molecules (any shape) is distributed."""
    p = palette()
    values = np.asarray(efficiency)[np.isfinite(efficiency)]
    if not len(values):
        return parts.empty(ax, "no molecule is on")
    ax.hist(np.clip(values, *E_RANGE), bins=np.linspace(*E_RANGE, 65).tolist(), color=p.after)
    ax.set_xlim(*E_RANGE)
    ax.set_xlabel("apparent efficiency E of a frame")
    ax.set_ylabel("frames")
    parts.title(ax, f"Efficiency ({len(values)} frames)")


def registration(ax: Axes, channels: Channels) -> None:
    """The beads in the donor's channel, and how far off each is in the acceptor's when it is left out, enlarged."""
    p = palette()
    height, width = channels.donor.shape_px
    at, off = channels.donor_px, channels.left_out_px
    residual = channels.residual_px
    enlarged = ARROW * max(height, width) / max(residual.value, 1e-9)
    ax.plot(at[:, 1], at[:, 0], "o", ms=3, color=p.muted)
    ax.quiver(
        at[:, 1], at[:, 0], enlarged * off[:, 1], enlarged * off[:, 0], color=p.after, angles="xy",
        scale_units="xy", scale=1, width=0.004,
    )  # fmt: skip
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    ax.set_aspect("equal")
    ax.set_xlabel("x in the donor's channel (px)")
    ax.set_ylabel("y (px)")
    parts.title(ax, f"{len(at)} beads, left out they are {residual} px off (arrows × {enlarged:.3g})")
