"""A finding checked on data that it has not seen: the halves of a field, another movie of the same set-up."""

from dataclasses import replace

import pytest

import napari_mufasa as nm
from napari_mufasa.discover import confirmation
from napari_mufasa.effects import effect_class
from napari_mufasa.report.words import check_lines, summary

ROWS = effect_class("row_noise")(rms_adu=30.0)
LIGHT = effect_class("laser_drift")(change=-0.25)
KINDS = ["row_noise", "laser_drift"]


def model(width=96):
    return nm.preset("FF").with_values(
        {"acquisition.n_frames": 60, "acquisition.shape_px": (48, width), "sample.n_molecules": width // 2}
    )


def recorded(*effects, seed):
    """A movie of the set-up, and its dark frames."""
    truth = model().with_effects(*effects)
    return nm.simulate(truth, seed=seed).movie, nm.simulate_dark(truth, 20, seed + 50)


@pytest.fixture(scope="module")
def here():
    movie, dark = recorded(ROWS, seed=5)
    return nm.diagnose(movie, model(), dark, effects=KINDS, seed=2)


def test_the_same_set_up_is_found_again_and_another_is_not(here):
    """Row noise is in both movies, falling light only in the second; its strength is the same in both."""
    assert here.chosen == ["row_noise"]
    steps = []
    movie, dark = recorded(ROWS, LIGHT, seed=6)
    held = nm.confirm(here, movie, model(), dark, effects=KINDS, seed=3, progress=lambda *at: steps.append(at))
    found = held.to_dict("OTHER.tif")
    assert found["both"] == ["row_noise"] and found["only_there"] == ["laser_drift"] and not found["only_here"]
    assert held.shared == 0.5
    (row,) = found["parameters"]
    assert row["agree"] and row["here"] == pytest.approx(30.0, rel=0.1) and row["there"] == pytest.approx(30.0, rel=0.1)
    error = found["error"]
    # The completed model has the rows but not the falling light: between the one believed and the one completed there.
    assert error["floor"] * 1.5 < error["carried"] < error["before"] and error["after"] < 1.5 * error["floor"]
    assert steps and all(done <= total for done, total in steps)
    lines = check_lines(found)
    assert lines[0] == "Checked on OTHER.tif: 1 of 2 effects are named in both."
    assert any(line.startswith("Only there: ") for line in lines)
    told = replace(here, check=found)
    assert set(lines) < {line.strip() for line in summary(told)} and told.to_dict()["check"] == found
    assert check_lines(here.check) == [] and here.to_dict()["check"] == {}


def test_parameters_that_do_not_agree_are_told(here):
    """A second movie with rows half as noisy: ten standard deviations away."""
    movie, dark = recorded(effect_class("row_noise")(rms_adu=15.0), seed=7)
    found = nm.confirm(here, movie, model(), dark, effects=KINDS, seed=3).to_dict("OTHER.tif")
    (row,) = found["parameters"]
    assert not row["agree"] and found["both"] == ["row_noise"]
    assert any(line.startswith("Row read-out noise, ") and "there" in line for line in check_lines(found))


def test_effects_believed_of_the_whole_field_are_seen_from_the_half_that_is_checked(here, monkeypatch):
    """The left half lies in columns 0 to 2 of its own width, the right one in −1 to 1."""
    carried = []
    monkeypatch.setattr(confirmation, "diagnose", lambda movie, model, *_, **__: replace(here, model=model))
    monkeypatch.setattr(confirmation, "_carried", lambda completed, *_, **__: carried.append(completed) or (1.0, 1.0))
    movie = nm.simulate(model(), seed=5).movie
    nm.confirm_halves(movie, model().with_effects(effect_class("illumination_profile")()))
    assert carried[0].effects_refer_to.columns == (-1.0, 1.0)
    nm.confirm_halves(movie, model())
    assert carried[1].effects_refer_to is None


@pytest.mark.parametrize(
    ("verdicts", "shared", "words"),
    [
        (("adequate", "adequate"), 1.0, "nothing is missing in either"),
        (("unexplained", "unexplained"), 0.0, "no effect is named in either"),
        (("adequate", "unexplained"), 0.0, "no effect is named in either"),
    ],
)
def test_no_name_is_not_no_failure(here, verdicts, shared, words):
    """Two movies that nothing explains share no finding."""
    one, other = (replace(here, verdict=verdict, chosen=[]) for verdict in verdicts)
    error = {"before": 2.0, "carried": 2.0, "after": 2.0, "floor": 1.0}
    held = nm.discover.Confirmation(one, other, error)
    assert held.shared == shared
    assert check_lines(held.to_dict("OTHER.tif"))[0] == f"Checked on OTHER.tif: {words}."


def test_two_halves_of_a_field_say_the_same():
    movie, dark = recorded(ROWS, seed=8)
    held = nm.confirm_halves(movie, model(), dark, effects=KINDS, seed=2)
    assert held.shared == 1.0 and held.both == ["row_noise"]
    assert held.error["carried"] < 1.5 * held.error["floor"] < held.error["before"]
    assert held.here.model.acquisition.shape_px == held.there.model.acquisition.shape_px == (48, 48)


def test_halves_must_be_large_enough():
    with pytest.raises(nm.MufasaError, match="48 to give halves"):
        nm.confirm_halves(nm.simulate(model(40), seed=1).movie[:, :40], model(40))
    with pytest.raises(nm.MufasaError, match="give what diagnose"):
        nm.confirm({}, nm.simulate(model(40), seed=1).movie, model(40))
