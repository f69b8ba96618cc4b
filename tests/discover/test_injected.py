"""The disturbances that the benchmark puts into real movies are what they are called."""

import numpy as np
import pytest
from benchmarks import injected
from benchmarks.injected import DISTURBANCES, disturbed

NOISE, MEAN = 12.0, 300.0
MOVIE = np.random.default_rng(1).normal(MEAN, NOISE, (200, 40, 50)).round().astype(np.uint16)


def put_in(name):
    return disturbed(MOVIE, getattr(injected, name)).astype(float)


def test_nothing_is_put_in_by_none():
    assert disturbed(MOVIE, None) is MOVIE
    assert {f.__name__ for f in DISTURBANCES} <= set(injected.nm.catalogue())


def test_row_noise_is_common_to_a_row_of_a_frame():
    rows = put_in("row_noise").mean(axis=2)
    assert rows.std() == pytest.approx(NOISE * np.hypot(0.3, 1 / np.sqrt(50)), rel=0.05)


def test_image_lag_is_a_share_of_the_last_frame():
    seen = put_in("image_lag")
    fluctuation = seen - seen.mean(axis=0)
    correlation = (fluctuation[1:] * fluctuation[:-1]).mean() / fluctuation.var()
    assert correlation == pytest.approx(0.05 * 0.95 / (0.95**2 + 0.05**2), abs=0.015)


def test_column_offsets_stay():
    columns = put_in("column_offset").mean(axis=(0, 1))
    assert columns.std() == pytest.approx(0.3 * NOISE, rel=0.35)  # of 50 columns: ± 10 % each sd


def test_few_pixels_are_hot_and_stay_so():
    hot = put_in("hot_pixels").mean(axis=0) - MEAN > NOISE
    assert 1 <= hot.sum() <= 20  # 6 expected, of which most are so bright


def test_cosmic_rays_strike_once():
    struck = put_in("cosmic_rays") - MOVIE
    assert 0 < np.count_nonzero(struck) < 12 and struck[struck != 0].min() >= 10 * NOISE - 1


def test_baseline_drifts_by_the_noise_of_a_pixel():
    change = (put_in("baseline_drift") - MOVIE).mean(axis=(1, 2))
    assert change[0] == 0 and change[-1] == pytest.approx(NOISE, rel=0.05)


def test_stage_drift_moves_whole_pixels():
    seen = put_in("stage_drift")
    np.testing.assert_array_equal(seen[0], MOVIE[0, :36])
    np.testing.assert_array_equal(seen[-1], MOVIE[-1, 4:])


def test_pixels_differ_in_gain_about_their_offset():
    change = (put_in("pixel_gain_variation") - MOVIE).mean(axis=0)
    assert (change / (MOVIE.mean(axis=0) - np.quantile(MOVIE, 0.001))).std() == pytest.approx(0.06, rel=0.1)
