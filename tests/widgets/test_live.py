"""Live distance: it follows the model, off the interface's thread, and an overtaken answer is never shown."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from napari_mufasa.compare.quick import quick_distance, thinned
from napari_mufasa.widgets.turns.jobs import Latest
from napari_mufasa.widgets.turns.live import live_of
from napari_mufasa.widgets.turns.session import session_of


@pytest.fixture
def latest(viewer):
    made = Latest(20)
    yield made
    made.drop()


def test_only_the_newest_of_many_requests_is_worked_on(latest, qtbot):
    worked, came = [], []
    latest.arrived.connect(lambda outcome: came.append(outcome.value))
    for i in range(30):
        latest.request(lambda _cancel, i=i: worked.append(i) or i)
    qtbot.waitUntil(lambda: not latest.busy, timeout=5000)
    assert came == [29] and worked == [29]


@pytest.mark.parametrize("polite", [True, False], ids=["work that looks at cancel", "work that does not"])
def test_answer_overtaken_by_a_newer_request_is_never_shown(latest, qtbot, polite):
    came, started, release = [], threading.Event(), threading.Event()
    latest.arrived.connect(lambda outcome: came.append(outcome.value))

    def slow(cancel):
        started.set()
        while not release.wait(0.01) and not (polite and cancel()):
            pass
        return "old"

    latest.request(slow)
    qtbot.waitUntil(started.is_set, timeout=5000)
    latest.request(lambda _cancel: "new")
    qtbot.wait(100)
    release.set()
    qtbot.waitUntil(lambda: not latest.busy, timeout=5000)
    qtbot.wait(50)
    assert came == ["new"]


def test_error_of_the_work_arrives(latest, qtbot):
    came = []
    latest.arrived.connect(came.append)
    latest.request(lambda _cancel: 1 / 0)
    qtbot.waitUntil(lambda: bool(came), timeout=5000)
    assert isinstance(came[0].error, ZeroDivisionError)


def test_distance_follows_the_model_while_it_is_edited(make_napari_viewer, qtbot, run, bright_model, bright_movie):
    from tests.widgets.helpers import add_movie

    from napari_mufasa.files.layers import movie_space

    viewer = make_napari_viewer(strict_qt="raise", show=True)
    _, workflow = viewer.window.add_plugin_dock_widget("napari-mufasa", "MUFASA workflow")
    session = session_of(viewer)
    session.set_movie(
        add_movie(
            viewer, bright_movie.movie, "bright", movie_space(bright_model.acquisition.pixel_size_nm), bright_model
        )
    )
    session.set_model(bright_model, "test")
    workflow.show_step(4)
    model = workflow.step("Model")
    assert "extract traces" in model.live.text()
    workflow.show_step(3)
    run(workflow.step("Molecules"))
    workflow.show_step(4)
    live = live_of(session)
    settle(live, qtbot)
    true = live.distance
    assert true.w1 < 3 * true.floor.high
    power = model.parts["excitation"].form["power_density_w_per_cm2"].native
    seen = []
    for watts in ("22", "26", "34"):  # typed faster than anything can be worked out
        power.setText(watts)
        power.editingFinished.emit()
    live.changed.connect(lambda: seen.append(live.distance and live.distance.w1))
    settle(live, qtbot)
    assert session.model.excitation.power_density_w_per_cm2 == 34
    assert live.distance.w1 == quick_distance(session.traces, session.model).w1  # of the last value typed
    assert live.distance.w1 > 1.5 * true.w1
    assert f"{live.distance.w1:.2f}" in model.live.text()
    assert set(seen) == {live.distance.w1}
    # the Compare step shows the same, with the histograms on top of each other
    workflow.show_step(5)
    compare = workflow.step("Compare")
    power.setText("20")
    power.editingFinished.emit()
    settle(live, qtbot)
    assert live.distance.w1 == pytest.approx(true.w1)  # the same chance: only the model makes a difference
    compare.tabs.setCurrentIndex(2)
    assert f"{live.distance.w1:.2f}" in compare.live_line.text()
    assert set(compare.live.data.columns) == {"signal per frame (photoelectrons)", "measured", "mufasa"}
    assert np.allclose(compare.live.data["measured"].sum(), compare.live.data["mufasa"].sum(), rtol=0.05)
    qtbot.waitUntil(lambda: not compare.live.busy and not compare.live.picture.pixmap().isNull(), timeout=20_000)
    # of another movie there are no traces yet
    session.set_movie(add_movie(viewer, bright_movie.movie, "other", movie_space(100.0), bright_model))
    assert live.distance is None and "extract traces" in compare.live_line.text() and compare.live.data is None


def test_a_distance_of_traces_that_are_no_longer_those_of_the_session_is_dropped(with_movie, qtbot, bright_movie):
    from tests.widgets.helpers import add_movie

    session = session_of(with_movie)
    live = live_of(session)
    session.set_traces(SimpleNamespace(), session.movie_layer)
    started, release, ended = threading.Event(), threading.Event(), threading.Event()

    def slow(_cancel):
        started.set()
        release.wait(5)
        ended.set()
        return SimpleNamespace(known="of the first movie")

    live.request(slow)
    qtbot.waitUntil(started.is_set, timeout=5000)
    session.set_movie(add_movie(with_movie, bright_movie.movie, "other", {}))
    assert session.traces is None
    release.set()
    qtbot.waitUntil(lambda: ended.is_set() and not live.busy, timeout=5000)
    assert live.distance is None and live._known is None


def test_thinned_traces_are_few_and_tell_nearly_the_same_distance():
    from napari_mufasa import compare

    rng = np.random.default_rng(5)
    measured = rng.gamma(2, rng.gamma(20, 5, (500, 1)), (500, 2000)).astype(np.float32)
    simulated = rng.gamma(2, 105, (64, 2000)).astype(np.float32)
    left = thinned(measured, 50_000)
    assert left.shape == (500, 100)
    assert np.allclose(left.mean(axis=1), measured.mean(axis=1), rtol=1e-5)
    off = compare.wasserstein(left, measured)
    assert 0 < off < 0.003 * measured.std()
    assert abs(compare.wasserstein(left, simulated) - compare.wasserstein(measured, simulated)) <= off + 1e-4
    rng_of_floor = [np.random.default_rng(0) for _ in range(2)]
    floors = [compare.floor(t, n_splits=20, rng=r).value for t, r in zip((left, measured), rng_of_floor, strict=True)]
    assert floors[0] == pytest.approx(floors[1], rel=0.02)
    few = measured[:, :90]
    assert thinned(few, 50_000) is few


def settle(live, qtbot):
    end = time.monotonic() + 30
    qtbot.waitUntil(lambda: not live.busy or time.monotonic() > end, timeout=31_000)
    qtbot.wait(20)
    assert not live.busy
