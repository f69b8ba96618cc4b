"""Observables of the background and of the sensor: courses in time, maps, patterns, noise.

Patterns are kept as logarithms of (measured variance / variance that independent pixel noise would give), so
that 0 means "nothing but noise" whatever the light level.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.observe.pixels import PixelStatistics
from napari_mufasa.observe.summary import BINS, Part
from napari_mufasa.observe.table import COMB, Table
from napari_mufasa.spots.follow import Spots

Array = NDArray[np.float64]
SMOOTH_PX = 2.0  # what varies over more than this is no pattern of pixels
TILE = 8  # px; the background's map is made of tiles of this side


def background(
    table: Table,
    pixels: PixelStatistics,
    spots: Spots,
    label: NDArray[np.int8],
    tiles: NDArray[np.int8],
    part: Part,
    scale: float,
) -> None:
    """Observables of pixels away from spots; `scale` is photoelectrons per ADU."""
    mask = np.isin(label, part.labels)
    area = max(int(mask.sum()), 1)
    rows = pixels.row_sum[list(part.labels)].sum(axis=0) * scale  # (frame, y)
    course = rows.sum(axis=1) / area
    mean = pixels.mean * scale
    variance = pixels.step_variance.sum(axis=0) / 2 * scale**2
    table.add("background", course.mean(), "background", "e⁻", "background pixels")
    table.log("background_variance", _over(variance, mask), "variance of background pixels", "background pixels")
    table.add(
        "background_skewness", _over(pixels.skewness, mask), "skewness of background pixels", "", "background pixels"
    )
    half = pixels.step_variance * scale**2
    table.log(
        "background_time_variance",
        _over(half[1], mask) / max(_over(half[0], mask), 1e-9),
        "variance, second half / first",
        "background pixels",
    )
    _courses(table, course, spots, part)
    _map(table, mean, mask)
    _transfer(table, mean, variance, mask, (label == 0) & np.isin(tiles, part.labels))
    spread = _over(pixels.variance, mask) or np.nan  # a small field may have no background pixel
    table.add(
        "pixel_lag_1",
        _over(pixels.lag1, mask) / spread,
        "correlation with the last frame",
        "",
        "background pixels",
    )
    table.add(
        "pixel_lag_2",
        _over(pixels.lag2, mask) / spread,
        "correlation two frames apart",
        "",
        "background pixels",
    )
    inner = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1]
    table.add(
        "neighbour_right", _over(pixels.right, inner) / spread, "noise correlation along a row", "", "background pixels"
    )
    table.add(
        "neighbour_below",
        _over(pixels.below, inner) / spread,
        "noise correlation along a column",
        "",
        "background pixels",
    )
    sensor(table, pixels, mask, part, "")


def sensor(table: Table, pixels: PixelStatistics, mask: NDArray[np.bool_], part: Part, prefix: str) -> None:
    """Patterns and outliers of the sensor, in the light or (prefix "dark_") in dark frames."""
    where = "dark frames" if prefix else "background pixels"
    n = pixels.n_frames
    noise = pixels.step_variance.sum(axis=0) / 2
    spread = max(_over(noise, mask), 1e-9)
    weight = np.maximum(ndimage.gaussian_filter(mask.astype(float), SMOOTH_PX), 1e-3)
    high = pixels.mean - _masked_smooth(pixels.mean, mask, weight)
    core = np.clip(high, -6 * np.sqrt(spread / n), 6 * np.sqrt(spread / n))
    table.log(f"{prefix}pixel_pattern", _over(core**2, mask) / (spread / n), "fixed pattern / noise", where)
    deviation = noise - _masked_smooth(noise, mask, weight)
    table.add(
        f"{prefix}pixel_gain", _correlation(high, deviation, mask), "pattern that comes with its own noise", "", where
    )
    for axis, name in ((0, "column"), (1, "row")):
        table.log(
            f"{prefix}{name}_pattern",
            _line_pattern(core, mask, axis) / (spread / n),
            f"fixed {name} pattern / noise",
            where,
        )
    rows = _line_noise(pixels.row_sum, mask.sum(axis=1), part)
    columns = _line_noise(pixels.column_sum, mask.sum(axis=0), part)
    table.log(f"{prefix}row_noise", rows / spread, "row noise / pixel noise", where)
    table.log(f"{prefix}column_noise", columns / spread, "column noise / pixel noise", where)
    table.count(
        f"{prefix}narrow_bright",
        float((mask & (high > 7 * np.sqrt(spread / n))).sum()),
        "bright single pixels that stay",
        where,
    )
    jump = np.where(mask, pixels.peak - np.maximum(pixels.second, pixels.mean), 0.0) / np.sqrt(spread)
    table.count(f"{prefix}single_frame_outliers", float((jump > 8).sum()), "single bright pixels in one frame", where)
    table.log(
        f"{prefix}single_frame_largest",
        float(np.sort(jump, axis=None)[-3:].mean()),
        "size of the three largest, in noise",
        where,
        1e-3,
    )
    counts = pixels.comb[list(part.labels)].sum(axis=0)
    uneven = ((counts / max(counts.sum(), 1) * COMB - 1) ** 2).mean()
    table.log(f"{prefix}digits", uneven * max(counts.sum(), 1) + 1, "uneven use of digits", where)


def dark(
    table: Table, pixels: PixelStatistics, label: NDArray[np.int8], part: Part, scale: float, n_frames: int
) -> None:
    """Observables of dark frames."""
    mask = np.isin(label, part.labels)
    area = max(int(mask.sum()), 1)
    course = pixels.row_sum[list(part.labels)].sum(axis=(0, 2)) * scale / area
    variance = pixels.step_variance.sum(axis=0) / 2 * scale**2
    table.add("dark_mean", course.mean() / scale, "mean of dark frames above the baseline", "ADU", "dark frames")
    table.log("dark_variance", _over(variance, mask), "variance of dark frames", "dark frames")
    table.add("dark_skewness", _over(pixels.skewness, mask), "skewness of dark frames", "", "dark frames")
    table.add(
        "dark_tail",
        np.log1p(
            _over(np.maximum(pixels.peak - pixels.mean, 0), mask) / np.sqrt(max(_over(variance, mask) / scale**2, 1e-9))
        ),
        "brightest dark count of a pixel, in noise",
        "ln",
        "dark frames",
    )
    third = max(1, n_frames // 3)
    table.add(
        "dark_trend",
        (course[-third:].mean() - course[:third].mean()) / scale,
        "drift of dark frames",
        "ADU",
        "dark frames",
    )
    sensor(table, pixels, mask, part, "dark_")


def _courses(table: Table, course: Array, spots: Spots, part: Part) -> None:
    n = len(course)
    bins = np.minimum(np.arange(n) * BINS // n, BINS - 1)
    level = np.array([course[bins == b].mean() for b in range(BINS)])
    where = "background over time"
    scale = max(abs(float(course.mean())), 1e-6)
    table.add("background_time_change", (level[-1] - level[0]) / scale, "background, end minus start", "rel.", where)
    table.add(
        "background_time_middle",
        (level[BINS // 2] - (level[0] + level[-1]) / 2) / scale,
        "background, middle against the ends",
        "rel.",
        where,
    )
    table.add("background_time_early", (level[1] - level[0]) / scale, "background, early change", "rel.", where)
    fast = course - ndimage.uniform_filter1d(course, 31, mode="nearest")
    keep = part.molecules & spots.inside
    light = spots.light[keep].sum(axis=0)
    light_fast = light - ndimage.uniform_filter1d(light, 31, mode="nearest")
    power = np.abs(np.fft.rfft(fast * np.hanning(n))) ** 2
    power = power[2:] if len(power) > 6 else power + 1e-12
    where = "all pixels, frame to frame"
    table.log("common_mode_variance", fast.var() / scale**2, "flicker of the background²", where)
    table.add("common_mode_lag", _lag(fast), "its correlation with the last frame", "", where)
    table.log(
        "common_mode_line",
        float(power.max() / max(np.median(power), 1e-12)),
        "strongest line / median of its spectrum",
        where,
    )
    low = power[: len(power) // 4].mean() / max(power[len(power) // 4 :].mean(), 1e-12)
    table.log("common_mode_colour", float(low), "slow / fast part of its spectrum", where)
    alternate = np.where(np.arange(n) % 2 == 0, 1.0, -1.0)
    table.add(
        "common_mode_alternate",
        abs((fast * alternate).mean()) / scale,
        "difference of even and odd frames",
        "rel.",
        where,
    )
    table.log(
        "common_mode_largest", np.abs(fast).max() / max(fast.std(), 1e-9), "largest frame, in its own spread", where
    )
    table.log(
        "common_mode_spots", light_fast.var() / max(float(light.mean()), 1e-6) ** 2, "flicker of all spots²", where
    )
    together = (fast * light_fast).mean() / max(fast.std() * light_fast.std(), 1e-12)
    table.add("common_mode_together", together, "do background and spots flicker together", "corr.", where)
    changes = np.abs(np.diff(course))
    table.add(
        "repeated_frames",
        float((changes < 1e-6 * scale).mean()) if n > 1 else 0.0,
        "frames equal to the last",
        "",
        where,
    )


def _lag(values: Array) -> float:
    power = float((values**2).sum())
    return float((values[1:] * values[:-1]).sum()) / power if power > 0 else 0.0


def tile_means(mean: Array, mask: NDArray[np.bool_]) -> Array:
    """Means of `mean` (y, x) over the mask in each tile of `TILE` pixels a side; NaN where it leaves too few."""

    def tiled(values: Array) -> Array:
        rows = np.add.reduceat(values, np.arange(0, values.shape[0], TILE), axis=0)
        return np.add.reduceat(rows, np.arange(0, values.shape[1], TILE), axis=1)

    count = tiled(mask.astype(float))
    return np.where(count >= TILE, tiled(np.where(mask, mean, 0.0)) / np.maximum(count, 1), np.nan)


def _map(table: Table, mean: Array, mask: NDArray[np.bool_]) -> None:
    """Tilt, bow and unevenness of the background, from its tiles, relative to its mean."""
    height, width = mean.shape
    tiles = tile_means(mean, mask)
    ok = np.isfinite(tiles)
    values = tiles[ok]
    r2 = sy = sx = rest = 0.0
    if len(values) >= 6:
        row, column = np.nonzero(ok)
        half = max(height, width) / 2
        v, u = ((row + 0.5) * TILE - height / 2) / half, ((column + 0.5) * TILE - width / 2) / half
        relative = values / max(abs(float(values.mean())), 1e-6)
        design = np.stack([v**2 + u**2, v, u, np.ones_like(v)], axis=1)
        solution = np.linalg.lstsq(design, relative, rcond=None)[0]
        r2, sy, sx = (float(s) for s in solution[:3])
        rest = float(np.var(relative - design @ solution))
    where = "background across the field"
    table.add("background_map_bow", r2, "background bow (centre to edge)", "rel.", where)
    table.add("background_map_tilt_y", sy, "background tilt along y", "rel.", where)
    table.add("background_map_tilt_x", sx, "background tilt along x", "rel.", where)
    table.log("background_map_rest", rest + 1e-7, "background unevenness² beyond tilt and bow", where)


def _transfer(table: Table, mean: Array, variance: Array, mask: NDArray[np.bool_], spot: NDArray[np.bool_]) -> None:
    """Variance over mean at three light levels: the photon-transfer curve."""
    table.log(
        "photon_transfer_low",
        _over(variance, mask) / max(_over(mean, mask), 1e-6),
        "variance/mean, background",
        "photon transfer",
    )
    values = mean[spot]
    if values.size < 30:
        middle = top = float("nan")
    else:
        edges = np.quantile(values, [0.6, 0.9])
        middle_mask = spot & (mean > edges[0]) & (mean <= edges[1])
        top_mask = spot & (mean > edges[1])
        middle, top = (_over(variance, m) / max(_over(mean, m), 1e-6) for m in (middle_mask, top_mask))
    table.log("photon_transfer_middle", middle, "variance/mean, spots", "photon transfer")
    table.log("photon_transfer_top", top, "variance/mean, brightest tenth of spot pixels", "photon transfer")
    peak = np.quantile(values, 0.99) / max(np.quantile(values, 0.8), 1e-6) if values.size >= 30 else float("nan")
    table.log("peak_quantile", float(peak), "brightest pixels / bright pixels", "spot pixels")


def _over(values: Array, mask: NDArray[np.bool_]) -> float:
    return float(values[mask].mean()) if mask.any() else 0.0


def _masked_smooth(values: Array, mask: NDArray[np.bool_], weight: Array) -> Array:
    result: Array = ndimage.gaussian_filter(np.where(mask, values, 0.0), SMOOTH_PX) / weight
    return result


def _correlation(a: Array, b: Array, mask: NDArray[np.bool_]) -> float:
    if mask.sum() < 10:
        return 0.0
    u, v = a[mask], b[mask]
    u, v = np.clip(u, *np.quantile(u, [0.01, 0.99])), np.clip(v, *np.quantile(v, [0.01, 0.99]))
    u, v = u - u.mean(), v - v.mean()
    return float((u * v).mean() / max(u.std() * v.std(), 1e-12))


def _line_pattern(high: Array, mask: NDArray[np.bool_], axis: int) -> float:
    """Mean square of line means, each times its number of pixels: equals the pixel variance without a pattern."""
    count = mask.sum(axis=axis)
    ok = count >= 4
    line = (high * mask).sum(axis=axis)[ok] / count[ok]
    return float((line**2 * count[ok]).mean()) if ok.any() else 0.0


def _line_noise(sums: Array, count: NDArray[np.int64], part: Part) -> float:
    """Variance of line means about frame and line means, each times its number of pixels."""
    total = sums[list(part.labels)].sum(axis=0)
    ok = count >= 4
    if not ok.any() or len(total) < 3:
        return 0.0
    line = total[:, ok] / count[ok]
    line = line - line.mean(axis=0) - (line - line.mean(axis=0)).mean(axis=1, keepdims=True)
    return float(((line**2).mean(axis=0) * count[ok]).mean())
