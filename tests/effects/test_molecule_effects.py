"""Laws of molecules that are dim, wander or switch; tolerances of four standard errors (6e-5 each) unless said."""

import numpy as np
import pytest
from scipy import stats

from napari_mufasa import preset, simulate_emission
from napari_mufasa.simulate import SimulatedAcquisition

from .helpers import effect, plain, scene_of

PHOTONS = 67.249  # of a molecule in 10 ms


def close(per_molecule, expected, slack=0.0):
    """A mean over independent molecules against its law."""
    error = per_molecule.std() / np.sqrt(len(per_molecule))
    assert per_molecule.mean() == pytest.approx(expected, abs=4 * error + slack)


# Two levels ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_two_levels_have_their_mean_and_covariance_from_the_first_frame_on(engine):
    """In equilibrium the brightness is a telegraph signal: covariance p(1 − p)(1 − level)² e^(−(a+b)t), over frames."""
    to_low, to_full, level = 8.0, 12.0, 0.4
    added = effect("level_switching", to_low_per_s=to_low, to_full_per_s=to_full, level=level)
    counts = simulate_emission(plain(n_frames=30).with_effects(added), 1500, seed=1, engine=engine) / PHOTONS
    low = to_low / (to_low + to_full)
    mean = 1 - low * (1 - level)
    close(counts.mean(axis=1), mean, 1e-3)
    for frame in (0, 29):
        close(counts[:, frame], mean, 1e-3)
    x = (to_low + to_full) * 0.01
    size = low * (1 - low) * (1 - level) ** 2
    z = counts - mean
    close((z**2).mean(axis=1), size * 2 * (x - 1 + np.exp(-x)) / x**2 + mean / PHOTONS, 1e-3)
    for lag in (1, 3, 10):
        law = size * np.exp(-lag * x) * 2 * (np.cosh(x) - 1) / x**2
        close((z[:, lag:] * z[:, :-lag]).mean(axis=1), law, 1e-3)


def test_levels_and_dwell_times_of_single_traces():
    """672 photons in 1 ms, less k01/k10: each frame tells its level. Dwell times (100, 50 frames) are exponential."""
    values = {"excitation.power_density_w_per_cm2": 200.0}
    added = effect("level_switching", to_low_per_s=20.0, to_full_per_s=10.0, level=0.4)
    counts = simulate_emission(plain(n_frames=1200, frame_length_s=1e-3, **values).with_effects(added), 1500, seed=2)
    full = 672.49 / (1 + 672.49e3 * 2e-9)
    low = counts < 0.7 * full
    for state, mean in ((low, 100.0), (~low, 50.0)):
        inside = state[:, 1:-1] & state[:, :-2] & state[:, 2:]
        level = counts[:, 1:-1][inside].mean() / full
        assert level == pytest.approx(0.4 if state is low else 1.0, abs=4 * 0.05 / np.sqrt(inside.sum()) + 1e-4)
        begins = state[:, 1:] & ~state[:, :-1]
        first = begins[:, :200].argmax(axis=1)[begins[:, :200].any(axis=1)]
        rows = np.nonzero(begins[:, :200].any(axis=1))[0]
        rest = ~state[rows][:, 1:]
        ends = np.array([np.argmax(row[start:]) for row, start in zip(rest, first, strict=True)])
        assert len(ends) > 1000
        # A switch within a frame shifts both ends by up to half a frame: blurred by a frame against 50 or 100.
        blurred = ends + np.random.default_rng(1).uniform(-0.5, 0.5, len(ends))
        assert stats.kstest(blurred, "expon", args=(0, mean)).pvalue > 1e-4


@pytest.mark.parametrize("first", ["level_switching", "photobleaching"])
def test_both_levels_bleach_alike_in_any_order(first):
    effects = [effect("level_switching", to_low_per_s=20.0), effect("photobleaching", rate_per_s=3.0)]
    effects.sort(key=lambda e: e.kind != first)
    counts = simulate_emission(plain(n_frames=60).with_effects(*effects), 4000, seed=3)
    on = counts > 0
    alive = np.where(on.any(axis=1), 60 - on[:, ::-1].argmax(axis=1), 0)
    for frame in (10, 40, 59):
        share = np.exp(-3.0 * (frame * 0.01 + 0.2e-3))
        assert np.mean(alive > frame) == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / 4000) + 1e-3)


@pytest.mark.parametrize("protocol", ["FF", "STORM", "Blinking"])
@pytest.mark.parametrize("beside", [(), ("triplet_blinking",), ("long_dark_state", "triplet_blinking")])
def test_what_comes_back_from_the_dark_has_the_level_that_it_had(protocol, beside):
    """Or a molecule that is often dark would hardly ever be at its lower level."""
    model = preset(protocol).with_values({"fluorophore.cycles_before_bleaching": None})
    switching = effect("level_switching", to_low_per_s=1.0, to_full_per_s=3.0, level=0.4)
    chain = scene_of(model.with_effects(switching, *(effect(kind) for kind in beside))).chain
    rates = chain.generator()
    shares = np.linalg.lstsq(np.vstack([rates.T, np.ones(len(rates))]), np.eye(len(rates) + 1)[-1], rcond=None)[0]
    chances = dict.fromkeys(chain.states, 0.0) | {
        t.source: t.photon_probability for t in chain.transitions if t.photon_probability
    }
    full, low = (
        sum(shares[chain.states.index(s)] for s, p in chances.items() if p == level)
        for level in sorted({p for p in chances.values() if p}, reverse=True)
    )
    assert low / (full + low) == pytest.approx(0.25, abs=1e-4)


def test_two_populations_and_blinking_keep_their_two_levels():
    """Every bright pair gets a lower one: bleaching kinds of molecules and dark states of each stay as they were."""
    bleaching = effect("photobleaching", form="two_populations")
    chain = scene_of(plain().with_effects(bleaching, effect("level_switching", level=0.4))).chain
    probabilities = sorted(t.photon_probability for t in chain.transitions if t.photon_probability > 0)
    full = probabilities[-1]
    assert probabilities == pytest.approx([0.4 * full, 0.4 * full, full, full])
    assert sum(chain.start.values()) == pytest.approx(1)


# A dim population ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_dim_molecules_are_as_many_and_as_bright_as_said(engine):
    added = effect("dim_population", number_ratio=2.5, brightness=0.2)
    counts = simulate_emission(plain(n_frames=20).with_effects(added), 400, seed=4, engine=engine)
    assert len(counts) == 400 + 1000
    close(counts[:400].mean(axis=1), PHOTONS, 0.05)
    dim = counts[400:].astype(float)
    close(dim.mean(axis=1), 0.2 * PHOTONS, 0.01)
    assert dim.var() / dim.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / dim.size) * 1.05)  # Poisson


def test_the_others_stay_as_they_were_and_dim_ones_lie_anywhere():
    model = plain(n_frames=10, shape=(30, 60))
    places = np.random.default_rng(1).random((1000, 2)) * 30
    base = SimulatedAcquisition(model, places, seed=5)
    more = SimulatedAcquisition(model.with_effects(effect("dim_population", number_ratio=4.0)), places, seed=5)
    np.testing.assert_array_equal(more.emission[:1000], base.emission)
    np.testing.assert_array_equal(more.scene.positions_px[:1000], places)
    for axis, n in enumerate((30, 60)):
        assert stats.kstest(more.scene.positions_px[1000:, axis], "uniform", args=(-0.5, n)).pvalue > 1e-4
    assert abs(np.corrcoef(more.emission[:1000, 0], more.emission[1000:2000, 0])[0, 1]) < 4 / np.sqrt(1000)


@pytest.mark.parametrize("engine", ["fast", "exact"])
@pytest.mark.parametrize("slower", [1.0, 5.0])
def test_dim_molecules_bleach_at_their_own_rate(slower, engine):
    effects = effect("photobleaching", rate_per_s=4.0), effect("dim_population", number_ratio=1.0, slower=slower)
    counts = simulate_emission(plain(n_frames=40).with_effects(*effects), 800, seed=6, engine=engine)
    for rows, level, rate in ((slice(0, 800), PHOTONS, 4.0), (slice(800, None), 0.12 * PHOTONS, 4.0 / slower)):
        for frame in (5, 39):
            lit = level * np.exp(-rate * frame * 0.01) * (1 - np.exp(-rate * 0.01)) / (rate * 0.01)
            close(counts[rows, frame].astype(float), lit, 2e-3 * level)


def test_as_many_dim_ones_that_never_bleach_are_two_levels_of_brightness_and_nothing_else():
    """Of levels 0.4 and 1.6 of a mean of 0.625, one is a quarter of the other, which is 1."""
    added, model = effect("dim_population", number_ratio=1.0, brightness=0.25), plain(n_frames=100)
    dim = simulate_emission(model.with_effects(added), 400, seed=4).mean(axis=1)
    unequal = effect("brightness_heterogeneity", spread=0.6, form="two_levels")
    factors = 0.625 * scene_of(plain().with_effects(unequal), np.zeros((800, 2))).brightness
    parted = 0.625 * PHOTONS
    assert np.mean(factors > 0.625) == pytest.approx(np.mean(dim > parted), abs=4 * np.sqrt(1 / 4 / 800))
    close(dim[dim > parted], factors.max() * PHOTONS, 0.05)
    close(dim[dim < parted], factors.min() * PHOTONS, 0.01)
    np.testing.assert_allclose(np.unique(factors), [0.25, 1.0])
    assert added.same_as(model, []) == ("brightness_heterogeneity",)
    assert added.same_as(model, ["photobleaching"]) == ()
    assert added.same_as(model.with_values({"fluorophore.cycles_before_bleaching": 1e5}), []) == ()


def test_dim_molecules_blink_and_have_no_spread_of_their_own():
    effects = [effect("dim_population", number_ratio=3.0), effect("brightness_heterogeneity", spread=0.5)]
    effects += [effect("multiple_emitters", fraction=1.0), effect("molecule_diffusion")]
    for order in (effects, effects[::-1]):
        scene = scene_of(plain().with_effects(*order), np.zeros((10, 2)))
        assert len(scene.positions_px) == 20 + 60
        assert np.all(scene.brightness[20:] == 1) and scene.brightness[:20].std() > 0.1
        assert scene.walk_px.shape == (40, 80, 2) and not scene.walk_px[:, 20:].any()


# Dim companions -----------------------------------------------------------------------------------------------


def test_companions_are_where_molecules_are_and_shine_on_when_these_have_bleached():
    companions = effect("dim_companions", brightness=0.25, slower=1e5)
    beside = [effect("brightness_heterogeneity", spread=0.5), effect("molecule_diffusion"), effect("dim_population")]
    places = np.arange(20.0).reshape(10, 2)
    for order in ([companions, *beside], [*beside, companions]):
        scene = scene_of(plain().with_effects(*order), places)
        assert len(scene.positions_px) == 10 + 40 + 10
        np.testing.assert_array_equal(scene.positions_px[50:], places)
        np.testing.assert_array_equal(scene.brightness[50:], scene.brightness[:10])
        np.testing.assert_array_equal(scene.walk_px[:, 50:], scene.walk_px[:, :10])
        assert scene.brightness[:10].std() > 0.1 and scene.walk_px.any()
    bleaching = effect("photobleaching", rate_per_s=50.0)
    counts = simulate_emission(plain(n_frames=40).with_effects(bleaching, companions), 400, seed=8)
    assert len(counts) == 800 and not counts[:400, 30:].any()  # 400 e^(-15) are left: 1 in 8000 that any is
    close(counts[400:, 30:].mean(axis=1), 0.25 * PHOTONS, 0.02)


def test_companions_come_and_go_with_their_molecules():
    landing = effect("binding", unbinding_rate_per_s=50.0, form="landing")
    scene = scene_of(plain(n_frames=40).with_effects(landing, effect("dim_companions", brightness=0.2)))
    n = len(scene.positions_px) // 2
    np.testing.assert_array_equal(scene.light_of_each[n:], scene.light_of_each[:n])
    assert (scene.light_of_each == 0).any()


# Brightness that wanders --------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["wandering", "jumps"])
@pytest.mark.parametrize("rms", [0.25, 0.8])
def test_wander_is_lognormal_stationary_and_forgets_exponentially(form, rms):
    n, forget = 8000, 20.0
    added = effect("brightness_wander", rms=rms, correlation_frames=forget, form=form)
    course = scene_of(plain(n_frames=120).with_effects(added), np.zeros((n, 2))).light_of_each.astype(float)
    width = np.sqrt(np.log1p(rms**2))
    for frame in (0, 60, 119):
        close(course[:, frame], 1.0)
        x = (np.log(course[:, frame]) + width**2 / 2) / width
        assert stats.kstest(x, "norm").pvalue > 1e-4
    x = (np.log(course) + width**2 / 2) / width
    for lag in (1, 10, 40):
        law = np.exp(-lag / forget)
        for start in (0, 60):
            close(x[:, start] * x[:, start + lag], law)
        brightness = (course[:, 0] - 1) * (course[:, lag] - 1)
        close(brightness, np.expm1(width**2 * law))  # the covariance of what is exponential of a normal
    assert abs(np.corrcoef(x[:-1, 60], x[1:, 60])[0, 1]) < 4 / np.sqrt(n)


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_photons_are_poisson_given_the_course(engine):
    model = plain(n_frames=20).with_effects(effect("brightness_wander", rms=0.5, correlation_frames=5.0))
    made = SimulatedAcquisition(model, np.zeros((400, 2)), seed=7, engine=engine)
    expected = PHOTONS * made.scene.light_of_each
    z = (made.emission - expected) / np.sqrt(expected)
    assert z.mean() == pytest.approx(0, abs=4 / np.sqrt(z.size) + 2e-3)
    # var of z²: 2 + 1/mean; the exact engine lacks the 1e-4 of antibunching.
    assert np.mean(z**2) == pytest.approx(1, abs=4 * np.sqrt(2.1 / z.size) + 1e-3)


def test_emitters_of_a_spot_and_dim_molecules_wander_on_their_own():
    effects = [effect("brightness_wander", correlation_frames=1.0), effect("multiple_emitters", fraction=1.0)]
    effects.append(effect("dim_population", number_ratio=1.0))
    for order in (effects, effects[::-1]):
        course = scene_of(plain(n_frames=2000).with_effects(*order), np.zeros((2, 2))).light_of_each
        assert course.shape == (8, 2000)
        together = np.corrcoef(np.log(course)) - np.eye(8)
        assert np.abs(together).max() < 5 * np.sqrt(1.3 / 2000)  # lag-1 correlations of e^−1 widen it by 1.3
