"""Optics: where the photons land (docs/optics.md)."""

import numpy as np
import pytest
from scipy.special import ndtr

from napari_mufasa.optics.kernels import below
from napari_mufasa.optics.psf import image_on_grid, spot_images

SIGMA = np.array([[1.308, 1.308]])  # 308 nm FWHM on 100 nm pixels


def spot(positions, shape=(33, 33), sigma=SIGMA, photons=None):
    positions = np.atleast_2d(np.asarray(positions, float))
    photons = np.full((1, len(positions)), 1000.0) if photons is None else np.asarray(photons, float)
    return spot_images(photons, positions[None], np.asarray(sigma, float), shape)[0].astype(float)


def moments(image):
    """Total, centroid (y, x) and second central moments (yy, xx)."""
    total = image.sum()
    y, x = np.indices(image.shape)
    cy, cx = (image * y).sum() / total, (image * x).sum() / total
    return total, cy, cx, (image * (y - cy) ** 2).sum() / total, (image * (x - cx) ** 2).sum() / total


def exact_share(position, sigma, n):
    edges = np.arange(n + 1) - 0.5
    return np.diff(ndtr((edges - position) / sigma))


def test_the_normal_law_from_a_table_is_that_of_scipy():
    """Anywhere between its places, and beyond them, where nothing or all is below."""
    z = np.concatenate([np.linspace(-6.0, 6.0, 20_011), [-1e6, -40.0, 40.0, 1e6]])
    assert np.abs([below(each) for each in z] - ndtr(z)).max() < 5e-9


def test_pixels_hold_the_integral_of_the_gaussian():
    image = spot([15.3, 16.8])
    expected = 1000 * np.outer(exact_share(15.3, 1.308, 33), exact_share(16.8, 1.308, 33))
    # Cut at 5 σ: what lies beyond is 6e-7 of the photons.
    np.testing.assert_allclose(image, expected, atol=1000 * 2e-6)


@pytest.mark.parametrize("position", [(16, 16), (15.5, 16.5), (14.13, 17.91)])
@pytest.mark.parametrize("sigma", [(0.4, 0.4), (1.308, 1.308), (1.0, 2.1)])
def test_photons_position_and_width(position, sigma):
    total, cy, cx, vy, vx = moments(spot(position, sigma=[sigma]))
    assert total == pytest.approx(1000, rel=1e-5)
    if min(sigma) >= 1:  # below, a pixel is no longer a small step and centroid and width ripple
        assert (cy, cx) == pytest.approx(position, abs=2e-4)
        assert vy == pytest.approx(sigma[0] ** 2 + 1 / 12, rel=2e-3)
        assert vx == pytest.approx(sigma[1] ** 2 + 1 / 12, rel=2e-3)


def test_photons_outside_are_lost_and_nothing_wraps_round():
    # At the middle of the border pixel's outer edge half the light is outside, at the corner three quarters.
    assert spot([-0.5, 16]).sum() == pytest.approx(500, rel=1e-5)
    assert spot([32.5, 16]).sum() == pytest.approx(500, rel=1e-5)
    corner = spot([-0.5, -0.5])
    assert corner.sum() == pytest.approx(250, rel=1e-5)
    assert corner[10:].sum() == 0 and corner[:, 10:].sum() == 0
    assert spot([-40, 16]).sum() == 0
    on_grid = image_on_grid(np.array([1000.0]), np.array([[-0.5, -0.5]]), (1.308, 1.308), (33, 33), 8)
    assert on_grid[12:].sum() == 0 and on_grid[:, 12:].sum() == 0
    assert on_grid.sum() == pytest.approx(250, rel=0.1)  # the fine grid knows the place to 1/16 px


def test_emitters_outside_the_field_light_its_border():
    inside = spot([-2.0, 16.0]).sum()
    assert inside == pytest.approx(1000 * (1 - ndtr((-0.5 + 2.0) / 1.308)), rel=1e-4)
    on_grid = image_on_grid(np.array([1000.0]), np.array([[-2.0, 16.0]]), (1.308, 1.308), (33, 33), 16)
    assert on_grid.sum() == pytest.approx(inside, rel=0.1)


def test_images_add_up():
    rng = np.random.default_rng(1)
    positions, photons = rng.uniform(-2, 34, (40, 2)), rng.uniform(0, 500, 40)
    together = spot(positions, photons=[photons])
    alone = sum(spot(p, photons=[[n]]) for p, n in zip(positions, photons, strict=True))
    np.testing.assert_allclose(together, alone, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("sigma", [(1.308, 1.308), (0.9, 1.7)])
def test_both_paths_agree_and_converge(sigma):
    """UΨ on an L-fold grid against exact pixel integrals: the error is that of an emitter's place, 1/(2L) px."""
    rng = np.random.default_rng(2)
    positions, photons = rng.uniform(0, 31, (60, 2)), rng.uniform(100, 500, 60)
    exact = spot(positions, (32, 32), [sigma], [photons])
    errors = [
        np.abs(image_on_grid(photons, positions, sigma, (32, 32), factor) - exact).sum() / exact.sum()
        for factor in (1, 4, 16)
    ]
    # A shift d moves a share d·2/(√(2π)σ) of a spot; d averages 1/(4L) per axis.
    for factor, error in zip((1, 4, 16), errors, strict=True):
        assert error < 0.5 / factor
    assert errors[1] < errors[0] / 2.5 and errors[2] < errors[1] / 2.5


def test_fine_grid_has_the_right_width_on_average():
    """Second moment about the true place, over many sub-pixel places: σ² + 1/12 at any factor."""
    sigma = 1.308
    places = 16 + (np.arange(64) + 0.5) / 64 - 0.5
    y = np.arange(33)
    for factor in (1, 2, 3):
        variances = []
        for place in places:
            image = image_on_grid(np.ones(1), np.array([[place, 16.0]]), (sigma, sigma), (33, 33), factor)
            variances.append((image.sum(axis=1) * (y - place) ** 2).sum())
        assert np.mean(variances) == pytest.approx(sigma**2 + 1 / 12, rel=2e-3)


def test_fine_grid_keeps_photons_and_places():
    photons, positions = np.array([1000.0]), np.array([[16.2, 14.7]])
    total, cy, cx, _, _ = moments(image_on_grid(photons, positions, (1.308, 1.308), (33, 33), 8))
    assert total == pytest.approx(1000, rel=1e-6)
    assert (cy, cx) == pytest.approx((16.2, 14.7), abs=1 / 16 + 1e-6)


def test_moving_molecules_and_changing_widths_frame_by_frame():
    positions = np.array([[[10.0, 10.0]], [[12.5, 9.0]]])
    images = spot_images(np.full((2, 1), 100.0), positions, np.array([[1.3, 1.3], [2.0, 2.0]]), (33, 33))
    first, second = moments(images[0].astype(float)), moments(images[1].astype(float))
    assert first[1:3] == pytest.approx((10, 10), abs=1e-3)
    assert second[1:3] == pytest.approx((12.5, 9.0), abs=2e-2)  # 5 σ reach the border on one side
    assert second[3] / first[3] == pytest.approx((4 + 1 / 12) / (1.69 + 1 / 12), rel=1e-2)
