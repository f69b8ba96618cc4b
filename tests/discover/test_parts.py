"""The parts a diagnosis is made of, on cases whose answer is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import optimize
from tests.spec_example import MODEL

import napari_mufasa as nm
from napari_mufasa.discover import metric, nuisance
from napari_mufasa.discover.coordinates import changed, is_at_an_end, model_at, room
from napari_mufasa.discover.derivatives import free_steps
from napari_mufasa.discover.library import as_seen, ray_settings, read_by_halves
from napari_mufasa.discover.measurement import FRAMES, VOXELS, prepare
from napari_mufasa.discover.movie_bench import MovieBench
from napari_mufasa.discover.null import Null
from napari_mufasa.discover.reporting import credibility, detectable, sure_of_names
from napari_mufasa.discover.rules import ALARM, FORM_ERROR, MISFIT_ALARM, VALUE_REACH
from napari_mufasa.discover.stand import Stand, Worth
from napari_mufasa.discover.state import Ray, State, scaled, two_sided
from napari_mufasa.effects import catalogue, effect_class
from napari_mufasa.observe import PARTS, observe, photoelectrons_per_adu
from napari_mufasa.simulate.layout import scatter
from napari_mufasa.simulate.movie import SimulatedAcquisition


def test_whitening_makes_correlated_noise_white():
    rng = np.random.default_rng(0)
    mixing = rng.standard_normal((6, 6)) * 0.4 + np.eye(6)
    z = rng.standard_normal((4000, 6)) @ mixing.T
    z /= z.std(axis=0)
    white = z @ metric.whitener(metric.shrunk_correlation(z, weight=0.0)).T
    np.testing.assert_allclose(np.cov(white.T), np.eye(6), atol=0.1)


def test_shrinkage_is_strong_for_few_samples_and_weak_for_many():
    rng = np.random.default_rng(1)
    common = rng.standard_normal((5000, 1))
    z = 0.7 * common + 0.7 * rng.standard_normal((5000, 20))
    few, many = metric.shrunk_correlation(z[:25]), metric.shrunk_correlation(z)
    off = ~np.eye(20, dtype=bool)
    assert abs(many[off].mean() - 0.5 * 0.85) < 0.05  # never less than 15 % shrinkage
    assert few[off].mean() < many[off].mean() + 0.1


def test_soften_is_linear_for_noise_and_tames_outliers():
    assert metric.soften(np.array([1.0]))[0] == pytest.approx(1.0, rel=0.01)
    assert metric.soften(np.array([1000.0]))[0] < 50
    np.testing.assert_allclose(metric.stretch(metric.soften(np.array([-300.0, 0.5, 70.0]))), [-300.0, 0.5, 70.0])


FREE = np.array([[-np.inf], [np.inf]]) * np.ones(3)


def test_profile_recovers_known_moves():
    rng = np.random.default_rng(2)
    jacobian = rng.standard_normal((30, 3)) * 5
    moves = np.array([0.3, -0.2, 0.5])
    x = jacobian @ moves + rng.standard_normal(30)
    found = metric.adjust(x, np.zeros(30), np.ones(30), jacobian, np.full(3, 10.0), FREE, np.eye(30))
    error = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    assert np.all(np.abs(found.moves - moves) < 4.5 * error)
    assert found.chi2 < 60  # chi² of 27 degrees of freedom: 60 is beyond 2e-4


def test_a_value_at_the_end_of_its_room_stays_there_and_the_others_make_the_best_of_it():
    """Against scipy's least squares with bounds: two of three values would like to go farther."""
    rng = np.random.default_rng(2)
    jacobian = rng.standard_normal((30, 3))
    x = jacobian @ np.array([3.0, -2.0, 0.5])
    room = np.array([[-1.0, -1.0, -4.0], [1.0, 1.0, 4.0]])
    found = metric.adjust(x, np.zeros(30), np.ones(30), jacobian, np.full(3, 10.0), room, np.eye(30))

    def residual(moves):
        return np.concatenate([metric.soften(x - jacobian @ moves), moves / 10.0])

    best = optimize.least_squares(residual, np.zeros(3), bounds=tuple(room))
    np.testing.assert_allclose(found.moves, best.x, atol=2e-3)
    assert found.moves[0] == 1.0 and found.moves[1] == -1.0
    assert found.chi2 == pytest.approx(2 * best.cost, rel=1e-3)


def test_no_free_value_moves_farther_than_the_model_can_follow():
    """Moves to the ends of their room give the model's own ends: the emulator must not promise what no model does."""
    lag = effect_class("image_lag")(fraction=0.02, kept=0.5, form="decaying")
    model = nm.preset("FF").with_effects(lag)
    values = nuisance.nuisances(model)
    free = [n.path for n in values] + ["image_lag.fraction", "image_lag.kept"]
    ends = room(model, values, free)
    reach = [0.0 if n.most == 1.0 else VALUE_REACH * n.prior for n in values]  # one is at its largest already
    np.testing.assert_allclose(ends[1, : len(values)], reach)
    for end in ends:
        there = model_at(model, values, free, end).effects[0]
        beyond = model_at(model, values, free, 2 * end).effects[0]
        assert there.kept == pytest.approx(beyond.kept) and there.fraction == pytest.approx(beyond.fraction)
        nearer = model_at(model, values, free, 0.9 * end).effects[0]
        assert abs(nearer.kept - 0.5) < abs(there.kept - 0.5)
        assert abs(nearer.fraction - 0.02) < abs(there.fraction - 0.02)


@pytest.mark.parametrize("towards", [-1.0, 1.0])
def test_nuisance_values_keep_their_distance_from_where_they_started_however_often_they_are_moved(towards):
    """What moves on from every model it led to ends with thousands of molecules and another camera's read noise."""
    model = nm.preset("FF").with_values({"sample.n_molecules": 60, "acquisition.shape_px": (96, 96)})
    values = nuisance.nuisances(model)
    free = [n.path for n in values]
    far = towards * np.array([VALUE_REACH * n.prior for n in values])
    once = model_at(model, values, free, far)
    again = model_at(once, values, free, far)
    assert once.camera.read_noise_e == pytest.approx(model.camera.read_noise_e * np.exp(towards * 0.2))
    assert again.camera.read_noise_e == pytest.approx(once.camera.read_noise_e)
    assert again.optics.psf_fwhm_nm == pytest.approx(once.optics.psf_fwhm_nm)
    end = room(once, values, free)[1 if towards > 0 else 0]
    np.testing.assert_allclose(end, 0.0, atol=0.03)  # molecules are whole
    steps = free_steps(once, values, free)  # derivatives are taken where the values can go
    np.testing.assert_allclose(np.clip(steps, *room(once, values, free)), steps, atol=0.03)
    beyond = model.with_values({"sample.n_molecules": 6000 if towards > 0 else 1})
    assert nuisance.kept(beyond, values).sample.n_molecules == pytest.approx(60 * np.exp(towards), abs=0.5)


def test_what_is_believed_of_a_value_stays_in_reach_wherever_the_first_match_has_put_it():
    """Beside hits of cosmic rays, which look like spots, 20 molecules were matched by 257."""
    believed = nm.preset("FF").with_values(
        {"sample.n_molecules": 50, "acquisition.shape_px": (96, 96), "camera.baseline_adu": 9000.0}
    )
    matched = believed.with_values({"sample.n_molecules": 257, "camera.baseline_adu": 9500.0})
    values = nuisance.nuisances(matched, believed)
    few, many = (
        nuisance.kept(believed.with_values({"sample.n_molecules": n}), values).sample.n_molecules for n in (1, 5000)
    )
    assert few == pytest.approx(50 * np.exp(-1), abs=0.5) and many == pytest.approx(257 * np.exp(1), abs=0.5)
    free = [n.path for n in values]
    baseline = next(n for n in values if n.path == "camera.baseline_adu")
    ends = room(matched, values, free)[:, free.index("camera.baseline_adu")]
    reach = VALUE_REACH * baseline.prior
    np.testing.assert_allclose(ends, [-500.0 - reach, reach])


def test_a_value_that_comes_to_its_end_does_not_keep_the_others_from_their_place():
    """Two values that make up for one another: cut short where one of them ends, the way to the best of both leads
    uphill, and neither moved."""
    rng = np.random.default_rng(7)
    slopes = rng.standard_normal((40, 1)) + 0.1 * rng.standard_normal((40, 4))  # much the same, all of them
    noise, one = rng.standard_normal(40), np.eye(40)
    x = slopes @ [3.0, -2.0, 0.5, 0.0] + noise
    room = np.array([[-4.0] * 4, [0.02, 4.0, 4.0, 4.0]])
    found = metric.adjust(x, np.zeros(40), np.ones(40), slopes, np.full(4, 3.0), room, one)

    def chi2(moves):
        return float(np.square(metric.soften(x - slopes @ moves)).sum() + np.square(moves / 3.0).sum())

    best = optimize.minimize(chi2, np.zeros(4), bounds=room.T, method="L-BFGS-B", options={"ftol": 1e-14})
    assert found.moves[0] == pytest.approx(0.02) and best.x[0] == pytest.approx(0.02)
    assert found.chi2 < best.fun + 0.05 and chi2(np.zeros(4)) > best.fun + 20


def test_a_lead_does_not_take_credit_for_a_value_at_its_end():
    """Misfit along a direction that a free value may not follow any farther is nothing that an idle ray explains."""
    state = toy_state()
    x = np.zeros((3, 25))
    x[:, :4] = 3.0 * 9.0  # brightness would move by 9, and may by 1.25
    idle = Ray(catalogue()["laser_drift"](), np.full((3, 25), 1e-9))
    lead = state.screen(x, {"laser_drift": [idle]})["laser_drift"][0]
    assert state.adjusted(x).moves[0] == pytest.approx(state.room[1, 0])
    assert abs(lead.gain) < 0.1


def toy_state(p=25, free=1):
    rng = np.random.default_rng(3)
    model = nm.preset("FF")
    slopes = np.zeros((3, p, free))
    slopes[:, :4] = 3.0
    return State(
        model, np.zeros((3, p)), np.ones((3, p)), slopes, np.full(free, 2.0), np.stack([np.eye(p)] * 3),
        rng.standard_normal((10, 3, p)), ("optics.brightness_correction",) * free, np.full(p, 0.1),
        tuple(n for n in nuisance.nuisances(model) if n.path == "optics.brightness_correction") * free,
    )  # fmt: skip


def test_screen_finds_the_ray_that_made_the_data_and_is_not_fooled_by_nuisance():
    state, rng = toy_state(), np.random.default_rng(4)
    drift, flicker = effect_class("stage_drift")(), effect_class("laser_flicker")()
    one, two = np.zeros((3, 25)), np.zeros((3, 25))
    one[:, 5:9], two[:, 12:15] = 8.0, 8.0
    rays = {"stage_drift": [Ray(drift, one)], "laser_flicker": [Ray(flicker, two)]}
    noise = rng.standard_normal((3, 25))
    leads = state.screen(noise + 0.7 * one, rays)
    assert leads["stage_drift"][0].gain > 60 > 20 > leads["laser_flicker"][0].gain
    assert leads["stage_drift"][0].scale == 0.7
    nuisance_only = state.screen(noise + state.slopes[:, :, 0] * 0.6, rays)
    assert max(forms[0].gain for forms in nuisance_only.values()) < 8


def test_doubt_widens_what_effects_move_and_nothing_else():
    """Errors of two laws that know nothing of each other, a share of what each moves, beside the noise."""
    state = toy_state()
    one, two = np.zeros((3, 25)), np.zeros((3, 25))
    one[:, :10], two[:, 5:15] = 20.0, -10.0
    doubted = state.doubting([one, two]).spread / state.spread
    share = FORM_ERROR * np.array([20.0, 10.0])
    np.testing.assert_allclose(doubted[:, :5], np.hypot(1, share[0]))
    np.testing.assert_allclose(doubted[:, 5:10], np.sqrt(1 + share @ share))
    np.testing.assert_allclose(doubted[:, 10:15], np.hypot(1, share[1]))
    np.testing.assert_array_equal(doubted[:, 15:], 1.0)


def test_a_ray_that_is_too_weak_says_that_it_ends():
    state, drift, shift = toy_state(), effect_class("stage_drift")(), np.zeros((3, 25))
    shift[:, 5:9] = 3.0
    (lead,) = state.screen(0.7 * shift, {"stage_drift": [Ray(drift, shift)]})["stage_drift"]
    assert lead.scale == 0.7 and not lead.may_be_stronger
    (lead,) = state.screen(4.0 * shift, {"stage_drift": [Ray(drift, shift)]})["stage_drift"]
    assert lead.may_be_stronger


def test_held_out_error_is_one_for_noise_and_larger_for_a_shift():
    state, rng = toy_state(p=200), np.random.default_rng(5)
    # rms of 200 standard normals: 1 ± 0.05.
    assert state.held_out_error(rng.standard_normal((3, 200))) == pytest.approx(1.0, abs=0.2)
    assert state.held_out_error(rng.standard_normal((3, 200)) + 3.0 * (np.arange(200) % 2)) > 1.8


def test_each_half_of_the_field_is_judged_with_what_was_fitted_to_the_other():
    state = toy_state(p=25)
    by_one = state.slopes[0, :, 0]  # 3 for the first four observables, 0 for the others
    white, black = np.zeros((3, 25)), np.zeros((3, 25))
    white[PARTS.index("white")] = by_one
    black[PARTS.index("black")] = by_one
    # What one half alone shows is missing from the other: 4 of 25 observables are 3 off in each of both directions.
    assert state.held_out_error(white) == pytest.approx(3 * np.sqrt(4 / 25), rel=0.03)
    assert state.held_out_error(black) == pytest.approx(state.held_out_error(white), rel=1e-6)
    assert state.held_out_error(white + black) < 0.05  # what both show is a free value's


def test_the_floor_is_the_error_of_a_right_model_whose_pattern_is_read_off_one_half():
    rng, white, black = np.random.default_rng(8), PARTS.index("white"), PARTS.index("black")
    state, ratios = toy_state(p=200), []
    for _ in range(20):
        # Half of the observables are a pattern, read off with as much noise as it is seen with (variance 1 + 1), of the
        # others each half has its own noise: √1.5 on average.
        x = rng.standard_normal((3, 200))
        pattern = np.arange(200) < 100
        both = np.where(pattern, (x[white] + x[black]) / 2, 0.0)
        mean = np.broadcast_to(both, (3, 200))
        unread = {"column_offset": {half: np.where(pattern, x[half] - mean, 0.0) for half in (white, black)}}
        check = mean + rng.standard_normal((12, 3, 200))
        bare = replace(state, mean=mean, check=check).with_floor()
        seen = replace(bare, unread=unread).with_floor()
        assert bare.floor == pytest.approx(1.0, abs=0.1)  # the median of 12, each 1 ± 0.05
        assert seen.floor == pytest.approx(np.sqrt(1.5), abs=0.15)
        ratios.append(seen.held_out_error(x) / seen.floor)
    # Each ± 0.06: the mean of twenty is within 4 of its standard deviations of 1.
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.055)


@pytest.mark.parametrize(("shown", "differs"), [((), False), ((0.0, 0.5, 1.0), True)])
def test_a_half_that_shows_no_course_is_judged_with_that_of_the_whole(shown, differs):
    """Fewer than ten molecules of a half show no course of the focus; one at random would be another effect."""
    drift = effect_class("focus_drift")(form="wandering", course=(0.0, 1.0, 0.2))
    model = nm.preset("PALM").with_effects(drift)
    rows = np.zeros((3, 3, 4))
    halves = SimpleNamespace(
        bench=SimpleNamespace(read_off=lambda *_: {"course": shown}), simulated=lambda jobs: np.ones((len(jobs), 3, 4))
    )
    assert bool(read_by_halves(halves, model, "focus_drift", rows)) == differs


def test_null_laws_fit_their_own_samples():
    rng = np.random.default_rng(6)
    evidence, misfit = rng.gumbel(5, 3, 4000), rng.gamma(40, 2, 4000)
    null = Null.of({"any": evidence}, misfit)
    for p in (0.05, 0.01):
        # Between two freaks (0.3 % of a Gumbel law, 1 in 4000 each) the probability is not reached exactly.
        assert null.evidence.p(null.evidence.at(p)) == pytest.approx(p, abs=1 / 4000)
        assert null.misfit.p(null.misfit.at(p)) == pytest.approx(p, abs=1 / 4000)
        # Binomial error of 4000 samples at 5 % is 0.35 %.
        assert (evidence > null.evidence.at(p)).mean() == pytest.approx(p, abs=0.012)
        assert (misfit > null.misfit.at(p)).mean() == pytest.approx(p, abs=0.012)


def test_one_freak_does_not_hide_what_the_others_say():
    rng = np.random.default_rng(7)
    evidence, misfit = rng.gumbel(5, 3, 72), rng.gamma(40, 2, 72)
    clean = Null.of({"any": evidence}, misfit)
    evidence[5], misfit[5] = 800.0, 1100.0
    null = Null.of({"any": evidence}, misfit)
    # By moments of all 72 the 2 % level lies above 260. The freak costs 1 in 72: 2 % leave 0.6 % to the others,
    # 1.2 scales (4) higher; one value less moves scale and location by a tenth.
    assert clean.evidence.at(0.02) < null.evidence.at(0.02) < clean.evidence.at(0.02) + 8
    assert null.evidence.p(200) == pytest.approx(1 / 72, abs=1e-3)
    assert null.misfit.p(400) == pytest.approx(1 / 72, abs=1e-3)
    # What is rarer than one in 72 must lie beyond the freak, too.
    assert null.evidence.at(0.001) == pytest.approx(800)
    assert null.evidence.p(801) < 1e-6


def test_freaks_of_one_effect_do_not_hide_another_and_the_false_alarms_of_all_stay_as_they_are():
    """Rows stand out usually; drift does so, and wildly in 3 % of movies where nothing drifts."""
    rng = np.random.default_rng(8)

    def promised(n: int) -> dict[str, np.ndarray]:
        wild = np.where(rng.random(n) < 0.03, rng.uniform(30, 200, n), 0)
        return {"row_noise": rng.gumbel(3, 2.5, n), "stage_drift": rng.gumbel(3, 2.5, n) + wild}

    alarms, of_one, of_any = [], [], []
    for _ in range(400):
        null, later = Null.of(promised(72), rng.gamma(20, 1, 72)), promised(2000)
        alarms.append(np.any([later[kind] > null.needed(kind) for kind in later], axis=0).mean())
        of_one.append(null.needed("row_noise"))
        of_any.append(null.evidence.at(ALARM))
        assert max(null.needed(kind) for kind in later) == null.needed("something else") == of_any[-1]
    # What 72 simulations say of 2 % scatters by about 1.4 %: the mean of 400 by 0.07 %; freaks that few have seen add.
    assert 0.015 < np.mean(alarms) < 0.03
    assert np.mean(of_one) < 24 and np.median(of_any) > 50  # 21: usual ones of both, and wild ones below the fence


def test_settings_of_every_effect_span_its_range_and_forms():
    for kind, effect in catalogue().items():
        settings = ray_settings(effect, nm.preset("EGFP"), np.random.default_rng(1))
        assert all(type(s) is effect for s in settings), kind
        low, high, _ = effect.plausible(nm.preset("EGFP"))[effect.strength]
        values = [getattr(s, effect.strength) for s in settings]
        assert low <= min(values) < max(values) <= high
        assert {s.form_name for s in settings} == set(effect.forms()), kind


def test_every_form_has_a_strong_setting_and_choices_are_not_tied():
    for kind, effect in catalogue().items():
        settings = ray_settings(effect, nm.preset("EGFP"), np.random.default_rng(1))
        low, high, log = effect.plausible(nm.preset("EGFP"))[effect.strength]
        scale = np.log if log else float
        for form in set(effect.forms()):
            values = [getattr(s, effect.strength) for s in settings if s.form_name == form]
            shares = [(scale(v) - scale(low)) / (scale(high) - scale(low)) for v in values]
            strong = max(abs(u - 0.5) * 2 for u in shares) if two_sided(effect, effect.null_value) else max(shares)
            assert strong > 0.4, (kind, form)
    blinking = ray_settings(effect_class("triplet_blinking"), nm.preset("EGFP"), np.random.default_rng(1))
    assert len({(s.form, s.start) for s in blinking}) == 4


def test_an_axis_that_chance_favours_alarms_no_more_often_than_chance():
    """Two observables tell where an axis lies. A measurement is judged along the axis that they show in it, base
    simulations by the settings of another measurement: its level that 5 % of them exceed, 5 % of measurements do.

    Along one axis alone it would be chi² of one value against two: exp(−1.92) = 15 %. Of 1000 draws each, the share
    beyond and the level scatter: by 1 % together, 2 % at 15 %; the bounds are three and two of these from there."""
    state, rng, kind = toy_state(), np.random.default_rng(5), "astigmatism"
    settings = ray_settings(effect_class(kind), nm.preset("EGFP"), np.random.default_rng(1))

    def gain(x, effects):
        turn = [np.deg2rad(2 * effect.axis_deg) for effect in effects]
        shifts = [
            np.tile(8 * (np.arange(25) == 8) * np.cos(t) + 8 * (np.arange(25) == 9) * np.sin(t), (3, 1)) for t in turn
        ]
        return state.screen(x, {kind: [Ray(e, s) for e, s in zip(effects, shifts, strict=True)]})[kind][0].gain

    def axis(x):
        return {"axis_deg": np.rad2deg(np.arctan2(x[0, 9], x[0, 8]) / 2) % 180}

    draws = np.tile(rng.standard_normal((2000, 1, 25)), (1, 3, 1))
    chance = [gain(x, as_seen(settings, {"axis_deg": 30.0})) for x in draws[:1000]]
    measured = [gain(x, [changed(settings[0], axis(x))]) for x in draws[1000:]]
    assert np.mean(measured > np.quantile(chance, 0.95)) < 0.08
    fixed = [gain(x, [changed(settings[0], {"axis_deg": 30.0})]) for x in draws[:1000]]
    assert np.mean(measured > np.quantile(fixed, 0.95)) > 0.11


def test_an_effect_of_two_directions_is_found_in_the_other_one():
    state, rng = toy_state(), np.random.default_rng(4)
    one = np.zeros((3, 25))
    one[:, 5:9] = 8.0
    for kind, sign in (("laser_drift", -1), ("em_excess_noise", -1), ("laser_flicker", 0)):
        effect = effect_class(kind)()
        (lead,) = state.screen(rng.standard_normal((3, 25)) - 0.7 * one, {kind: [Ray(effect, one, effect.null_value)]})[
            kind
        ]
        if sign:
            assert lead.scale == -0.7 and lead.gain > 60
            before, after = (getattr(e, effect.strength) - effect.null_value for e in (effect, lead.start()))
            assert after == pytest.approx(-0.7 * before)
        else:
            assert lead.scale > 0 and lead.gain < 8  # no negative flicker


def test_what_would_have_been_seen_is_told_from_where_there_is_none_of_it():
    """Settings on either side of the ideal register promise alike, as far from it: their middle is not the ideal."""
    state, shift = toy_state(), np.zeros((3, 25))
    shift[:, 5:9] = 40.0
    register = effect_class("em_excess_noise")
    rays = [Ray(register(excess_noise_factor=f), np.sign(f - 2) * shift, 2.0) for f in (1.2, 2.8)]
    stand = SimpleNamespace(needed=lambda _: 25.0, library=SimpleNamespace(rays={"em_excess_noise": rays}))
    # 80 % power for 25 takes √(0.84² + 25) + 0.84 = 5.91 sd; four observables move by 80 sd together at the rays' ends.
    told = detectable(SimpleNamespace(state=state, stand=stand))["em_excess_noise"]
    assert 1 <= (told - 2) / (5.91 / 80 * 0.8) < 1.06  # strengths are asked for in steps of 5 %
    stand.needed = lambda _: 1e6
    assert detectable(SimpleNamespace(state=state, stand=stand)) == {"em_excess_noise": None}


def test_most_settings_would_have_been_seen_at_the_strength_that_is_told():
    """Of three settings one would not be seen in range: the weaker of the other two is not what most would show."""
    state, shift = toy_state(), np.zeros((3, 25))
    shift[:, 5:9] = 1.0
    rows = effect_class("row_noise")
    rays = [Ray(rows(rms_adu=10.0), far * shift, 0.0) for far in (80.0, 8.0, 0.1)]
    stand = SimpleNamespace(needed=lambda _: 25.0, library=SimpleNamespace(rays={"row_noise": rays}))
    told = detectable(SimpleNamespace(state=state, stand=stand))["row_noise"]
    stand.library.rays["row_noise"] = rays[1:2]
    assert told == detectable(SimpleNamespace(state=state, stand=stand))["row_noise"] > 1.0


@pytest.mark.parametrize("sd", [12.0, 48.0, 300.0])
def test_fewer_frames_as_many_as_credibility_says_bring_the_misfit_to_where_it_is_just_told(sd):
    state = toy_state(free=0)
    rng = np.random.default_rng(7)
    null = Null.of({}, np.array([state.misfit(rng.standard_normal(state.mean.shape)) for _ in range(200)]))
    off = np.zeros_like(state.mean)
    off[:, 3] = sd
    stand = SimpleNamespace(state=state, x=off, null=null, misfit=state.misfit(off))
    fewer = credibility(stand)
    # What is off shrinks with the square root of the number of frames, chance stays: as much as can just be told.
    usual, told = float(null.misfit.law.median()), null.misfit.at(MISFIT_ALARM)
    left = state.misfit(off / np.sqrt(fewer))
    assert left == pytest.approx(told - usual, rel=0.25)  # soft residuals of 5 sd count a tenth less


def test_a_name_is_as_sure_as_its_evidence_its_rivals_and_the_share_of_the_error_that_it_takes_away():
    worths = {
        "row_noise": Worth(1000.0, 5.0, 10.0),
        "laser_flicker": Worth(60.0, 1.6, 10.0),
        "photobleaching": Worth(1000.0, 5.0, 10.0, {"laser_drift": 0.0}),
        "triplet_blinking": Worth(-3.0, 1.1, 10.0),
    }

    def sure_at(error):
        stand = SimpleNamespace(
            worths=worths, birge=1.2, in_place_of=lambda kind: worths[kind].rivals, error=error,
            state=SimpleNamespace(floor=1.0), share=lambda kind: Stand.share(stand, kind),
        )  # fmt: skip
        return sure_of_names(stand)

    at_floor, off = sure_at(0.98), sure_at(1.4)
    assert {kind: sure for kind, (sure, _) in at_floor.items()} == pytest.approx(
        {"row_noise": 1.0, "laser_flicker": 1.0, "photobleaching": 0.5, "triplet_blinking": 0.5}
    )
    assert {kind: sure for kind, (sure, _) in off.items()} == pytest.approx(
        {"row_noise": 0.9, "laser_flicker": 0.2 / 0.6, "photobleaching": 0.45, "triplet_blinking": 0.0}
    )
    assert {kind: others for kind, (_, others) in off.items() if others} == {"photobleaching": ("laser_drift",)}


def test_changed_effects_keep_their_limits():
    drift = effect_class("stage_drift")(distance_px=2.0)
    assert scaled(drift, 0.25, 0.0).distance_px == 0.5
    assert changed(drift, {"distance_px": -1.0}).distance_px == 0.0
    assert changed(drift, {}, form="saturating").form == "saturating"
    excess = effect_class("em_excess_noise")(excess_noise_factor=1.4)
    assert scaled(excess, 0.5, 2.0).excess_noise_factor == pytest.approx(1.7)  # half the way from 2


def test_a_shape_at_an_end_of_its_range_is_told_and_a_strength_there_is_none():
    rays, model = effect_class("cosmic_rays"), nm.preset("FF")
    low, high, _ = rays.plausible(model)["electrons"]
    assert is_at_an_end(rays(electrons=high, form="tracks"), model) and is_at_an_end(rays(electrons=low), model)
    assert not is_at_an_end(rays(electrons=0.9 * high), model)
    assert not is_at_an_end(rays(hits_per_frame=4 * rays.plausible(model)["hits_per_frame"][1]), model)


def test_nuisance_values_are_those_the_model_has():
    paths = {n.path for n in nuisance.nuisances(nm.preset("EGFP"))}
    assert "optics.psf_fwhm_nm" in paths and "fluorophore.cycles_before_bleaching" not in paths
    assert "fluorophore.isc_ratio" in {n.path for n in nuisance.nuisances(nm.preset("Blinking"))}
    model = nm.preset("EGFP")
    values = nuisance.nuisances(model)
    moved = nuisance.apply(model, values, np.array([np.log(1.1)] + [0.0] * (len(values) - 1)))
    assert moved.optics.brightness_correction == pytest.approx(1.1)


def test_density_stays_within_what_the_field_can_hold():
    model = nm.preset("EGFP").with_values(
        {"acquisition.shape_px": (64, 64), "sample.min_distance_px": 6.0, "sample.n_molecules": 22}
    )
    values = nuisance.nuisances(model)
    crowded = nuisance.apply(model, values, np.full(len(values), 10.0))
    assert 22 < crowded.sample.n_molecules < 70
    for n in (1, 10_000):
        nm.simulate(nuisance.with_molecules(model, n).with_values({"acquisition.n_frames": 1}), seed=1)


def test_a_value_with_a_largest_stays_below_it():
    model = nm.preset("EGFP")
    (noise,) = (n for n in nuisance.nuisances(model) if n.path == "optics.emission_noise")
    assert noise.room(model) == (-1.0, 0.0)
    assert nuisance.apply(model, [noise], [3.0]).optics.emission_noise == 1.0
    assert nuisance.apply(model, [noise], [-3.0]).optics.emission_noise == 0.0
    for at in (0.0, 0.3, 0.5, 0.8, 1.0):  # the step for the derivative is never cut short
        there = model.with_values({"optics.emission_noise": at})
        step = noise.inward(there, noise.step)
        assert nuisance.apply(there, [noise], [step]).optics.emission_noise - at == pytest.approx(step)


def _spots_of(n: int, least_px: float, seed: int) -> np.ndarray:
    """Where n molecules on 96 × 96 px are seen, whose PSF has an sd of 1.27 px: pairs that merge are seen once."""
    seen: list[np.ndarray] = []
    for at in scatter(n, (96, 96), least_px, np.random.default_rng(seed)):
        if all(np.hypot(*(at - other)) > 2 * np.sqrt(2) * 1.27 for other in seen):
            seen.append(at)
    return np.array(seen)


def test_the_smallest_distance_between_molecules_is_read_off_the_spots():
    model = nm.preset("EGFP").with_values({"optics.psf_fwhm_nm": 300.0, "acquisition.pixel_size_nm": 100.0})
    found = [nuisance.spaced(model, _spots_of(50, 5.0, k), 96**2).sample.min_distance_px for k in range(100)]
    told = np.array([d for d in found if d > 0])
    # With 50 · 49/2 pairs c = 0.42 px⁻²: what is told of d² has an sd of 1/c, its mean of 100 one of 0.24 px². Five px
    # apart, c (d² − 13 px²) is above 4 always.
    assert len(told) == 100
    assert np.mean(told**2) == pytest.approx(25.0, abs=1.0)


def test_a_few_pairs_that_are_nearer_are_exceptions():
    model = nm.preset("EGFP").with_values({"optics.psf_fwhm_nm": 300.0, "acquisition.pixel_size_nm": 100.0})
    told = []
    for k in range(30):
        spots = _spots_of(150, 5.0, k)
        angles = np.linspace(0, 2 * np.pi, 60)
        near = spots[:, None] + 3.66 * np.stack([np.sin(angles), np.cos(angles)], axis=-1)  # spots that nearly merge
        neighbours = (np.linalg.norm(near.reshape(-1, 1, 2) - spots, axis=-1) < 5.0).sum(axis=1)
        odd = near.reshape(-1, 2)[neighbours == 1][0]  # nearer to one of them than molecules lie
        told.append(nuisance.spaced(model, np.concatenate([spots, [odd]]), 96**2).sample.min_distance_px)
    # c is 3.8 px⁻²: 46 pairs at random would lie between 3.6 px, where spots merge, and 5 px.
    assert np.mean(told) == pytest.approx(5.0, abs=0.15) and min(told) > 4.6


@pytest.mark.parametrize("n", [50, 150])
def test_molecules_at_random_are_not_called_spaced(n):
    model = nm.preset("EGFP").with_values({"optics.psf_fwhm_nm": 300.0, "acquisition.pixel_size_nm": 100.0})
    spaced = sum(nuisance.spaced(model, _spots_of(n, 0.0, k), 96**2).sample.min_distance_px > 0 for k in range(200))
    # e⁻⁴ each, a little more as neighbours beyond the edge are not seen: 3 % is 6 of 200, 15 has a chance of 0.1 %.
    assert spaced <= 15


def test_where_spots_at_random_merge_they_are_not_called_spaced():
    # Between 3.6 px and 5.3 px hardly half of the pairs are found as two: the finder misses the rest.
    model = nm.Model.from_dict(MODEL).with_values({"sample.n_molecules": 300, "acquisition.n_frames": 100})
    for seed in range(4):
        spots = observe(SimulatedAcquisition(model, seed=100 + seed).movie(), model).spots
        assert len(spots.positions_px) > 90
        assert nuisance.spaced(model, spots.positions_px, 96**2) == model


def test_a_layout_that_is_told_stays():
    far_apart = np.array([[10.0, 10.0], [80.0, 80.0], [10.0, 80.0], [80.0, 10.0]])
    for told in ({"sample.min_distance_px": 2.0}, {"sample.layout": "grid"}):
        model = nm.preset("EGFP").with_values(told)
        assert nuisance.spaced(model, far_apart, 20.0) == model
    model = nm.preset("EGFP")
    assert nuisance.spaced(model, far_apart[:1], 96**2) == model  # one spot has no neighbour


def test_what_became_of_the_values_believed_is_told():
    model = nm.preset("EGFP").with_values({"optics.psf_fwhm_nm": 280.0})
    fitted = model.with_values({"optics.psf_fwhm_nm": 306.9, "sample.min_distance_px": 4.8})
    assert nuisance.told(model, fitted) == "optics.psf_fwhm_nm 280 → 307, sample.min_distance_px 0 → 4.8"
    assert nuisance.told(model, model) == ""


@pytest.mark.parametrize("with_dark", [True, False])
def test_moments_are_light_whatever_gain_the_movie_is_seen_with(with_dark):
    """A camera of twice the gain believed, its true background 10 photons brighter than that of the model, its baseline
    3 ADU higher: one round finds both. Seen by the gain believed an electron counts twice."""
    eyes = nm.preset("FF").with_values({"camera.type": "EMCCD"})
    per_adu, efficiency = photoelectrons_per_adu(eyes), eyes.camera.quantum_efficiency
    model = eyes.with_values({"camera.electrons_per_adu": eyes.camera.electrons_per_adu / 2})
    light, noise = efficiency * np.array([model.optics.background_photons_per_px, 10.0]).cumsum(), 0.5  # e⁻, variance

    def shown(electrons, offset_adu):
        seen = {"level": 0.0, "spot_width_early": 0.0, "spots": 3.0, "background": 2 * electrons + offset_adu * per_adu}
        seen["background_variance"] = np.log(4 * (2 * electrons + noise))  # F² = 2
        return seen | ({"dark_mean": offset_adu} if with_dark else {})

    there = nuisance.moment_step(model, eyes, shown(light[1], 3.0), shown(light[0], 0.0))
    assert there.optics.background_photons_per_px == pytest.approx(model.optics.background_photons_per_px + 10)
    assert there.camera.baseline_adu == pytest.approx(model.camera.baseline_adu + 3)
    assert there.camera.electrons_per_adu == model.camera.electrons_per_adu  # left to all observables together


@pytest.mark.parametrize("believed, own", [(120, True), (50, False), (2000, False)])
def test_matching_begins_with_a_models_own_molecules_where_it_hides_many_and_shows_what_the_movie_shows(
    believed, own, monkeypatch
):
    """As many as there are spots would each be far too bright where most are too dim to be found; but a number that is
    not the movie's is no place to begin with."""
    monkeypatch.setattr("napari_mufasa.discover.movie_bench.MATCHING_ROUNDS", 0)
    model = nm.preset("FF").with_values({"acquisition.n_frames": 100, "acquisition.shape_px": (96, 96)})
    model = model.with_effects(effect_class("brightness_heterogeneity")(spread=1.5))
    movie = nm.simulate(model.with_values({"sample.n_molecules": 120}), seed=4).movie
    bench = MovieBench(prepare(movie, model.with_values({"sample.n_molecules": believed}), None), 1)
    spots = bench.measured.part("all")[bench.names.index("spots")] ** 2
    assert spots < 0.6 * 120
    there = bench.matched(bench.start).sample.n_molecules
    assert there == pytest.approx(believed if own else 1.15 * spots, abs=0.5)
    assert bench.done == 2 == bench.matching_simulations


def test_a_part_of_a_field_has_its_share_of_the_molecules():
    model = nm.preset("FF").with_values({"sample.n_molecules": 4000})
    measurement = prepare(np.random.default_rng(1).poisson(1000, (40, 512, 512)).astype(np.uint16), model)
    part = np.prod(measurement.movie.shape[1:]) / 512**2
    assert part < 0.7 and measurement.model.sample.n_molecules == round(4000 * part)


def test_preparation_crops_large_movies_and_says_so():
    model = nm.preset("EGFP")

    class Lazy:
        shape, dtype = (1000, 512, 512), np.dtype(np.uint16)

        def __getitem__(self, key):
            size = [s.stop - s.start for s in key]
            assert np.prod(size) <= 1.05 * VOXELS, "only the crop may be read"
            return np.arange(np.prod(size), dtype=np.uint16).reshape(size)

    measurement = prepare(Lazy(), model)
    assert len(measurement.movie) == FRAMES
    assert measurement.model.acquisition.shape_px == measurement.movie.shape[1:]
    assert len(measurement.notes) == 2


@pytest.mark.parametrize(
    ("movie", "message"),
    [
        (np.zeros((5, 5)), "needs a non-empty stack"),
        (np.ones((10, 48, 48), np.uint16), "at least 20"),
        (np.ones((50, 10, 10), np.uint16), "at least 24"),
        (np.ones((50, 48, 48), np.uint16), "nothing was recorded"),
        (np.full((50, 48, 48), np.nan), "not numbers"),
        (np.full((50, 48, 48), -3.0), "raw counts"),
        (np.full((50, 48, 48), "a"), "needs real numbers"),
    ],
)
def test_unusable_movies_are_refused_in_one_line(movie, message):
    with pytest.raises(nm.MufasaError, match=message) as error:
        prepare(movie, nm.preset("EGFP"))
    assert "\n" not in str(error.value)
