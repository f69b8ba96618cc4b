"""Laws of the illumination, optics and background effects at strong values."""

import types

import numpy as np
import pytest

from napari_mufasa import simulate, simulate_emission
from napari_mufasa.discover.read_off import averaged, relief, sharpened
from napari_mufasa.discover.seen_courses import light_step

from .helpers import ccd, effect, plain, scene_of, still_spots


def moments(image):
    y, x = np.indices(image.shape)
    total = image.sum()
    cy, cx = (image * y).sum() / total, (image * x).sum() / total
    return total, cy, cx, (image * (y - cy) ** 2).sum() / total, (image * (x - cx) ** 2).sum() / total


# illumination ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["gaussian", "off_centre", "linear"])
@pytest.mark.parametrize("dimming", [0.2, 0.8])
def test_profile_keeps_the_field_s_mean_and_dims_spots_and_background_alike(form, dimming):
    model = plain(shape=(48, 64)).with_effects(effect("illumination_profile", edge_dimming=dimming, form=form))
    positions = np.array([[5.0, 5.0], [24.0, 32.0], [40.0, 60.0]])
    scene = scene_of(model, positions)
    light = scene.light_at(*scene.pixel_coordinates())
    assert light.mean() == pytest.approx(1.0) and light.min() >= 0
    assert 1 - light.min() / light.max() > 0.8 * dimming
    np.testing.assert_allclose(scene.background_map(), 20 * light)
    np.testing.assert_allclose(scene.drive(), light[tuple(positions.astype(int).T)])


@pytest.mark.parametrize("seed", range(6))
def test_linear_profile_loses_its_dimming_from_side_to_side(seed):
    """Whatever its direction and the field's shape."""
    scene = scene_of(plain(shape=(200, 400)).with_effects(effect("illumination_profile", form="linear")), seed=seed)
    light = scene.light_at(*scene.pixel_coordinates())
    assert light.min() / light.max() == pytest.approx(0.6, rel=0.01)


def test_gaussian_profile_loses_its_dimming_at_the_edge_of_the_longer_side():
    scene = scene_of(plain(shape=(41, 81)).with_effects(effect("illumination_profile", edge_dimming=0.6)))
    centre, edge, corner = (
        float(scene.light_at(np.array(y), np.array(x))) for y, x in ((20, 40), (20, 80.5), (40.5, 80.5))
    )
    assert edge / centre == pytest.approx(0.4)
    assert corner < edge


def test_profile_reaches_the_photons():
    model = plain(n_frames=20, shape=(64, 64)).with_effects(effect("illumination_profile", edge_dimming=0.8))
    positions = np.array([[31.5, 31.5], [31.5, 0.0]])
    counts = simulate(model, positions, seed=1).emission.mean(axis=1)
    drive = scene_of(model, positions).drive()
    assert np.all(np.abs(counts - 67.249 * drive) < 4 * np.sqrt(67.249 * drive / 20))


@pytest.mark.parametrize("form", ["linear", "saturating", "step"])
@pytest.mark.parametrize("change", [-0.4, 0.5])
def test_laser_drift_is_the_ratio_of_last_to_first(form, change):
    model = plain(n_frames=60).with_effects(effect("laser_drift", change=change, form=form))
    light = scene_of(model).light
    assert light[-1] / light[0] == pytest.approx(1 + change, abs=1e-9)
    counts = simulate_emission(model, 2000, seed=2)
    last, first = counts[:, -1].mean(), counts[:, 0].mean()
    error = np.sqrt((1 / last + 1 / first) / 2000) * (1 + change)
    assert last / first == pytest.approx(1 + change, abs=4 * error)  # |z| > 4: 6e-5
    empty = simulate(model, np.empty((0, 2)), seed=2).optical.mean(axis=(1, 2))  # the background follows
    np.testing.assert_allclose(empty, 20 * light, rtol=1e-5)


@pytest.mark.parametrize("settling_time", [0.1, 0.5])
def test_what_settles_has_done_so_by_all_but_one_in_e_within_its_time(settling_time):
    drift = effect("laser_drift", change=0.4, form="saturating", settling_time=settling_time)
    light = scene_of(plain(n_frames=101).with_effects(drift)).light
    whole = 0.4 / (1 - np.exp(-1 / settling_time))  # what it would come to in the end
    assert light[round(100 * settling_time)] - 1 == pytest.approx(whole * (1 - np.exp(-1)), rel=1e-9)
    half = light[round(50 * settling_time)] - 1
    assert half == pytest.approx(whole * (1 - np.exp(-0.5)), rel=1e-9)


def test_what_settles_slowly_is_linear():
    slow, straight = (
        scene_of(plain(n_frames=50).with_effects(effect("laser_drift", change=0.4, **form))).light
        for form in ({"form": "saturating", "settling_time": 500.0}, {"form": "linear"})
    )
    np.testing.assert_allclose(slow, straight, atol=2e-4)


def test_wandering_drift_stays_within_its_change():
    light = scene_of(plain(n_frames=200).with_effects(effect("laser_drift", change=-0.3, form="wandering"))).light
    assert np.abs(light - 1).max() == pytest.approx(0.3) and light[0] == 1.0


@pytest.mark.parametrize("step_at", [0.15, 0.5, 0.8])
@pytest.mark.parametrize("rise", [0.0, 8.0])
def test_a_step_comes_when_said_and_is_read_off_a_noisy_background(step_at, rise):
    step = effect("laser_drift", change=0.3, form="step", step_at=step_at, step_frames=rise)
    light = scene_of(plain(n_frames=200).with_effects(step)).light
    assert np.argmax(np.abs(np.diff(light))) == pytest.approx(step_at * 199, abs=1)
    assert np.count_nonzero((light > 1.03) & (light < 1.27)) == pytest.approx(rise, abs=1)  # 10 to 90 %
    # A step of 0.3 in noise of 0.03 per frame: the change point is off by more than 3 frames with chance < 1e-6.
    course = light + 0.03 * np.random.default_rng(0).standard_normal(200)
    seen = light_step(still_spots(course))
    assert seen["step_at"] == pytest.approx(step_at, abs=3 / 199)
    assert seen["step_frames"] < 4 if rise == 0 else 4 <= seen["step_frames"] <= 16


@pytest.mark.parametrize("form", ["white", "pink"])
def test_flicker_has_its_rms(form):
    light = scene_of(plain(n_frames=4096).with_effects(effect("laser_flicker", rms=0.1, form=form))).light
    # White: rms of 4096 independent values, 4 × 0.1/√8192; pink is scaled to its rms.
    assert light.std() == pytest.approx(0.1, abs=4 * 0.1 / np.sqrt(2 * 4096))
    assert light.mean() == pytest.approx(1.0, abs=4 * 0.1 / np.sqrt(4096))


def test_white_flicker_is_white_and_pink_falls_as_one_over_f():
    for form, slope in (("white", 0.0), ("pink", -1.0)):
        light = scene_of(plain(n_frames=4096).with_effects(effect("laser_flicker", rms=0.05, form=form))).light
        power = np.abs(np.fft.rfft(light - light.mean())[1:-1]) ** 2
        frequency = np.arange(1, len(power) + 1)
        # Regression of log power (sd π/√6 per value): error of the slope 1.28/√(n · var(log f)) = 0.028.
        error = 1.283 / np.sqrt(len(power) * np.log(frequency).var())
        assert np.polyfit(np.log(frequency), np.log(power), 1)[0] == pytest.approx(slope, abs=4 * error)


@pytest.mark.parametrize("frames", [0.8, 3.0, 10.0])
def test_relaxing_flicker_forgets_itself_exponentially(frames):
    """Uhlenbeck and Ornstein: unit variance from the first frame on, correlation exp(−lag/τ)."""
    added = effect("laser_flicker", rms=0.1, form="relaxing", correlation_frames=frames)
    light = scene_of(plain(n_frames=20_000).with_effects(added), seed=2).light / 0.1 - 10
    kept = np.exp(-1 / frames)
    effective = 20_000 * (1 - kept**2) / (1 + kept**2)  # independent values that the variance is as sure as
    assert light.var() == pytest.approx(1, abs=4 * np.sqrt(2 / effective))
    for lag in (1, 3):
        seen = np.mean(light[lag:] * light[:-lag])
        assert seen == pytest.approx(kept**lag, abs=4 * np.sqrt(2 / effective))
    starts = [scene_of(plain(n_frames=2).with_effects(added), seed=k).light[0] / 0.1 - 10 for k in range(400)]
    assert np.var(starts) == pytest.approx(1, abs=4 * np.sqrt(2 / 400))


def test_flicker_is_common_to_molecules_and_background():
    model = plain(n_frames=200, shape=(8, 8)).with_effects(effect("laser_flicker", rms=0.2))
    result = simulate(model, np.full((400, 2), 3.0), seed=3)
    light = scene_of(model, seed=3).light
    together = result.emission.mean(axis=0)
    assert np.corrcoef(together, light)[0, 1] > 0.99
    halves = result.emission[:200].mean(axis=0), result.emission[200:].mean(axis=0)
    assert np.corrcoef(*halves)[0, 1] > 0.97


@pytest.mark.parametrize(("form", "rms"), [("sine", 0.2 / np.sqrt(2)), ("square", 0.2)])
def test_periodic_modulation_is_one_line_of_the_spectrum(form, rms):
    model = plain(n_frames=400).with_effects(effect("periodic_modulation", amplitude=0.2, period_frames=8.0, form=form))
    light = scene_of(model).light
    power = np.abs(np.fft.rfft(light - 1)) ** 2
    assert power.argmax() == 400 / 8
    assert power[50] / power.sum() > (0.999 if form == "sine" else 0.75)
    assert light.std() == pytest.approx(rms, rel=1e-3)
    counts = simulate_emission(model, 500, seed=4).mean(axis=0)
    assert np.abs(np.fft.rfft(counts - counts.mean())).argmax() == 50


# optics and background ------------------------------------------------------------------------------------


@pytest.mark.parametrize("log_ratio", [-0.6, 0.5])
def test_astigmatism_in_second_moments(log_ratio):
    """ln(σ_y/σ_x) is log_ratio, and σ_y·σ_x stays."""
    model = plain(n_frames=1, shape=(41, 41), **{"optics.background_photons_per_px": 0})
    model = model.with_effects(effect("astigmatism", log_ratio=log_ratio))
    image = simulate(model, np.array([[20.3, 19.6]]), seed=5).optical[0].astype(float)
    _, _, _, vy, vx = moments(image)
    sy, sx = np.sqrt(vy - 1 / 12), np.sqrt(vx - 1 / 12)
    assert np.log(sy / sx) == pytest.approx(log_ratio, abs=2e-3)
    assert np.sqrt(sy * sx) == pytest.approx(model.sigma_px, rel=2e-3)


@pytest.mark.parametrize(("log_ratio", "axis_deg"), [(0.2, 30.0), (0.5, 120.0), (-0.5, 30.0), (1.5, 45.0)])
def test_astigmatism_along_any_axis(log_ratio, axis_deg):
    """The second moments are those of the turned ellipse: eigenvalues σ² e^±r, the axis where it was put."""
    model = plain(n_frames=1, shape=(81, 81), **{"optics.background_photons_per_px": 0})
    model = model.with_effects(effect("astigmatism", log_ratio=log_ratio, axis_deg=axis_deg))
    image = simulate(model, np.array([[40.3, 39.6]]), seed=5).optical[0].astype(float)
    y, x = np.indices(image.shape) - np.array([40.3, 39.6])[:, None, None]
    vy, vx, vxy = (float((image * a * b).sum() / image.sum()) for a, b in ((y, y), (x, x), (x, y)))
    measured = np.array([[vx, vxy], [vxy, vy]]) - np.eye(2) / 12
    axis = np.array([np.cos(np.deg2rad(axis_deg)), np.sin(np.deg2rad(axis_deg))])
    along, across = np.outer(axis, axis), np.eye(2) - np.outer(axis, axis)
    expected = model.sigma_px**2 * (np.exp(log_ratio) * along + np.exp(-log_ratio) * across)
    np.testing.assert_allclose(measured, expected, atol=0.01 * model.sigma_px**2)


@pytest.mark.parametrize("axis_deg", [45.0, 80.0])
@pytest.mark.parametrize("log_ratio", [0.3, 1.0, 2.0])
def test_a_long_psf_is_a_gaussian_along_any_axis(log_ratio, axis_deg):
    """Not only in its moments: 2.5 % of the peak, where few nodes of a quadrature would be beads on a string."""
    model = plain(n_frames=1, shape=(121, 121), **{"optics.background_photons_per_px": 0.0})
    model = model.with_effects(effect("astigmatism", log_ratio=log_ratio, axis_deg=axis_deg))
    image = simulate(model, np.array([[60.0, 60.0]]), seed=2).optical[0]
    fine = (np.arange(121 * 4) + 0.5) / 4 - 0.5 - 60
    y, x = np.meshgrid(fine, fine, indexing="ij")
    c, s = np.cos(np.deg2rad(axis_deg)), np.sin(np.deg2rad(axis_deg))
    long, short = model.sigma_px * np.exp(log_ratio / 2), model.sigma_px * np.exp(-log_ratio / 2)
    law = np.exp(-(((x * c + y * s) / long) ** 2 + ((y * c - x * s) / short) ** 2) / 2)
    law = law.reshape(121, 4, 121, 4).sum(axis=(1, 3))
    np.testing.assert_allclose(image / image.sum(), law / law.sum(), atol=0.025 * law.max() / law.sum())


@pytest.mark.parametrize("gradient", [{"form": "hump", "width": 0.4, "relative_height": 8.0}, {"relative_height": 1.2}])
def test_the_background_is_that_of_the_fields_mean_where_light_and_background_are_both_uneven(gradient):
    both = effect("illumination_profile", edge_dimming=0.85), effect("background_gradient", **gradient)
    scene = scene_of(plain(shape=(40, 50)).with_effects(*both))
    assert scene.background_map().mean() == pytest.approx(20.0)


@pytest.mark.parametrize("form", ["linear", "hump"])
def test_gradient_keeps_the_mean_and_the_spots(form):
    added = effect("background_gradient", relative_height=0.8, form=form)
    base, model = plain(shape=(40, 40)), plain(shape=(40, 40)).with_effects(added)
    background = scene_of(model, seed=6).background_map()
    assert background.mean() == pytest.approx(20.0)
    assert background.min() >= 0 and np.ptp(background) / 20 > 0.3
    positions = np.array([[10.0, 30.0]])
    with_spot, plain_spot = (simulate(m, positions, seed=6).optical for m in (model, base))
    np.testing.assert_allclose(with_spot - background, plain_spot - 20, atol=1e-3)


def test_linear_gradient_rises_by_its_height_across_the_field():
    scene = scene_of(plain(shape=(50, 50)).with_effects(effect("background_gradient", relative_height=0.8)))
    dy, dx = np.gradient(scene.background_map())
    assert np.hypot(dy.mean(), dx.mean()) * 50 / 20 == pytest.approx(0.8, rel=1e-6)


@pytest.mark.parametrize(("centre", "width"), [((0.1, -0.3), 0.4), ((0.0, 0.9), 1.5)])
def test_a_hump_is_a_gaussian_about_its_centre_that_rises_by_its_height(centre, width):
    height = 1.5
    added = effect(
        "background_gradient", relative_height=height, form="hump", centre_y=centre[0], centre_x=centre[1], width=width
    )
    background = scene_of(plain(shape=(48, 64)).with_effects(added)).background_map()
    y, x = np.mgrid[:48, :64]
    hump = np.exp(-(((y - 23.5) / 32 - centre[0]) ** 2 + ((x - 31.5) / 32 - centre[1]) ** 2) / (2 * width**2))
    law = 1 + height * (hump - hump.min()) / (1 - hump.min())
    np.testing.assert_allclose(background / background.mean(), law / law.mean(), rtol=1e-5)


def test_background_that_decays_linearly_loses_its_share_by_the_end():
    scene = scene_of(ccd(**{"acquisition.n_frames": 11}).with_effects(effect("background_decay", form="linear")))
    np.testing.assert_allclose(scene.background, np.linspace(1, 0.7, 11))


def test_background_that_decays_as_seen_follows_the_course_it_is_given():
    seen = (0.0, -0.7, -0.9, -1.0)
    model = ccd(**{"acquisition.n_frames": 404})
    scene = scene_of(model.with_effects(effect("background_decay", fraction=0.5, form="as_seen", course=seen)))
    at = 101 * np.arange(4) + 50
    np.testing.assert_allclose(scene.background[at], 1 + 0.5 * np.array(seen), atol=1e-12)
    blind = scene_of(model.with_effects(effect("background_decay", fraction=0.5, form="as_seen")))
    np.testing.assert_allclose(blind.background, np.linspace(1, 0.5, 404))  # nothing seen: linear


def test_background_decays_with_its_variance_while_spots_stay():
    added = effect("background_decay", fraction=0.6, time_constant_movies=0.3)
    model = ccd(**{"acquisition.n_frames": 100, "acquisition.shape_px": [64, 64]}).with_effects(added)
    scene = scene_of(model)
    left = 0.4 + 0.6 * np.exp(-np.linspace(0, 1, 100) / 0.3)
    np.testing.assert_allclose(scene.background, left)
    assert np.all(scene.light == 1)
    movie = simulate(model, np.empty((0, 2)), seed=7).movie.astype(float) - 100
    n = 64 * 64
    # 100 frames each, |z| > 5: overall 1e-4. Poisson: variance = mean.
    assert np.all(np.abs(movie.mean(axis=(1, 2)) - 20 * left) < 5 * np.sqrt(20 * left / n))
    assert np.all(np.abs(movie.var(axis=(1, 2)) / (20 * left) - 1) < 5 * np.sqrt(2.2 / n))


# Courses that are read off ----------------------------------------------------------------------------------


def test_light_that_wanders_follows_the_course_it_is_given():
    seen = (0.0, 1.0, -0.5, 0.2)
    added = effect("laser_drift", change=0.4, form="wandering", course=seen)
    light = scene_of(plain(n_frames=404).with_effects(added)).light
    at = 101 * np.arange(4) + 50  # the middles of four equal parts
    np.testing.assert_allclose(light[at], 1 + 0.4 * np.array(seen), atol=1e-12)
    upside_down = tuple(-value for value in seen)  # `change` is where the course is farthest from 0, with its sign
    other = effect("laser_drift", change=0.4, form="wandering", course=upside_down)
    np.testing.assert_array_equal(scene_of(plain(n_frames=404).with_effects(other)).light, light)
    falling = effect("laser_drift", change=-0.4, form="wandering", course=seen)
    np.testing.assert_allclose(scene_of(plain(n_frames=404).with_effects(falling)).light, 2 - light, atol=1e-12)


# Reliefs that are read off -----------------------------------------------------------------------------------

RELIEF = (0.0, 0.5, 1.0, 0.2, 0.4, 0.6)  # two rows of three


@pytest.mark.parametrize("kind", ["background_gradient", "illumination_profile"])
def test_as_seen_follows_the_heights_it_is_given(kind):
    """At the centres of its cells the map has those heights; strength 0 leaves it flat, no heights make it linear."""
    strength = "relative_height" if kind == "background_gradient" else "edge_dimming"
    size = 0.6

    def background(**changes):
        added = effect(kind, **{"form": "as_seen", "seen": RELIEF, "seen_columns": 3, strength: size} | changes)
        return scene_of(plain(shape=(40, 60)).with_effects(added)).background_map()

    found = background()
    centres = (found[9:31:20, 9::20] + found[10:31:20, 10::20]) / 2  # centres lie between two pixels
    heights = np.reshape(RELIEF, (2, 3))
    expected = 1 + size * heights if kind == "background_gradient" else 1 - size * (1 - heights)
    np.testing.assert_allclose(centres / centres[0, 0], expected / expected[0, 0], rtol=0.03)
    assert found.mean() == pytest.approx(20.0)
    np.testing.assert_allclose(background(**{strength: 0.0}), 20.0)
    np.testing.assert_array_equal(background(seen=()), background(form="linear"))
    np.testing.assert_array_equal(background(seen_columns=4), background(seen=RELIEF[:4], seen_columns=9))  # one row


def test_a_relief_is_seen_where_tiles_agree_and_only_there():
    """White noise on 12 × 12 tiles: seen in none of 1000 draws (less than one in 20 000 is)."""
    rng = np.random.default_rng(5)

    def seen(tiles):
        return relief(types.SimpleNamespace(background_map=tiles), averaged)

    v, u = (np.indices((12, 12)) - 5.5) / 6
    hill = 10 + 2 * np.exp(-((v - 0.3) ** 2 + u**2) / 0.4)
    covered = hill + 0.1 * rng.standard_normal(hill.shape)
    covered[rng.random(hill.shape) < 0.3] = np.nan
    found = seen(covered)
    assert found["seen_columns"] == 12
    heights = np.reshape(found["seen"], (12, 12))
    assert heights.min() == 0 and heights.max() == 1
    assert np.corrcoef(heights.ravel(), hill.ravel())[0, 1] > 0.97
    assert not any(seen(10 + rng.standard_normal((12, 12)))["seen"] for _ in range(1000))
    assert seen(np.full((12, 12), np.nan))["seen"] == ()


@pytest.mark.parametrize(("noise", "share"), [(0.0, (0.3, 0.55)), (1.0, (0.95, 1.05))])
def test_a_sharpened_map_is_nearer_to_slopes_and_humps_and_has_no_more_noise(noise, share):
    """rms error over that of the average, in the map's own standard deviations; 20 maps of each size."""
    rng = np.random.default_rng(8)
    errors = {averaged: [], sharpened: []}
    for n in (8, 12, 16):
        y, x = (np.indices((n, n)) + 0.5) / n
        for law in (x, np.exp(-((x - 0.3) ** 2 + (y - 0.6) ** 2) / (2 * 0.2**2))):
            for _ in range(20):
                seen = law + noise * law.std() * rng.standard_normal(law.shape)
                for read in errors:
                    error = read(seen) - law
                    errors[read].append(error.std() / law.std())
    assert share[0] < np.mean(errors[sharpened]) / np.mean(errors[averaged]) < share[1]


@pytest.mark.parametrize("centre", [(0.0, 0.0), (-0.4, 0.7), (0.3, 1.6)])
@pytest.mark.parametrize("width", [0.4, 1.5])
def test_a_beam_is_a_gaussian_about_its_centre_over_even_light(centre, width):
    added = effect(
        "illumination_profile", form="beam", edge_dimming=0.7, centre_y=centre[0], centre_x=centre[1], width=width
    )
    scene = scene_of(plain(shape=(48, 64)).with_effects(added), np.array([[5.0, 9.0]]))
    y, x = scene.pixel_coordinates()
    light = scene.light_at(y, x)
    assert light.mean() == pytest.approx(1.0) and light.min() >= 0
    beam = np.exp(-(((y - 23.5) / 32 - centre[0]) ** 2 + ((x - 31.5) / 32 - centre[1]) ** 2) / (2 * width**2))
    law = 0.3 + 0.7 * (beam - beam.min()) / (1 - beam.min())  # 1 at the centre, 0.3 where it is faintest
    np.testing.assert_allclose(light, law / law.mean(), rtol=1e-9)
    np.testing.assert_allclose(scene.background_map(), 20 * light)
    assert scene.drive()[0] == pytest.approx(light[5, 9])


def test_a_beam_s_values_matter_to_a_beam_only():
    kind = type(effect("illumination_profile"))
    own = {"centre_y", "centre_x", "width"}
    assert own <= set(kind(form="beam").parameters())
    for form in ("gaussian", "off_centre", "linear", "as_seen"):
        assert not own & set(kind(form=form).parameters())
    one = scene_of(plain().with_effects(kind(form="off_centre")))
    two = scene_of(plain().with_effects(kind(form="off_centre", centre_x=0.9, width=0.4)))
    np.testing.assert_array_equal(one.background_map(), two.background_map())


# background as measured -----------------------------------------------------------------------------------


MAP, COURSE = (0.4, 1.0, 1.2, 0.8, 1.6, 1.0), (1.3, 1.1, 2.0, 0.9, 0.7, 0.8, 0.6, 0.6)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_background_follows_its_map_and_course_and_spots_do_not(share):
    """A grid of 2 × 3 cells and a course of as many values as frames: given in the middle of each."""
    added = effect("background_as_measured", share=share, map=MAP, map_columns=3, course=COURSE)
    model = plain(n_frames=8, shape=(21, 31))
    positions = np.array([[10.0, 15.0]])
    base, made = simulate(model, positions, seed=1), simulate(model.with_effects(added), positions, seed=1)
    np.testing.assert_array_equal(base.emission, made.emission)
    scene = scene_of(model.with_effects(added))
    course = 1 + share * (np.array(COURSE) - 1)
    np.testing.assert_allclose(scene.background, course / course.mean())
    everywhere = scene.background_map()
    assert everywhere.mean() == pytest.approx(20.0) and scene.background.mean() == pytest.approx(1.0)
    rows, columns = np.array([4.75, 15.25]), np.array([4 + 2 / 3, 15.0, 25 + 1 / 3])  # the middles of the cells
    at = np.stack(np.meshgrid(rows, columns, indexing="ij"))
    law = 1 + share * (np.array(MAP).reshape(2, 3) - 1)
    found = scene.background_field[0](at[0], at[1])
    np.testing.assert_allclose(found / found[0, 1], law / law[0, 1], rtol=1e-6)
    spot = made.optical - scene.background[:, None, None] * everywhere - (base.optical - 20)
    np.testing.assert_allclose(spot, 0, atol=1e-3)


def test_background_as_measured_is_poisson_light():
    """Counts of each frame and cell have the mean of map times course, and variance equal to it."""
    added = effect("background_as_measured", map=MAP, map_columns=3, course=COURSE)
    model = ccd(**{"acquisition.shape_px": [60, 90], "acquisition.n_frames": 8}).with_effects(added)
    electrons = simulate(model, np.empty((0, 2)), seed=1).movie.astype(float) - 100
    scene = scene_of(model, np.empty((0, 2)))
    law = scene.background[:, None, None] * scene.background_map()
    z = (electrons - law) / np.sqrt(law)
    frames = z.mean(axis=(1, 2)) * np.sqrt(z[0].size)
    assert np.abs(frames).max() < 4.5  # 8 frames: 5e-5
    assert np.mean(z**2) == pytest.approx(1, abs=4 * np.sqrt(2.2 / z.size))


def test_what_was_not_measured_is_even_and_steady():
    scene = scene_of(plain().with_effects(effect("background_as_measured")))
    assert not scene.background_field and np.all(scene.background == 1)
    only = scene_of(plain().with_effects(effect("background_as_measured", course=(1.0, 3.0))))
    assert not only.background_field and only.background[-1] / only.background[0] == pytest.approx(3.0)


# a halo ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("others", [{}, {"oblique": True}, {"grid": 5}])
@pytest.mark.parametrize(("share", "ratio"), [(0.4, 2.0), (0.15, 3.0)])
def test_a_halo_keeps_the_light_and_widens_the_moments(share, ratio, others):
    """⟨r²⟩ = σ²(1 − s + s ρ²) along each axis, and 1/12 of the pixel; ⟨r⁴⟩ = 3σ⁴(1 − s + s ρ⁴) to begin with."""
    values = {"optics.background_photons_per_px": 0, "optics.high_resolution_factor": others.get("grid")}
    model = plain(n_frames=2, shape=(61, 61), **values)
    if others.get("oblique"):
        model = model.with_effects(effect("astigmatism", log_ratio=0.4, axis_deg=30.0))
    positions = np.array([[30.0, 30.0]])
    base = simulate(model, positions, seed=1).optical[0].astype(float)
    halo = simulate(model.with_effects(effect("psf_halo", share=share, width_ratio=ratio)), positions, seed=1)
    image = halo.optical[0].astype(float)
    (light0, _, _, vy0, vx0), (light, cy, cx, vy, vx) = moments(base), moments(image)
    assert light == pytest.approx(light0, rel=1e-5)
    assert (cy, cx) == pytest.approx((30, 30), abs=0.11 if others.get("grid") else 1e-3)  # half a step of the fine grid
    wider = 1 - share + share * ratio**2
    pixel = 1 / 12
    tolerance = 0.02 if others.get("grid") else 2e-3
    assert vy - pixel == pytest.approx(wider * (vy0 - pixel), rel=tolerance)
    assert vx - pixel == pytest.approx(wider * (vx0 - pixel), rel=tolerance)
    if not others:
        sigma2 = model.sigma_px**2
        x = np.arange(61) - 30.0
        fourth = (image.sum(axis=0) * x**4).sum() / light
        law = 3 * sigma2**2 * (1 - share + share * ratio**4) + 6 * sigma2 * wider / 12 + 1 / 80
        assert fourth == pytest.approx(law, rel=5e-3)
