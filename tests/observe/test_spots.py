"""Spots: found where they are; light, motion and width are measured without bias."""

import numpy as np
import pytest
from scipy import ndimage

import napari_mufasa as nm
from napari_mufasa import optics
from napari_mufasa.spots.drift import common_path
from napari_mufasa.spots.evidence import block_means
from napari_mufasa.spots.filters import spot_filter
from napari_mufasa.spots.follow import find_and_follow
from napari_mufasa.spots.kernels import fit_weights, moved_back
from napari_mufasa.spots.quantiles import quantiles

SIGMA, SCALE, BASELINE = 1.3, 0.1, 200.0
SHAPE = (64, 64)


def movie_of(light, positions, sigma=SIGMA, background=9.0, seed=0, frames=120):
    """Poisson movie (frame, y, x) in ADU of spots (light per frame) at positions, possibly (frame, molecule, 2)."""
    positions = np.asarray(positions, float)
    positions = positions[None] if positions.ndim == 2 else positions
    light = np.broadcast_to(light, (frames, positions.shape[1]))
    sigmas = np.broadcast_to(np.atleast_2d(sigma), (frames, 2))
    expected = optics.spot_images(light, positions, sigmas, SHAPE) + background
    counts = np.random.default_rng(seed).poisson(expected)
    return np.rint(counts / SCALE + BASELINE).astype(np.uint16)


def grid():
    return np.stack(np.meshgrid(np.arange(10.2, 60, 14), np.arange(9.7, 60, 14), indexing="ij"), -1).reshape(-1, 2)


def measure(movie):
    camera = nm.preset("PALM").camera.model_copy(update={"baseline_adu": BASELINE})
    return find_and_follow(movie, camera, SCALE, SIGMA)


def match(found, truth):
    distance = np.linalg.norm(found[:, None] - truth[None], axis=2)
    return distance.min(axis=0), distance.argmin(axis=0)


def test_every_spot_is_found_once_and_in_place():
    spots = measure(movie_of(100.0, grid()))
    assert len(spots.positions_px) == len(grid())
    distance, _ = match(spots.positions_px, grid())
    assert distance.max() < 0.3


def test_an_empty_field_has_no_spots():
    # The threshold is 6 sd on 4096 pixels × about 150 images: about 1e-3 false spots expected.
    assert len(measure(movie_of(0.0, grid())).positions_px) == 0


def test_light_is_unbiased_and_background_does_not_matter():
    for background in (2.0, 40.0):
        spots = measure(movie_of(150.0, grid(), background=background, seed=4))
        level = spots.light[spots.inside].mean()
        # 16 molecules × 120 frames: standard error under 0.6 e⁻; the pixel's width is treated as a Gaussian's.
        assert abs(level - 150) < 3


def test_common_motion_is_followed_and_light_kept():
    frames = 120
    shift = np.linspace(0, 4.0, frames)[:, None, None] * np.array([0.6, -0.8])
    spots = measure(movie_of(120.0, grid()[None] + shift, frames=frames))
    np.testing.assert_allclose(spots.path_px[-1] - spots.path_px[0], 0.9 * 4.0 * np.array([0.6, -0.8]), atol=0.15)
    lit = spots.light[spots.inside]
    assert abs(lit[:, -12:].mean() / lit[:, :12].mean() - 1) < 0.04


def test_own_motion_is_separate_from_common_motion():
    frames, truth = 120, grid()
    walk = np.zeros((frames, len(truth), 2))
    walk[60:, 3, 0] = 0.6  # one molecule jumps
    spots = measure(movie_of(150.0, truth[None] + walk, frames=frames))
    _, index = match(spots.positions_px, truth)
    moved = spots.displacement_px[index[3]]
    assert abs(np.nanmean(moved[6:, 0]) - np.nanmean(moved[:4, 0]) - 0.6) < 0.1
    others = np.delete(index, 3)
    assert np.abs(np.nanmean(spots.displacement_px[others, 6:, 0] - spots.displacement_px[others, :4, 0].mean())) < 0.1


@pytest.mark.parametrize(("sigma", "expected"), [((1.3, 1.3), (0.0, 0.0)), ((1.45, 1.3), (1.45**2 - 1.3**2, 0.0))])
def test_width_change_is_measured_along_its_axis(sigma, expected):
    spots = measure(movie_of(400.0, grid(), sigma=sigma, seed=2))
    excess = spots.shape[spots.inside].sum(axis=(0, 1)) / spots.shape_weight[spots.inside].sum()
    # The Taylor series is good to a few hundredths of a px² here.
    np.testing.assert_allclose(excess[:2], expected, atol=0.08)
    assert abs(excess[2]) < 0.05


def test_common_path_of_still_images_is_still():
    means = block_means(movie_of(100.0, grid()), np.arange(0, 121, 12))
    assert np.abs(common_path(spot_filter(means, SIGMA))).max() < 0.1


@pytest.mark.parametrize("same", [True, False])
def test_a_leap_is_one_of_the_same_spots(same):
    """25 spots of exponential brightness in ten images, all 5 px farther from the sixth on: followed in each of twenty
    seeds; and where other spots are lit in every image, none (of 40 other seeds: none; each without the rule: 34)."""
    for seed in range(100, 120):
        rng = np.random.default_rng(seed)
        places, light = rng.uniform(4, 58, (2, 25)), rng.exponential(100, 25)
        images = []
        for number in range(10):
            if not same:
                places, light = rng.uniform(4, 92, (2, 25)), rng.exponential(100, 25)
            at = (places + 5 * (same and number >= 5)).T
            images.append(optics.spot_images(light[None], at[None], np.full((1, 2), SIGMA), (96, 96))[0])
        noisy = np.array(images, np.float32) + rng.normal(0, 0.5, (10, 96, 96)).astype(np.float32)
        path = common_path(spot_filter(noisy, SIGMA))
        if same:
            np.testing.assert_allclose(path[5:], 5, atol=0.3)
        else:
            assert np.hypot(*path.T).max() < 1


def test_a_leap_of_spots_without_any_noise_is_followed():
    images = np.zeros((2, 64, 64), np.float32)
    for image, leap in zip(images, (0, 5), strict=True):
        image[np.array([20, 30, 50]) + leap, np.array([20, 40, 30])] = 3.0, 1.0, 1.0
    np.testing.assert_allclose(common_path(images)[1], (5, 0), atol=0.5)


def test_a_path_longer_than_one_look_is_followed():
    """30 px in ten images: each is looked for around the place of the last."""
    rng = np.random.default_rng(0)
    field = spot_filter(rng.poisson(5.0, (1, 128, 128)).astype(np.float32), SIGMA)[0]
    shifts = np.linspace(0, 30, 10).round().astype(int)
    moved = [np.roll(field, (s, -s), axis=(0, 1)) for s in shifts]
    np.testing.assert_allclose(common_path(moved), np.stack([shifts, -shifts], axis=1), atol=0.3)


@pytest.mark.parametrize("sigma", [0.6, 1.27, 3.0])
@pytest.mark.parametrize("shape", [(5, 7), (40, 53)])
def test_the_filter_is_the_difference_of_two_gaussian_blurs(sigma, shape):
    images = np.random.default_rng(1).normal(size=(3, *shape)).astype(np.float32)
    narrow = ndimage.gaussian_filter(images, sigma, axes=(1, 2), truncate=3.0)
    wide = ndimage.gaussian_filter(images, 2 * sigma, axes=(1, 2), truncate=2.5)
    np.testing.assert_allclose(spot_filter(images, sigma), narrow - wide, atol=2e-6)


@pytest.mark.parametrize("kind", ["u2", "f8", ">u2"])
def test_block_means_are_means(kind):
    stack = np.random.default_rng(2).poisson(900.0, (23, 5, 6)).astype(kind)
    found = block_means(stack, np.array([0, 4, 5, 23]))
    np.testing.assert_allclose(found, [stack[:4].mean(0), stack[4], stack[5:].mean(0)], rtol=1e-6)


def test_images_are_moved_back_as_scipy_does():
    images = np.random.default_rng(3).normal(size=(2, 20, 24)).astype(np.float32)
    shifts = np.array([[1.3, -2.6], [-0.4, 0.0]])
    expected = [ndimage.shift(i, -s, order=1, mode="nearest") for i, s in zip(images, shifts, strict=True)]
    np.testing.assert_allclose(moved_back(images, shifts), expected, atol=1e-6)


def test_weights_tell_each_term_apart():
    """Each row gives 1 for its own term of the series and 0 for those it is fitted with."""
    size, centre = 9, np.array([[[4.3, 3.8]]])
    weights = fit_weights(centre, size, SIGMA)[0, 0].reshape(6, -1)
    d = np.arange(size)[:, None] - centre[0, 0]
    g = np.exp(-(d**2) / (2 * SIGMA**2)) / (np.sqrt(2 * np.pi) * SIGMA)
    slope, bend = g * d / SIGMA**2, 0.5 * g * (d**2 - SIGMA**2) / SIGMA**4
    y, x = 0, 1
    pairs = [(g[:, y], g[:, x]), (slope[:, y], g[:, x]), (g[:, y], slope[:, x]), (np.ones(size), np.ones(size)),
             (bend[:, y], g[:, x]), (g[:, y], bend[:, x]), (slope[:, y], slope[:, x])]  # fmt: skip
    terms = np.array([np.outer(a, b).ravel() for a, b in pairs])
    np.testing.assert_allclose(weights[:3] @ terms[:4].T, np.eye(3, 4), atol=1e-10)
    np.testing.assert_allclose(weights[3:] @ terms.T, np.eye(7)[4:], atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_quantiles_are_numpys(dtype):
    values, shares = np.random.default_rng(4).normal(size=(3, 41)).astype(dtype), [0.0, 0.05, 0.5, 0.93, 1.0]
    for some in (values, values[:, :1], values[0, :2]):
        np.testing.assert_array_equal(quantiles(some, shares), np.quantile(some, shares, axis=-1))


def test_a_width_that_changes_from_frame_to_frame_is_told_in_each():
    """σ² ± 0.15 px² in turn: the first order of the spot's Taylor series, of which the second leaves a few per cent.
    (16 molecules of 400 e⁻ in 60 frames of each kind: standard error 0.004 px².)"""
    turn = np.where(np.arange(120) % 2 == 0, 1.0, -1.0)
    sigma = np.sqrt(SIGMA**2 + 0.15 * turn)[:, None] * np.ones(2)
    spots = measure(movie_of(400.0, grid(), sigma=sigma, seed=3))
    inside = spots.inside
    change = spots.common_widening(inside)
    assert (change[turn > 0].mean() - change[turn < 0].mean()) / 2 == pytest.approx(0.15, abs=0.02)
    shown = spots.shape[inside][:, :, :2].sum() / 2 / spots.shape_weight[inside].sum()
    assert change.mean() == pytest.approx(shown, abs=0.01)  # blocks and frames tell the same
