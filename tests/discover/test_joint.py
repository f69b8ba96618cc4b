"""Joint fits against a bench whose simulations are a known function and noise: what is found was put in."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import napari_mufasa as nm
from napari_mufasa.discover import exchange, joint, rules, steps
from napari_mufasa.discover.coordinates import Coordinate
from napari_mufasa.discover.library import build
from napari_mufasa.discover.nuisance import nuisances
from napari_mufasa.discover.null import Null
from napari_mufasa.discover.rules import ALARM, SCALES
from napari_mufasa.discover.stand import Stand, Worth
from napari_mufasa.discover.start import _design, begun, started
from napari_mufasa.discover.uncertainty import coordinates_sd
from napari_mufasa.effects import effect_class

P = 60
HOT, ROWS = effect_class("hot_pixels"), effect_class("row_noise")
KINDS = ["hot_pixels", "row_noise", "column_offset"]


class ToyBench:
    """Observables that saturate with the strength of hot pixels and turn with their electrons, and that grow with row
    noise; column offsets are like row noise but for a part of their own. Noise of one seed is the same for every
    model, as in the simulator."""

    seed, is_cheap, matching_simulations, done = 1, False, 0, 0
    read_last = frozenset()
    names = tuple(f"o{i}" for i in range(P))
    start = nm.preset("FF")
    values = ()

    def __init__(self):
        self.one, self.two, self.three, self.four = np.random.default_rng(7).standard_normal((4, 3, P)) * 6
        self.gaps = set()
        self.measured = SimpleNamespace(values=np.zeros((3, P)))

    def law(self, model):
        total = np.zeros((3, P))
        for effect in model.effects:
            if effect.kind == "hot_pixels":
                more = np.log1p(effect.fraction / 1e-3)
                total = total + more * (self.one + self.two * np.log(effect.electrons / 10.0))
            else:
                own = self.four if effect.kind == "column_offset" else 0.0
                total = total + np.log1p(effect.rms_adu) * (self.three + 0.4 * own)
        return total

    def plan(self, more):
        pass

    def least_spread(self):
        return np.full(P, 0.1)

    def free_values(self, model):
        return list(self.values)

    def read_off(self, kind, beside=None, part="all"):
        return {}

    def matched(self, model):
        return model  # a toy has no moments to match

    def noise(self, model, number):
        return np.random.default_rng([3, number]).standard_normal((3, P))

    def rows(self, jobs):
        self.done += len(jobs)
        return np.array([self.law(m) + self.noise(m, k) for m, k in jobs])


def stand_of(bench, truth, number=999, kinds=KINDS):
    """The model believed, before a measurement of the truth."""
    near = build(bench, bench.start, kinds)
    x = bench.rows([(truth, number)])[0]
    return Stand(near, (), x, Null.of(*near.null_distribution()), near.base)


def after(stand, state, kinds=KINDS):
    near = joint.settled(stand.library, state, stand.x, kinds, 2000)
    added = tuple(effect.kind for effect in near.base.model.effects)
    return Stand(near, added, stand.x, stand.null, stand.first)


def best(stand):
    model = stand.state.model_at(stand.state.adjusted(stand.x).moves)
    return {effect.kind: effect for effect in model.effects}


def usual_misfit():
    """chi² of P observables at a chance of 1e-4, with a tenth more for the finite simulations."""
    return 1.1 * stats.chi2.isf(1e-4, P)


@pytest.fixture(scope="module")
def bench():
    return ToyBench()


@pytest.mark.parametrize(("fraction", "electrons"), [(4e-4, 25.0), (5e-3, 4.0), (2e-2, 10.0)])
def test_a_fit_finds_strength_and_shape_from_a_far_start(bench, fraction, electrons):
    """The start is up to 50 times off in strength and 5 times in shape; noise alone allows about a percent."""
    stand = stand_of(bench, bench.start.with_effects(HOT(fraction=fraction, electrons=electrons)))
    start = HOT(fraction=4e-4 if fraction > 1e-3 else 1e-2, electrons=20.0 if electrons < 20 else 5.0)
    found = after(stand, begun(stand.library, stand.state, [start], stand.x))
    effect, sd = best(found)["hot_pixels"], found.uncertainties["hot_pixels"]
    assert effect.fraction == pytest.approx(fraction, rel=0.15)
    assert effect.electrons == pytest.approx(electrons, rel=0.15)
    assert 0 < sd["fraction"] < 0.2 * fraction and 0 < sd["electrons"] < 0.2 * electrons
    assert found.misfit < usual_misfit()


def test_what_is_stated_is_as_uncertain_as_it_is(bench):
    """Of 40 intervals that hold 95 % each, 32 or fewer hold with a chance below 10⁻³."""
    truth = HOT(fraction=5e-3, electrons=10.0)
    inside = {"fraction": 0, "electrons": 0}
    base = stand_of(bench, bench.start.with_effects(truth))
    fitted = after(base, begun(base.library, base.state, [HOT(fraction=4e-3, electrons=12.0)], base.x))
    for number in range(9000, 9040):
        x = bench.rows([(bench.start.with_effects(truth), number)])[0]
        found = Stand(fitted.library, fitted.added, x, fitted.null, fitted.first)
        for name in inside:
            off = getattr(best(found)["hot_pixels"], name) - getattr(truth, name)
            inside[name] += abs(off) < 1.96 * found.uncertainties["hot_pixels"][name]
    assert min(inside.values()) > 32


class UnsharedBench(ToyBench):
    """Chance that models do not share, and electrons that hardly show: slopes are half noise."""

    def __init__(self):
        super().__init__()
        self.two = self.two / 5

    def noise(self, model, number):
        told = [int(b) for b in model.model_dump_json().encode()]
        return np.random.default_rng([3, number, *told]).standard_normal((3, P))


def test_an_estimate_that_follows_the_truth_half_way_is_stated_as_less_certain():
    """Slopes that are half noise pull estimates towards where the model stands. Of 40 intervals of truths about two
    standard deviations to either side that hold 95 % each, 32 or fewer hold with a chance below 10⁻³."""
    bench = UnsharedBench()
    here = HOT(fraction=5e-3, electrons=10.0)
    stand = stand_of(bench, bench.start.with_effects(here))
    near = build(bench, bench.start.with_effects(here), KINDS, ("hot_pixels",))
    widths = coordinates_sd(near)
    narrow = np.std([near.base.adjusted(row).moves for row in near.rows], axis=0)[1]
    inside = {"told": 0, "as_scattered": 0}
    for number in range(9000, 9040):
        by = (-1) ** number * 2 * narrow
        truth = HOT(fraction=5e-3, electrons=10.0 * np.exp(by))
        x = bench.rows([(bench.start.with_effects(truth), number)])[0]
        found = Stand(near, ("hot_pixels",), x, stand.null, stand.first)
        off = abs(np.log(best(found)["hot_pixels"].electrons / truth.electrons))
        inside["told"] += off < 1.96 * widths[1]
        inside["as_scattered"] += off < 1.96 * narrow
    assert inside["told"] > 32 >= inside["as_scattered"]


def test_the_floor_is_what_fresh_simulations_score(bench):
    """A floor from simulations that made the mean and the spread themselves would be some 10 % too low."""
    stand = stand_of(bench, bench.start.with_effects(HOT(fraction=5e-3, electrons=8.0)))
    found = after(stand, begun(stand.library, stand.state, [HOT(fraction=5e-3, electrons=8.0)], stand.x)).state
    fresh = bench.rows([(found.model, 50_000 + k) for k in range(200)])
    # The scatter of one score is about 1 / sqrt(4 P) = 6 %, of the median of 12 of them 2.5 %.
    assert found.floor == pytest.approx(np.median([found.held_out_error(row) for row in fresh]), rel=0.08)


def test_two_effects_are_taken_up_together_and_neither_bends_the_other(bench):
    truth = HOT(fraction=5e-3, electrons=8.0), ROWS(rms_adu=3.0)
    stand = stand_of(bench, bench.start.with_effects(*truth))
    groups = stand.promising(set())
    assert {cases[0][0].ray.effect.kind for cases in groups[:2]} == {"hot_pixels", "row_noise"}
    state = stand.state
    for start in (HOT(fraction=2e-3, electrons=15.0), ROWS(rms_adu=1.0)):
        state = begun(stand.library, state, [start], stand.x)
    found = after(stand, state)
    effects = best(found)
    assert effects["hot_pixels"].fraction == pytest.approx(5e-3, rel=0.15)
    assert effects["row_noise"].rms_adu == pytest.approx(3.0, rel=0.15) and found.misfit < usual_misfit()
    assert all(found.is_worth(worth) and worth.error_without > 2 * found.error for worth in found.worths.values())


def test_what_may_stand_in_for_another_is_started_beside_it_and_nothing_else_is(bench):
    """Column offsets look like row noise, hot pixels like neither."""
    stand = stand_of(bench, bench.start.with_effects(ROWS(rms_adu=3.0), HOT(fraction=5e-3, electrons=8.0)))
    groups = [{case[0].ray.effect.kind for case in cases} for cases in stand.promising(set())]
    assert {"row_noise", "column_offset"} in groups[:2] and {"hot_pixels"} in groups[:2]


def test_what_stands_in_for_another_beside_it_is_not_worth_its_place(bench):
    """Column offsets look like row noise; beside it nothing is left for them."""
    stand = stand_of(bench, bench.start.with_effects(ROWS(rms_adu=3.0)))
    state = stand.state
    for start in (ROWS(rms_adu=1.0), effect_class("column_offset")(rms_adu=1.0)):
        state = begun(stand.library, state, [start], stand.x)
    found = after(stand, state)
    assert found.is_worth(found.worths["row_noise"]) and not found.is_worth(found.worths["column_offset"])
    sure, needed = 300.0, 20.0
    assert not found.is_worth(Worth(sure, 1.02 * found.error, needed)), "it may make up for the form of the other"
    assert found.is_worth(Worth(sure, 1.08 * found.error, needed))


def test_what_the_form_of_an_effect_may_have_left_is_no_lead(bench, monkeypatch):
    """Hot pixels by another law than the catalogue's: each observable is a tenth of what they move off the fit, to the
    side where row noise would move it. It is tried only where the error is not explained. Row noise that is there
    shows beside them all the same."""
    stand = stand_of(bench, bench.start.with_effects(HOT(fraction=5e-3, electrons=8.0)))
    found = after(stand, begun(stand.library, stand.state, [HOT(fraction=5e-3, electrons=8.0)], stand.x))
    rows = bench.law(bench.start.with_effects(ROWS(rms_adu=1.0)))
    form = replace(found, x=found.x + 0.1 * np.abs(found.moved_by("hot_pixels")) * np.sign(rows))
    assert form.state.screen(form.x, form.library.rays)["row_noise"][0].gain > form.needed("row_noise")
    assert form.leads["row_noise"][0].gain < form.needed("row_noise")
    assert form.error > rules.FAR * form.state.floor and form.promising(set())
    monkeypatch.setattr("napari_mufasa.discover.stand.FAR", 2.0)
    assert not form.promising(set())
    there = replace(found, x=found.x + rows)
    assert there.leads["row_noise"][0].gain > 10 * there.needed("row_noise") and there.promising(set())


def test_an_effect_that_promises_nothing_is_started_all_the_same(bench):
    """A user may ask for it; there is none of it."""
    stand = stand_of(bench, bench.start)
    forms = [replace(lead, gain=lead.gain - 1e3) for lead in stand.leads["hot_pixels"]]
    state = started(stand.library, stand.state, forms, stand.x)
    assert state.model.effects[-1].kind == "hot_pixels" and stand.misfit - state.misfit(stand.x) < 12


def test_nothing_is_promising_where_nothing_is_missing(bench):
    """An alarm is allowed in 2 % of measurements: four and more of 40 have a chance below 1 %."""
    near = build(bench, bench.start, KINDS)
    null = Null.of(*near.null_distribution())
    alarms = 0
    for number in range(700, 740):
        alarms += bool(Stand(near, (), bench.rows([(bench.start, number)])[0], null, near.base).promising(set()))
    assert alarms <= stats.binom.isf(0.01, 40, ALARM) == 3


class MaskedBench(ToyBench):
    """Hot pixels lower what column offsets have of their own: without them row noise looks nearer."""

    def __init__(self):
        super().__init__()
        self.one = self.one - 0.5 * self.four


def asking(stand, taken):
    """What `take_up` asks of an investigation; `taken` gets the states that it would settle."""
    asked = SimpleNamespace(
        stand=stand, bench=stand.library.bench, _settling=lambda n: 0, _settle=lambda state, *_: taken.append(state)
    )
    asked._promises = lambda *lead: steps.Steps._promises(asked, *lead)
    asked._begun_before_courses = lambda case: steps.Steps._begun_before_courses(asked, case)
    return asked


def test_what_is_read_off_as_others_leave_it_is_begun_after_them(bench, monkeypatch):
    monkeypatch.setattr(type(bench), "read_last", frozenset({"row_noise"}))
    stand, taken = stand_of(bench, bench.start.with_effects(ROWS(rms_adu=3.0), HOT(fraction=5e-3, electrons=10.0))), []
    steps.Steps.take_up(asking(stand, taken), [[stand.leads["row_noise"]], [stand.leads["hot_pixels"]]])
    assert [effect.kind for effect in taken[0].model.effects] == ["hot_pixels", "row_noise"]


def test_rivals_are_compared_beside_the_other_effects_that_are_taken_up():
    bench = MaskedBench()
    columns = effect_class("column_offset")
    stand = stand_of(bench, bench.start.with_effects(columns(rms_adu=3.0), HOT(fraction=5e-3, electrons=10.0)))
    leads, x, taken = stand.leads, stand.x, []
    alone = {k: started(stand.library, stand.state, leads[k], x).surprise(x) for k in ("row_noise", "column_offset")}
    assert alone["row_noise"] < alone["column_offset"]
    steps.Steps.take_up(asking(stand, taken), [[leads["row_noise"], leads["column_offset"]], [leads["hot_pixels"]]])
    assert {effect.kind for effect in taken[0].model.effects} == {"column_offset", "hot_pixels"}


def test_what_promises_nothing_more_beside_those_begun_is_not_begun(bench):
    """Column offsets look like row noise, which is there."""
    stand, taken = stand_of(bench, bench.start.with_effects(ROWS(rms_adu=3.0))), []
    assert stand.leads["column_offset"][0].gain > stand.needed("column_offset")  # alone they promise much
    steps.Steps.take_up(asking(stand, taken), [[stand.leads["row_noise"]], [stand.leads["column_offset"]]])
    assert [effect.kind for effect in taken[0].model.effects] == ["row_noise"]


def test_what_moves_the_same_as_an_effect_in_the_model_waits_for_its_forms(bench, monkeypatch):
    """Column offsets look like row noise, hot pixels like neither."""
    stand = stand_of(bench, bench.start.with_effects(ROWS(rms_adu=3.0), HOT(fraction=5e-3, electrons=10.0)))
    found = after(stand, begun(stand.library, stand.state, [ROWS(rms_adu=3.0)], stand.x))
    hot, columns = (found.leads[kind][0] for kind in ("hot_pixels", "column_offset"))
    assert found.kin(hot) == set() and found.stands_apart(hot)
    assert found.kin(columns) == {"row_noise"} and not found.stands_apart(replace(columns, gain=hot.gain))
    assert not found.stands_apart(replace(hot, gain=0.05 * found.misfit))  # little of what is left
    monkeypatch.setattr(ROWS, "rivals", ("hot_pixels",))  # known to look alike, whatever it moves
    near, far = (replace(found) for _ in range(2))
    near.__dict__["far_off"], far.__dict__["far_off"] = False, True
    assert near.kin(hot) == {"row_noise"} and not near.stands_apart(hot)
    assert far.kin(hot) == set()  # much else is wrong


def test_a_lead_whose_settings_end_before_it_is_at_its_best_vies_with_less(bench):
    stand = stand_of(bench, bench.start.with_effects(ROWS(rms_adu=3.0)))
    best = replace(stand.leads["row_noise"][0], scale=1.0)
    assert not best.may_be_stronger
    for share, scale, vies in ((0.3, 1.0, False), (0.6, 1.0, True), (0.3, SCALES[-1], True), (0.1, SCALES[-1], False)):
        assert stand._vies(replace(best, gain=share * best.gain, scale=scale), best) == vies
    assert not stand._vies(replace(best, gain=0.3 * best.gain, scale=SCALES[-1]), replace(best, scale=SCALES[-1]))


@pytest.mark.parametrize("far_off", [True, False])
def test_what_is_known_to_look_like_the_best_vies_with_it_whatever_it_moves_where_little_else_is_wrong(bench, far_off):
    stand = stand_of(bench, bench.start.with_effects(ROWS(rms_adu=3.0)))
    vars(stand)["far_off"] = far_off
    best, hot = stand.leads["row_noise"][0], stand.leads["hot_pixels"][0]
    farther = replace(hot.ray, shift=1e4 * hot.ray.shift)  # than anything else moves
    flicker = replace(farther, effect=effect_class("laser_flicker")())  # looks like row noise, and hot pixels do not
    for ray, share, vies in ((farther, 0.6, False), (flicker, 0.6, not far_off), (flicker, 0.4, False)):
        assert stand._vies(replace(hot, ray=ray, gain=share * best.gain, scale=1.0), best) == vies


class FormBench(ToyBench):
    """Hot pixels that switch show as they do; steady ones have something of row noise, too."""

    def law(self, model):
        steady = [e for e in model.effects if e.kind == "hot_pixels" and e.form == "steady"]
        return super().law(model) + sum(0.5 * np.log1p(e.fraction / 1e-3) for e in steady) * self.three


def test_forms_are_compared_each_in_its_best_shape():
    """Far from the electrons that are there, steady pixels in the right shape are nearer than switching ones in a
    wrong one."""
    bench = FormBench()
    stand = stand_of(bench, bench.start.with_effects(HOT(fraction=5e-3, electrons=33.0, form="telegraph")))
    forms = [HOT(fraction=5e-3, electrons=5.0, form=form) for form in ("steady", "telegraph")]
    found = begun(stand.library, stand.state, forms, stand.x)
    assert found.model.effects[-1].form == "telegraph"


@pytest.mark.parametrize(
    ("rows_adu", "most", "rivals", "doubtful", "left"),
    [
        (0.0, 1.03, ("row_noise",), 0.0, ["hot_pixels"]),
        (0.0, 1.03, (), 1.1, ["hot_pixels"]),
        (0.0, 1.03, (), 0.0, ["hot_pixels", "row_noise"]),
        (0.0, 0.5, ("row_noise",), 0.0, ["hot_pixels", "row_noise"]),
        (20.0, 1.03, ("row_noise",), 0.0, ["hot_pixels", "row_noise"]),
        (20.0, 1.03, (), 1.1, ["hot_pixels", "row_noise"]),
    ],
)
def test_one_effect_in_another_form_takes_the_place_of_two_rivals_or_of_one_and_a_doubtful_one(
    monkeypatch, rows_adu, most, rivals, doubtful, left
):
    """Switching pixels and row noise explain steady pixels, unless there is much row noise beside them, or one effect
    in their place leaves more error than it may."""
    monkeypatch.setattr(HOT, "rivals", rivals)
    monkeypatch.setattr(ROWS, "rivals", ())
    monkeypatch.setattr(exchange, "NOT_RISEN", most)
    monkeypatch.setattr(exchange, "DOUBTFUL", doubtful)  # of any effect, or of none
    bench = FormBench()
    hidden = [HOT(fraction=5e-3, electrons=33.0, form="steady")] + [ROWS(rms_adu=rows_adu)] * (rows_adu > 0)
    stand = stand_of(bench, bench.start.with_effects(*hidden))
    state = begun(stand.library, stand.state, [HOT(fraction=5e-3, electrons=33.0, form="telegraph")], stand.x)
    asked = steps.Steps(bench, bench.start, 10_000, KINDS, [])
    asked.stands = [stand, after(stand, begun(stand.library, state, [ROWS(rms_adu=1.0)], stand.x))]
    assert asked.chosen == ["hot_pixels", "row_noise"] and asked.stand.worths["row_noise"].is_some
    assert asked.merge() == (len(left) == 1)
    assert asked.chosen == left and (len(left) == 2 or asked.state.model.effects[0].form == "steady")


class SumBench(ToyBench):
    """Columns show as hot pixels and row noise together do."""

    def law(self, model):
        columns = [effect for effect in model.effects if effect.kind == "column_offset"]
        others = tuple(effect for effect in model.effects if effect.kind != "column_offset")
        together = sum(np.log1p(e.rms_adu) for e in columns) * (self.one + self.three)
        return super().law(model.model_copy(update={"effects": others})) + together


@pytest.mark.parametrize(
    ("rivals", "rows_adu", "left"),
    [
        (("hot_pixels", "row_noise"), 0.0, ["column_offset"]),
        (("hot_pixels",), 0.0, ["hot_pixels", "row_noise"]),
        (("hot_pixels", "row_noise"), 9.0, ["hot_pixels", "row_noise"]),
    ],
)
def test_what_is_known_to_look_like_two_takes_their_place_where_it_explains_as_much(
    monkeypatch, rivals, rows_adu, left
):
    columns = effect_class("column_offset")
    monkeypatch.setattr(columns, "rivals", rivals)
    for effect in (HOT, ROWS):
        monkeypatch.setattr(effect, "rivals", ())
    monkeypatch.setattr(exchange, "FORM_WORTH", 1.0)
    bench = SumBench()
    hidden = [columns(rms_adu=1.0)] + [ROWS(rms_adu=rows_adu)] * (rows_adu > 0)
    stand = stand_of(bench, bench.start.with_effects(*hidden))
    state = begun(stand.library, stand.state, [HOT(fraction=1e-3, electrons=10.0)], stand.x)
    asked = steps.Steps(bench, bench.start, 10_000, KINDS, [])
    asked.stands = [stand, after(stand, begun(stand.library, state, [ROWS(rms_adu=1.0)], stand.x))]
    assert asked.chosen == ["hot_pixels", "row_noise"] and asked.merge() == (len(left) == 1)
    assert asked.chosen == left


class WindingBench(ToyBench):
    """What switching pixels do turns with their number, so that a strong setting says nothing of a weak one."""

    def law(self, model):
        hot = [effect for effect in model.effects if effect.kind == "hot_pixels"]
        others = tuple(effect for effect in model.effects if effect.kind != "hot_pixels")
        total = super().law(model.model_copy(update={"effects": others}))
        for effect in hot:
            turn = np.pi / 2 * np.log(effect.fraction / 5e-3) / np.log(2.2)
            switching = self.one * np.cos(turn) + self.two * np.sin(turn)
            steady = 0.5 * (self.one + self.three) * np.log1p(effect.fraction / 1e-3)
            total = total + (steady if effect.form == "steady" else switching)
        return total


def test_forms_judged_apart_are_told_by_their_ladders_not_by_what_one_strength_promises():
    bench = WindingBench()
    stand = stand_of(bench, bench.start.with_effects(HOT(fraction=5e-3, form="telegraph")))
    forms = [HOT(fraction=1.1e-2, form=form) for form in ("steady", "telegraph")]
    found = {apart: begun(stand.library, stand.state, forms, stand.x, apart=apart) for apart in (False, True)}
    assert {apart: state.model.effects[-1].form for apart, state in found.items()} == {
        False: "steady",
        True: "telegraph",
    }
    assert found[True].misfit(stand.x) < found[False].misfit(stand.x)


def test_a_ladder_of_strengths_ends_where_their_range_does(bench):
    """A strength that chance or something else drives on would run away, and nothing leads back from there."""
    believed = bench.start
    most = next(c.high for c in Coordinate.of(ROWS(rms_adu=1.0), believed))
    stand = stand_of(bench, believed.with_effects(ROWS(rms_adu=10 * most)))
    found = begun(stand.library, stand.state, [ROWS(rms_adu=0.6 * most)], stand.x).model.effects[-1].rms_adu
    assert found == pytest.approx(most)
    beyond = begun(stand.library, stand.state, [ROWS(rms_adu=2 * most)], stand.x).model.effects[-1].rms_adu
    assert beyond == pytest.approx(2 * most)  # where it starts, it may stay


class BentBench(ToyBench):
    """With hot pixels more light lowers what it raises without them: the base model's derivative leads astray."""

    values = tuple(n for n in nuisances(ToyBench.start) if n.path == "optics.brightness_correction")

    def law(self, model):
        light = np.log(model.optics.brightness_correction) * 40.0 * (-1 if model.effects else 1)
        return super().law(model) + light * np.roll(self.one, 1) / 6


def test_derivatives_taken_anew_bring_nuisance_values_home():
    bench = BentBench()
    truth = bench.start.with_values({"optics.brightness_correction": 1.15})
    stand = stand_of(bench, truth.with_effects(HOT(fraction=5e-3, electrons=8.0)))
    found = after(stand, begun(stand.library, stand.state, [HOT(fraction=5e-3, electrons=8.0)], stand.x))
    light = found.state.model_at(found.state.adjusted(stand.x).moves).optics.brightness_correction
    assert light == pytest.approx(1.15, rel=0.02) and found.misfit < usual_misfit()


def test_a_fit_that_will_not_come_below_what_it_must_is_given_up():
    """Once derivatives taken anew say so: they are all that is spent after that."""
    bench = BentBench()
    truth = bench.start.with_values({"optics.brightness_correction": 1.15})
    stand = stand_of(bench, truth.with_effects(HOT(fraction=5e-3, electrons=8.0)))
    state = begun(stand.library, stand.state, [HOT(fraction=5e-3, electrons=8.0)], stand.x)

    def spent(below):
        before = bench.done
        there = joint.descended(stand.library, state, state.model, stand.x, 2000, below)
        return bench.done - before, there.misfit(stand.x)

    (whole, misfit), (little, _) = spent(usual_misfit()), spent(1.0)
    assert misfit < usual_misfit() and little < whole
    assert joint.settled(stand.library, state, stand.x, KINDS, 2000, below=1.0) is None


@pytest.mark.parametrize("better", [True, False])
def test_nuisance_values_are_matched_again_where_that_is_nearer(bench, monkeypatch, better):
    truth = bench.start.with_effects(HOT(fraction=5e-3, electrons=8.0))
    other = bench.start.with_effects(HOT(fraction=5e-4, electrons=30.0))
    stand = stand_of(bench, truth, 996)
    monkeypatch.setattr(bench, "matched", lambda model: truth if better else other)
    assert joint.nearer(stand.library, stand.state, other if better else truth, stand.x) == truth


class CurvedBench(ToyBench):
    """The light's effect bends over: from afar its derivative promises a model that is not there."""

    start = ToyBench.start.with_values({"optics.brightness_correction": 2.0})
    values = tuple(n for n in nuisances(start) if n.path == "optics.brightness_correction")

    def law(self, model):
        light = np.log(model.optics.brightness_correction / 2.0)
        return 40.0 * np.tanh(2.0 * light) * self.one / 6


@pytest.mark.parametrize("light", [2.0, 3.6])
def test_far_from_a_measurement_free_values_go_downhill_as_far_as_simulations_confirm(light):
    bench = CurvedBench()
    stand = stand_of(bench, bench.start.with_values({"optics.brightness_correction": light}), kinds=[])
    one_step = stand.state.model_at(stand.state.adjusted(stand.x).moves)
    found = joint.descended(stand.library, stand.state, bench.start, stand.x, 1000)
    if light == 2.0:
        assert found.model is bench.start  # nothing is nearer
        return
    assert one_step.optics.brightness_correction < 0.9 * light
    assert found.model.optics.brightness_correction == pytest.approx(light, rel=0.03)


class TurningBench(CurvedBench):
    """From afar the light's derivative points elsewhere than where it leads."""

    def law(self, model):
        light = np.log(model.optics.brightness_correction / 2.0)
        return super().law(model) + 15.0 * light**2 * self.two / 6


@pytest.mark.parametrize("light", [2.0, 3.6])
def test_a_neighbourhood_is_left_only_where_a_step_leads_to_the_measurement(light):
    bench = TurningBench()
    stand = stand_of(bench, bench.start.with_values({"optics.brightness_correction": light}), kinds=[])
    deeper = joint.deepened(stand.library, stand.x, [], 1000)
    if light == 2.0:
        assert deeper is None
        return
    assert deeper.base.misfit(stand.x) < usual_misfit() < stand.misfit
    assert deeper.base.model.optics.brightness_correction == pytest.approx(light, rel=0.03)


@pytest.mark.parametrize(("fraction", "electrons"), [(5e-3, 10.0), (9e-3, 5.0), (2e-3, 22.0), (2e-2, 4.0)])
def test_values_are_told_from_where_they_are_and_not_by_slopes_from_elsewhere(fraction, electrons):
    """Slopes leave as little misfit as the truth does, at electrons up to twice off; noise allows about 2 %."""
    bench, here = ToyBench(), HOT(fraction=5e-3, electrons=10.0)
    x = bench.rows([(bench.start.with_effects(HOT(fraction=fraction, electrons=electrons)), 999)])[0]
    near = build(bench, bench.start.with_effects(here), [], ["hot_pixels"])
    spent = bench.done
    found = joint.arrived(near, x, ["hot_pixels"], 1000)
    if fraction == here.fraction:
        assert found is None and bench.done == spent
        return
    by_slopes = near.base.model_at(near.base.adjusted(x).moves).effects[0]
    assert near.base.misfit(x) < usual_misfit() and abs(np.log(by_slopes.electrons / electrons)) > 0.15
    told = found.base.model_at(found.base.adjusted(x).moves).effects[0]
    assert (told.fraction, told.electrons) == pytest.approx((fraction, electrons), rel=0.05)
    assert np.all(np.abs(found.base.adjusted(x).moves) < rules.LINEAR)


def test_no_more_is_spent_than_may_be():
    bench = CurvedBench()
    stand = stand_of(bench, bench.start.with_values({"optics.brightness_correction": 3.6}), kinds=[])
    before = bench.done
    assert joint.descended(stand.library, stand.state, bench.start, stand.x, 6).model is bench.start
    assert bench.done - before == rules.TRIALS  # it looked where it stood


class ReadingBench(ToyBench):
    """The measurement shows the electrons directly, whatever a fit would say."""

    def read_off(self, kind, beside=None, part="all"):
        return {"electrons": 12.0} if kind == "hot_pixels" else {}


def test_what_is_read_off_is_not_fitted():
    bench = ReadingBench()
    stand = stand_of(bench, bench.start.with_effects(HOT(fraction=5e-3, electrons=10.0)))
    found = after(stand, begun(stand.library, stand.state, [HOT(fraction=2e-3, electrons=12.0)], stand.x))
    assert best(found)["hot_pixels"].electrons == 12.0 and found.state.free == ("hot_pixels.fraction",)
    assert set(found.uncertainties["hot_pixels"]) == {"fraction"}
    assert found.misfit > usual_misfit()  # 20 % off in what was read off is left as it is


class HalvesBench(ReadingBench):
    """One half shows 12 electrons, the other 9."""

    def read_off(self, kind, beside=None, part="all"):
        electrons = {"all": 10.5, "white": 12.0, "black": 9.0}[part]
        return {"electrons": electrons} if kind == "hot_pixels" else {}


def test_a_half_is_judged_by_what_was_read_off_the_other():
    bench = HalvesBench()
    truth = bench.start.with_effects(HOT(fraction=5e-3, electrons=10.5))
    model = bench.start.with_effects(HOT(fraction=5e-3, electrons=10.5))
    near = build(bench, model, [], ["hot_pixels"])
    x = bench.rows([(truth, 999)])[0]
    state = near.base
    for half, electrons in ((1, 12.0), (2, 9.0)):
        other = bench.start.with_effects(HOT(fraction=5e-3, electrons=electrons))
        np.testing.assert_allclose(state.unread["hot_pixels"][half], bench.law(other) - bench.law(model))
    assert state.held_out_error(x) > 1.5 * replace(state, unread={}).held_out_error(x)  # readings that do not agree
    assert joint.removed(near, "hot_pixels").unread == {}  # nothing is read off any more
    assert build(ToyBench(), model, [], ["hot_pixels"]).base.unread == {}


class TwiceBench(HalvesBench):
    """The halves show two effects differently."""

    def read_off(self, kind, beside=None, part="all"):
        rms = {"all": 1.0, "white": 1.4, "black": 0.7}[part]
        return {"rms_adu": rms} if kind == "row_noise" else super().read_off(kind, beside, part)


def test_what_was_read_off_goes_with_its_effect():
    bench = TwiceBench()
    one, other = HOT(fraction=5e-3, electrons=10.5), ROWS(rms_adu=1.0)
    near = build(bench, bench.start.with_effects(one, other), [], ["hot_pixels", "row_noise"])
    x = bench.rows([(bench.start.with_effects(one), 999)])[0]
    without, alone = joint.removed(near, "row_noise"), build(bench, bench.start.with_effects(one), [], ["hot_pixels"])
    assert set(near.base.unread) == {"hot_pixels", "row_noise"} and set(without.unread) == {"hot_pixels"}
    for half, change in alone.base.unread["hot_pixels"].items():
        np.testing.assert_allclose(without.unread["hot_pixels"][half], change)
    assert without.held_out_error(x) == pytest.approx(alone.base.held_out_error(x), rel=0.05)


def test_where_an_effect_is_begun_its_halves_are_judged_by_one_another():
    """Or what is read off the movie, its noise with it, would pass for more than what is fitted."""
    bench = HalvesBench()
    stand = stand_of(bench, bench.start.with_effects(HOT(fraction=5e-3, electrons=10.5)))
    state = begun(stand.library, stand.state, [HOT(fraction=4e-3, electrons=10.5)], stand.x)
    assert state.surprise(stand.x) > replace(state, unread={}).surprise(stand.x) + 100
    assert state.misfit(stand.x) == replace(state, unread={}).misfit(stand.x)


@pytest.mark.parametrize("dimensions", range(1, 8))
def test_settings_around_a_start_tell_all_its_parameters_apart(dimensions):
    signs = np.sign(_design(9, dimensions, 0.4, np.random.default_rng(1)))
    assert not signs[0].any() and not signs.sum(axis=0).any()
    np.testing.assert_array_equal(signs.T @ signs, 8 * np.eye(dimensions))


class ScaleBench(HalvesBench):
    """Only the product of fraction and electrons shows."""

    def law(self, model):
        shown = sum(np.log(effect.fraction * effect.electrons / 1e-2) for effect in model.effects)
        return shown * np.stack([self.one[0]] * 3)


def test_a_scale_that_the_halves_read_differently_is_fitted_where_it_was_read():
    bench = ScaleBench()
    model = bench.start.with_effects(HOT(fraction=5e-3, electrons=10.5))
    state = build(bench, model, [], ["hot_pixels"]).base
    x, unread = bench.rows([(model, 999)])[0], state.unread["hot_pixels"]
    assert state.free == ("hot_pixels.fraction",) and np.ptp(unread[1] - unread[2]) > 5
    assert state.held_out_error(x) < 1.05 * replace(state, unread={}).held_out_error(x)


def test_what_does_not_matter_to_a_form_is_not_free():
    bleaching, model = effect_class("photobleaching"), nm.preset("FF")
    free = {form: [c.name for c in Coordinate.of(bleaching(form=form), model)] for form in bleaching.forms()}
    assert free == {
        "exponential": ["rate_per_s"], "two_populations": ["rate_per_s", "fast_fraction", "rate_ratio"]
    }  # fmt: skip


def test_settings_show_all_that_was_measured_but_for_what_only_describes(monkeypatch):
    """A law stands in the place of what is in the model, too; what only describes is read off beside it."""
    bench, asked = ToyBench(), {}

    def read_off(kind, beside=None, part="all"):
        asked[kind] = beside
        return {}

    monkeypatch.setattr(bench, "read_off", read_off)
    monkeypatch.setattr(ROWS, "describes_only", True)
    near = build(bench, bench.start.with_effects(HOT()), KINDS[1:])
    assert asked == {"row_noise": near.base.model, "column_offset": None}


class Unlike(ToyBench):
    """Hot pixels move half of the observables, and make them scatter six times as much."""

    def __init__(self):
        super().__init__()
        self.one[:, P // 2 :] = self.two[:, P // 2 :] = 0.0

    def noise(self, model, number):
        wide = any(effect.kind == "hot_pixels" for effect in model.effects)
        return super().noise(model, number) * np.where(np.arange(P) < P // 2, 6.0 if wide else 1.0, 1.0)


def test_what_an_effect_brings_to_the_spread_is_no_reason_to_take_it_out():
    """Shifts of 4 are little in a spread of 6 that the effect itself brings (0.4 of misfit each), and without it much
    (16 and more): molecules that bleach make a movie unlike the next. What does nothing is worth nothing."""
    bench = Unlike()
    model = bench.start.with_effects(HOT(fraction=1e-3), ROWS(rms_adu=1e-6))
    library = build(bench, model, [], ["hot_pixels", "row_noise"])
    x = bench.law(model) + bench.noise(model, 99)
    by_slopes = {kind: joint.removed(library, kind).misfit(x) - library.base.misfit(x) for kind in KINDS[:2]}
    shown = {kind: joint.shown_worth(library, kind, x) for kind in KINDS[:2]}
    assert by_slopes["hot_pixels"] < 30 and shown["hot_pixels"] > 300
    assert abs(by_slopes["row_noise"]) < 1 and abs(shown["row_noise"]) < 1
