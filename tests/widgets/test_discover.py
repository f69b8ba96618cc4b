"""The Discover step: a made-up report shown in every detail, and a real investigation from click to falling error."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from qtpy.QtCore import Qt
from tests.widgets.helpers import Answers

from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.report.words import headline, matching_curve, observable_text
from napari_mufasa.widgets.steps.discover import DiscoverPanel
from napari_mufasa.widgets.turns.session import session_of

_spec = importlib.util.spec_from_file_location("report_example", Path(__file__).parents[1] / "report_example.py")
example = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(example)


@pytest.fixture
def panel(with_movie):
    made = DiscoverPanel(with_movie)
    with_movie.window.add_dock_widget(made)
    return made


def choose_suspects(panel, *kinds):
    """Untick all suspects, tick these."""
    panel.suspects.none_button.click()
    for row in range(panel.suspects.list.count()):
        item = panel.suspects.list.item(row)
        if item.data(Qt.ItemDataRole.UserRole) in kinds:
            item.setCheckState(Qt.CheckState.Checked)
    assert set(panel.suspects.chosen()) == set(kinds)


def cells(table, row):
    return [table.item(row, column).text() for column in range(table.columnCount())]


def test_report_fills_the_tables_and_a_click_shows_the_curve(panel):
    report = example.report()
    panel.show_report(report)
    assert "fast dark-state blinking" in panel.verdict.text().lower()
    assert panel.where.failing.rowCount() == len(report.failing)
    assert cells(panel.where.failing, 0)[1] == f"{report.failing[0]['z']:+.1f}"
    first = cells(panel.what.ranking, 0)
    assert first[1:3] == ["260", "1.04"]
    assert cells(panel.what.ranking, 4)[2] == "–"  # never fitted: no error known
    assert "Check:" in panel.what.details.toPlainText()
    assert "Cannot be told apart from:" in panel.what.details.toPlainText()
    panel.where.failing.selectRow(1)
    curve = matching_curve(report.failing[1]["observable"], report.curves)
    if curve is None:  # a single number is shown among the others
        assert set(panel.where.curve.data["observable"]) == set(report.observables["observable"])
    else:
        assert np.array_equal(panel.where.curve.data["measured"], curve.measured)
    assert list(panel.history.data["error"]) == [2.93, 1.04]
    assert "to 1.06 times the error" in panel.standing.text() and "cannot tell which" in panel.standing.text()


def test_curve_is_the_one_the_observable_belongs_to():
    curves = example.report().curves
    assert matching_curve("autocorrelation_3", curves).name == "autocorrelation"
    assert matching_curve("survival_half", curves).name == "survival"
    assert matching_curve("pixel_lag_1", curves) is None


def test_words_follow_the_evidence():
    adequate = example.report("adequate")
    assert "explains this measurement" in headline(adequate)[0]
    found = example.report("unexplained")
    line, sentence = headline(found)
    assert "blinking" in line  # nothing was added yet, but something would help
    assert "2.93 to 1.04" in sentence


def test_headline_says_when_an_added_effect_did_not_help():
    report = example.report()
    worse = dataclasses.replace(report, verdict="unexplained", error=report.error | {"after": 3.1})
    line, sentence = headline(worse)
    assert "does not lower the error" in line and "Undo" in line
    assert "it is 3.10" in sentence


def test_headline_does_not_praise_what_explains_nothing():
    found = example.report("unexplained")
    weak = [dataclasses.replace(c, evidence=10.0, error_after=2.92) for c in found.ranking]
    line, sentence = headline(dataclasses.replace(found, ranking=weak))
    assert "no effect tried explains it" in line and "blinking comes nearest" in line
    assert "2.93 to 2.92" in sentence
    added = example.report()
    line, _ = headline(
        dataclasses.replace(added, verdict="unexplained", error=added.error | {"after": 2.92}, explained=0.003)
    )
    assert "hardly lowers the error" in line and "Undo" in line


def test_headline_says_which_of_the_effects_added_the_data_do_not_ask_for():
    report = example.report()
    assert "do not ask" not in headline(report)[1]
    needless = [dataclasses.replace(c, p_value=0.7) for c in report.ranking]
    sentence = headline(dataclasses.replace(report, ranking=needless))[1]
    assert "The data do not ask for fast dark-state blinking" in sentence


def test_a_logarithm_is_told_as_one_behind_its_number():
    row = {"title": "variance/mean", "unit": "ln", "measured": 0.5, "before": 0.62, "after": 0.62, "sd": 0.003}
    assert observable_text(row, False).endswith("measured 0.5, model 0.62 ± 0.003 (natural log)")
    assert "± 0.003 (natural log of e⁻)" in observable_text(row | {"unit": "ln e⁻"}, False)


def test_export_writes_report_and_model(panel, tmp_path):
    report = example.report()
    panel.show_report(report)
    panel.export(str(tmp_path))
    told = json.loads((tmp_path / "report.json").read_text())
    assert told["chosen"] == ["triplet_blinking"]
    assert Model.from_json(tmp_path / "model.json") == report.model
    assert (tmp_path / "observables.csv").is_file()


def test_a_report_exported_before_is_replaced_only_when_the_user_says_so(panel, tmp_path, monkeypatch):
    user = Answers(monkeypatch, tmp_path)
    panel.show_report(example.report())
    (tmp_path / "model.json").write_text("of a day's work")
    panel.export_button.click()
    assert user.asked == [f"{tmp_path} already holds model.json. Replace?"]
    assert [file.name for file in tmp_path.iterdir()] == ["model.json"]
    user.replace = True
    panel.export_button.click()
    assert Model.from_json(tmp_path / "model.json") == example.report().model
    assert panel.run_bar.message.text() == f"Written: report.json, model.json and observables.csv in {tmp_path}"


def test_a_check_considers_the_suspects_of_the_look(panel, qtbot, monkeypatch):
    from napari_mufasa import discover

    asked = {}

    def confirm_halves(movie, model, dark, **how):
        asked.update(how)
        raise MufasaError("asked")

    monkeypatch.setattr(discover, "confirm_halves", confirm_halves)
    measurement = session_of(panel.viewer).measurement()
    investigation = SimpleNamespace(believed=session_of(panel.viewer).model)
    panel._examined = {"measurement": measurement, "investigation": investigation, "suspects": ("stage_drift",)}
    with qtbot.waitSignal(panel.run_bar.finished, timeout=20_000):
        panel.check_halves()
    assert asked["effects"] == ("stage_drift",)


def test_a_check_is_of_another_movie_and_goes_with_its_report(panel):
    layer = session_of(panel.viewer).movie_layer
    panel._examined = {"measurement": session_of(panel.viewer).measurement(), "layer": weakref.ref(layer)}
    held = {"against": "B", "shared": 1.0, "both": [], "only_here": [], "only_there": [], "parameters": [],
            "error": {"before": 4.2, "carried": 1.1, "after": 1.0, "floor": 0.9}}  # fmt: skip
    panel.show_report(dataclasses.replace(example.report(), check=held))
    assert "Checked on B" in panel.check.outcome.toPlainText()
    panel.show_report(example.report())
    assert "Checked" not in panel.check.outcome.toPlainText()
    panel.check.other.value = layer
    panel.check.other_button.click()
    assert "choose another movie" in panel.run_bar.message.text() and not panel.run_bar.running


def test_a_verdict_names_its_movie_when_another_is_chosen(panel):
    session = session_of(panel.viewer)
    panel._examined = {"measurement": session.measurement(), "layer": weakref.ref(session.movie_layer)}
    panel.show_report(example.report())
    assert "Found on" not in panel.verdict.text()
    session.set_movie(panel.viewer.add_image(np.zeros((4, 16, 24), np.uint16), name="another"))
    assert "Found on bright, not on the movie chosen" in panel.verdict.text()
    session.set_movie(panel.viewer.layers["bright"])
    assert "Found on" not in panel.verdict.text()


def test_add_without_examination_says_what_to_do(panel):
    panel.show_report(example.report())
    assert panel.what.take_out_button.isEnabled() and not panel.what.add_button.isEnabled()  # it is in the model
    panel.what.take_out_button.click()
    assert "Look for what is missing" in panel.run_bar.message.text()
    panel.run_bar.say("")
    panel.what.ranking.selectRow(1)
    assert panel.what.add_button.isEnabled() and not panel.what.take_out_button.isEnabled()
    panel.what.add_button.click()
    assert "Look for what is missing" in panel.run_bar.message.text()
    panel.what.ranking.selectAll()
    n = panel.what.ranking.rowCount() - 1
    assert panel.what.add_button.text() == f"Add these {n} together" and len(panel.what.to_take_out) == 1


@pytest.mark.slow
def test_drift_is_found_added_and_taken_out_again(viewer, qtbot):
    from tests.widgets.helpers import add_movie

    from napari_mufasa.effects import effect_from_data
    from napari_mufasa.files.layers import movie_space
    from napari_mufasa.samples import puzzle_model
    from napari_mufasa.simulate.movie import simulate

    believed = puzzle_model().with_values({"acquisition.n_frames": 120, "acquisition.shape_px": (48, 48),
                                           "sample.n_molecules": 20})  # fmt: skip
    truth = believed.with_effects(effect_from_data({"kind": "stage_drift", "distance_px": 4.0}))
    layer = add_movie(
        viewer, simulate(truth, seed=4).movie, "drifting", movie_space(believed.acquisition.pixel_size_nm), believed
    )
    session = session_of(viewer)
    session.set_movie(layer)
    session.set_model(believed, "test")
    panel = DiscoverPanel(viewer)
    viewer.window.add_dock_widget(panel)
    choose_suspects(panel, "stage_drift", "triplet_blinking")
    with qtbot.waitSignal(panel.run_bar.finished, timeout=300_000):
        panel.run_bar.run_button.click()
    assert panel.what.ranking.item(0, 0).data(Qt.ItemDataRole.UserRole) == "stage_drift"
    assert not panel.what.undo_button.isEnabled()
    assert session.model.effects == ()
    with qtbot.waitSignal(panel.run_bar.finished, timeout=300_000):
        panel.what.add_button.click()
    errors = [step["error"] for step in panel.report.history]
    assert errors[1] < 0.6 * errors[0]
    assert [effect.kind for effect in session.model.effects] == ["stage_drift"]
    # 4 px were hidden; the fit knows them to a few tenths.
    assert session.model.effects[0].distance_px == pytest.approx(4.0, abs=1.0)
    simulated = panel.layers.simulated
    assert simulated.data.shape == layer.data.shape
    assert simulated.translate[-1] > layer.extent.world[1][-1]  # beside the measured one, not on top of it
    panel.what.undo_button.click()
    assert simulated not in viewer.layers
    assert session.model.effects == ()
    assert panel.what.ranking.item(0, 0).data(Qt.ItemDataRole.UserRole) == "stage_drift"
    panel.what.ranking.selectAll()
    with qtbot.waitSignal(panel.run_bar.finished, timeout=300_000):
        panel.what.add_button.click()
    assert {effect.kind for effect in session.model.effects} == {"stage_drift", "triplet_blinking"}
    rows = {panel.what.ranking.item(row, 0).data(Qt.ItemDataRole.UserRole): row for row in range(2)}
    with_it, without = (float(cells(panel.what.ranking, rows["stage_drift"])[column]) for column in (2, 3))
    assert without > 1.5 * with_it  # the price of taking the drift out
    panel.what.ranking.selectRow(rows["triplet_blinking"])
    with qtbot.waitSignal(panel.run_bar.finished, timeout=300_000):
        panel.what.take_out_button.click()
    assert [effect.kind for effect in session.model.effects] == ["stage_drift"]
    checked = panel.report.check
    assert not checked
    with qtbot.waitSignal(panel.run_bar.finished, timeout=300_000):
        panel.check.halves_button.click()
    checked = panel.report.check
    assert checked["against"] == "the two halves of the field, apart" and "stage_drift" in checked["both"]
    assert "noise alone gives" in panel.check.outcome.toPlainText()
    panel.check.other.value = None
    panel.check.other_button.click()
    assert "choose another movie" in panel.run_bar.message.text()
