"""Laws of the sample's motion at strong values."""

import numpy as np
import pytest
from scipy import stats

from napari_mufasa import simulate, simulate_emission

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
        plain(n_frames=303).with_effects(effect("stage_drift", distance_px=3.0, form="wandering", path=path))
    ).shift_px
    np.testing.assert_allclose(shift[[50, 151, 252]], 3 * np.array(path), atol=1e-12)
    added = effect("focus_drift", widening=0.5, form="wandering", course=(0.0, -0.4, 1.0))
    widths = scene_of(plain(n_frames=303).with_effects(added)).sigma_px[:, 0]
    np.testing.assert_allclose(widths[[50, 151, 252]] / widths[0], [1.0, 0.8, 1.5], atol=1e-12)


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


# Molecules that glide -----------------------------------------------------------------------------------------


def gliding(form, n=4000, **values):
    added = effect("directed_motion", speed_px_per_frame=0.2, axis_deg=30.0, form=form, **values)
    return scene_of(plain(n_frames=101).with_effects(added), np.zeros((n, 2)), 1).walk_px.astype(float)


@pytest.mark.parametrize("form", ["one_way", "both_ways", "any_direction"])
def test_gliding_molecules_keep_a_velocity_of_their_own(form):
    """Speeds of those that move: gamma, mean v, sd v/2; displacements grow in proportion to time."""
    n, share = 4000, 0.7
    path = gliding(form, n, moving=share)
    np.testing.assert_allclose(path[100], 2 * path[50], atol=1e-4)
    speed = np.hypot(*path[100].T) / 100
    moving = speed > 0
    assert moving.mean() == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / n))
    assert stats.kstest(speed[moving], stats.gamma(4, scale=0.05).cdf).pvalue > 1e-4
    along, across = np.sin(np.deg2rad([30, 120])), np.cos(np.deg2rad([30, 120]))
    forth, aside = (path[100][moving] @ np.stack([along, across])).T
    back = np.mean(forth < 0)
    if form == "any_direction":
        angle = np.arctan2(*path[100][moving].T)
        assert stats.kstest(angle, stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-4
    else:
        np.testing.assert_allclose(aside, 0, atol=1e-4)
        assert back == (0 if form == "one_way" else pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(moving.sum())))


def test_molecules_are_lit_as_the_field_is_where_they_have_come_to():
    """A beam that falls off from 1.5 to 0.5 of the mean along x, and 20 px through it."""
    model = plain(n_frames=40, shape=(40, 60), **{"optics.background_photons_per_px": 0})
    beam = effect("illumination_profile", edge_dimming=2 / 3, direction_deg=180.0, form="linear")
    moves = {
        "directed_motion": {"speed_px_per_frame": 0.5, "moving": 1.0, "axis_deg": 0.0, "form": "one_way"},
        "stage_drift": {"distance_px": 20.0, "direction_deg": 0.0},
    }
    places = np.column_stack([np.full(2000, 20.0), np.full(2000, 10.0)])
    for kind, values in moves.items():
        model_there = model.with_effects(effect(kind, **values), beam)
        scene = scene_of(model_there, places)
        counts = simulate(model_there, places, seed=1).emission / 67.249
        moved = scene.shift_px[:, None] + (0 if scene.walk_px is None else scene.walk_px)
        light = 1.5 - (places[:, 1] + np.broadcast_to(moved, (40, 2000, 2))[..., 1] + 0.5) / 60
        assert light[0].mean() - light[-1].mean() > 0.2
        assert counts.mean(axis=0) == pytest.approx(light.mean(axis=1), abs=4 * np.sqrt(1.4 / 67 / 2000))


def test_gliding_adds_to_diffusion():
    both = [effect("directed_motion", moving=1.0), effect("molecule_diffusion", diffusion_px2_per_frame=0.04)]
    scene = scene_of(plain(n_frames=101).with_effects(*both), np.zeros((400, 2)), 1)
    forth, aside = scene.walk_px[100].astype(float).T  # axis 90°: along y
    assert forth.mean() == pytest.approx(5.0, abs=4 * np.sqrt((2.5**2 + 8) / 400))
    assert aside.var() == pytest.approx(8.0, rel=4 * np.sqrt(2 / 400))


# Molecules that bind and leave --------------------------------------------------------------------------------


def bound(n=2000, rate=2.0, form="exchange", seed=1, n_frames=100, **values):
    """The scene of n molecules within 1 s, and the share of each frame that each molecule is bound."""
    added = effect("binding", unbinding_rate_per_s=rate, form=form)
    scene = scene_of(plain(n_frames=n_frames, **values).with_effects(added), np.full((n, 2), 7.0), seed=seed)
    return scene, scene.light_of_each.astype(float)


def test_as_many_molecules_bind_as_leave():
    """At t, of n molecules Binomial(n, e^−kt) are left and Poisson(n(1 − e^−kt)) have come and stayed."""
    n, rate = 4000, 2.0
    _, share = bound(n, rate)
    for frame in (0, 20, 99):
        left = np.exp(-rate * (frame + 0.5) * 0.01)
        old, new = share[:n, frame].sum(), share[n:, frame].sum()
        assert old == pytest.approx(n * left, abs=4 * np.sqrt(n * left * (1 - left)))
        assert new == pytest.approx(n * (1 - left), abs=4 * np.sqrt(n * (1 - left)))


def test_arrivals_are_poisson():
    came = np.array([len(bound(5, 2.0, seed=seed, n_frames=50)[1]) - 5 for seed in range(400)])
    mean = 5 * 2.0 * 0.5
    assert came.mean() == pytest.approx(mean, abs=4 * np.sqrt(mean / 400))
    assert came.var() / mean == pytest.approx(1, abs=4 * np.sqrt(2 / 400 * (1 + 1 / (2 * mean))))


def test_they_come_at_any_time_and_stay_exponentially():
    """Ten mean stays long; of those who come in the first half, 1 − e^−5 leave before the end."""
    n, rate = 200, 10.0
    scene, share = bound(n, rate)
    stay_s = share.sum(axis=1) * 0.01
    first = np.where(share > 0, np.arange(100), 10**6).min(axis=1)
    early = (first < 50) & (np.arange(len(share)) >= n)
    assert early.sum() > 800
    assert stats.kstest(stay_s[early], "expon", args=(0, 0.1)).pvalue > 1e-4
    assert stats.kstest(stay_s[:n], "expon", args=(0, 0.1)).pvalue > 1e-4
    came = first[n:][first[n:] < 100] + np.random.default_rng(1).random((first[n:] < 100).sum())
    assert stats.kstest(came, "uniform", args=(0, 100)).pvalue > 1e-4
    for axis, size in enumerate((32, 40)):
        assert stats.kstest(scene.positions_px[n:, axis], "uniform", args=(-0.5, size)).pvalue > 1e-4
    assert np.all(scene.positions_px[:n] == 7.0)


def test_landing_fills_an_empty_field():
    n, rate = 3000, 2.0
    scene, share = bound(n, rate, form="landing")
    for frame in (2, 30, 99):
        law = n * (1 - np.exp(-rate * (frame + 0.5) * 0.01))
        assert share[:, frame].sum() == pytest.approx(law, abs=4 * np.sqrt(law))
    assert np.all(scene.positions_px[:n] == 7.0)
    _, few = bound(50, 0.01, form="landing")  # hardly anyone comes: the places of the others stay empty
    assert len(few) == 50 and (few.sum(axis=1) > 0).sum() < 8


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_who_is_not_bound_neither_shines_nor_bleaches(engine):
    effects = effect("binding", unbinding_rate_per_s=2.0), effect("photobleaching", rate_per_s=5.0)
    model = plain(n_frames=60).with_effects(*effects)
    counts = simulate_emission(model, 600, seed=2, engine=engine)
    scene = scene_of(model, np.zeros((600, 2)), seed=2)
    share = scene.light_of_each
    assert counts.shape == share.shape and not counts[share == 0].any()
    late = np.nonzero(share[:, :30].sum(axis=1) == 0)[0]
    begin = np.argmax(share[late] > 0, axis=1) + 1  # the first full frame, where there is one
    full = np.array([share[m, min(f, 59)] == 1 and f < 60 for m, f in zip(late, begin, strict=True)])
    light = counts[late[full], begin[full]] / 67.249
    assert full.sum() > 300
    # Half a frame of light on average before that frame, and half in it: e^(−5 · 0.01 (½ + ½)).
    assert light.mean() == pytest.approx(np.exp(-0.05), abs=4 * light.std() / np.sqrt(full.sum()) + 2e-3)


@pytest.mark.parametrize("beside", [[], ["multiple_emitters"], ["dim_companions"]])
def test_who_comes_later_walks_from_where_it_arrives(beside):
    """1 px per frame at 90° for 100 frames: a walk from the first frame on would carry nearly all of them away."""
    glide = effect("directed_motion", speed_px_per_frame=1.0, moving=1.0)
    effects = [effect("binding", unbinding_rate_per_s=1.0), glide, *map(effect, beside)]
    scene = scene_of(plain(n_frames=100).with_effects(*effects), np.full((300, 2), 7.0))
    lit = scene.light_of_each > 0
    came, later = lit.argmax(axis=1), lit.any(axis=1)
    start = scene.walk_px[came, np.arange(len(came))]
    assert later[300:].sum() > 200 and (came[later] > 0).sum() > 200
    assert np.all(start[later] == 0)
    steps = np.diff(scene.walk_px[:, :, 0], axis=0)
    np.testing.assert_allclose(steps.std(axis=0), 0, atol=1e-4)  # each at its own speed throughout


@pytest.mark.parametrize("rate", [0.0, 1.0, 10.0])
def test_dim_molecules_are_so_many_for_those_that_are_there_at_a_time(rate):
    effects = effect("binding", unbinding_rate_per_s=rate), effect("dim_population", number_ratio=4.0)
    scene = scene_of(plain(n_frames=200).with_effects(*effects), np.full((50, 2), 7.0))
    assert scene.populations[0].n_molecules == pytest.approx(200, abs=1)


def test_emitters_of_a_spot_come_and_go_together():
    effects = [effect("binding"), effect("multiple_emitters", fraction=1.0), effect("brightness_heterogeneity")]
    for order in (effects, effects[::-1]):
        scene = scene_of(plain().with_effects(*order), np.zeros((50, 2)))
        np.testing.assert_array_equal(scene.light_of_each[::2], scene.light_of_each[1::2])
        assert len(scene.brightness) == len(scene.light_of_each) == len(scene.positions_px)
        assert scene.brightness[100:].std() > 0.1  # who comes later is as unequal
