"""The one-pass statistics are the plain ones."""

import numpy as np
import pytest

from napari_mufasa.observe.pixels import pixel_statistics
from napari_mufasa.observe.table import COMB

BASELINE = 100.0


@pytest.fixture(scope="module")
def movie():
    rng = np.random.default_rng(3)
    # Coloured in time, so that the lag statistics have something to find.
    noise = rng.standard_normal((62, 12, 14))
    noise[1:] += 0.6 * noise[:-1]
    return np.rint(BASELINE + 40 + 9 * noise).astype(np.uint16)


@pytest.fixture(scope="module")
def label():
    return (np.indices((12, 14)).sum(axis=0) % 3).astype(np.int8)


def test_moments_are_numpys(movie, label):
    found = pixel_statistics(movie, BASELINE, label, 2)
    data = movie - BASELINE
    np.testing.assert_allclose(found.mean, data.mean(0))
    np.testing.assert_allclose(found.variance, data.var(0))
    centred = data - data.mean(0)
    np.testing.assert_allclose(found.skewness, (centred**3).mean(0) / data.var(0) ** 1.5, atol=1e-9)


def test_covariances_in_time_and_space(movie, label):
    found = pixel_statistics(movie, BASELINE, label, 2)
    data = movie - BASELINE
    centred = data - data.mean(0)
    for lag, value in ((1, found.lag1), (2, found.lag2)):
        np.testing.assert_allclose(value, (centred[lag:] * centred[:-lag]).mean(0), atol=1e-8)
    np.testing.assert_allclose(found.right, (centred[:, :-1, :-1] * centred[:, :-1, 1:]).mean(0), atol=1e-8)
    np.testing.assert_allclose(found.below, (centred[:, :-1, :-1] * centred[:, 1:, :-1]).mean(0), atol=1e-8)


def test_step_variance_is_blind_to_a_slow_ramp(label):
    rng = np.random.default_rng(1)
    ramp = np.linspace(0, 300, 400)[:, None, None]
    movie = np.rint(1000 + ramp + 10 * rng.standard_normal((400, 12, 14))).astype(np.uint16)
    found = pixel_statistics(movie, BASELINE, label, 2)
    # Mean of 168 pixels × 400 frames: relative standard error about 0.7 % for each half; rounding adds 1/12.
    np.testing.assert_allclose(found.step_variance.mean(axis=(1, 2)), 100 + 1 / 12, rtol=0.04)
    assert found.variance.mean() > 5000


def test_sums_and_digits_by_part(movie, label):
    found = pixel_statistics(movie, BASELINE, label, 2)
    data = movie - BASELINE
    for part in (1, 2):
        inside = np.where(label == part, data, 0)
        np.testing.assert_allclose(found.row_sum[part], inside.sum(axis=2))
        np.testing.assert_allclose(found.column_sum[part], inside.sum(axis=1))
        apart = np.abs(np.diff(data, axis=0, prepend=data[:1]))
        np.testing.assert_allclose(found.steps[part], np.where(label == part, apart, 0).sum(axis=(1, 2)))
        counts = np.bincount(movie[:, label == part].ravel() % COMB, minlength=COMB)
        np.testing.assert_array_equal(found.comb[part], counts)


def test_peak_is_found_and_the_second_is_elsewhere_in_time(label):
    movie = np.full((30, 12, 14), 200, dtype=np.uint16)
    movie[7, 3, 4] = 5000  # one hit
    movie[5:9, 6, 6] = 4000  # several frames long
    found = pixel_statistics(movie, BASELINE, label, 2)
    assert found.peak[3, 4] == 4900 and found.second[3, 4] == 100
    assert found.second[6, 6] == 3900


@pytest.mark.parametrize("shape", [(2, 9, 5), (3, 4, 30), (13, 3, 2100)])
def test_few_frames_and_wide_fields_are_whole(shape):
    movie = np.random.default_rng(2).integers(90, 400, shape, dtype=np.uint16)
    found = pixel_statistics(movie, BASELINE, np.ones(shape[1:], np.int8), 2)
    data, n = movie - BASELINE, len(movie)
    steps, half = np.diff(data, axis=0) ** 2, (np.arange(1, n) * 2 // n)[:, None, None]
    for i in (0, 1):
        np.testing.assert_allclose(found.step_variance[i], (steps * (half == i)).sum(axis=0) / (n - 1))
    right = (data[:, :-1, :-1] * data[:, :-1, 1:]).mean(0) - data.mean(0)[:-1, :-1] * data.mean(0)[:-1, 1:]
    np.testing.assert_allclose(found.right, right, atol=1e-7)
    np.testing.assert_array_equal(found.peak, data.max(axis=0))
    np.testing.assert_array_equal(found.peak_frame, data.argmax(axis=0))


def test_line_noise_is_the_variance_that_lines_share_and_not_a_single_hit():
    # 400 frames × 60 lines of 64 pixels, noise 1: what a line has in common counts 64 times; the relative standard
    # error of a variance of 24 000 normal values is 0.9 %. Frame and line means take 1/60 and 1/400 away.
    from napari_mufasa.observe.kernels import line_noise

    rng = np.random.default_rng(5)
    lines = rng.standard_normal((1, 400, 60)) * np.sqrt(64 * (1 + 64 * 0.2**2))
    labels, count = np.array([0]), np.full(60, 64)
    expected = (1 + 64 * 0.2**2) * (1 - 1 / 60) * (1 - 1 / 400)
    bare = line_noise(lines, labels, count)
    assert bare == pytest.approx(expected, rel=0.045)  # five standard errors
    for frame, line in zip(rng.integers(400, size=20), rng.integers(60, size=20), strict=True):
        lines[0, frame, line] += 600.0  # a particle's track along the line, 40 standard deviations of it
    about = lines[0] - lines[0].mean(axis=0)
    assert ((about - about.mean(axis=1, keepdims=True)) ** 2).mean() / 64 > 2 * bare  # outweighs all others
    assert line_noise(lines, labels, count) == pytest.approx(bare, rel=0.06)  # 20 of 24 000, 36 times at most
