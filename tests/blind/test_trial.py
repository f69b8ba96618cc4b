"""The trial: its cases follow from the seed, its rows are judged as is written, its page tells how much of it ran."""

import json
import math
import typing
from collections import Counter
from statistics import NormalDist

import pytest

import napari_mufasa as nm

from . import cases, forms, generator, judging, running, trial
from .cases import PLAN
from .page import page as written
from .page import summary

SMALL = "single:26,null:4"


def row(case, chosen=None, **more):
    """A row as of a perfect diagnosis, but for what is given."""
    kinds = [kind for kind, _ in case["effects"]]
    chosen = kinds if chosen is None else chosen
    names = [generator.forms(kind)[case["form"] or 0] for kind in kinds]
    truth = [
        {"kind": kind, "strength": strength, "form": name, "parameters": {}}
        for (kind, strength), name in zip(case["effects"], names, strict=True)
    ]
    verdict = "unexplained" if case["off"] else "missing_effect" if kinds else "adequate"
    told = {
        "forms": names, "truth": truth, "verdict": verdict, "chosen": chosen, "ranking": chosen,
        "error": {"before": 4.0, "after": 1.0, "floor": 1.0}, "alternatives": [], "detectable": {},
        "found": {kind: {"parameters": {}, "sd": {}, "rivals": []} for kind in chosen}, "state": "abc123",
        "processor_seconds": 2.0, "plan": dict(PLAN),
    }  # fmt: skip
    return case | told | more


def line(lines, what):
    return next(each for each in lines if what in each.what)


@pytest.fixture
def page(tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "PAGE", tmp_path / "page.md")
    monkeypatch.setattr(trial, "ROWS", tmp_path / "kept.jsonl")
    monkeypatch.setattr(running, "run", row)
    return trial.PAGE


# Cases --------------------------------------------------------------------------------------------------------
def test_the_plan_is_interleaved_and_follows_from_the_seed():
    plan = cases.planned(PLAN)
    assert plan == cases.planned(PLAN) != cases.planned(PLAN, seed=1)
    assert len({case["seed"] for case in plan}) == len({cases.key(case) for case in plan}) == sum(PLAN.values())
    half = Counter(case["group"] for case in plan[: len(plan) // 2])
    assert all(abs(half[name] - n / 2) <= 1 for name, n in PLAN.items())
    part = {cases.key(case) for case in cases.planned({"single": 30})}
    assert part <= {cases.key(case) for case in plan}  # a smaller plan is a part of a larger one


def test_every_effect_is_hidden_once_a_round_and_in_all_its_forms_in_as_many_rounds():
    singles = cases.planned({"single": 4 * 26})
    for turn in range(4):
        assert {case["effects"][0][0] for case in singles[26 * turn :][:26]} == set(generator.EFFECTS)
    hidden = {(case["effects"][0][0], case["form"]) for case in singles}
    assert hidden == {(kind, i) for kind in generator.EFFECTS for i in range(len(generator.forms(kind)))}


def test_strengths_are_those_of_their_groups_and_stay_on_the_scale():
    strengths = {
        name: {case["effects"][0][1] for case in cases.planned({name: 78})} for name in ("single", "faint", "strong")
    }
    assert strengths == {"single": {0.4, 0.6, 0.8}, "faint": {0.14, 0.21, 0.28}, "strong": {0.88, 1.0}}


def test_effects_get_bases_that_suit_them_and_all_bases_get_cases():
    plan = cases.planned(PLAN)
    assert {case["base"] for case in plan} == {*cases.BASES, *cases.BLEACHING}
    for case in plan:
        kinds = {kind for kind, _ in case["effects"]}
        assert not kinds & cases.NEEDS_REGISTER or case["base"].startswith("emccd")
        assert bool(kinds & cases.NEEDS_BLEACHING) == (case["base"] in cases.BLEACHING)
        if case["group"].startswith("several"):
            assert 3 <= len(kinds) <= 5 and not any(pair <= kinds for pair in cases.APART)
            assert (case["off"] is not None) == (case["group"] == "several_off")
    nulls = Counter(case["base"] for case in plan if case["group"] == "null")
    assert max(nulls.values()) - min(nulls.values()) <= 1
    assert {len(case["effects"]) for case in plan if case["group"] == "several"} == {3, 4, 5}


def test_what_the_catalogue_has_by_now_is_no_test_of_what_is_off_it():
    assert set(forms.CAUGHT_UP) == set(generator.OFF_CATALOGUE) & set(nm.catalogue())
    assert not set(cases.OFF) & set(nm.catalogue())


# Forms --------------------------------------------------------------------------------------------------------
def test_the_table_of_forms_names_what_generator_and_catalogue_have():
    assert set(forms.KNOWN) == set(forms.STRENGTH) == set(generator.EFFECTS)
    for kind, laws in forms.KNOWN.items():
        effect = nm.catalogue()[kind]
        assert set(laws) <= set(generator.forms(kind))
        assert forms.STRENGTH[kind][0] == effect.strength
        known = typing.get_args(effect.model_fields["form"].annotation) if "form" in effect.model_fields else (None,)
        for law in laws.values():
            assert law.form in known, (kind, law.form)
            assert set(law.means) <= set(effect.model_fields), (kind, law.means)
    unseen = [f for kind in generator.EFFECTS for f in generator.forms(kind) if forms.law(kind, f) is None]
    assert len(unseen) == 14 and sum(len(generator.forms(kind)) for kind in generator.EFFECTS) == 81


@pytest.mark.parametrize("kind", generator.EFFECTS)
def test_every_hidden_strength_has_a_number_in_the_catalogues_unit(kind):
    believed = generator.base_model(generator.suitable_base(kind))
    believed["acquisition"].update(n_frames=40, shape_px=[32, 32])
    for i, form in enumerate(generator.forms(kind)):
        weak, strong = (
            generator.make(believed, effects=[(kind, s)], form=i, seed=2, n_molecules=12).truth["effects"][0][
                "parameters"
            ]
            for s in (0.3, 0.9)
        )
        sizes = [forms.hidden_strength(kind, form, truth, believed) for truth in (weak, strong)]
        assert 0 < sizes[0] < sizes[1], (form, sizes)
        law = forms.law(kind, form)
        if law is not None:  # the catalogue takes the law at the truth's values
            values = {name: forms.value(meaning, strong, believed) for name, meaning in law.means.items()}
            nm.catalogue()[kind](**values, **({"form": law.form} if law.form else {}))


def test_uneven_light_means_the_same_here_and_there():
    """The catalogue's light at the truth's value and the generator's, at centre and corner of a square field."""
    believed = generator.base_model("emccd_small")
    from .world import build

    world = build(believed, 1, 1, generator._stream(1, "positions"))
    truth = generator.EFFECTS["illumination_profile"][0](world, 0.6, 0, generator._stream(1, "x"))
    dimming = forms.value(forms.KNOWN["illumination_profile"]["centred"].means["edge_dimming"], truth, believed)
    corner_over_centre = (1 - dimming) ** 2  # (1 − d)^r² with r² = 2 in a corner
    assert world.light_map[0, 0] / world.light_map[32, 32] == pytest.approx(corner_over_centre, rel=0.01)


# Judging ------------------------------------------------------------------------------------------------------
def test_known_and_unseen_forms_are_counted_apart():
    rows = [row(case) for case in cases.planned({"single": 52})]
    known = [each for each in rows if judging.is_known(each)]
    rows[0] = row(rows[0], ["psf_halo", "binding"])
    lines = judging.asked(rows)
    assert line(lines, "known form: first").of == len(known) and line(lines, "unseen form: first").of == 52 - len(known)
    exact = [line(lines, f"{which} form: exactly right") for which in ("known", "unseen")]
    assert sum(each.hits for each in exact) == 51 and exact[0].asked == "≥ 95 %" and exact[1].asked == "≥ 88 %"


def test_movies_of_other_protocols_are_counted_apart():
    """Of four STORM movies with an effect one is told wrong, in one nothing is named that the report says it would not
    have seen; nothing of that is in the lines of what is asked."""
    lit = [row(case) for case in cases.planned({"single": 4, "null": 2})]
    others = [row(case) for case in cases.planned({"single": 4, "null": 2}, 1, "emccd_storm")]
    single = [i for i, each in enumerate(others) if each["group"] == "single"]
    others[single[0]] |= {"chosen": ["psf_halo"], "found": {"psf_halo": {"parameters": {}, "sd": {}, "rivals": []}}}
    others[single[1]] |= {"chosen": [], "detectable": {others[single[1]]["effects"][0][0]: None}}
    text = written(lit + others, "command")
    assert "Blinking, STORM and PALM" not in written(lit, "command")
    assert summary(lit) in text and judging.of_planned_bases(lit + others) == lit
    assert "| `emccd_storm` | 2 / 2 | 2 / 4 | 1 / 4 | 1 / 4 | 1 / 1 | 4 / 4 | 0 / 6 |" in text
    assert "| `emccd_storm` |" not in text.split("## Blinking, STORM and PALM")[0]
    palm = [row(case) | {"plan": {"single": 4}} for case in cases.planned({"single": 3}, 1, "emccd_palm")]
    ran = [each | {"plan": {"single": 4, "null": 2}} for each in others] + palm
    assert "**9 of 10 planned cases ran**" in written(lit + ran, "command")


def test_several_effects_at_once_are_counted_one_by_one():
    """Of three to five hidden, the last is missed in each movie, and a wrong one named in the first."""
    rows = [
        row(case, [kind for kind, _ in case["effects"]][:-1] + ["psf_halo"] * (case["number"] == 0))
        for case in cases.planned({"several": 3, "several_off": 1})
    ]
    rows[-1]["error"]["after"] = 1.3
    lines = judging.asked(rows)
    found, wrong = line(lines, "three to five: effects found"), line(lines, "three to five: wrong names")
    assert (found.hits, found.of, wrong.hits, wrong.of) == (9, 12, 1, 10)
    assert line(lines, "three to five: error").hits == line(lines, "`missing_effect` at ≤ 1.25 floors").of == 2
    assert line(lines, "`unexplained`").hits == 1


def test_what_is_missed_is_held_against_the_strength_that_the_report_says():
    case = next(c for c in cases.planned({"faint": 26}) if c["effects"][0][0] == "em_excess_noise")
    told = row(case, [], verdict="adequate")
    told["truth"][0]["parameters"] = {"excess_noise_factor": 1.7}  # 0.3 from the ideal register
    for seen, within in ((1.75, True), (1.85, False), (None, True)):
        told["detectable"] = {"em_excess_noise": seen}
        assert judging.missed_as_said(told) is within
    told["detectable"] = {}
    assert not judging.missed_as_said(told)
    assert line(judging.beside([told]), "says no strength").hits == 1


def test_intervals_and_sets_hold_the_truth_or_not():
    case = {"group": "single", "number": 0, "seed": 1, "effects": [["row_noise", 0.5]], "form": 0, "off": None}
    case |= {"base": "emccd", "molecules": 50}
    told = row(case)
    told["truth"][0]["parameters"] = {"rms_adu": 2.0}
    told["found"]["row_noise"] = {"parameters": {"rms_adu": 2.19, "form": "rows"}, "sd": {"rms_adu": 0.1}, "rivals": []}
    (pull,) = judging.pulls([told])
    assert pull.inside and pull.same_form and pull.pull == pytest.approx(1.9)
    told["found"]["row_noise"]["parameters"] = {"rms_adu": 2.21, "form": "bursts"}
    (pull,) = judging.pulls([told])
    assert not pull.inside and not pull.same_form
    wrong = row(case, ["laser_flicker"])
    assert judging.credible_sets([wrong]) == [(False, 1)]
    wrong["alternatives"] = [["laser_flicker", "row_noise"]]
    assert judging.credible_sets([wrong]) == [(True, 2)]


def test_names_are_counted_by_the_share_of_the_error_that_they_take_away():
    case = {"group": "several", "number": 0, "seed": 1, "effects": [["row_noise", 0.5], ["stage_drift", 0.5]]}
    case |= {"form": None, "off": None, "base": "emccd", "molecules": 50}
    told = row(case, ["row_noise", "laser_flicker"]) | {"error": {"before": 4.0, "after": 1.2, "floor": 1.0}}
    for kind, without in (("row_noise", 2.0), ("laser_flicker", 1.25)):
        told["found"][kind]["error_without"] = without
    assert judging.share_taken(told, "row_noise") == pytest.approx(0.8 / 1.0)
    assert judging.share_taken(told, "laser_flicker") == pytest.approx(0.05 / 0.25)
    counted = judging.beside([told, row(case)])  # rows that do not say what the error is without are not counted
    much, little = (line(counted, f"names that take away {how}") for how in ("two thirds", "less"))
    assert (much.hits, much.of) == (1, 1) and (little.hits, little.of) == (0, 1)


def test_a_share_has_the_interval_of_wilson():
    low, high = judging.Line("", 97, 100).interval
    z, p, n = NormalDist().inv_cdf(0.975), 0.97, 100
    middle, half = (p + z * z / (2 * n)), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    assert (low, high) == pytest.approx(((middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)))


def test_a_crash_is_a_row_that_is_right_about_nothing(monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("no background")

    monkeypatch.setattr(nm, "diagnose", broken)
    told = running.run(cases.case("null", 0, 0, "emccd_short")) | {"plan": {"null": 1}}
    assert told["verdict"] == "crash" and "ZeroDivisionError" in told["crash"][-1]
    json.dumps(told)
    assert line(judging.asked([told]), "adequate").hits == 0 and "crashed | 1 / 1" in written([told], "x")


# Running and writing ------------------------------------------------------------------------------------------
def test_a_stopped_trial_goes_on_and_two_processes_share_it(page, tmp_path, monkeypatch, capsys):
    shared = ["--groups", SMALL, "--results", str(tmp_path / "rows.jsonl")]
    trial.main([*shared, "--minutes", "0"])
    assert len(running.read(tmp_path / "rows.jsonl")) == 1  # the case that exceeds them is kept
    trial.main([*shared, "--share", "0/2"])
    assert "**15 of 30 planned cases ran** (single 13 of 26, null 2 of 4)" in capsys.readouterr().out
    trial.main([*shared, "--share", "1/2"])
    assert "All 30 cases" in capsys.readouterr().out and not page.exists()
    monkeypatch.setattr(running, "run", lambda case: pytest.fail("it was run already"))
    trial.main(shared)


def test_the_page_is_made_of_rows_alone_and_tells_how_many_ran(page, tmp_path, monkeypatch):
    rows = tmp_path / "rows.jsonl"
    trial.main(["--results", str(rows)])
    monkeypatch.setattr(running, "run", lambda case: pytest.fail("nothing is to be run"))
    trial.main(["--table", str(rows)])
    text = page.read_text()
    assert running.read(trial.ROWS) == running.read(rows)
    assert f"`python -m tests.blind.trial --table {rows}` wrote this page" in text and "abc123" in text
    assert f"All {sum(PLAN.values())} cases that were planned ran." in text
    assert "| nothing hidden: `adequate` | 200 / 200 | 100.0 % | 98.1 … 100.0 % | ≥ 97 % of ≥ 200 |" in text
    some = tmp_path / "some.jsonl"
    some.write_text("".join(f"{each}\n" for each in rows.read_text().splitlines()[:100]))
    trial.main(["--table", str(some)])
    assert f"**100 of {sum(PLAN.values())} planned cases ran**" in page.read_text()
    with pytest.raises(SystemExit):
        trial.main(["--table", str(tmp_path / "none.jsonl")])


def test_a_group_that_did_not_run_is_said_not_to_have_run():
    text = summary([row(case) for case in cases.planned({"null": 2})])
    assert "| strong: first | 0 / 0 | none ran |  | ≥ 95 % |" in text


@pytest.mark.parametrize("wrong", [["--groups", "singles"], ["--groups", "null:x"], ["--share", "2/2"]])
def test_what_cannot_be_run_is_refused(page, wrong):
    with pytest.raises(SystemExit):
        trial.main(wrong)


@pytest.mark.parametrize(
    ("hits", "of", "asked", "met"),
    [
        (19, 20, "≥ 95 %", "yes"), (18, 20, "≥ 95 %", "no"), (1, 20, "≤ 5 %", "yes"), (2, 20, "≤ 5 %", "no"),
        (5, 5, "all", "yes"), (4, 5, "all", "no"), (195, 200, "≥ 97 % of ≥ 200", "yes"),
        (99, 99, "≥ 97 % of ≥ 200", "no"),
    ],
)  # fmt: skip
def test_the_page_says_whether_a_bound_is_met(hits, of, asked, met):
    assert judging.Line("", hits, of, asked).met == met
