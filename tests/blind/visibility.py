"""How visible is each hidden effect to someone who knows the positions?

    python -m tests.blind.visibility [--seeds 3] [--nulls 16]

For every effect and strength: the simple statistic that moved most against null movies (same
spread of nuisance values) and by how many of their standard deviations. This says whether strengths are sensible;
it is no diagnosis.
"""

from __future__ import annotations

import argparse

import numpy as np

from . import generator as g


def _corr(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).mean() / np.sqrt((a * a).mean() * (b * b).mean() + 1e-30))


def statistics(case: g.BlindMovie, reach: int = 3) -> dict[str, float]:
    """Plain numbers of one movie; positions are taken from the truth."""
    movie, dark = case.movie.astype(np.float32), case.dark.astype(np.float32)
    n, ny, nx = movie.shape
    movie = movie - dark.mean()
    position = np.array(case.truth["positions_px"])
    centre = np.rint(position).astype(int)
    inner = np.all((centre >= reach) & (centre < np.array([ny, nx]) - reach), axis=1)
    centre, position = centre[inner], position[inner]
    free = np.ones((ny, nx), bool)
    for y, x in np.rint(np.array(case.truth["positions_px"])).astype(int):
        free[max(y - 5, 0) : y + 6, max(x - 5, 0) : x + 6] = False
    back_t = movie[:, free].mean(axis=1)
    back = float(back_t.mean())
    box = np.stack([movie[:, y - reach : y + reach + 1, x - reach : x + reach + 1] for y, x in centre])
    cut = movie.mean(axis=0)
    local = np.array([
        np.mean(cut[max(y - 7, 0) : y + 8, max(x - 7, 0) : x + 8][free[max(y - 7, 0) : y + 8, max(x - 7, 0) : x + 8]])
        if free[max(y - 7, 0) : y + 8, max(x - 7, 0) : x + 8].any() else back
        for y, x in centre
    ])  # fmt: skip
    trace = (box - local[:, None, None, None] * (back_t / back)[None, :, None, None]).sum(axis=(2, 3))
    level = trace.mean(axis=1)
    third = n // 3
    rest = trace - level[:, None]
    common = rest.mean(axis=0)
    single = rest - common
    out: dict[str, float] = {}
    power = (single**2).mean()
    for lag in (1, 3, 10, 30):
        out[f"trace_acf_{lag}"] = float((single[:, lag:] * single[:, :-lag]).mean() / power)
    out["trace_variance_over_mean"] = float(power / level.mean() / back)
    out["spots_late_over_early"] = float(trace[:, -third:].mean() / trace[:, :third].mean())
    out["spots_first_tenth"] = float(trace[:, : n // 10].mean() / level.mean())
    out["level_cv"] = float(level.std() / level.mean())
    out["level_max"] = float(
        np.quantile(trace[:, :third].mean(axis=1), 0.95) / np.median(trace[:, :third].mean(axis=1))
    )
    out["level_against_background"] = _corr(level, local)

    grid = np.arange(-reach, reach + 1)
    yy, xx = np.meshgrid(grid, grid, indexing="ij")
    disc = (yy**2 + xx**2 <= (reach + 0.5) ** 2).astype(np.float32)

    def moments(part: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        image = (box[:, part].mean(axis=1) - local[:, None, None] * back_t[part].mean() / back) * disc
        total = image.sum(axis=(1, 2))
        cy, cx = (image * yy).sum(axis=(1, 2)) / total, (image * xx).sum(axis=(1, 2)) / total
        vy = (image * yy**2).sum(axis=(1, 2)) / total - cy**2
        vx = (image * xx**2).sum(axis=(1, 2)) / total - cx**2
        vxy = (image * yy * xx).sum(axis=(1, 2)) / total - cy * cx
        keep = total > 0.3 * np.median(total)
        return np.where(keep, cy, np.nan), np.where(keep, cx, np.nan), vy[keep], vx[keep], vxy[keep]

    e, l, a = moments(slice(0, third)), moments(slice(n - third, n)), moments(slice(0, n))
    dy, dx = l[0] - e[0], l[1] - e[1]
    out["common_shift"] = float(np.hypot(np.nanmedian(dy), np.nanmedian(dx)))
    out["own_shift"] = float(np.nanmedian(np.hypot(dy - np.nanmedian(dy), dx - np.nanmedian(dx))))
    thirds = [float(np.median(m[2] + m[3])) for m in (e, moments(slice(third, 2 * third)), l)]
    out["width_change"] = max(thirds) / min(thirds)
    size = np.median(a[2] + a[3])
    out["ellipse"] = float(np.hypot(np.median(a[2] - a[3]), 2 * np.median(a[4])) / size)
    half = position[:, 1] > nx / 2
    if len(a[2]) == len(half):
        out["ellipse_right"] = float(np.hypot(np.median((a[2] - a[3])[half]), 2 * np.median(a[4][half])) / size)
    shift_t = np.array([(box.sum(axis=0)[t] * xx).sum() for t in range(n)]) / level.sum()
    out["jitter"] = float(shift_t.std())

    relative = back_t / back
    slope = np.polyfit(np.linspace(-0.5, 0.5, n), relative, 1)
    out["back_slope"] = abs(float(slope[0]))
    out["back_common_rms"] = float(relative.std())
    out["back_common_acf"] = _corr(back_t[1:], back_t[:-1])
    spectrum = np.abs(np.fft.rfft(relative - np.polyval(slope, np.linspace(-0.5, 0.5, n)))) ** 2
    out["back_line"] = float(np.log(spectrum[8:].max() / np.median(spectrum[8:])))
    out["back_extreme"] = float(
        (np.abs(relative - 1) / (1.48 * np.median(np.abs(relative - np.median(relative))))).max()
    )
    out["spot_against_back"] = _corr(common, back_t)
    pixel = movie[:, free]
    mean_px, var_px = pixel.mean(axis=0), pixel.var(axis=0)
    out["back_variance_over_mean"] = float(np.median(var_px) / back)
    out["back_skew"] = float(((pixel - pixel.mean()) ** 3).mean() / pixel.std() ** 3)
    top = cut > np.quantile(cut, 0.99)
    out["top_variance_over_mean"] = float(
        np.median(movie[:, top].var(axis=0) / cut[top]) / out["back_variance_over_mean"] / back
    )
    out["top_flatness"] = float(movie[:, top].max(axis=0).mean() / cut[top].mean())
    out["map_spread"] = float(mean_px.std() / np.sqrt(var_px.mean() / n))
    out["map_variance_follows_mean"] = _corr(mean_px, var_px)
    y, x = np.nonzero(free)
    shape = np.stack([y / ny - 0.5, x / nx - 0.5, (y / ny - 0.5) ** 2 + (x / nx - 0.5) ** 2, np.ones(len(y))], axis=1)
    fit = np.linalg.lstsq(shape, mean_px / back, rcond=None)[0]
    out["back_gradient"], out["back_bowl"] = float(np.hypot(fit[0], fit[1])), abs(float(fit[2]))
    moving = movie - cut
    out["pixel_lag_1"] = float((moving[1:, free] * moving[:-1, free]).mean() / var_px.mean())
    out["neighbour_x"] = float((moving[:, :, 1:] * moving[:, :, :-1]).mean() / moving.var())
    out["neighbour_y"] = float((moving[:, 1:] * moving[:, :-1]).mean() / moving.var())
    out["row_noise"] = float((moving.mean(axis=2) - moving.mean(axis=(1, 2))[:, None]).var() * nx / moving.var())
    out["repeated_frames"] = float((np.abs(np.diff(movie, axis=0)).mean(axis=(1, 2)) < 1e-6).sum())
    out["outliers"] = float(np.log1p((movie > back + 40 * pixel.std()).sum()))
    ratio = var_px / np.maximum(mean_px, 1e-3)
    out["noisy_pixels"] = float(np.log1p((np.abs(ratio - np.median(ratio)) > 1.5 * np.median(ratio)).sum()))
    codes = np.unique(case.movie)
    out["codes"] = float(np.log(np.median(np.diff(codes[: len(codes) // 2]))))
    still = dark.mean(axis=0)
    spread = dark.std()
    robust = 1.48 * np.median(np.abs(dark - np.median(dark))) + 0.3
    out["dark_sd"] = float(np.log(spread))
    out["dark_tail"] = float((dark > dark.mean() + 8 * robust).mean())
    out["dark_columns"] = float(np.log(np.median(dark, axis=0).mean(axis=0).std() + 1e-3))
    out["dark_rows"] = float(np.log(np.median(dark - still, axis=2).std() + 1e-3))
    level_t = np.clip(dark, None, dark.mean() + 5 * robust).mean(axis=(1, 2))
    out["dark_drift"] = float(np.log(level_t.std() / (robust / np.sqrt(ny * nx))))
    out["dark_hot"] = float((still > still.mean() + 12 * robust / np.sqrt(len(dark))).sum())
    out["dark_neighbour"] = float((np.diff(dark, axis=2) ** 2).mean() / (2 * dark.var()))
    return out


def table(kinds: list[str], strengths: tuple[float, ...], seeds: int, nulls: int) -> list[tuple[str, list[str]]]:
    """Rows (effect, one cell per strength): median over seeds of the largest z, and its statistic."""
    reference: dict[str, tuple[np.ndarray, np.ndarray, list[str]]] = {}
    rows = []
    for kind in kinds:
        base = g.suitable_base(kind)
        if base not in reference:
            null = [statistics(g.make(g.base_model(base), seed=9000 + i)) for i in range(nulls)]
            names = sorted(set.intersection(*(set(s) for s in null)))
            values = np.array([[s[k] for k in names] for s in null])
            # robust floor: a statistic that never moves in the nulls must not give infinite z
            reference[base] = values.mean(axis=0), np.maximum(values.std(axis=0, ddof=1), 1e-4), names
        centre, sd, names = reference[base]
        cells = []
        for strength in strengths:
            best = []
            for seed in range(seeds):
                model = g.base_model(base)
                if kind in g.EFFECTS:
                    case = g.make(model, effects=[(kind, strength)], seed=seed)
                else:
                    case = g.off_catalogue(model, kind, seed, strength=strength)
                found = statistics(case)
                z = np.array([(found.get(k, c) - c) for k, c in zip(names, centre, strict=True)]) / sd
                best.append((abs(z).max(), names[int(abs(z).argmax())]))
            best.sort()
            z_median, name = best[len(best) // 2]
            cells.append(f"{z_median:.0f} {name}")
        rows.append((kind, cells))
        print(f"| `{kind}` | " + " | ".join(cells) + " |", flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--nulls", type=int, default=16)
    parser.add_argument("--strengths", type=float, nargs="+", default=[0.15, 0.5])
    parser.add_argument("kinds", nargs="*")
    args = parser.parse_args()
    kinds = args.kinds or [*g.EFFECTS, *g.OFF_CATALOGUE]
    table(kinds, tuple(args.strengths), args.seeds, args.nulls)


if __name__ == "__main__":
    main()
