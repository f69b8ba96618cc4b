"""Laws of PURE-LET: the risk estimate is unbiased, the weights minimise it, means and constants are kept."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.denoise_risk import honest_ratio
from benchmarks.scenes import photograph

from napari_mufasa.denoise import fused, pure_let, pure_let_traces
from napari_mufasa.denoise.expansion import Guides, apply, expand
from napari_mufasa.denoise.noise import Noise
from napari_mufasa.errors import MufasaError


def scene(side=72):
    """An image with flat parts, an edge, spots and a ramp; maximum about 1."""
    y, x = np.mgrid[:side, :side] / side
    image = 0.1 + 0.4 * (x > 0.55) + 0.2 * y
    for cy, cx in ((0.3, 0.25), (0.7, 0.3), (0.45, 0.8)):
        image = image + 0.5 * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * 0.03**2))
    return image


def observe(x, rng, kind, sigma):
    counts = rng.poisson(x)
    y = rng.standard_gamma(counts) if kind == "multiplied" else counts.astype(float)
    return (y + rng.normal(0, sigma, x.shape)).astype(np.float32)


@pytest.mark.parametrize(
    ("peak", "kind", "sigma"),
    [(1, "poisson", 0.0), (10, "poisson", 0.0), (4, "poisson", 1.0), (4, "multiplied", 0.2), (15, "multiplied", 0.2)],
)
def test_risk_estimate_is_unbiased_for_fixed_weights(peak, kind, sigma):
    # 60 realisations; the mean difference to the true error must lie within 4 standard errors: 6 false alarms in
    # 100 000. An estimate without the noise correction misses by more than 6 (checked below).
    rng = np.random.default_rng(peak)
    x = scene() * peak
    multiplied = kind == "multiplied"
    noise = Noise(2.0 if multiplied else 1.0, np.float32(sigma**2), multiplied)
    weights = None
    difference, naive = [], []
    for _ in range(60):
        y = observe(x, rng, kind, sigma)
        system, planes = expand(y, noise, 3, False)
        if weights is None:
            weights = system.solve()
            continue
        estimate = planes[0] + weights.astype(np.float32) @ planes[1:]
        true = np.mean((estimate - x.ravel()) ** 2)
        difference.append(system.risk(weights) - true)
        naive.append(np.mean((estimate - y.ravel()) ** 2) - system.noise_variance() - true)
    error = np.std(difference) / np.sqrt(len(difference))
    assert abs(np.mean(difference)) < 4 * error
    assert abs(np.mean(naive)) > 6 * np.std(naive) / np.sqrt(len(naive))


def test_guides_keep_the_risk_unbiased():
    # As above; the neighbour shows a shifted scene with its own noise.
    rng = np.random.default_rng(3)
    x = scene() * 5
    noise = Noise(1.0, np.float32(0.25))
    weights, difference = None, []
    for _ in range(60):
        y = observe(x, rng, "poisson", 0.5)
        guide = observe(np.roll(x, 2, axis=1), rng, "poisson", 0.5)
        system, planes = expand(y, noise, 3, False, Guides([guide], np.ones(1, np.float32)))
        if weights is None:
            weights = system.solve()
            continue
        estimate = planes[0] + weights.astype(np.float32) @ planes[1:]
        difference.append(system.risk(weights) - np.mean((estimate - x.ravel()) ** 2))
    assert abs(np.mean(difference)) < 4 * np.std(difference) / np.sqrt(len(difference))


def test_least_squares_weights_minimise_the_estimated_risk():
    rng = np.random.default_rng(0)
    y = observe(scene() * 8, rng, "poisson", 0.0)
    system, _ = expand(y, Noise(1.0, np.float32(0)), 3, False)
    best = system.solve(doubt=0.0)
    lowest = system.risk(best)
    for _ in range(50):
        assert system.risk(best + rng.normal(0, 0.05, best.size)) > lowest


@pytest.mark.parametrize("mapped", [False, True], ids=["one read noise", "a map of it"])
@pytest.mark.parametrize("n_guides", [0, 2])
@pytest.mark.parametrize(("shape", "levels"), [((61, 50), 3), ((26, 2 * fused.WIDTH + 35), 2)])
def test_applied_estimator_is_the_one_whose_risk_was_estimated(shape, levels, n_guides, mapped):
    # The single pass that movies take, in several strips, against the candidates one by one.
    rng = np.random.default_rng(0)
    x = np.resize(scene(61), shape) * 6
    y, *guides = (observe(x, rng, "poisson", 0.0) for _ in range(1 + n_guides))
    noise = Noise(1.0, rng.uniform(0, 2, shape).astype(np.float32) if mapped else np.float32(0.3))
    seen = Guides(guides, np.array([1.0, 0.3], np.float32)[:n_guides])
    system, planes = expand(y, noise, levels, False, seen)
    weights = rng.normal(0, 0.2, system.cross.size)
    direct = apply(y, noise, levels, False, weights, seen)
    combined = planes[0] + weights.astype(np.float32) @ planes[1:]
    np.testing.assert_allclose(direct.ravel(), combined, atol=2e-4)


@pytest.mark.parametrize("method", ["undecimated", "cycle-spinning", "patches"])
@pytest.mark.parametrize("shape", [(1, 1), (3,), (64,), (7, 9), (33, 71), (1, 80), (80, 1), (201, 64)])
def test_any_shape_keeps_its_shape_and_mean(method, shape):
    y = np.random.default_rng(0).poisson(4.0, shape)
    out = pure_let(y, method=method)
    assert out.shape == shape
    assert out.dtype == np.float32
    assert out.mean(dtype=float) == pytest.approx(y.mean(), rel=1e-5)


@pytest.mark.parametrize("method", ["undecimated", "cycle-spinning", "patches"])
def test_a_constant_image_stays_constant(method):
    out = pure_let(np.full((70, 53), 7.0), offset=2.0, method=method)
    np.testing.assert_allclose(out, 5.0, atol=1e-4)


@pytest.mark.parametrize("method", ["undecimated", "cycle-spinning", "patches"])
def test_it_denoises_and_cycle_spinning_is_the_weaker(method):
    rng = np.random.default_rng(5)
    x = scene(128) * 10
    out = pure_let(rng.poisson(x), method=method)
    gain_db = 10 * np.log10(np.mean(x) / np.mean((out - x) ** 2))
    assert gain_db > (7.0 if method == "cycle-spinning" else 8.0)


def test_borders_are_as_good_as_the_inside():
    # No padding: over 20 images of a flat scene the mean square error of the outermost pixels stays below 4 times
    # the inner one (a corner has no other shifts to average over) and far below the noise (3).
    rng = np.random.default_rng(6)
    error = np.mean(
        [(pure_let(rng.poisson(3.0, (64, 64)), method="undecimated") - 3.0) ** 2 for _ in range(20)], axis=0
    )
    edge = np.mean([error[0].mean(), error[-1].mean(), error[:, 0].mean(), error[:, -1].mean()])
    assert edge < 0.5
    assert error[16:-16, 16:-16].mean() < 0.2


def test_scaling_signal_and_noise_scales_the_result():
    rng = np.random.default_rng(7)
    y = rng.poisson(scene() * 9) + rng.normal(0, 0.5, (72, 72))
    one = pure_let(y, 1.0, 0.5)
    np.testing.assert_allclose(pure_let(3 * y + 10, 3.0, 1.5, 10.0) / 3, one, atol=2e-3)


def test_reported_risk_is_honest():
    # The risk of weights on the data they were fitted to is too low; the reported one is not: the mean over 24
    # images lies within 4 standard errors of the true error, plus 3 % for the windows' borders.
    rng = np.random.default_rng(8)
    x = scene(128) * 20
    difference, true = [], []
    for _ in range(24):
        out, risk = pure_let(rng.poisson(x), method="undecimated", return_risk=True)
        true.append(np.mean((out - x) ** 2))
        difference.append(risk - true[-1])
    assert abs(np.mean(difference)) < 4 * np.std(difference) / np.sqrt(24) + 0.03 * np.mean(true)


def test_do_no_harm():
    # White noise as signal: nothing in it can be predicted, and at variance 400 against noise 1 nothing is gained.
    rng = np.random.default_rng(9)
    x = rng.normal(0, 20, (96, 96))
    y = x + rng.normal(0, 1, x.shape)
    out = pure_let(y, alpha=0.0, sigma=1.0)
    assert np.mean((out - x) ** 2) < 1.03 * np.mean((y - x) ** 2)
    noiseless = scene()
    np.testing.assert_array_equal(pure_let(noiseless, alpha=0.0, sigma=0.0), noiseless.astype(np.float32))


def test_read_noise_maps_are_used():
    # Left half noisy, right half clean: the known map must beat its own average.
    rng = np.random.default_rng(10)
    x = scene(96) * 20
    sigma = np.where(np.arange(96) < 48, 6.0, 0.2) * np.ones((96, 1))
    y = rng.poisson(x) + rng.normal(0, 1, x.shape) * sigma
    mapped = np.mean((pure_let(y, 1.0, sigma) - x) ** 2)
    uniform = np.mean((pure_let(y, 1.0, np.sqrt(np.mean(sigma**2))) - x) ** 2)
    assert mapped < 0.9 * uniform


def test_traces_keep_their_bleaching_steps():
    rng = np.random.default_rng(11)
    bleached = rng.integers(60, 240, 60)
    x = np.where(np.arange(300)[None] < bleached[:, None], 25.0, 2.0)
    y = rng.poisson(x)
    out = pure_let_traces(y)
    assert np.mean((out - x) ** 2) < 0.15 * np.mean((y - x) ** 2)
    # Where the trace falls through the middle of its two levels.
    found = np.array([np.flatnonzero(trace > 13.5).max() + 1 for trace in out])
    assert np.mean(np.abs(found - bleached) <= 1) >= 0.9


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"image": np.zeros((2, 2, 2))}, "dimensions"),
        ({"image": np.zeros((0, 4))}, "empty"),
        ({"image": np.array([[1.0, np.nan], [1.0, 1.0]])}, "not finite"),
        ({"image": np.ones((4, 4)), "alpha": -1.0}, "alpha is -1"),
        ({"image": np.ones((4, 4)), "sigma": -1.0}, "sigma"),
        ({"image": np.ones((4, 4)), "sigma": np.ones((3, 4))}, "shape"),
        ({"image": np.ones((4, 4)), "method": "magic"}, "undecimated"),
        ({"image": np.array([["a"]])}, "real numbers"),
    ],
)
def test_bad_input_is_told_in_one_line(arguments, message):
    with pytest.raises(MufasaError, match=message) as caught:
        pure_let(**arguments)
    assert "\n" not in str(caught.value)


def stripes(side=96):
    """Curved stripes and an edge: the same small pattern over and over."""
    y, x = np.mgrid[:side, :side]
    return 0.3 + 0.25 * np.sin(np.hypot(y + 20, x + 40) * 0.8) + 0.4 * (x > 0.6 * side)


def test_like_patches_help_where_the_image_repeats_itself():
    rng = np.random.default_rng(12)
    x = stripes() * 15
    first = second = 0.0
    for _ in range(4):
        y = rng.poisson(x)
        first += np.mean((pure_let(y, method="undecimated") - x) ** 2)
        second += np.mean((pure_let(y, method="patches") - x) ** 2)
    assert second < 0.85 * first


def test_like_patches_do_no_harm_where_hardly_a_count_is_seen():
    rng = np.random.default_rng(13)
    x = scene(128) * 0.5
    first = second = 0.0
    for _ in range(4):
        y = rng.poisson(x)
        first += np.mean((pure_let(y, method="undecimated") - x) ** 2)
        second += np.mean((pure_let(y, method="patches") - x) ** 2)
    assert second < 1.03 * first


def test_the_second_pass_is_linear_in_the_data_at_the_pilot():
    # With the truth as pilot and no structure, groups are averaged: the mean of many results is the truth even at
    # 0.2 counts per pixel, where a square root and its inverse would not give it. Standard error of the mean of
    # 12 x 64 x 64 pixels at 0.2 counts: 0.002; limit five of them.
    from napari_mufasa.denoise import patches

    rng = np.random.default_rng(14)
    pilot = np.full((64, 64), 0.2, np.float32)
    noise = Noise(1.0, np.float32(0.0))
    runs = [patches.refined(rng.poisson(pilot).astype(np.float32), pilot, noise) for _ in range(12)]
    assert abs(np.mean(runs) - 0.2) < 0.01
    assert np.mean((np.mean(runs, axis=0) - 0.2) ** 2) < 0.01


@pytest.mark.parametrize("peak", [10, 30])
def test_reported_risk_is_the_true_risk_within_two_per_cent(peak):
    # The picture and the size of the published values. With what is known to be chance taken off, 36 draws know the
    # ratio to 0.7 %: a truth 2 % off would fail once in 700 runs, one of 1.00 (measured 0.99 to 1.00) never.
    ratio, error, _ = honest_ratio(photograph(256) * peak, np.random.default_rng(peak), 36, "undecimated")
    assert error < 0.010
    assert abs(ratio - 1) < 0.02 + 3 * error
