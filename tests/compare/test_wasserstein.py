"""W1 is exact, its floor and interval mean what they say (docs/comparison.md)."""

from __future__ import annotations

import time

import numpy as np
import ot
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.distance import cdist

import napari_mufasa as nm
from napari_mufasa.compare import bootstrap_interval, difference_interval, floor, wasserstein


def uniform(n):
    return np.full(n, 1 / n)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 10**6))
def test_frames_equal_the_transport_solver(n, m, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.gamma(2, 3, n), rng.normal(5, 4, m)
    cost = np.abs(a[:, None] - b)
    assert wasserstein(a, b) == pytest.approx(ot.emd2(uniform(n), uniform(m), cost), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("n", "m"), [(1, 7), (12, 12), (30, 17)])
def test_traces_equal_the_transport_solver(n, m):
    rng = np.random.default_rng(n)
    a, b = rng.normal(size=(n, 20)), rng.normal(0.3, 1.2, (m, 20))
    assert wasserstein(a, b, rows="traces") == pytest.approx(ot.emd2(uniform(n), uniform(m), cdist(a, b)), rel=1e-9)


@settings(max_examples=30, deadline=None)
@given(hnp.arrays(float, (3, 8), elements=st.floats(-1e3, 1e3)), st.floats(-50, 50), st.floats(0.1, 600))
def test_shift_and_gain(a, shift, gain):
    """A shift moves every sample by itself; W1 grows with the gain (source note 10)."""
    assert wasserstein(a, a + shift) == pytest.approx(abs(shift), rel=1e-9, abs=1e-9)
    b = a[::-1] ** 2 / 1000
    assert wasserstein(gain * a, gain * b) == pytest.approx(gain * wasserstein(a, b), rel=1e-9, abs=1e-9)


def test_order_of_frames_counts_for_traces_only():
    rng = np.random.default_rng(0)
    a = np.repeat(rng.normal(size=(40, 1)), 30, axis=1)
    shuffled = rng.permuted(a.ravel()).reshape(a.shape)
    assert wasserstein(a, shuffled) == pytest.approx(0, abs=1e-12)
    assert wasserstein(a, shuffled, rows="traces") > 1


def test_a_million_samples_in_a_second():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(1000, 1000)), rng.normal(size=(1000, 999))
    start = time.process_time()
    wasserstein(a, b)
    assert time.process_time() - start < 1.0


def test_resampling_by_weights_is_resampling_of_traces():
    from napari_mufasa.compare.wasserstein import Pooled

    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(12, 30)), rng.normal(1, 2, (9, 30))
    i, j = rng.integers(12, size=12), rng.integers(9, size=9)
    weights = np.concatenate([np.bincount(i, minlength=12) / 12, -np.bincount(j, minlength=9) / 9])
    found = Pooled(np.concatenate([a, b])).w1(weights)
    assert found == pytest.approx(wasserstein(a[i], b[j]), rel=1e-9)


def test_the_floor_is_what_a_perfect_model_scores():
    rng = np.random.default_rng(1)

    def draw(n):
        return rng.normal(rng.gamma(4, 5, (n, 1)), 3.0, (n, 50))

    floors = [floor(draw(60), rng=rng).value for _ in range(20)]
    perfect = [wasserstein(draw(30), draw(30)) for _ in range(60)]
    # Means of 20 and 60 values with a relative spread of 0.4: 4 sd of their ratio is 0.45.
    assert np.mean(floors) / np.mean(perfect) == pytest.approx(1.0, abs=0.45)


def test_the_interval_holds_the_distance_of_the_populations():
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(40):
        a = rng.normal(rng.normal(20, 4, (50, 1)), 2.0, (50, 30))
        b = rng.normal(rng.normal(30, 4, (50, 1)), 2.0, (50, 30))
        low, high = bootstrap_interval(a, b, n=100, rng=rng)
        hits += low <= 10.0 <= high  # equal shapes 10 apart: W1 = 10
    assert hits >= 33  # 95 % of 40 is 38; fewer than 33 once in 20 000 runs at 95 %, once in 30 at 88 %


def test_a_difference_is_known_better_than_the_distances():
    """Shares the measured molecules: the interval holds the truth and is far narrower than those of the parts."""
    rng = np.random.default_rng(4)
    hits, widths, apart = 0, [], []
    for _ in range(40):
        real = rng.normal(rng.normal(20, 6, (40, 1)), 2.0, (40, 10))
        near = rng.normal(rng.normal(40, 6, (200, 1)), 2.0, (200, 10))
        far = rng.normal(rng.normal(43, 6, (200, 1)), 2.0, (200, 10))
        low, high = difference_interval(real, near, far, n=60, rng=rng)
        hits += low <= -3.0 <= high
        widths.append(high - low)
        apart.append(np.subtract(*bootstrap_interval(real, near, n=30, rng=rng)[::-1]))
    assert hits >= 33  # as for the interval of one distance
    assert np.mean(widths) < 0.9 * np.mean(apart)
    with pytest.raises(nm.MufasaError, match="same window"):
        difference_interval(real, near, far[:, :5])


@pytest.mark.parametrize(
    ("a", "b", "rows", "word"),
    [
        (np.zeros((0, 3)), np.zeros((2, 3)), "frames", "non-empty"),
        (np.full((2, 3), np.nan), np.zeros((2, 3)), "frames", "finite"),
        (np.zeros((2, 3)), np.zeros((2, 4)), "traces", "equal"),
        (np.zeros((2, 3)), np.zeros((2, 3)), "columns", "rows"),
    ],
)
def test_bad_input_is_named(a, b, rows, word):
    with pytest.raises(nm.MufasaError, match=word):
        wasserstein(a, b, rows=rows)
