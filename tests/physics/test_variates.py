"""Counter-based random variates against their distributions; false alarm 1e-4 per test, seeds fixed."""

import numpy as np
import pytest
from numba import njit
from scipy import stats

from napari_mufasa.chance import variates
from napari_mufasa.chance.streams import Streams

N = 100_000
KEY = Streams(5).key("test")
stream, uniform, normal, exponential, poisson, gamma = (
    variates.stream,
    variates.uniform,
    variates.normal,
    variates.exponential,
    variates.poisson,
    variates.gamma,
)


@njit
def plain(which, key, n):
    """One variate from each of n neighbouring streams."""
    out = np.empty(n)
    for i in range(n):
        state = stream(key, 3, i)
        if which == 0:
            out[i], _ = uniform(state)
        elif which == 1:
            out[i], _ = normal(state)
        else:
            out[i], _ = exponential(state)
    return out


@njit
def poissons(mean, key, n):
    out = np.empty(n)
    for i in range(n):
        out[i], _ = poisson(mean, stream(key, i, 7))
    return out


@njit
def gammas(shape, key, n):
    out = np.empty(n)
    for i in range(n):
        out[i], _ = gamma(shape, stream(key, i, 7))
    return out


@pytest.mark.parametrize(("which", "law"), [(0, "uniform"), (1, "norm"), (2, "expon")])
def test_continuous_variates(which, law):
    values = plain(which, KEY, N)
    assert stats.kstest(values, law).pvalue > 1e-4


def test_neighbouring_streams_are_independent():
    for lag in (1, 2, 64):
        values = plain(1, KEY, N)
        assert abs(np.mean(values[lag:] * values[:-lag])) < 4 / np.sqrt(N)  # |z| > 4: 6e-5
    other = plain(1, Streams(5).key("other"), N)
    assert abs(np.mean(values * other)) < 4 / np.sqrt(N)
    next_seed = plain(1, Streams(6).key("test"), N)
    assert abs(np.mean(values * next_seed)) < 4 / np.sqrt(N)


@pytest.mark.parametrize("mean", [0.002, 0.3, 4.0, 29.9, 30.1, 180.0, 5e4])
def test_poisson(mean):
    """Chi-square over bins of expected count ≥ 10, on both sides of the change of method at 30."""
    values = poissons(mean, KEY, N).astype(int)
    low, high = int(stats.poisson.ppf(1e-4, mean)), int(stats.poisson.ppf(1 - 1e-4, mean))
    edges = np.unique(np.linspace(low, high, min(high - low + 1, 60)).astype(int))
    cumulative = np.concatenate(([0], stats.poisson.cdf(edges, mean), [1]))
    expected = N * np.diff(cumulative)
    observed = np.histogram(values, np.concatenate(([-1], edges, [10**9])) + 0.5)[0]
    use = expected >= 10
    e, o = expected[use], observed[use]
    if (~use).any():
        e, o = np.append(e, expected[~use].sum()), np.append(o, observed[~use].sum())
    assert stats.chisquare(o, e * o.sum() / e.sum()).pvalue > 1e-4


def test_poisson_of_nothing_is_nothing():
    assert not poissons(0.0, KEY, 100).any()
    assert not poissons(-1.0, KEY, 100).any()


@pytest.mark.parametrize("shape", [0.2, 0.5, 1.0, 2.5, 40.0, 3e3])
def test_gamma(shape):
    assert stats.kstest(gammas(shape, KEY, N), "gamma", args=(shape,)).pvalue > 1e-4


def test_gamma_of_no_electron_is_none():
    assert not gammas(0.0, KEY, 100).any()


def test_normal_quantile_follows_the_inverse_distribution_function():
    """Within 3e-5 of scipy's down to chances of 1e-10, far below what any of our samples could show; never falling."""
    p = np.unique(np.concatenate([np.geomspace(2.0**-33, 0.5, 20_000), np.linspace(0.01, 0.5, 20_000)])).astype("f4")
    high = np.array([variates.normal_quantile(v) for v in p])
    low = np.array([variates.normal_quantile(-v) for v in p])
    assert np.abs(high - stats.norm.isf(p.astype(float))).max() < 3e-5
    np.testing.assert_array_equal(low, -high)
    assert np.diff(high).max() < 3e-5


def test_tails_are_the_uniforms_told_from_their_nearer_end():
    u, bits, tail = np.empty(N), np.empty(N, np.uint64), np.empty(N, np.float32)
    uniforms(KEY, 3, 7, 1, u)
    variates.tails(KEY, 3, 7, bits, tail)
    np.testing.assert_allclose(tail, np.where(u < 0.5, -u, 1 - u), rtol=1e-6, atol=2.0**-31)
    assert np.all((tail < 0) == (u < 0.5))


@njit
def row_and_single(means, key):
    """The same means drawn as a row and one by one."""
    n = means.size
    u, p, below, row, single = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    uniforms(key, 3, 7, 1, u)
    poisson_row(means, u, 90, p, below, row)
    for x in range(n):
        single[x], _ = poisson(means[x], stream(key, 3, 7 + x))
    return row, single


uniforms, poisson_row = variates.uniforms, variates.poisson_row


def test_a_row_of_counts_is_the_same_as_one_by_one():
    means = np.random.default_rng(0).uniform(0, 29.9, 20_000)
    row, single = row_and_single(means, KEY)
    assert np.array_equal(row, single)


@njit
def quantiles(means, tail, k):
    variates.poisson_quantiles(means, tail, k)


@pytest.mark.parametrize("kind", [np.float32, np.float64])  # of pixels' and of molecules' photons
@pytest.mark.parametrize("mean", [variates.SMOOTH, 22.5, 60.0, 250.0, 40_000.0])
def test_a_bright_row_of_counts_follows_the_poisson_law(mean, kind):
    """Below each count lies the chance that is below it: within 5e-5, and within a tenth of what is left of it in the
    tails down to 1e-4 (deterministic: each tail gives one count)."""
    u = (np.arange(1_000_000) + 0.5) / 1_000_000
    tail = np.where(u < 0.5, -u, 1 - u).astype(np.float32)
    k = np.empty(u.size, kind)
    quantiles(np.full(u.size, mean, kind), tail, k)
    assert np.all(np.diff(k) >= 0)
    counts = np.arange(int(k.min()), int(k.max()))
    below = np.searchsorted(k, counts, side="right") / u.size
    expected = stats.poisson.cdf(counts, mean)
    assert np.abs(below - expected).max() < 5e-5
    rest = np.minimum(expected, 1 - expected)
    far = rest > 1e-4
    assert np.all(np.abs(below - expected)[far] < 0.1 * rest[far])
    assert k.mean() == pytest.approx(mean, rel=1e-4) and k.var() == pytest.approx(mean, rel=1e-3)


def test_the_uniforms_at_either_end_lie_inside_the_interval():
    ends = [variates.unit(np.uint64(bits)) for bits in (0, 2**64 - 1, 5 << 12)]
    assert ends == [2.0**-53, 1 - 2.0**-53, 5.5 * 2.0**-52]
