"""The 1-Wasserstein distance between measured and simulated emission, its floor and its interval
(docs/comparison.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.errors import MufasaError

Rows = Literal["frames", "traces"]


def wasserstein(measured: Any, simulated: Any, rows: Rows = "frames") -> float:
    """W1 between two sets of traces, in the unit of the traces; exact.

    Parameters
    ----------
    measured, simulated : (molecule, frame) arrays, or `TraceSet`s; any numbers of molecules
    rows : "frames": every count of every molecule is a sample, |a − b| (any numbers of frames, too);
        "traces": every molecule's trace is a sample in R^T with Euclidean cost (equal numbers of frames)

    Equal to ``ot.emd2`` with uniform weights (docs/comparison.md). Raises `MufasaError` for empty, non-finite or
    mismatched input.
    """
    a, b = _traces(measured, "measured"), _traces(simulated, "simulated")
    if rows == "frames":
        return samples_w1(a.ravel(), b.ravel())
    if rows != "traces":
        raise MufasaError(f"rows = {rows!r} is unknown: choose 'frames' or 'traces'")
    if a.shape[1] != b.shape[1]:
        raise MufasaError(
            f"measured traces have {a.shape[1]} frames, simulated {b.shape[1]}: rows='traces' needs equal "
            "numbers; cut both to the same window or use rows='frames'"
        )
    return traces_w1(a, b)


def samples_w1(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """W1 of two one-dimensional samples with uniform weights: ∫|F_a − F_b| (exact, n log n)."""
    a, b = np.sort(a), np.sort(b)
    if len(a) == len(b):
        return float(np.abs(a - b).mean())
    together = np.concatenate([a, b])
    order = np.argsort(together, kind="stable")  # two sorted runs: merged in linear time
    share = np.where(order < len(a), 1 / len(a), -1 / len(b))
    return float(np.abs(np.cumsum(share)[:-1]) @ np.diff(together[order]))


class Pooled:
    """Many W1s between resampled molecules: all samples are sorted once, then only their weights change."""

    def __init__(self, traces: NDArray[np.floating]) -> None:
        values = traces.ravel()
        order = np.argsort(values, kind="stable")
        self.gaps = np.diff(values[order])
        self.molecule = order // traces.shape[1]
        self.n_frames = traces.shape[1]

    def w1(self, weights: NDArray[np.float64]) -> float:
        """W1 between positive and negative weights per molecule, each summing to one in size."""
        difference = np.cumsum(weights[self.molecule])[:-1] / self.n_frames
        return float(np.abs(difference) @ self.gaps)


def traces_w1(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """W1 of two sets of vectors with uniform weights and Euclidean cost, by the exact solver of POT."""
    import ot
    from scipy.spatial.distance import cdist

    cost = cdist(a, b)
    return float(ot.emd2(np.full(len(a), 1 / len(a)), np.full(len(b), 1 / len(b)), cost, numItermax=10_000_000))


@dataclass(frozen=True)
class Floor:
    """W1 between random halves of one set: as good as any model can get. mean and 95 % range of the splits."""

    value: float
    low: float
    high: float


def floor(measured: Any, rows: Rows = "frames", n_splits: int = 50, rng: np.random.Generator | None = None) -> Floor:
    """W1 between random halves of the molecules, repeated `n_splits` times.

    Halves have half the molecules, so their distance is what a perfect model scores with as few of each.
    """
    traces = _traces(measured, "measured")
    rng = rng or np.random.default_rng(0)
    if len(traces) < 2:
        return Floor(float("nan"), float("nan"), float("nan"))
    half = len(traces) // 2
    pooled = Pooled(traces)
    values = []
    for _ in range(n_splits):
        order = rng.permutation(len(traces))
        if rows == "frames":
            weights = np.zeros(len(traces))
            weights[order[:half]], weights[order[half : 2 * half]] = 1 / half, -1 / half
            values.append(pooled.w1(weights))
        else:
            values.append(wasserstein(traces[order[:half]], traces[order[half : 2 * half]], rows))
    low, high = np.percentile(values, [2.5, 97.5])
    return Floor(float(np.mean(values)), float(low), float(high))


def bootstrap_interval(
    measured: Any, simulated: Any, rows: Rows = "frames", n: int = 200, rng: np.random.Generator | None = None
) -> tuple[float, float]:
    """95 % interval of W1 by resampling molecules of both sets.

    The percentile range of the resampled values is shifted by their bias: resampled sets are farther apart
    than the sets themselves, because W1 cannot be negative.
    """
    a, b = _traces(measured, "measured"), _traces(simulated, "simulated")
    rng = rng or np.random.default_rng(0)
    centre = wasserstein(a, b, rows)
    pooled = Pooled(np.concatenate([a, b])) if a.shape[1] == b.shape[1] and rows == "frames" else None
    drawn = []
    for _ in range(n):
        i, j = rng.integers(len(a), size=len(a)), rng.integers(len(b), size=len(b))
        if pooled is None:
            drawn.append(wasserstein(a[i], b[j], rows))
        else:
            first = np.bincount(i, minlength=len(a)) / len(a)
            second = np.bincount(j, minlength=len(b)) / len(b)
            drawn.append(pooled.w1(np.concatenate([first, -second])))
    values = np.array(drawn)
    low, high = np.percentile(values, [2.5, 97.5]) - (values.mean() - centre)
    return max(0.0, float(min(low, centre))), float(max(high, centre))


def difference_interval(
    measured: Any, one: Any, other: Any, n: int = 200, rng: np.random.Generator | None = None
) -> tuple[float, float]:
    """95 % interval of W1(measured, one) − W1(measured, other) over frames, by resampling molecules of all three.

    Both distances share the measured molecules, so their difference is known far better than either of them.
    All three sets need equal numbers of frames.
    """
    sets = [_traces(measured, "measured"), _traces(one, "first simulated"), _traces(other, "second simulated")]
    if len({s.shape[1] for s in sets}) != 1:
        raise MufasaError(f"traces have {', '.join(str(s.shape[1]) for s in sets)} frames: cut all to the same window")
    rng = rng or np.random.default_rng(0)
    pooled = Pooled(np.concatenate(sets))
    nothing = [np.zeros(len(s)) for s in sets]

    def difference(weights: list[NDArray[np.float64]]) -> float:
        real, first, second = weights
        near = pooled.w1(np.concatenate([real, -first, nothing[2]]))
        return near - pooled.w1(np.concatenate([real, nothing[1], -second]))

    centre = difference([np.full(len(s), 1 / len(s)) for s in sets])
    drawn = [rng.multinomial(len(s), np.full(len(s), 1 / len(s)), size=n) / len(s) for s in sets]
    values = np.array([difference([part[i] for part in drawn]) for i in range(n)])
    low, high = np.percentile(values, [2.5, 97.5]) - (values.mean() - centre)
    return float(low), float(high)


def _traces(value: Any, name: str) -> NDArray[np.float64]:
    return checks.table(getattr(value, "traces", value), f"{name} traces").astype(np.float64)
