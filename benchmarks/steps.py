"""Steps in traces: the package's change points against those of `ruptures`, on traces whose steps are known.

    python -m benchmarks.steps [--traces N]

Prints, for each kind of trace, the share of traces that are split though they have no step (stated: 1 %), the share of
true steps found within two frames, the steps found that are none, per trace, and the time per trace over the package's.
`ruptures` is given the noise from successive differences and, as it knows no false-alarm rate, the penalty that splits
1 % of simulated traces of normal noise.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Traces = NDArray[np.float64]
Finder = Callable[[Traces], list[NDArray[np.int64]]]
N_FRAMES, RATE, WITHIN = 300, 0.01, 2


def courses(n: int, rng: np.random.Generator) -> dict[str, tuple[Traces, list[NDArray[np.int64]]]]:
    """Name → noiseless traces (trace, frame) in noise sd and their true steps."""
    frame = np.arange(N_FRAMES)
    found: dict[str, tuple[Traces, list[NDArray[np.int64]]]] = {"noise": (np.zeros((n, N_FRAMES)), [])}
    found["noise"] = (found["noise"][0], [np.empty(0, np.int64)] * n)
    for snr in (1.0, 2.0, 5.0):
        at = rng.integers(20, N_FRAMES - 20, n)
        found[f"one step, SNR {snr:g}"] = (snr * (frame < at[:, None]), [np.array([a]) for a in at])
    for snr, gap in ((3.0, 5), (3.0, 20), (10.0, 5), (10.0, 20)):
        at = rng.integers(60, 200, n)
        dark = (frame >= at[:, None]) & (frame < at[:, None] + gap)
        found[f"dark for {gap}, SNR {snr:g}"] = (snr * ~dark, [np.array([a, a + gap]) for a in at])
    flips = rng.random((n, N_FRAMES)) < 1 / 25
    flips[:, 0] = False
    on = np.cumsum(flips, axis=1) % 2 == 0
    found["blinking every 25, SNR 5"] = (5.0 * on, [np.flatnonzero(f) for f in flips])
    return found


def own(traces: Traces) -> list[NDArray[np.int64]]:
    from napari_mufasa.traces.steps import idealise

    return [s.starts[1:] for s in idealise(traces, RATE)]


def noise_of(traces: Traces) -> Traces:
    """Noise sd of each trace from the median of its successive differences, (trace, 1)."""
    return np.asarray(np.median(np.abs(np.diff(traces, axis=1)), axis=1, keepdims=True) / 0.6745 / np.sqrt(2))


def by_ruptures(make: Callable[[], object], penalty: float) -> Finder:
    def find(traces: Traces) -> list[NDArray[np.int64]]:
        scaled = traces / noise_of(traces)
        return [np.array(make().fit(t).predict(pen=penalty)[:-1], dtype=np.int64) for t in scaled]  # type: ignore[attr-defined]

    return find


def calibrated(make: Callable[[], object], rng: np.random.Generator, n: int = 300) -> float:
    """The penalty that splits `RATE` of traces of normal noise."""
    noise = rng.standard_normal((n, N_FRAMES))
    low, high = 5.0, 40.0
    for _ in range(10):
        middle = 0.5 * (low + high)
        rate = np.mean([len(s) > 0 for s in by_ruptures(make, middle)(noise)])
        low, high = (middle, high) if rate > RATE else (low, middle)
    return high


def scores(found: list[NDArray[np.int64]], truth: list[NDArray[np.int64]]) -> tuple[float, float]:
    """Share of the true steps found, and further steps per trace."""
    hits = extra = total = 0
    for starts, steps in zip(found, truth, strict=True):
        near = np.abs(starts[:, None] - steps[None]) <= WITHIN
        hits += int(near.any(axis=0).sum())
        extra += int((~near.any(axis=1)).sum()) if near.size else len(starts)
        total += len(steps)
    return (hits / total if total else float("nan")), extra / len(found)


def main() -> None:
    import ruptures

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--traces", type=int, default=300, help="traces of each kind")
    n = parser.parse_args().traces
    rng = np.random.default_rng(0)
    makers: dict[str, Callable[[], object]] = {
        "ruptures KernelCPD": lambda: ruptures.KernelCPD(kernel="linear", min_size=3),
        "ruptures Binseg": lambda: ruptures.Binseg(model="l2", min_size=3, jump=1),
    }
    finders: dict[str, Finder] = {"own": own}
    own(rng.standard_normal((2, N_FRAMES)))  # compiled
    for name, make in makers.items():
        finders[name] = by_ruptures(make, calibrated(make, rng, 200 if "Kernel" in name else 60))
    print(f"{'traces':28} {'finder':20} {'split / found':>14} {'wrong per trace':>16} {'time':>8}")
    for kind, (course, truth) in courses(n, rng).items():
        for noise in ("normal", "EM"):
            if noise == "EM" and kind != "noise" and "SNR 5" not in kind:
                continue
            # Electron-multiplied: 3 photoelectrons of background for a dozen pixels, steps in units of its noise.
            level = 36.0 + course * np.sqrt(72.0)
            drawn = (
                rng.standard_gamma(rng.poisson(level)) if noise == "EM" else course + rng.standard_normal(course.shape)
            )
            base = 0.0
            for name, finder in finders.items():
                use = slice(None) if name != "ruptures Binseg" else slice(0, max(20, n // 5))
                start = time.process_time()
                found = finder(drawn[use])
                each = (time.process_time() - start) / len(found)
                base = base or each
                share, extra = scores(found, truth[use])
                if kind == "noise":
                    share = float(np.mean([len(f) > 0 for f in found]))
                print(f"{kind + ', ' + noise:28} {name:20} {share:14.3f} {extra:16.3f} {each / base:8.1f}")


if __name__ == "__main__":
    main()
