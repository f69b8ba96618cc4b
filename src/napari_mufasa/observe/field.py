"""Observables of the background and of the sensor: courses in time, maps, patterns, noise.

Patterns are kept as logarithms of (measured variance / variance that independent pixel noise would give), so
that 0 means "nothing but noise" whatever the light level.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.observe.pixels import PixelStatistics
from napari_mufasa.observe.summary import BINS, Background, Part, along
from napari_mufasa.observe.table import COMB, Table
from napari_mufasa.spots.follow import Spots
from napari_mufasa.spots.quantiles import quantiles

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
    seen: Background,
) -> None:
    """Observables of pixels away from spots; `scale` is photoelectrons per ADU, `seen` their course and map."""
    mask = part.holds(label)
    at = np.flatnonzero(mask)
    course = seen.course
    mean = pixels.mean * scale
    variance = pixels.step_variance.sum(axis=0) / 2 * scale**2
    table.add("background", course.mean(), "background", "e⁻", "background pixels")
    table.log("background_variance", _over(variance, at), "variance of background pixels", "background pixels")
    table.add(
        "background_skewness", _over(pixels.skewness, at), "skewness of background pixels", "", "background pixels"
    )
    half = pixels.step_variance * scale**2
    table.log(
        "background_time_variance",
        _over(half[1], at) / max(_over(half[0], at), 1e-9),
        "variance, second half / first",
        "background pixels",
    )
    steps = pixels.steps[list(part.labels)].sum(axis=0)
    _courses(table, course, steps, spots, part)
    _noise_course(table, course, steps)
    _map(table, seen.tiles, mean.shape)
    _transfer(table, mean, variance, at, (label == 0) & part.holds(tiles))
    spread = _over(pixels.variance, at) or np.nan  # a small field may have no background pixel
    table.add(
        "pixel_lag_1",
        _over(pixels.lag1, at) / spread,
        "correlation with the last frame",
        "",
        "background pixels",
    )
    table.add(
        "pixel_lag_2",
        _over(pixels.lag2, at) / spread,
        "correlation two frames apart",
        "",
        "background pixels",
    )
    inner = np.flatnonzero(mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1])
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
    sensor(table, pixels, mask, at, part, "")


def sensor(
    table: Table, pixels: PixelStatistics, mask: NDArray[np.bool_], at: NDArray[np.int64], part: Part, prefix: str
) -> None:
    """Patterns and outliers of the sensor under a mask (y, x), whose flat pixels are `at`; in the light or (prefix
    "dark_") in dark frames."""
    from napari_mufasa.observe.kernels import line_noise

    where = "dark frames" if prefix else "background pixels"
    n = pixels.n_frames
    noise = pixels.step_variance.sum(axis=0) / 2
    spread = max(_over(noise, at), 1e-9)
    weight, slow_mean, slow_noise = _smooth(np.stack([mask, pixels.mean * mask, noise * mask]))
    weight = np.maximum(weight, 1e-3)
    high = pixels.mean - slow_mean / weight
    core = np.clip(high, -6 * np.sqrt(spread / n), 6 * np.sqrt(spread / n))
    table.log(f"{prefix}pixel_pattern", _over(core**2, at) / (spread / n), "fixed pattern / noise", where)
    deviation = noise - slow_noise / weight
    table.add(
        f"{prefix}pixel_gain", _correlation(high, deviation, at), "pattern that comes with its own noise", "", where
    )
    for axis, name in ((0, "column"), (1, "row")):
        table.log(
            f"{prefix}{name}_pattern",
            _line_pattern(core, mask, axis) / (spread / n),
            f"fixed pattern of {name} means / noise",
            where,
        )
    rows = line_noise(pixels.row_sum, np.array(part.labels), mask.sum(axis=1))
    columns = line_noise(pixels.column_sum, np.array(part.labels), mask.sum(axis=0))
    table.log(f"{prefix}row_noise", rows / spread, "row noise / pixel noise", where)
    table.log(f"{prefix}column_noise", columns / spread, "column noise / pixel noise", where)
    table.count(
        f"{prefix}narrow_bright",
        float(np.count_nonzero(high.take(at) > 7 * np.sqrt(spread / n))),
        "bright single pixels that stay",
        where,
    )
    jump = np.where(mask, pixels.peak - np.maximum(pixels.second, pixels.mean), 0.0) / np.sqrt(spread)
    table.count(
        f"{prefix}single_frame_outliers", float(np.count_nonzero(jump > 8)), "single bright pixels in one frame", where
    )
    table.log(
        f"{prefix}single_frame_largest",
        float(np.sort(np.partition(jump, -3, axis=None)[-3:]).mean()),
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
    mask = part.holds(label)
    at = np.flatnonzero(mask)
    area = max(at.size, 1)
    course = pixels.row_sum[list(part.labels)].sum(axis=(0, 2)) * scale / area
    variance = pixels.step_variance.sum(axis=0) / 2 * scale**2
    table.add("dark_mean", course.mean() / scale, "mean of dark frames above the baseline", "ADU", "dark frames")
    table.log("dark_variance", _over(variance, at), "variance of dark frames", "dark frames")
    table.add("dark_skewness", _over(pixels.skewness, at), "skewness of dark frames", "", "dark frames")
    table.add(
        "dark_tail",
        np.log1p(
            _over(np.maximum(pixels.peak - pixels.mean, 0), at) / np.sqrt(max(_over(variance, at) / scale**2, 1e-9))
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
    sensor(table, pixels, mask, at, part, "dark_")


def _courses(table: Table, course: Array, steps: Array, spots: Spots, part: Part) -> None:
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
    table.add(
        "repeated_frames",
        float((steps[1:] == 0).mean()) if n > 1 and steps.any() else 0.0,
        "frames equal to the last",
        "",
        where,
    )


def _noise_course(table: Table, course: Array, steps: Array) -> None:
    """How much noise is in pixels when they are bright: light brings its own, a converter's offset none. Noise is how
    far pixels are from the frame before; a few that are hit do not rule that."""
    noise, between = np.log(np.maximum(steps[1:], 1e-9)), (course[1:] + course[:-1]) / 2
    title = "noise when the background is a spread higher"
    table.add("background_time_noise", along(noise, between), title, "ln", "background over time")


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


def seen_background(
    pixels: PixelStatistics, label: NDArray[np.int8], part: Part, scale: float, positions_px: Array
) -> Background:
    """Course and map of the labelled pixels of a part, and the map at positions (spot, 2)."""
    mask = part.holds(label)
    course = pixels.row_sum[list(part.labels)].sum(axis=(0, 2)) * scale / max(int(mask.sum()), 1)
    tiles = tile_means(pixels.mean * scale, mask)
    return Background(course, tiles, map_at(tiles, positions_px))


def map_at(tiles: Array, positions_px: Array) -> Array:
    """(place,) a map of tiles, NaN where it shows nothing, at places (place, 2) as pixels y, x: between the tiles,
    each blurred with its neighbours by a Gaussian of one tile."""
    seen = np.isfinite(tiles)
    weight, sums = (
        ndimage.gaussian_filter(each, 1.0, mode="constant") for each in (seen * 1.0, np.where(seen, tiles, 0.0))
    )
    usual = float(tiles[seen].mean()) if seen.any() else 0.0
    blurred = np.where(weight > 1e-3, sums / np.maximum(weight, 1e-3), usual)
    at = (positions_px + 0.5) / TILE - 0.5
    result: Array = ndimage.map_coordinates(blurred, at.T, order=1, mode="nearest")
    return result


def _map(table: Table, tiles: Array, shape_px: tuple[int, ...]) -> None:
    """Tilt, bow and unevenness of the background, from its tiles, relative to its mean. Where fewer than six show any,
    tilt and bow are as likely to either side, 0, and nothing is known of how uneven the rest is."""
    height, width = shape_px
    ok = np.isfinite(tiles)
    values = tiles[ok]
    r2, sy, sx, rest = 0.0, 0.0, 0.0, np.nan
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


def _transfer(table: Table, mean: Array, variance: Array, at: NDArray[np.int64], spot: NDArray[np.bool_]) -> None:
    """Variance over mean at three light levels: the photon-transfer curve."""
    table.log(
        "photon_transfer_low",
        _over(variance, at) / max(_over(mean, at), 1e-6),
        "variance/mean, background",
        "photon transfer",
    )
    bright = np.flatnonzero(spot)
    values = mean.take(bright)
    middle = top = peak = float("nan")
    if values.size >= 30:
        low, high, upper, highest = quantiles(values, [0.6, 0.9, 0.8, 0.99])
        middle_at, top_at = bright[(values > low) & (values <= high)], bright[values > high]
        middle, top = (_over(variance, m) / max(_over(mean, m), 1e-6) for m in (middle_at, top_at))
        peak = float(highest / max(upper, 1e-6))
    table.log("photon_transfer_middle", middle, "variance/mean, spots", "photon transfer")
    table.log("photon_transfer_top", top, "variance/mean, brightest tenth of spot pixels", "photon transfer")
    table.log("peak_quantile", peak, "brightest pixels / bright pixels", "spot pixels")


def _over(values: Array, at: NDArray[np.int64]) -> float:
    """Mean over flat pixels; 0 where there are none."""
    return float(values.take(at).mean()) if at.size else 0.0


def _smooth(maps: Array) -> Array:
    """Maps (map, y, x) blurred by a Gaussian of `SMOOTH_PX`."""
    from napari_mufasa.observe.kernels import blur

    weights = np.exp(-0.5 * (np.arange(int(4 * SMOOTH_PX) + 1) / SMOOTH_PX) ** 2)
    rows, columns = (np.pad(np.arange(n), len(weights) - 1, mode="symmetric") for n in maps.shape[1:])
    result: Array = blur(maps, weights / (2 * weights.sum() - weights[0]), rows, columns)
    return result


def _correlation(a: Array, b: Array, at: NDArray[np.int64]) -> float:
    if at.size < 10:
        return np.nan
    u, v = (np.clip(x, *quantiles(x, [0.01, 0.99])) for x in (a.take(at), b.take(at)))
    u, v = u - u.mean(), v - v.mean()
    return float((u * v).mean() / max(u.std() * v.std(), 1e-12))


def _line_pattern(high: Array, mask: NDArray[np.bool_], axis: int) -> float:
    """Mean square of line means, each times its number of pixels: equals the pixel variance without a pattern. NaN
    where no line has four pixels."""
    count = mask.sum(axis=axis)
    ok = count >= 4
    line = (high * mask).sum(axis=axis)[ok] / count[ok]
    return float((line**2 * count[ok]).mean()) if ok.any() else np.nan
