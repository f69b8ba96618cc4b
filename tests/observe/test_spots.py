"""Spots: found where they are; light, motion and width are measured without bias."""

import numpy as np
import pytest
from scipy import ndimage

import napari_mufasa as nm
from napari_mufasa import optics
from napari_mufasa.camera.frames import Frames
from napari_mufasa.spots.aperture import background_slopes
from napari_mufasa.spots.drift import between, common_path
from napari_mufasa.spots.evidence import block_means
from napari_mufasa.spots.filters import spot_filter
from napari_mufasa.spots.find import estimate_sigma_px
from napari_mufasa.spots.follow import find_and_follow
from napari_mufasa.spots.kernels import fit_weights, moved_back
from napari_mufasa.spots.locate import fit_places
from napari_mufasa.spots.quantiles import quantiles
from napari_mufasa.traces import extract_traces

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


CAMERA = nm.preset("PALM").camera.model_copy(update={"baseline_adu": BASELINE})
# In which an ADU is a photoelectron / SCALE, so that levels are those of `movie_of`.
IN_ELECTRONS = CAMERA.model_copy(update={"type": "CCD", "em_gain": None, "electrons_per_adu": SCALE})


def measure(movie):
    return find_and_follow(movie, CAMERA, SCALE, SIGMA)


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


def width_of(movie, camera=IN_ELECTRONS):
    return estimate_sigma_px(Frames(movie, camera))


@pytest.mark.parametrize(("n", "height"), [(30, 60.0), (30, 200.0), (60, 200.0)])
def test_hot_pixels_tell_nothing_of_the_width_of_the_psf(n, height):
    # 16 spots whose brightest pixel has 56 e; one pixel in 70 is hot at most.
    background = np.full(SHAPE, 9.0)
    background.ravel()[np.random.default_rng(1).choice(background.size, n, replace=False)] += height
    assert width_of(movie_of(600.0, grid(), background=background)) == pytest.approx(SIGMA, rel=0.04)


@pytest.mark.parametrize("sigma", [0.6, 1.3, 2.0])
@pytest.mark.parametrize("frames", [1, 60])
def test_a_margin_that_never_changes_tells_nothing_of_the_width(sigma, frames):
    movie = movie_of(1500.0, grid(), sigma=sigma, frames=frames)
    alone = width_of(movie)
    assert alone == pytest.approx(sigma, rel=0.07)
    for margin in (1, 2, 10, 40):
        wide = np.pad(movie, ((0, 0), (margin, margin), (margin, margin)))
        assert width_of(wide) == pytest.approx(alone, rel=0.05)
    dead = movie.copy()
    dead[:, :, 30], dead[:, 12, 12:14] = 0, 65535
    assert width_of(dead) == pytest.approx(alone, rel=0.05)


def test_where_nothing_is_as_wide_as_light_no_width_is_told():
    background = np.full(SHAPE, 9.0)
    background.ravel()[::97] += 100
    background[:, 40:] += 30
    assert width_of(movie_of(0.0, grid(), background=background)) is None


def test_light_that_is_scarce_is_no_margin():
    """Three of four pixels have seen no photon: they are the field, too."""
    movie = movie_of(20.0, grid(), background=0.001, frames=50)
    assert np.mean(movie.max(axis=0) == movie.min(axis=0)) > 0.7
    assert width_of(movie) == pytest.approx(SIGMA, rel=0.05)


SLOPES = {"slope": (np.mgrid[:64, :64] * [[[2.0]], [[3.0]]]).sum(axis=0),
          "hill": 200 * np.exp(-((np.mgrid[:64, :64] - 31.5) ** 2).sum(axis=0) / 2 / 40**2)}  # fmt: skip


@pytest.mark.parametrize("name", SLOPES)
def test_a_background_that_rises_draws_no_spot_uphill(name):
    """By up to 0.3 px it did; each place is known to 0.02 px here."""
    movie = movie_of(1000.0, grid(), background=5 + SLOPES[name], frames=60)
    found = extract_traces(movie, IN_ELECTRONS, psf_sigma_px=SIGMA)
    assert found.kept.all() and len(found.kept) == len(grid())  # none is wider than the PSF
    _, index = match(found.positions_px, grid())
    off = found.positions_px[index] - grid()
    assert np.sqrt(np.mean(off**2)) < 0.035
    image = (movie.mean(axis=0, dtype=np.float32) - BASELINE) * SCALE
    pixel = np.rint(grid()).astype(int)
    places, good = fit_places(image[None].astype(np.float32), np.zeros(len(pixel), int), pixel, SIGMA)
    assert good.all() and np.sqrt(np.mean((places - grid()) ** 2)) < 0.035


def test_a_plane_costs_hardly_any_precision_where_there_is_none():
    """Noise of a slope that a whole ring tells moves the place by 1 % of what the noise beneath the spot does."""
    rng = np.random.default_rng(6)
    spot = optics.spot_images(np.array([[100.0]]), np.array([[[15.2, 14.9]]]), np.full((1, 2), SIGMA), (31, 31))
    images = (spot + rng.normal(0, 1, (2000, 31, 31))).astype(np.float32)
    at, pixel = np.arange(2000), np.full((2000, 2), 15)
    with_plane, _ = fit_places(images, at, pixel, SIGMA)
    without, _ = fit_places(images, at, pixel, SIGMA, slopes=np.zeros((2000, 2)))
    assert with_plane.std(axis=0).mean() < 1.02 * without.std(axis=0).mean()


def test_where_neighbours_leave_no_ring_no_slope_is_told():
    """24 neighbours 6 px apart: what is left between them is their light."""
    places = 40 + 6.0 * (np.indices((5, 5)).reshape(2, -1).T - 2)
    image = optics.spot_images(np.full((1, 25), 400.0), places[None], np.full((1, 2), SIGMA), (80, 80))
    image = np.float32(image + np.arange(80))
    slopes = background_slopes(image, np.zeros(25, int), places, SIGMA)
    np.testing.assert_array_equal(slopes[12], 0)


@pytest.mark.parametrize("margin", [3, 4, 5, 6])
def test_the_corner_of_a_margin_is_no_molecule(margin):
    movie = np.pad(movie_of(600.0, grid(), frames=60), ((0, 0), (margin, margin), (margin, margin)))
    found = extract_traces(movie, IN_ELECTRONS)
    distance, _ = match(grid() + margin, found.positions_px[found.kept])
    assert found.kept.sum() == len(grid()) and distance.max() < 0.3


def test_a_path_goes_on_beyond_the_blocks_it_is_known_in():
    t = np.arange(200)
    truth = np.stack([0.04 * t, -0.03 * t], axis=1)
    times = np.arange(2, 200, 5.0)
    path = np.stack([np.interp(times, t, truth[:, axis]) for axis in range(2)], axis=1)
    np.testing.assert_allclose(between(path - path[0], times, 200), truth, atol=1e-9)


def test_a_leap_at_the_end_of_a_path_does_not_go_on():
    times, path = np.arange(2, 50, 5.0), np.zeros((10, 2))
    path[-1] = 5.0
    motion = between(path, times, 50)
    assert np.abs(motion[:43]).max() == 0 and motion.max() == 5.0
    np.testing.assert_array_equal(between(path[:1], times[:1], 3), np.zeros((3, 2)))
