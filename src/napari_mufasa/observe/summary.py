"""Named observables of a movie: what the pixels and the spots say, as numbers a user can read.

Every number has one place here. Molecule numbers are averages over isolated molecules, background numbers
over pixels away from spots; `Part` chooses which molecules and pixels take part, so that one part of the
field can be kept out of a fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.observe.table import Table
from napari_mufasa.spots.follow import Spots
from napari_mufasa.spots.quantiles import quantiles
from napari_mufasa.traces.correlation import autocovariance
from napari_mufasa.traces.dynamics import Dynamics

Array = NDArray[np.float64]
LAGS = (1, 2, 3, 5, 10, 20, 50)
COUNT_QUANTILES = (0.05, 0.25, 0.75, 0.95)
BINS = 5  # time bins of the slow courses
HIGHEST = 1.5  # of its top: a level that is higher tells of the top, not of the level
LEAST_SNR = 0.3  # per frame: below it what is on and what is off cannot be told


@dataclass(frozen=True)
class Part:
    """Which part of the field: pixel labels, and molecules."""

    labels: tuple[int, ...]
    molecules: NDArray[np.bool_]

    def holds(self, label: NDArray[np.int8]) -> NDArray[np.bool_]:
        """Which pixels are labelled as of this part."""
        return np.asarray(np.logical_or.reduce([label == mine for mine in self.labels]))


@dataclass(frozen=True)
class Background:
    """The background of a part of the field, photoelectrons.

    course (frame,) · tiles (tile_y, tile_x) : its map, NaN under spots and outside the part · around (spot,) : where
    each spot is
    """

    course: Array
    tiles: Array
    around: Array


def telling(states: Dynamics) -> NDArray[np.bool_]:
    """(trace,) the traces that are on at a level beyond doubt."""
    return np.asarray((states.first >= 0) & (states.snr > LEAST_SNR))


def well_seen(spots: Spots, states: Dynamics) -> NDArray[np.bool_]:
    """(molecule,) the molecules whose traces count: alone, inside the field, and telling."""
    return np.asarray(spots.inside & spots.isolated & telling(states))


def fluctuation(light: Array, states: Dynamics) -> tuple[Array, NDArray[np.bool_]]:
    """Light over the on level, minus 1, and the frames from first to last light, each (molecule, frame)."""
    t = np.arange(light.shape[1])
    span = (t >= states.first[:, None]) & (t <= states.last[:, None])
    return light / states.on_level[:, None] - 1, span


def molecules(
    table: Table, spots: Spots, states: Dynamics, part: Part, shape_px: tuple[int, int], background: Background
) -> None:
    """Observables of the molecules of a part; `states` are those of all spots."""
    table.count("spots", float((part.molecules & spots.inside).sum()), "number of spots", "whole movie")
    keep = part.molecules & well_seen(spots, states)
    light, states = spots.light[keep], states.of(keep)
    trace_levels(table, states)
    _level_positions(table, states, spots.positions_px[keep], shape_px, background.around[keep])
    trace_kinetics(table, light, states)
    _level_course(table, light, states, background.course)
    _shape_and_motion(table, spots, keep, spots.of(part.molecules).common_path())


def _mean(values: Array, default: float = 0.0) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else default


def _drawn_mean(values: Array, towards: float, weight: int = 8) -> float:
    """Mean of a few events, drawn `towards` a usual value as if so many more had shown it: one event is no share."""
    return float((values.sum() + weight * towards) / (len(values) + weight))


def _trimmed_mean(values: Array, cut: float = 0.1) -> float:
    """Mean without the lowest and the highest tenth. A median jumps between the levels of one and of two emitters."""
    if not values.size:
        return 0.0
    drop = int(cut * values.size)
    return float(np.sort(values)[drop : values.size - drop].mean())


def _ranked(values: Array, shares: Sequence[float], default: float = 0.0) -> list[float]:
    """Nearest-rank quantiles: a partition is much cheaper than `np.quantile`, and this runs hundreds of times."""
    if not values.size:
        return [default] * len(shares)
    ranks = [min(int(q * values.size), values.size - 1) for q in shares]
    ordered = np.partition(values, sorted(set(ranks)))
    return [float(ordered[rank]) for rank in ranks]


def trace_levels(table: Table, states: Dynamics) -> None:
    """How bright molecules are while on, and how unlike each other."""
    logs = np.log(states.on_level)
    where = "level of each spot while on"
    middle = _trimmed_mean(logs)
    table.add("level", middle, "brightness of a spot (mean of the middle four fifths)", "ln e⁻", where)
    dimmest, dim, bright, brightest = _ranked(logs, (0.1, 0.16, 0.84, 0.95))
    table.add("level_spread", bright - dim, "spread of brightness", "ln", where)
    table.add("level_quantile_low", middle - dimmest, "dim spots against the middle", "ln", where)
    table.add("level_quantile_high", brightest - middle, "bright spots against the middle", "ln", where)


def _level_positions(
    table: Table, states: Dynamics, positions: Array, shape_px: tuple[int, int], background: Array
) -> None:
    """How bright molecules are where, and where the background is bright: uneven light is on both, haze is not."""
    half = max(shape_px) / 2
    v = (positions[:, 0] - (shape_px[0] - 1) / 2) / half
    u = (positions[:, 1] - (shape_px[1] - 1) / 2) / half
    level = _drawn_in(np.log(states.on_level))
    r2, y, x = _slopes(level, v, u)
    table.add("level_position_radial", r2, "brightness against distance from the centre", "ln", "spots")
    table.add("level_position_tilt_y", y, "brightness tilt along y", "ln", "spots")
    table.add("level_position_tilt_x", x, "brightness tilt along x", "ln", "spots")
    title = "brightness where the background is a spread higher"
    table.add("level_position_background", along(level, background), title, "ln", "spots")


def _drawn_in(values: Array) -> Array:
    """Values from their median, none farther than three times as far as half of them (two standard deviations of a
    normal law): pairs that pass for one spot, and hot pixels that pass for spots, would rule slopes."""
    if not values.size:
        return values
    apart = values - np.median(values)
    reach = 3 * np.median(np.abs(apart))
    return np.clip(apart, -reach, reach)


def _level_course(table: Table, light: Array, states: Dynamics, course: Array) -> None:
    """How bright molecules are when the background is bright, each against itself: a laser's power is on both, what
    drifts or fades in the background alone is not."""
    on = states.lit

    def apart(values: Array) -> Array:
        """From a molecule's mean while it is on; 0 while it is not."""
        mean = np.where(on, values, 0.0).sum(axis=1) / np.maximum(on.sum(axis=1), 1)
        return np.where(on, values - mean[:, None], 0.0)

    level, beside = apart(light / states.on_level[:, None]), apart(np.broadcast_to(course, on.shape))
    slope = float((level * beside).sum()) / max(float((beside**2).sum()), 1e-12)
    title = "brightness when the background is a spread higher"
    table.add("level_time_background", slope * float(course.std()), title, "rel.", "frames in which molecules are on")


def along(values: Array, course: Array) -> float:
    """By how much values are higher where another course is one of its spreads higher; 0 for few."""
    if len(values) < 6:
        return 0.0
    apart = course - course.mean()
    return float((values * apart).mean() / max(apart.std(), 1e-9))


def _slopes(values: Array, v: Array, u: Array) -> tuple[float, float, float]:
    """Coefficients of r², y and x (ridge for few points)."""
    if len(values) < 6:
        return 0.0, 0.0, 0.0
    design = np.stack([v**2 + u**2, v, u, np.ones_like(v)], axis=1)
    gram = design.T @ design + np.diag([0.5, 0.5, 0.5, 0.0])
    r2, y, x, _ = np.linalg.solve(gram, design.T @ values)
    return float(r2), float(y), float(x)


def trace_kinetics(table: Table, light: Array, states: Dynamics) -> None:
    """What traces do in time: counts while on, memory, first and last light, gaps, trend and steps of the level."""
    n, frames = light.shape
    on, t = states.lit, np.arange(frames)
    deviation, span = fluctuation(light, states)
    relative = deviation + 1
    edge = max(2, frames // 100)

    counts = relative[on]
    for q, value in zip(COUNT_QUANTILES, _ranked(counts, COUNT_QUANTILES, 1.0), strict=True):
        table.add(
            f"count_quantile_{round(q * 100):02d}", value,
            f"{q:.0%} quantile of counts while on / level", "", "frames in which molecules are on",
        )  # fmt: skip
    table.log("count_variance", _mean((counts - 1) ** 2, 1.0), "relative variance while on", "traces")
    table.add(
        "count_dark",
        _mean((relative < 0.35)[span].astype(float)),
        "dark frames between first and last light",
        "",
        "traces",
    )
    lags = [lag for lag in LAGS if lag < frames]
    for lag, covariance in zip(lags, np.nan_to_num(autocovariance(deviation, span, lags)), strict=True):
        table.add(f"autocorrelation_{lag}", covariance, f"trace covariance at lag {lag}", "level²", f"lag {lag} frames")

    first, last = states.first / frames, states.last / frames
    table.add("first_seen_mean", _mean(first), "mean first appearance", "movie", "start of traces")
    table.add("first_seen_late", _mean(first > 0.05), "molecules that appear late", "", "start of traces")
    for at in (0.25, 0.5, 0.75):
        table.add(
            f"survival_{round(at * 100)}",
            _mean(last > at, 1.0),
            f"molecules seen after {at:.0%} of the movie",
            "",
            "end of traces",
        )
    table.add(
        "survival_100", _mean(last >= 1 - (edge + 1) / frames, 1.0), "molecules seen to the end", "", "end of traces"
    )
    bins = np.minimum(t * BINS // max(frames, 1), BINS - 1)
    total = max(float(states.on_level.sum()), 1e-6)
    together = light.sum(axis=0)
    for b in range(BINS):
        table.add(
            f"ensemble_{b + 1}",
            together[bins == b].mean() / total,
            f"light of all spots, part {b + 1} of {BINS}",
            "level",
            f"time bin {b + 1}",
        )
    gaps = _gap_lengths(on)
    for low, high, name in ((1, 5, "short"), (6, 19, "middle"), (20, 10**9, "long")):
        found = int(((gaps >= low) & (gaps <= high)).sum())
        table.add(f"gap_{name}", np.sqrt((found + 0.1) / max(n, 1)), f"{name} gaps per molecule", "√", "gaps in traces")

    thirds = np.array_split(t, 3)
    early, late = np.array([_on_mean(light, on, i) for i in (thirds[0], thirds[2])])
    both = np.isfinite(early) & np.isfinite(late) & (early > 0)
    ratio = late[both] / early[both]
    middle = _trimmed_mean(ratio) if ratio.size else 1.0
    fallen, risen = _ranked(ratio, (0.16, 0.84), 1.0)
    table.add("level_trend", middle - 1, "change of level while on, last third / first", "", "traces")
    table.add(
        "level_trend_spread",
        risen - fallen,
        "spread of that change",
        "",
        "traces",
    )
    # Smoothed over 9 frames, single molecules are at 1 or 0; several emitters are also between and above.
    smooth = ndimage.uniform_filter1d(light, 9, axis=1, mode="nearest")
    top = np.maximum(_running_top(smooth), 1e-6)
    share = smooth / top
    between = ((share > 0.3) & (share < 0.75)).mean(axis=1)
    table.add("steps_between", _mean(between), "time at levels between dark and top", "", "traces")
    # Spots of several emitters are brighter and show more levels; dim ones only have more noise there.
    level = _drawn_in(np.log(states.on_level))
    together = along(level / max(level.std(), 1e-9), between) if n else 0.0
    table.add("steps_between_brighter", together, "brightness against time at such levels", "corr.", "traces")
    ends = last < 1 - 3 * edge / frames
    before_end = (t > states.last[:, None] - 21) & (t <= states.last[:, None] - 3)
    last_level = (light * before_end).sum(axis=1) / np.maximum(before_end.sum(axis=1), 1) / top[:, 0]
    last_level = np.clip(last_level, 0.0, HIGHEST)  # who ended within the first frames has no top
    table.add(
        "last_level_mean", _drawn_mean(last_level[ends], 0.9), "level before the last step / top", "", "last steps"
    )
    table.add(
        "last_level_low",
        _drawn_mean((last_level[ends] < 0.65).astype(float), 0.0),
        "last steps from less than two thirds of the top",
        "",
        "last steps",
    )
    after = t > states.last[:, None] + edge
    gone = ends & (states.on_level > 0)
    left = (light * after)[gone].sum(axis=1) / (after[gone].sum(axis=1) * states.on_level[gone])
    table.add(
        "left_after", _drawn_mean(np.clip(left, -1, 1), 0.0), "light after the last step / level", "", "last steps"
    )
    table.add(
        "steps_brighter_bleach",
        _brightness_of_enders(states, ends),
        "brightness of vanished spots against lasting ones",
        "ln",
        "last steps",
    )


def _running_top(smooth: Array) -> Array:
    if not smooth.size:
        return np.ones((len(smooth), 1))
    return quantiles(smooth, [0.95])[0, :, None]


def _brightness_of_enders(states: Dynamics, ends: NDArray[np.bool_]) -> float:
    if ends.sum() < 3 or (~ends).sum() < 3:
        return 0.0
    logs = np.log(states.on_level)
    return float(np.median(logs[ends]) - np.median(logs[~ends]))


def _on_mean(light: Array, on: NDArray[np.bool_], frames: NDArray[np.int64]) -> Array:
    count = on[:, frames].sum(axis=1)
    total = (light[:, frames] * on[:, frames]).sum(axis=1)
    return np.where(count >= max(5, len(frames) // 10), total / np.maximum(count, 1), np.nan)


def _gap_lengths(on: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Lengths (gap,) of dark stretches between two bright ones."""
    change = np.diff(on.astype(np.int8), axis=1)
    row, at = np.nonzero(change)
    falls = change[row, at] < 0
    ended = np.flatnonzero(falls[:-1] & (row[1:] == row[:-1]))  # falls and rises take turns
    gaps: NDArray[np.int64] = at[ended + 1] - at[ended]
    return gaps


def _shape_and_motion(table: Table, spots: Spots, keep: NDArray[np.bool_], path: Array) -> None:
    blocks = range(spots.shape.shape[1])
    early, late = (mean_shape(spots, keep, part) for part in np.array_split(blocks, 2))
    where = "isolated spots"
    table.add("spot_width_early", (early[0] + early[1]) / 2, "excess of PSF variance, first half", "px²", where)
    table.add(
        "spot_width_growth", (late[0] + late[1] - early[0] - early[1]) / 2, "growth of PSF variance", "px²", where
    )
    widths = [mean_shape(spots, keep, part)[:2].mean() for part in np.array_split(blocks, BINS)]
    for b in range(1, BINS - 1):
        bend = widths[b] - (widths[0] + widths[-1]) / 2
        title = f"PSF variance, part {b + 1} of {BINS} against first and last"
        table.add(f"spot_width_bend_{b + 1}", bend, title, "px²", where)
    table.add("spot_elongation_early", early[0] - early[1], "PSF variance along y minus x, first half", "px²", where)
    table.add("spot_elongation_late", late[0] - late[1], "PSF variance along y minus x, second half", "px²", where)
    table.add("spot_elongation_oblique", (early[2] + late[2]) / 2, "oblique elongation", "px²", where)
    # In pixels, not in powers: the noise of a path is the same whether the stage stands or drifts.
    table.add("common_shift_end", np.hypot(*path[-1]), "common displacement at the end", "px", "all spots")
    table.add("common_shift_extent", np.hypot(*path.T).max(), "largest common displacement", "px", "all spots")
    rough = np.diff(path, 2, axis=0) if len(path) > 2 else np.zeros((1, 2))
    table.add(
        "common_shift_roughness",
        np.sqrt((rough**2).sum(axis=1).mean()),
        "unsteadiness of the common motion",
        "px",
        "all spots",
    )
    total = spots.light[keep].sum(axis=0)
    total = np.maximum(total, 0.25 * total.mean() + 1e-6) if len(total) else total  # few lit: no jitter from noise
    jitter = spots.frame_shift[:, keep].sum(axis=1) / total[:, None]
    jitter = jitter - ndimage.uniform_filter1d(jitter, 31, axis=0, mode="nearest") if len(jitter) else jitter
    for axis, name in ((0, "y"), (1, "x")):
        table.log(
            f"common_shift_jitter_{name}",
            float(jitter[:, axis].var()),
            f"common jitter² along {name}, frame to frame",
            "px, all spots",
        )
    moved = spots.displacement_px[keep]
    own = moved - np.nan_to_num(_nanmedian(moved))
    for lag in (1, 3, max(1, moved.shape[1] // 2)):
        steps = _nanmean(((own[:, lag:] - own[:, :-lag]) ** 2).sum(axis=2))
        steps = steps[np.isfinite(steps)]
        name = "half" if lag > 3 else str(lag)
        mean = _trimmed_mean(steps) if steps.size else 0.1  # one that jumped to a neighbour that lit up is trimmed
        table.log(f"individual_shift_{name}", mean, f"own displacement² over {lag} blocks", "px, each spot")
    late_minus_early = _nanmean(own[:, -3:]) - _nanmean(own[:, :3])
    centre = spots.positions_px[keep] - spots.positions_px[keep].mean(axis=0) if keep.any() else np.zeros((0, 2))
    ok = np.isfinite(late_minus_early).all(axis=1)
    table.add(
        "individual_shift_radial",
        100 * _slope(centre[ok].ravel(), late_minus_early[ok].ravel()),
        "expansion of the field",
        "%",
        "each spot",
    )


def mean_shape(spots: Spots, keep: NDArray[Any], blocks: Sequence[int] | NDArray[np.int64]) -> Array:
    """Mean excess of PSF variance along y, along x, and covariance (3,), px², of these molecules in these blocks: of
    the middle half of them, for a few pairs that pass for one spot would rule it."""
    weight = spots.shape_weight[keep][:, blocks].sum(axis=1)
    lit = weight > 0
    if not lit.any():
        return np.zeros(3)
    weight, shape = weight[lit], spots.shape[keep][:, blocks].sum(axis=1)[lit]
    drop = len(weight) // 4
    middle = np.argsort(shape / weight[:, None], axis=0)[drop : len(weight) - drop]  # (molecule, component)
    mean: Array = np.take_along_axis(shape, middle, axis=0).sum(axis=0) / weight[middle].sum(axis=0)
    return mean


def _slope(x: Array, y: Array) -> float:
    """Slope of y on x through the origin with the least absolute error: a spot that jumped to a neighbour that
    lit up does not rule it."""
    use = np.abs(x) > 1e-6
    if not use.any():
        return 0.0
    slopes, weights = y[use] / x[use], np.abs(x[use])
    order = np.argsort(slopes)
    middle = np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)
    return float(slopes[order][middle])


def _nanmedian(values: Array) -> Array:
    """Median over molecules per block (molecule, block, axis), 0 where none is lit."""
    if not len(values):
        return np.zeros(values.shape[1:])
    ordered = np.sort(values, axis=0)  # nan last
    lit = np.isfinite(values).sum(axis=0)
    middle = [np.take_along_axis(ordered, np.maximum(at, 0)[None], axis=0)[0] for at in ((lit - 1) // 2, lit // 2)]
    return np.where(lit > 0, 0.5 * (middle[0] + middle[1]), 0.0)


def _nanmean(values: Array) -> Array:
    count = np.isfinite(values).sum(axis=1)
    result: Array = np.where(count > 0, np.nansum(values, axis=1) / np.maximum(count, 1), np.nan)
    return result
