"""Histograms of counts about their pixels' own means, the law fitted to them by likelihood, and the test of its fit.

Counts are taken about the mean of a few frames of their own pixel, and the law says what that does to them: neither
the pixels' patterns nor slow changes of the light are in the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate.law import PHASES, Law, below
from napari_mufasa.calibrate.value import NORMAL, Value

Array = NDArray[np.float64]
BLOCK = 8  # frames whose mean is taken off: short enough for slow changes, long enough to keep the law's shape
GROUPS = 10  # of pixels of like mean
PARTS = 4  # of a group, by level
MOST = 250_000  # counts that are tested: more would tell pixels apart that differ by a per mille
LEAST_EXPECTED = 10.0  # counts in a bin of the test
FREE = ("adu_per_electron", "excess_noise_factor", "read_noise_adu", "charge_e")
OFFSET = {"excess_noise_factor": 1.0}  # fitted as the logarithm of what is above


@dataclass(frozen=True)
class Histogram:
    """Counts about their means, by groups of pixels: `level_adu` (group,) mean counts + ½ (−∞: no light), `edges`
    (group, edge), `seen` (group, edge + 1) how many lie below, between and above; `n_mean` frames are in a mean. In a
    group levels differ, from pixel to pixel and in time: by `offsets_adu` (group, part), as many counts in each part;
    `phases` (group, phase): see `law.below`."""

    level_adu: Array
    offsets_adu: Array
    edges: Array
    seen: Array
    n_mean: int
    phases: Array

    def expected(self, law: Law, baseline_adu: float) -> Array:
        """How many the law puts there (group, edge + 1)."""
        signal = np.maximum(self.level_adu - baseline_adu - law.charge_e * law.adu_per_electron, 0.0)
        shares = below(law, signal[:, None] + self.offsets_adu, self.edges, self.n_mean, self.phases)
        ends = np.zeros((len(shares), 1)), np.ones((len(shares), 1))
        expected = np.diff(np.hstack([ends[0], shares, ends[1]]), axis=1) * self.seen.sum(axis=1, keepdims=True)
        return np.asarray(np.maximum(expected, 1e-9))


@dataclass(frozen=True)
class Fit:
    """A law fitted to a histogram.

    Attributes
    ----------
    law, values : the law, and its fitted numbers with intervals (widened by the misfit, where there is one)
    p_value : chance of a misfit as large where the law is right, of `MOST` counts
    misfit : how many times larger than chance it is (1 at least)
    distance : half the sum of |seen − expected| as a share of all: the part of the counts that the law puts elsewhere
    histogram, baseline_adu : what it was fitted to
    """

    name: str
    law: Law
    values: dict[str, Value]
    p_value: float
    distance: float
    histogram: Histogram
    baseline_adu: float
    misfit: float = 1.0

    @property
    def expected(self) -> Array:
        return self.histogram.expected(self.law, self.baseline_adu)


def of_dark(dark: NDArray[Any], tail: bool) -> Histogram:
    """Of frames without light (frame, y, x), each pixel about its mean over all of them; (frame,) offsets are off.

    tail : with bins far beyond the read noise, where single multiplied electrons lie
    """
    n = len(dark)
    values = dark.reshape(n, -1)
    about = (values - values.mean(axis=0)).ravel()
    return _histogram([about], [-np.inf], [np.zeros(1)], n, tail)


def of_light(chunks: Sequence[NDArray[np.float32]], pixels: NDArray[np.bool_]) -> Histogram | None:
    """Of lit frames within `pixels` (y, x), about the mean of `BLOCK` frames; None where there are too few. One
    chunk is held a second time."""
    lit = np.flatnonzero(pixels)
    whole = [chunk[: len(chunk) // BLOCK * BLOCK] for chunk in chunks if len(chunk) >= BLOCK]
    levels_of = [_levels(chunk[:, pixels]) for chunk in whole]

    def blocks(members: NDArray[np.int64]) -> NDArray[np.float32]:
        """(block, frame, pixel) of some of the lit pixels."""
        return np.concatenate([_blocks(chunk, own, lit[members]) for chunk, own in zip(whole, levels_of, strict=True)])

    if sum(map(len, whole)) < 2 * BLOCK or len(lit) < 9:
        return None
    in_turn = (_blocks(chunk, own, lit) for chunk, own in zip(whole, levels_of, strict=True))
    means = np.concatenate([values.mean(axis=1, dtype=np.float64) for values in in_turn])
    # A group is chosen by the other half's means: its own noise must not choose it.
    halves = [means[half::2].mean(axis=0) for half in (0, 1)]
    own = (halves[0] - halves[1]).std() / np.sqrt(2)
    real = np.sqrt(max(np.cov(halves[0], halves[1])[0, 1], 0.0))
    n_groups = GROUPS if real > own and len(lit) >= 60 * GROUPS else 1
    abouts: list[Any] = []
    levels: list[Any] = []
    spreads: list[Any] = []
    step = max(1, int(np.ceil(means.size * BLOCK / MOST)))
    for half in (0, 1):
        order = np.argsort(halves[1 - half], kind="stable")
        for g, members in enumerate(np.array_split(order, n_groups)):
            some = members[::step] if len(members) >= 9 * step else members
            part = blocks(some)[half::2]
            quarters = [means[half + 2 * q :: 4, some].mean(axis=0) for q in (0, 1)] if len(means) > 3 else halves
            between = max(np.cov(*quarters)[0, 1], 0.0) if n_groups > 1 else 0.0
            about = part - part.mean(axis=1, keepdims=True, dtype=np.float64)
            spreads.append(_parts(means[half::2, some], between, float(about.var()) / (BLOCK - 1)))
            about = about.ravel()
            if half == 0:
                abouts.append([about])
                levels.append([part.mean(dtype=np.float64) + 0.5])
            else:
                abouts[g].append(about)
                levels[g].append(part.mean(dtype=np.float64) + 0.5)
    level = [float(np.mean(level)) for level in levels]
    offsets = np.mean(np.reshape(spreads, (2, n_groups, PARTS)), axis=0)
    return _histogram([np.concatenate(a) for a in abouts], level, list(offsets), BLOCK)


def _levels(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], np.float32]:
    """The mean of each frame (frame, 1) of (frame, pixel) values, and that of all."""
    return values.mean(axis=1, keepdims=True), np.float32(values.mean(dtype=np.float64))


def _blocks(
    chunk: NDArray[np.float32], levels: tuple[NDArray[np.float32], np.float32], pixels: NDArray[np.int64]
) -> NDArray[np.float32]:
    """(block, frame, pixel) of a chunk's pixels (flat index), its frames brought to the same level."""
    values = chunk.reshape(len(chunk), -1)[:, pixels] - levels[0] + levels[1]
    return values.reshape(-1, BLOCK, len(pixels))


def _parts(means: Array, between: float, noise: float) -> Array:
    """How the levels within a group differ, in `PARTS` of equal size (part,), ADU about their mean.

    means : (block, pixel), pixels in the order of what other frames say of them, so that noise does not order them
    between : variance of pixels' true levels, `noise` : variance of a mean by noise alone, both ADU²
    """
    cells = np.array([part.mean(axis=1) for part in np.array_split(means, min(PARTS, means.shape[1]), axis=1)])
    course = float(np.var(means.mean(axis=1))) - noise / means.shape[1]
    true = between + max(course, 0.0)
    parts = np.array([part.mean() for part in np.array_split(np.sort(cells.ravel()), PARTS)]) - cells.mean()
    rms = float(np.sqrt(np.mean(parts**2)))
    return np.asarray(parts * np.sqrt(true) / rms if rms > 0 else np.zeros(PARTS))


def _histogram(
    abouts: Sequence[Array], levels: Sequence[float], offsets: Sequence[Array], n_mean: int, tail: bool = False
) -> Histogram:
    rng = np.random.default_rng(0)
    edges, seen, phases = [], [], []
    for about in abouts:
        phases.append(np.bincount((about % 1.0 * PHASES).astype(int) % PHASES, minlength=PHASES) / len(about))
        # Whole counts about almost the same mean would lie on a lattice, and bins hold one point of it or two.
        about = about + rng.uniform(-0.5, 0.5, len(about))
        low, middle, high = np.percentile(about, [15.87, 50, 84.13])
        sd = max((high - low) / 2, 0.5)
        scale = np.concatenate([np.linspace(-3.6, 5.2, 45), [6.0, 7.0]])
        if tail:  # one spurious electron reaches far beyond the read noise
            scale = np.concatenate([scale, np.geomspace(8.0, 150.0, 16)])
        edges.append(middle + scale * sd)
        cells = np.searchsorted(edges[-1], about, side="right")
        seen.append(np.bincount(cells, minlength=len(scale) + 1))
    return Histogram(
        np.array(levels), np.array(offsets), np.array(edges), np.array(seen, dtype=float), n_mean, np.array(phases)
    )


def surprise(histogram: Histogram, law: Law, baseline_adu: float) -> float:
    """−log likelihood of what was seen."""
    expected = histogram.expected(law, baseline_adu)
    return -float(np.sum(histogram.seen * np.log(expected / histogram.seen.sum(axis=1, keepdims=True))))


def fit(
    name: str, histogram: Histogram, law: Law, free: Sequence[str], baseline_adu: float, baseline_slope_adu: float = 0.0
) -> Fit:
    """The law of most likelihood, with the numbers named in `free` fitted, starting from `law`.

    baseline_slope_adu : where only the variance at no signal is known, the baseline moves with the read noise assumed:
        baseline_adu + read_noise_adu² / baseline_slope_adu (0: it is known).
    """
    from scipy import optimize

    def made(point: Array) -> tuple[Law, float]:
        given: dict[str, Any] = {
            n: OFFSET.get(n, 0.0) + float(np.exp(np.clip(p, -16, 16))) for n, p in zip(free, point, strict=True)
        }
        found = replace(law, **given)
        moved = found.read_noise_adu**2 / baseline_slope_adu if baseline_slope_adu else 0.0
        return found, baseline_adu + moved

    def improbable(point: Array) -> float:
        return surprise(histogram, *made(point))

    start = np.log([max(getattr(law, n) - OFFSET.get(n, 0.0), 1e-4) for n in free])
    if len(free):
        simplex = np.vstack([start, start + 0.3 * np.eye(len(free))])
        options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-3, "maxiter": 200 * len(free)}
        start = optimize.minimize(improbable, start, method="Nelder-Mead", options=options).x
    found, base = made(start)
    p_value, distance, excess = _misfit(histogram, histogram.expected(found, base), len(free))
    values = {}
    if len(free):
        # Counts about a mean that they are part of are fewer than they look.
        fewer = histogram.n_mean / (histogram.n_mean - 1) if histogram.n_mean > 1 else 1.0
        spread = np.sqrt(excess * fewer) * _spread(improbable, start)
        for n, p, sd in zip(free, start, spread, strict=True):
            shift, size = OFFSET.get(n, 0.0), float(np.exp(p))
            reach = float(np.exp(min(NORMAL * sd, 8.0)))
            values[n] = Value(shift + size, size * float(min(sd, 8.0)), shift + size / reach, shift + size * reach)
    return Fit(name, found, values, p_value, distance, histogram, base, excess)


def _spread(surprise: Any, point: Array) -> Array:
    """Standard errors by the curvature of −log likelihood at its least."""
    n, step = len(point), 0.02
    curvature = np.empty((n, n))
    unit = np.eye(n) * step
    middle = surprise(point)
    for i in range(n):
        for j in range(i, n):
            if i == j:
                second = surprise(point + unit[i]) - 2 * middle + surprise(point - unit[i])
            else:
                ways = ((1, 1), (1, -1), (-1, 1), (-1, -1))
                second = sum(a * b * surprise(point + a * unit[i] + b * unit[j]) for a, b in ways) / 4
            curvature[i, j] = curvature[j, i] = second / step**2
    eigen, vectors = np.linalg.eigh(curvature)
    covariance = vectors @ np.diag(1 / np.maximum(eigen, 1e-3)) @ vectors.T
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


def _misfit(histogram: Histogram, expected: Array, n_fitted: int) -> tuple[float, float, float]:
    """p-value, distance, and how many times larger than chance the misfit is (1 at least)."""
    from scipy import stats

    total, dof = 0.0, -n_fitted
    tested, share = _tested(histogram.seen)
    for seen, law in zip(tested, expected * share, strict=True):
        cells = _merged(law)
        s, e = np.bincount(cells, seen), np.bincount(cells, law)
        total += float(np.sum((s - e) ** 2 / e))
        dof += len(e) - 2  # the sum, and the mean, which was taken off
    distance = float(np.abs(histogram.seen - expected).sum() / histogram.seen.sum() / 2)
    if dof < 1:
        return 1.0, distance, 1.0
    return float(stats.chi2.sf(total, dof)), distance, max(1.0, total / dof)


def _tested(seen: Array) -> tuple[Array, float]:
    """`MOST` counts of all, drawn without looking, and which share that is."""
    total = int(seen.sum())
    if total <= MOST:
        return seen, 1.0
    drawn = np.random.default_rng(0).multivariate_hypergeometric(
        seen.ravel().astype(np.int64), MOST, method="marginals"
    )
    return np.asarray(drawn.reshape(seen.shape), np.float64), MOST / total


def _merged(expected: Array) -> NDArray[np.int64]:
    """The number of the cell that each bin goes to, so that each cell expects enough."""
    cells = np.zeros(len(expected), dtype=np.int64)
    cell, held = 0, 0.0
    for i, number in enumerate(expected):
        cells[i] = cell
        held += number
        if held >= LEAST_EXPECTED:
            cell, held = cell + 1, 0.0
    if held < LEAST_EXPECTED and cell > 0:  # what is left goes to the cell before
        cells[cells == cell] = cell - 1
    return cells
