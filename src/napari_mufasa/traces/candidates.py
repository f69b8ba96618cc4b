"""Candidates for molecules with their light: in their places, or followed from frame to frame (docs/traces.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.frames import Frames
from napari_mufasa.simulate.layout import check_positions
from napari_mufasa.spots import diffusion, drift, find, link, locate
from napari_mufasa.traces.measure import Measured, measure, measure_along
from napari_mufasa.traces.options import Options

Array = NDArray[np.float64]
Cancel = Callable[[], bool] | None
MIN_SPOTS_FOR_DRIFT = 5
DRIFT_PX = 0.7  # motion over the movie from which on the user is told
CUT_STEPS = 0.01  # of the steps of molecules that are followed, longer than the longest allowed, from which on D is low
NEAR_SHARE = 0.1  # of its frames, in which another molecule may come nearer to one that moves


@dataclass(frozen=True)
class Candidates:
    """positions_px (candidate, 2), of moving ones where they were first found · strength, prominence (candidate,) see
    `find.Found` · neighbour_px, edge_px (candidate,) how far from others and from the edge · measured : their light
    motion (frame, 2) of the field, where it was followed · path_px (candidate, frame, 2) of moving ones
    more : further columns for the table · notes : what the user should know"""

    positions_px: Array
    strength: Array
    prominence: Array
    neighbour_px: Array
    edge_px: Array
    measured: Measured
    motion: Array | None
    path_px: Array | None = None
    more: dict[str, NDArray[Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def standing(
    frames: Frames, sigma: float, options: Options, motion: Array | None, positions_px: NDArray[np.floating] | None,
    report: Callable[[int], None], cancel: Cancel,
) -> Candidates:  # fmt: skip
    """Molecules in their places, found or given; only the field may move, by `motion` (frame, 2)."""
    notes: tuple[str, ...] = ()
    if positions_px is None:
        seen = find.find_spots(
            frames, sigma, threshold=options.threshold, value=options.threshold_value,
            block=whole_blocks(frames.n_frames, options.time_block),
            drift_px=motion, report=report, cancel=cancel,
        )  # fmt: skip
        found, strength, outstanding = seen.positions_px, seen.significance, seen.prominence
        early, late = seen.evidence.early, seen.evidence.late
        moved = drift.moved_px(early, late) if motion is None and len(found) >= MIN_SPOTS_FOR_DRIFT else 0.0
        if moved > DRIFT_PX:
            notes = (
                f"the field moves by about {moved:.1f} px, so a molecule may count twice or leave its place: "
                "follow the drift",
            )
    else:
        found = check_positions(positions_px)
        strength = outstanding = np.full(len(found), np.nan)
    if options.position == "brightest_pixel" and positions_px is None:
        found = np.rint(found)
    measured = measure(frames, found, sigma, options, motion, report, cancel)
    refine = options.position == "fit" and positions_px is None
    positions = found + (measured.shapes.shift_px if refine else 0.0)
    near = find.neighbour_px(positions, ~(outstanding < find.LEAST_PROMINENCE))
    edge = least_edge_px(positions, motion, frames.shape[1:])
    return Candidates(positions, strength, outstanding, near, edge, measured, motion, notes=notes)


def followed(
    frames: Frames,
    sigma: float,
    options: Options,
    motion: Array | None,
    report: Callable[[int], None],
    cancel: Cancel,
) -> Candidates:
    """Molecules that move on their own: found in every frame, linked to paths, read along them; diffusion and drift are
    told beside the `motion` of the field (frame, 2)."""
    places = locate.locate(frames, sigma, threshold_sigma=options.threshold_value, report=report, cancel=cancel)
    field_px = np.zeros((frames.n_frames, 2)) if motion is None else motion
    step = options.max_step_px or link.farthest_step_px(sigma)
    paths = link.link(
        places.moved_by(-field_px), frames.n_frames, step, max_gap=options.max_gap, least_frames=options.min_found,
        cancel=cancel,
    )  # fmt: skip
    moves = diffusion.motion_of(paths.seen_px)
    whole = paths.everywhere() + field_px
    found, (first, last) = paths.found, paths.ends()
    measured = measure_along(frames, whole, found, sigma, options, report, cancel)
    each = np.arange(len(whole))
    edge = np.where(found, edge_px(whole, frames.shape[1:]), np.inf).min(axis=1, initial=np.inf)
    more = {
        "first_found": first,
        "last_found": last,
        "found_frames": found.sum(axis=1),
        "diffusion_px2_per_frame": moves.diffusion_px2,
        "diffusion_sd_px2_per_frame": moves.diffusion_sd_px2,
        "drift_y_px_per_frame": moves.drift_px[:, 0],
        "drift_x_px_per_frame": moves.drift_px[:, 1],
        "drift_sd_px_per_frame": moves.drift_sd_px,
        "localisation_px": moves.localisation_px,
    }
    note = f"{paths.shorter} paths of fewer than {options.min_found} frames are left out"
    unknown, apart = np.full(len(whole), np.nan), _kept_apart(whole, first, last)
    notes = ((note,) if paths.shorter else ()) + _cut_steps(moves.diffusion_px2, found.sum(axis=1), step)
    return Candidates(
        whole[each, first], paths.strength, unknown, apart, edge, measured, motion, whole, more, notes
    )  # fmt: skip


def whole_blocks(n_frames: int, asked: int | None) -> int | None:
    """Frames of a block, at most those `asked` for and more than half of them, so that fewest are left over at the
    movie's end: nobody looks at these."""
    if asked is None or asked >= n_frames:
        return asked
    return min(range(asked // 2 + 1, asked + 1), key=lambda block: (n_frames % block, -block))


def _cut_steps(diffusion_px2: Array, n_found: NDArray[np.int64], step_px: float) -> tuple[str, ...]:
    """A note where molecules of this D (molecule,) in px² per frame go farther than they are followed: a step in the
    plane exceeds r in exp(−r²/4D) of the frames."""
    known = np.isfinite(diffusion_px2)
    if not known.any():
        return ()
    mean = float(np.average(diffusion_px2[known], weights=n_found[known]))
    beyond = np.exp(-(step_px**2) / (4 * mean)) if mean > 0 else 0.0
    if beyond <= CUT_STEPS:
        return ()
    return (
        f"of molecules with D = {mean:.2g} px² per frame {100 * beyond:.2g} % of the steps or more are longer than the "
        f"{step_px:.2g} px that they are followed: D is a lower limit; raise the longest step (max_step_px, "
        "--max-step), or record faster",
    )


def edge_px(positions_px: Array, shape_px: tuple[int, ...]) -> Array:
    """Distance of places (…, 2) from the edge of the field."""
    least = np.minimum(positions_px + 0.5, np.array(shape_px) - 0.5 - positions_px)
    return np.asarray(least.min(axis=-1))


def least_edge_px(positions_px: Array, motion: Array | None, shape_px: tuple[int, ...]) -> Array:
    """(candidate,) the least distance from the edge of the field, over all frames where the field moves by `motion`
    (frame, 2)."""
    if motion is None:
        return edge_px(positions_px, shape_px)
    ends = (edge_px(positions_px + end(axis=0), shape_px) for end in (motion.min, motion.max))
    return np.minimum(*ends)


def _kept_apart(path_px: Array, first: NDArray[np.int64], last: NDArray[np.int64]) -> Array:
    """(molecule,) the distance to the nearest other one that each keeps in all but `NEAR_SHARE` of its frames."""
    n_frames = path_px.shape[1]
    t = np.arange(n_frames)
    there = (first[:, None] <= t) & (t <= last[:, None])
    nearest = np.full(there.shape, np.nan)
    for frame in t:
        present = there[:, frame]
        at = path_px[present, frame]
        nearest[present, frame] = find.neighbour_px(at, np.ones(len(at), dtype=bool))
    if len(path_px) == 0:
        return np.zeros(0)
    return np.asarray(np.nanquantile(nearest, NEAR_SHARE, axis=1, method="inverted_cdf"))
