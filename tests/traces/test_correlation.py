"""The autocovariance of traces against laws that are known."""

from __future__ import annotations

import numpy as np
import pytest

from napari_mufasa.traces.correlation import autocovariance, lagged
from napari_mufasa.traces.dynamics import dynamics


def test_of_a_moving_average():
    """x(t) = e(t) + ½ e(t − 1) has covariances 1¼, ½, 0, …: whatever frames are left out, if chance did not choose."""
    rng = np.random.default_rng(0)
    white = rng.standard_normal((400, 301))
    traces = white[:, 1:] + 0.5 * white[:, :-1]
    used = rng.random(traces.shape) < 0.8
    found = autocovariance(traces, used, [0, 1, 2, 5])
    # 400 × 300 × 0.64 pairs of variance 1.6 to 3.1: standard errors below 0.007; bound: four of them.
    np.testing.assert_allclose(found, [1.25, 0.5, 0.0, 0.0], atol=0.028)


def test_of_a_telegraph():
    """On and off with rates 0.05 and 0.15 per frame: p(1 − p)·(1 − 0.2)^lag with p = 0.25 dark."""
    rng = np.random.default_rng(1)
    n, frames, leave, come = 2000, 300, 0.05, 0.15
    on = rng.random(n) < come / (leave + come)
    states = np.empty((n, frames))
    for t in range(frames):
        states[:, t] = on
        change = rng.random(n) < np.where(on, leave, come)
        on = on ^ change
    lags = np.array([0, 1, 3, 10])
    found = autocovariance(states - 0.75, np.ones(states.shape, bool), lags)
    # 600 000 values of which about 1 in 9 is independent: standard error 0.0007 …; bound: five of them.
    np.testing.assert_allclose(found, 0.25 * 0.75 * 0.8**lags, atol=0.0035)


def test_pairs_count_within_traces_and_only_where_both_are_used():
    values = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
    used = np.array([[True, True, False, True], [True, True, True, False]])
    products, pairs = lagged(values, used, 1)
    assert list(products) == [2.0, 30.0 + 42.0] and list(pairs) == [1, 2]
    assert autocovariance(values, used, [1])[0] == pytest.approx(74 / 3)
    assert np.isnan(autocovariance(values, used, [4])).all()


def test_rows_of_dynamics():
    traces = np.random.default_rng(2).normal(5.0, 1.0, (6, 50))
    whole, chosen = dynamics(traces), np.array([4, 1])
    part, again = whole.of(chosen), dynamics(traces[chosen])
    for name, values in vars(part).items():
        np.testing.assert_array_equal(values, getattr(again, name))
    assert dynamics(traces[:0]).lit.shape == (0, 50)
