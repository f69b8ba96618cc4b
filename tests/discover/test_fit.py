"""Fits against a bench whose simulations are a known function plus noise: what is found must be what was put in."""

from dataclasses import replace

import numpy as np
import pytest

import napari_mufasa as nm
from napari_mufasa.discover import fit, nearing
from napari_mufasa.discover.coordinates import Coordinate, model_at
from napari_mufasa.discover.library import CHECK_SEED, CHECK_SIMULATIONS, Library, _with_noise_of
from napari_mufasa.discover.nuisance import nuisances
from napari_mufasa.discover.state import State
from napari_mufasa.effects import effect_class

P = 40
HOT = effect_class("hot_pixels")


class ToyBench:
    """Observables that saturate with the strength of hot pixels and turn with their electrons; noise of one seed
    is the same for every model, as in the simulator."""

    seed, is_cheap, matching_simulations = 1, False, 0
    names = tuple(f"o{i}" for i in range(P))

    def __init__(self):
        rng = np.random.default_rng(7)
        self.one, self.two = rng.standard_normal((2, 3, P)) * 6

    def law(self, model):
        for effect in model.effects:
            more = np.log1p(effect.fraction / 1e-3)
            return more * (self.one + self.two * np.log(effect.electrons / 10.0))
        return np.zeros((3, P))

    def read_off(self, kind):
        return {}

    def matched(self, model):
        return model  # a toy has no moments to match

    def rows(self, jobs):
        return np.array([self.law(m) + np.random.default_rng([3, k]).standard_normal((3, P)) for m, k in jobs])


@pytest.fixture(scope="module")
def library():
    return library_of(ToyBench())


def library_of(bench, model=None, values=()):
    model = nm.preset("FF") if model is None else model
    free = tuple(value.path for value in values)
    rows = bench.rows([(model, k) for k in range(60)])
    check = bench.rows([(model, CHECK_SEED + k) for k in range(CHECK_SIMULATIONS)])
    blank = np.zeros((3, P))
    steps = [0.1] * len(free)
    slopes = nearing.derivatives(bench.rows, lambda by: model_at(model, values, free, by), steps, rows) if free else 0.0
    slopes = np.zeros((3, P, len(free))) + slopes
    prior = np.array([value.prior for value in values])
    bare = State(model, blank, blank, slopes, prior, blank, check, free, np.full(P, 0.1), tuple(values))
    return Library(bench, _with_noise_of(bare, rows), rows, {})


@pytest.mark.parametrize(("fraction", "electrons"), [(4e-4, 25.0), (5e-3, 4.0), (2e-2, 10.0)])
def test_a_fit_finds_strength_and_shape_from_a_far_start(library, fraction, electrons):
    """The start is up to 50 times off in strength and 5 times in shape; noise alone allows about a percent."""
    truth = nm.preset("FF").with_effects(HOT(fraction=fraction, electrons=electrons))
    x = library.bench.rows([(truth, 999)])[0]
    start = HOT(fraction=4e-4 if fraction > 1e-3 else 1e-2, electrons=20.0 if electrons < 20 else 5.0)
    found = fit.sharpen(library, fit.fit_effect(library, library.base, start, x), x)
    assert found.effect.fraction == pytest.approx(fraction, rel=0.15)
    assert found.effect.electrons == pytest.approx(electrons, rel=0.15)
    assert set(found.sd) == {"fraction", "electrons"} and all(
        0 < sd < 0.2 * truth.effects[0].electrons for sd in found.sd.values()
    )
    assert found.misfit < stats_limit()


def stats_limit():
    """chi² of P observables at a chance of 1e-4, with a tenth more for the finite simulations."""
    from scipy import stats

    return 1.1 * stats.chi2.isf(1e-4, P)


class FaintBench(ToyBench):
    """The electrons hardly show, and other values are other chance, as with molecules that blink."""

    def __init__(self):
        super().__init__()
        self.two = self.two / 10

    def rows(self, jobs):
        def noise(model, k):
            values = [int(1e9 * v) % 2**31 for e in model.effects for v in (e.fraction, e.electrons)]
            return np.random.default_rng([3, k, *values]).standard_normal((3, P))

        return np.array([self.law(model) + noise(model, k) for model, k in jobs])


def test_a_parameter_that_does_not_show_is_not_known():
    """Slopes of nothing but noise would make the value known; fits of simulations that they have not seen do not
    follow the truth, which tells."""
    bench = FaintBench()
    bench.two = np.zeros((3, P))
    library = library_of(bench)
    truth = nm.preset("FF").with_effects(HOT(fraction=5e-3, electrons=20.0))
    for number in range(980, 986):
        x = bench.rows([(truth, number)])[0]
        found = fit.sharpen(library, fit.fit_effect(library, library.base, HOT(fraction=2e-3, electrons=8.0), x), x)
        assert found.sd["electrons"] > found.effect.electrons  # a factor of two and more
        assert found.sd["fraction"] < 0.2 * found.effect.fraction


def test_what_hardly_shows_is_stated_as_uncertain_as_it_is():
    """Few simulations close to the best would show slopes of nothing but noise, and pass them off as information:
    95 % intervals then hold half of the true values. Of 40 intervals that hold 95 % each, 32 or fewer hold with a
    chance below 10⁻³."""
    library = library_of(FaintBench())
    truth = HOT(fraction=5e-3, electrons=10.0)
    inside = {"fraction": 0, "electrons": 0}
    for seed in range(40):
        x = library.bench.rows([(nm.preset("FF").with_effects(truth), 9000 + seed)])[0]
        found = fit.fit_effect(library, library.base, HOT(fraction=4e-3, electrons=12.0), x)
        found = fit.sharpen(library, found, x)
        for name in inside:
            off = getattr(found.effect, name) - getattr(truth, name)
            inside[name] += abs(off) < 1.96 * found.sd[name]
    assert min(inside.values()) > 32
    assert found.sd["fraction"] < 0.1 * truth.fraction  # and what shows is not stated as uncertain


def test_the_floor_is_what_fresh_simulations_score(library):
    """A floor from simulations that made the mean and the spread themselves would be some 10 % too low."""
    truth = nm.preset("FF").with_effects(HOT(fraction=5e-3, electrons=8.0))
    x = library.bench.rows([(truth, 999)])[0]
    found = fit.sharpen(library, fit.fit_effect(library, library.base, truth.effects[0], x), x)
    fresh = library.bench.rows([(found.state.model, 50_000 + k) for k in range(200)])
    scores = [found.state.held_out_error(row) for row in fresh]
    # The scatter of one score is about 1 / sqrt(2 P) = 11 %, of the median of 32 of them 2.5 %.
    assert found.state.floor == pytest.approx(np.median(scores), rel=0.08)


def test_an_effect_that_is_not_there_gains_nothing(library):
    x = library.bench.rows([(nm.preset("FF"), 998)])[0]
    found = fit.fit_effect(library, library.base, HOT(fraction=1e-3), x)
    assert library.base.score(x) - found.score < 12  # two parameters: chi² of 2 is beyond 12 with chance 0.25 %


class BentBench(ToyBench):
    """With hot pixels more light lowers what it raises without them: the base model's derivative leads astray."""

    def law(self, model):
        light = np.log(model.optics.brightness_correction) * 40.0 * (-1 if model.effects else 1)
        return super().law(model) + light * np.roll(self.one, 1) / 6


def test_derivatives_taken_anew_bring_nuisance_values_home():
    bench, model = BentBench(), nm.preset("FF")
    values = tuple(n for n in nuisances(model) if n.path == "optics.brightness_correction")
    library = library_of(bench, model, values)
    light = model.optics.brightness_correction * 1.15
    effect = HOT(fraction=5e-3, electrons=8.0)
    truth = model.with_values({"optics.brightness_correction": light}).with_effects(effect)
    x = bench.rows([(truth, 995)])[0]
    found = fit.check(library, replace(library.base, model=model.with_effects(effect)), x, 0)
    far = found.state.model_at(found.state.adjusted(x).moves)
    assert far.optics.brightness_correction < model.optics.brightness_correction  # the wrong way
    home = fit.sharpen(library, fit.sharpen(library, found, x, anew=True), x, anew=True)
    assert home.misfit < stats_limit() and home.score < fit.sharpen(library, found, x).score
    best = home.state.model_at(home.state.adjusted(x).moves)
    assert best.optics.brightness_correction == pytest.approx(light, rel=0.02)


@pytest.mark.parametrize("better", [True, False])
def test_nuisance_values_are_matched_again_where_that_is_nearer(library, monkeypatch, better):
    truth = nm.preset("FF").with_effects(HOT(fraction=5e-3, electrons=8.0))
    other = nm.preset("FF").with_effects(HOT(fraction=5e-4, electrons=30.0))
    monkeypatch.setattr(library.bench, "matched", lambda model: truth if better else other)
    x = library.bench.rows([(truth, 996)])[0]
    assert nearing.nearer(library, library.base, other if better else truth, x) == truth


def test_an_effect_of_no_strength_is_none(library):
    """Two standard deviations from none, or within the plausible range where strengths are known by their logarithm."""
    bleaching, drift = effect_class("photobleaching"), effect_class("laser_drift")
    low = bleaching.plausible(library.base.model)["rate_per_s"][0]

    def some(effect, sd, birge=1.0):
        return fit.Fit(library.base, effect, {effect.strength: sd}, 0.0, 0.0, birge).is_some

    assert some(drift(change=-0.05), 0.01) and not some(drift(change=-0.05), 0.03)
    assert some(drift(change=-0.05), 0.05, birge=5.0)  # so wide for what else is missing
    assert some(bleaching(rate_per_s=3 * low), 2 * low)  # how fast is not known well, that it is there is
    assert some(bleaching(rate_per_s=0.5 * low), 0.1 * low) and not some(bleaching(rate_per_s=0.5 * low), 0.4 * low)
    excess = effect_class("em_excess_noise")
    assert some(excess(excess_noise_factor=1.5), 0.1) and not some(excess(excess_noise_factor=2.1), 0.1)


class ReadingBench(ToyBench):
    """The measurement shows the electrons directly, whatever a fit would say."""

    def read_off(self, kind):
        return {"electrons": 12.0}


def test_what_is_read_off_is_not_fitted():
    truth, start = HOT(fraction=5e-3, electrons=10.0), HOT(fraction=2e-3, electrons=20.0)
    found = {}
    for bench in (ToyBench(), ReadingBench()):
        library = library_of(bench)
        x = bench.rows([(nm.preset("FF").with_effects(truth), 999)])[0]
        found[type(bench)] = fit.sharpen(library, fit.fit_effect(library, library.base, start, x), x)
    fitted, read = found[ToyBench], found[ReadingBench]
    assert fitted.effect.electrons == pytest.approx(10.0, rel=0.15) and set(fitted.sd) == {"fraction", "electrons"}
    assert read.effect.electrons == 12.0 and set(read.sd) == {"fraction"}
    assert read.state.free == ("hot_pixels.fraction",)
    assert read.misfit > fitted.misfit + 50  # 20 % off in what was read off is left as it is


def test_what_does_not_matter_to_a_form_is_not_free():
    bleaching, model = effect_class("photobleaching"), nm.preset("FF")
    free = {form: [c.name for c in Coordinate.of(bleaching(form=form), model)] for form in bleaching.forms()}
    assert free == {
        "exponential": ["rate_per_s"], "two_populations": ["rate_per_s", "fast_fraction", "rate_ratio"]
    }  # fmt: skip


def test_a_start_that_cannot_win_is_not_fitted_further(library):
    truth = nm.preset("FF").with_effects(HOT(fraction=2e-3, electrons=10.0))
    x = library.bench.rows([(truth, 997)])[0]
    gain = library.base.misfit(x)  # no effect can bring more
    assert fit.fit_if_promising(library, library.base, truth.effects[0], x, to_beat=10 * gain) is None
    found = fit.fit_if_promising(library, library.base, truth.effects[0], x, to_beat=0.5 * gain)
    assert found is not None and found.misfit < 0.5 * gain
    nothing = library.bench.rows([(nm.preset("FF"), 996)])[0]
    assert fit.fit_effect(library, library.base, HOT(fraction=0.02), nothing) is not None  # asked for, so fitted


class CurvedBench(ToyBench):
    """The light's effect bends over: from afar its derivative promises a model that is not there."""

    def law(self, model):
        light = np.log(model.optics.brightness_correction / 2.0)
        return 40.0 * np.tanh(2.0 * light) * self.one / 6


@pytest.mark.parametrize("light", [2.0, 3.6])
def test_far_from_a_measurement_free_values_go_downhill_as_far_as_simulations_confirm(light):
    bench, model = CurvedBench(), nm.preset("FF").with_values({"optics.brightness_correction": 2.0})
    values = tuple(n for n in nuisances(model) if n.path == "optics.brightness_correction")
    library = library_of(bench, model, values)
    x = bench.rows([(model.with_values({"optics.brightness_correction": light}), 994)])[0]
    one_step = library.base.model_at(library.base.adjusted(x).moves)
    found = nearing.descended(library, library.base, model, x)
    if light == 2.0:
        assert found is model  # nothing is nearer
        return
    assert one_step.optics.brightness_correction < 0.9 * light
    assert found.optics.brightness_correction == pytest.approx(light, rel=0.03)
