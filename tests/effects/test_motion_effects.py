"""Laws of the sample's motion at strong values."""

import numpy as np
import pytest

from napari_mufasa import simulate

from .helpers import effect, plain, scene_of

DARK = {"optics.background_photons_per_px": 0, "excitation.power_density_w_per_cm2": 200}


def moments(image):
    image = image.astype(float)
    y, x = np.indices(image.shape)
    total = image.sum()
    cy, cx = (image * y).sum() / total, (image * x).sum() / total
    return cy, cx, (image * (y - cy) ** 2).sum() / total, (image * (x - cx) ** 2).sum() / total


@pytest.mark.parametrize("form", ["linear", "saturating", "step"])
@pytest.mark.parametrize("angle", [0.0, 90.0, 210.0])
def test_stage_drift_moves_the_centroid_by_its_distance(form, angle):
    added = effect("stage_drift", distance_px=4.0, direction_deg=angle, form=form)
    movie = simulate(plain(n_frames=11, shape=(41, 41), **DARK).with_effects(added), np.array([[20.0, 20.0]]), seed=1)
    (y0, x0, *_), (y1, x1, *_) = moments(movie.optical[0]), moments(movie.optical[-1])
    assert (y0, x0) == pytest.approx((20, 20), abs=1e-3)
    expected = 4 * np.sin(np.deg2rad(angle)), 4 * np.cos(np.deg2rad(angle))
    assert (y1 - y0, x1 - x0) == pytest.approx(expected, abs=2e-3)
    if form == "linear":
        assert moments(movie.optical[5])[1] - x0 == pytest.approx(expected[1] / 2, abs=2e-3)


def test_stage_drift_moves_all_molecules_alike():
    scene = scene_of(plain().with_effects(effect("stage_drift")), np.zeros((5, 2)))
    assert scene.walk_px is None and scene.shift_px.shape == (40, 2)


def test_wandering_stage_stays_within_its_distance():
    shift = scene_of(
        plain(n_frames=300).with_effects(effect("stage_drift", distance_px=3.0, form="wandering"))
    ).shift_px
    assert np.hypot(*shift.T).max() == pytest.approx(3.0) and not shift[0].any()


@pytest.mark.parametrize("form", ["linear", "accelerating", "step"])
def test_focus_drift_widens_spots_and_keeps_their_light(form):
    added = effect("focus_drift", widening=0.8, form=form)
    result = simulate(plain(n_frames=11, shape=(41, 41), **DARK).with_effects(added), np.array([[20.0, 20.0]]), seed=2)
    widths = [np.sqrt(np.mean(moments(frame)[2:]) - 1 / 12) for frame in (result.optical[0], result.optical[-1])]
    assert widths[1] / widths[0] == pytest.approx(1.8, rel=2e-3)
    np.testing.assert_allclose(result.optical.sum(axis=(1, 2)), result.emission[0], rtol=1e-4)


def test_focus_that_wanders_widens_by_its_strength_at_most():
    added = effect("focus_drift", widening=0.8, form="wandering")
    widths = scene_of(plain(n_frames=300).with_effects(added)).sigma_px[:, 0]
    assert widths.min() == widths[0] and widths.max() == pytest.approx(1.8 * widths[0])


def test_stage_and_focus_follow_what_is_seen_of_them():
    path = ((0.0, 0.0), (0.3, -0.2), (0.6, -0.8))
    shift = scene_of(
        plain(n_frames=301).with_effects(effect("stage_drift", distance_px=3.0, form="wandering", path=path))
    ).shift_px
    np.testing.assert_allclose(shift[[50, 150, 250]], 3 * np.array(path), atol=1e-12)
    added = effect("focus_drift", widening=0.5, form="wandering", course=(0.0, -0.4, 1.0))
    widths = scene_of(plain(n_frames=301).with_effects(added)).sigma_px[:, 0]
    np.testing.assert_allclose(widths[[50, 150, 250]] / widths[0], [1.0, 0.8, 1.5], atol=1e-12)


def walk(form, diffusion, n_frames=200, n=400, seed=1):
    model = plain(n_frames=n_frames).with_effects(
        effect("molecule_diffusion", diffusion_px2_per_frame=diffusion, form=form)
    )
    return scene_of(model, np.zeros((n, 2)), seed).walk_px.astype(float)


def test_free_diffusion_has_msd_4dt():
    path = walk("free", 0.04)
    assert not path[0].any()
    for lag in (1, 10, 100):
        squares = ((path[lag] - path[0]) ** 2).sum(axis=1)  # one per molecule: exponential, sd = mean
        assert squares.mean() == pytest.approx(4 * 0.04 * lag, rel=4 / np.sqrt(400))
    displacement = path[-1] / np.sqrt(2 * 0.04 * 199)
    assert abs(np.corrcoef(displacement.T)[0, 1]) < 4 / np.sqrt(400)
    assert np.all(np.abs(displacement.mean(axis=0)) < 4 / np.sqrt(400))


def test_confined_molecules_stay_near_and_half_mobile_ones_are_half():
    confined = walk("confined", 0.04)
    stationary = 2 * 0.04 / (1 - (1 - 1 / 30) ** 2)  # variance per axis of the pulled walk
    squares = (confined[-1] ** 2).sum(axis=1)
    assert squares.mean() == pytest.approx(2 * stationary, rel=4 / np.sqrt(400))
    first = (confined[1] ** 2).sum(axis=1)
    assert first.mean() == pytest.approx(4 * 0.04, rel=4 / np.sqrt(400))  # short times are free
    half = walk("half_mobile", 0.04)
    moving = np.any(half != 0, axis=(0, 2))
    assert moving.mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(400))
    assert (half[100, moving] ** 2).sum(axis=1).mean() == pytest.approx(16.0, rel=4 / np.sqrt(moving.sum()))


def test_diffusion_reaches_the_image():
    added = effect("molecule_diffusion", diffusion_px2_per_frame=0.05)
    model = plain(n_frames=30, shape=(61, 61), **DARK).with_effects(added)
    result = simulate(model, np.array([[30.0, 30.0]]), seed=3)
    path = scene_of(model, [(30.0, 30.0)], seed=3).walk_px[:, 0]
    centroids = np.array([moments(frame)[:2] for frame in result.optical])
    np.testing.assert_allclose(centroids, 30 + path, atol=2e-2)
