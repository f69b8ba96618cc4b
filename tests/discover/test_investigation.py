"""The conversation's bookkeeping: what is seen from where, and what is the user's own."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import napari_mufasa as nm
from napari_mufasa.discover import automatic, contest, reporting
from napari_mufasa.discover.coordinates import Coordinate, model_at
from napari_mufasa.discover.fit import Fit
from napari_mufasa.discover.investigation import SECOND, SECOND_SHARE, Investigation
from napari_mufasa.discover.nuisance import nuisances
from napari_mufasa.discover.state import SCALES, Lead, Ray
from napari_mufasa.effects import effect_class

KINDS = ["laser_drift", "row_noise", "background_gradient"]


def small():
    return nm.preset("FF").with_values(
        {"acquisition.n_frames": 60, "acquisition.shape_px": (48, 48), "sample.n_molecules": 14}
    )


@pytest.fixture(scope="module")
def inquiry():
    """Three strong effects are missing: far from the floor after any one of them."""
    model = small()
    strong = [
        effect_class("laser_drift")(change=-0.5),
        effect_class("row_noise")(rms_adu=12.0),
        effect_class("background_gradient")(relative_height=1.5, direction_deg=30.0),
    ]
    truth = model.model_copy(update={"effects": tuple(strong)})
    return Investigation(nm.simulate(truth, seed=5).movie, model, nm.simulate_dark(truth, 20, 6), seed=2, effects=KINDS)


def test_far_from_the_floor_the_neighbourhood_is_simulated_anew_and_undo_goes_back(inquiry):
    before, first = inquiry.state.held_out_error(inquiry.x), inquiry.library
    inquiry.add("laser_drift")
    near, gained = inquiry.state, inquiry.explained
    assert near.far_off(inquiry.x) and inquiry.library is first
    inquiry.approach()
    assert inquiry.library is not first and "laser_drift.change" in inquiry.state.free
    assert set(inquiry.library.rays) == {"row_noise", "background_gradient"}
    here = inquiry.library
    inquiry.approach()
    assert inquiry.library is here  # once is enough
    inquiry.add("row_noise")
    assert inquiry.chosen == ["laser_drift", "row_noise"]
    inquiry.add("background_gradient")
    assert inquiry.state.held_out_error(inquiry.x) < 1.5 * inquiry.state.floor  # nothing else is missing
    assert {e.kind for e in inquiry.model.effects} == set(KINDS) and inquiry.explained > gained > 0
    inquiry.undo()
    inquiry.undo()
    assert inquiry.library is here and inquiry.explained == gained
    inquiry.undo()
    assert inquiry.library is first and inquiry.state.held_out_error(inquiry.x) == before and inquiry.explained == 0


def test_a_further_effect_must_stand_out_only_from_what_the_first_ones_moved(inquiry):
    inquiry.add("laser_drift")
    try:
        by_drift = np.abs(inquiry.state.mean - inquiry.first_view.state.mean)[0] / inquiry.first_view.state.spread[0]

        def needed(observable):
            shift = np.zeros_like(inquiry.x)
            shift[:, observable] = inquiry.state.spread[0, observable]
            return inquiry.needed(Lead(1.0, Ray(effect_class("row_noise")(), shift), 1.0))

        elsewhere, on_the_same = needed(np.argmin(by_drift)), needed(np.argmax(by_drift))
        assert elsewhere == pytest.approx(inquiry.null.evidence.at(SECOND), rel=0.01)
        assert on_the_same == pytest.approx(SECOND_SHARE * inquiry.explained, rel=0.01) and on_the_same > 2 * elsewhere
    finally:
        inquiry.undo()


@pytest.mark.parametrize("first", ["photobleaching", "laser_drift"])
def test_what_stood_in_for_something_else_is_exchanged_once_a_second_effect_is_there(first):
    """Falling light lets the spots fade as bleaching does, and the background, too."""
    model = small()
    truth = model.with_effects(effect_class("laser_drift")(change=-0.4), effect_class("row_noise")(rms_adu=12.0))
    kinds = ["laser_drift", "photobleaching", "row_noise"]
    movie = nm.simulate(truth, seed=5).movie
    inquiry = Investigation(movie, model, nm.simulate_dark(truth, 20, 6), seed=2, effects=kinds)
    inquiry.rank()
    inquiry.add(first)
    inquiry.add("row_noise")
    explained, error = inquiry.explained, inquiry.state.held_out_error(inquiry.x)
    inquiry.reconsider()
    if first == "laser_drift":
        assert inquiry.chosen == ["laser_drift", "row_noise"] and inquiry.explained == explained
        return
    assert inquiry.chosen == ["row_noise", "laser_drift"] and inquiry.explained > explained
    assert inquiry.state.held_out_error(inquiry.x) < error
    assert {e.kind for e in inquiry.model.effects} == {"row_noise", "laser_drift"}
    inquiry.undo()
    assert inquiry.chosen == ["row_noise"] and {e.kind for e in inquiry.model.effects} == {"row_noise"}


@pytest.mark.parametrize(("is_some", "improves"), [(True, True), (False, True), (True, False)])
def test_an_effect_that_is_none_or_does_not_help_once_it_is_settled_is_taken_out_again(is_some, improves):
    steps = []
    inquiry = SimpleNamespace(
        state="before",
        fits=[SimpleNamespace(is_some=is_some)],
        add=lambda candidate: steps.append("add"),
        undo=lambda: steps.append("undo"),
        improves=lambda before, after, candidate: improves and before == "before",
    )
    kept = is_some and improves
    assert automatic._holds(inquiry, "candidate") is kept
    assert steps == (["add"] if kept else ["add", "undo"])


@pytest.mark.parametrize(("p_misfit", "verdict"), [(0.5, "adequate"), (1e-4, "unexplained")])
def test_an_effect_refuted_once_it_is_settled_is_no_reason_to_call_it_missing(inquiry, monkeypatch, p_misfit, verdict):
    inquiry.rank()
    best = inquiry.ranking[0]
    assert inquiry.convincing(best) and reporting.verdict_of(inquiry, [], 1.0) == "missing_effect"
    none_of_it = {effect_class(best.effect).strength: np.inf}
    monkeypatch.setattr(contest.Contest, "settled", lambda self, found: replace(found, sd=none_of_it))
    monkeypatch.setattr(type(inquiry.null.misfit), "p", lambda tail, value: p_misfit)
    monkeypatch.setattr(inquiry, "alarmed", lambda: True)
    assert not automatic._holds(inquiry, best)
    again = next(candidate for candidate in inquiry.ranking if candidate.effect == best.effect)
    assert not inquiry.convincing(again)
    inquiry.ranking = [again]
    assert reporting.verdict_of(inquiry, [], 1.0) == verdict


def test_a_form_simulated_too_weakly_has_its_turn(monkeypatch):
    forms = {form: effect_class("pixel_gain_variation")(form=form) for form in ("pixels", "dull_pixels", "columns")}
    promised = [("pixels", 1000.0, 1.0), ("dull_pixels", 100.0, max(SCALES)), ("columns", 100.0, 0.7)]
    leads = [Lead(gain, Ray(forms[form], np.zeros((3, 1))), scale) for form, gain, scale in promised]
    state = SimpleNamespace(screen=lambda x, rays: {"pixel_gain_variation": leads})
    library = SimpleNamespace(rays={"pixel_gain_variation": []}, bench=SimpleNamespace(plan=lambda n: None))
    tried = []
    monkeypatch.setattr(contest.Contest, "_content", lambda self, found: False)
    monkeypatch.setattr(contest.Contest, "evidence", lambda self, found: 1000.0)
    monkeypatch.setattr(contest.Contest, "_closest", lambda self, fits: fits[0])
    monkeypatch.setattr(contest.fit, "fit_if_promising", lambda lib, st, start, x, least: tried.append(start))
    ring = contest.Contest(library, state, None, lambda: None)
    ring._best_form(SimpleNamespace(effect=forms["pixels"]))
    assert [start.form_name for start in tried] == ["dull_pixels"]  # a tenth of the best, but its ray ended there


@pytest.mark.parametrize(
    ("p_left", "after", "farthest", "verdict"),
    [
        (0.5, 1.0, 4.3, "missing_effect"),  # of 111 observables one may be off by 4.4 with a chance of 0.001
        (0.5, 1.0, -4.6, "unexplained"),
        (0.5, 1.4, 2.0, "missing_effect"),
        (1e-4, 1.3, 2.0, "missing_effect"),
        (1e-4, 1.4, 2.0, "unexplained"),
    ],
)
def test_what_is_left_beyond_chance_is_unexplained_as_a_whole_or_in_one_observable(p_left, after, farthest, verdict):
    seen = SimpleNamespace(soft=np.append(np.zeros(110), farthest))
    state = SimpleNamespace(adjusted=lambda x: seen, misfit=lambda x: 100.0, measurable=np.ones(111, dtype=bool))
    null = SimpleNamespace(misfit=SimpleNamespace(p=lambda misfit: p_left))
    inquiry = SimpleNamespace(chosen=["stage_drift"], state=state, null=null, x=None)
    assert reporting.verdict_of(inquiry, [5.0, after], 1.0) == verdict


def test_an_effect_of_the_model_believed_is_not_added_again(inquiry):
    believed = inquiry.believed
    inquiry.believed = believed.with_effects(effect_class("triplet_blinking")())
    try:
        with pytest.raises(nm.MufasaError, match="believed already"):
            inquiry.add(effect_class("triplet_blinking")(off_rate_per_s=3.0))
    finally:
        inquiry.believed = believed


def test_no_move_changes_nothing_even_beyond_the_plausible_range():
    odd = [
        effect_class("photobleaching")(rate_per_s=1e-5, fast_fraction=0.9, rate_ratio=2.0, form="two_populations"),
        effect_class("triplet_blinking")(dark_time_s=0.5),
    ]
    model = nm.preset("FF").model_copy(update={"effects": tuple(odd)})
    values = nuisances(model)
    free = [n.path for n in values] + [f"{e.kind}.{c.name}" for e in odd for c in Coordinate.of(e, model)]
    assert model_at(model, values, free, np.zeros(len(free))).effects == model.effects


def test_a_step_at_the_end_of_a_range_goes_inward():
    bleaching, model = effect_class("photobleaching")(fast_fraction=0.6, form="two_populations"), nm.preset("FF")
    share = next(c for c in Coordinate.of(bleaching, model) if c.name == "fast_fraction")
    assert share.inward(bleaching, 0.2) == -0.2 and share.value_at(bleaching, -0.2) < 0.6 == share.value_at(
        bleaching, 0.2
    )


def test_an_effect_that_is_off_has_no_free_strength():
    off = effect_class("photobleaching")(rate_per_s=0.0)
    assert Coordinate.of(off, nm.preset("FF")) == []


def fits_of(forms, scores, errors=(1.0, 1.0, 1.0)):
    drift = effect_class("laser_drift")
    states = [SimpleNamespace(held_out_error=lambda x, error=error: error) for error in errors]
    return [Fit(state, drift(form=f), {}, score, 0.0) for f, score, state in zip(forms, scores, states, strict=True)]


@pytest.fixture
def choice(monkeypatch):
    """A contest whose fits are known; scores after more simulations come from the test."""
    after, judged = {}, []

    def judge_again(library, close, x):
        judged.extend(found.effect.form for found in close)
        return [replace(found, score=after.get(found.effect.form, found.score)) for found in close]

    monkeypatch.setattr(contest, "sharpened", judge_again)
    nothing_known = SimpleNamespace(score=lambda x: 0.0)
    return contest.Contest(None, nothing_known, np.zeros((3, 100)), None), after, judged


def test_forms_that_come_close_are_judged_by_more_simulations_before_one_is_chosen(choice):
    """What led by few simulations may lose to its rival by more; what is far behind is not looked at again."""
    judge, after, judged = choice
    fits = fits_of(("saturating", "wandering", "step"), (-714.0, -687.0, -300.0))
    after |= {"saturating": -709.0, "wandering": -772.0, "step": -9999.0}
    assert judge._closest(fits).effect.form == "wandering"
    assert judged == ["saturating", "wandering"]
    assert judge._closest([fits[0], fits[2]]) is fits[0] and judged == ["saturating", "wandering"]


def test_of_close_forms_the_plain_one_stays_unless_another_is_clearly_better(choice):
    judge, _, _ = choice
    close = fits_of(("linear", "saturating", "wandering"), (-700.0, -710.0, -600.0))
    assert judge._closest(close).effect.form == "linear"
    clearly = fits_of(("linear", "saturating", "wandering"), (-700.0, -720.0, -600.0))
    assert judge._closest(clearly).effect.form == "saturating"


def test_of_close_forms_the_one_that_tells_the_other_half_of_the_field_is_chosen(choice):
    """A pattern without the freedom of the real one: more likely for the whole field, far off for the other half."""
    judge, _, _ = choice
    forms = fits_of(("linear", "saturating", "wandering"), (-777.0, -799.0, -800.0), (1.09, 1.64, 1.5))
    assert judge._closest(forms).effect.form == "linear"


@pytest.mark.parametrize("evidence", [500.0, 5.0])
def test_a_fit_that_explains_much_and_ends_at_no_strength_gives_the_other_forms_their_turn(monkeypatch, evidence):
    """It went astray; where it explains no more than chance does, there is none of the effect."""
    drift, fitted = effect_class("laser_drift"), []

    def refine(library, state, starts, x, to_beat, promised=0.0):
        fitted.append([start.form for start in starts])
        astray = len(fitted) == 1
        effect = drift(form=starts[0].form, change=0.01 if astray else 0.3)
        return Fit(None, effect, {"change": 0.1}, -evidence if astray else -900.0, 0.0)

    monkeypatch.setattr(contest.fit, "fit_if_promising", refine)
    monkeypatch.setattr(Fit, "is_some", property(lambda found: abs(found.effect.change) > 0.1))
    state = SimpleNamespace(score=lambda x: 0.0)
    null = SimpleNamespace(evidence=SimpleNamespace(at=lambda p: 30.0))
    leads = [Lead(1000.0, Ray(drift(form=form), None), 1.0) for form in ("saturating", "linear")]
    found = contest.Contest(None, state, np.zeros((3, 100)), lambda: null)._tried(leads, 0.0)
    if evidence > 30.0:
        assert fitted == [["saturating", "linear"], ["linear"]] and found.effect.form == "linear"
    else:
        assert len(fitted) == 1 and not found.is_some
