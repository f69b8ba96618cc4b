"""Without a mouse: every control has a name, the Tab key reaches it, and keys change the step and run it."""

from __future__ import annotations

import pytest
from qtpy.QtCore import Qt
from qtpy.QtWidgets import (
    QAbstractButton,
    QAbstractItemView,
    QAbstractSpinBox,
    QComboBox,
    QHeaderView,
    QLabel,
    QLineEdit,
)

from napari_mufasa.widgets.workflow import STEPS, WorkflowWidget

CONTROLS = (QAbstractButton, QLineEdit, QAbstractSpinBox, QComboBox, QAbstractItemView)


@pytest.fixture
def workflow(make_napari_viewer, qtbot, bright_model, bright_movie):
    from tests.widgets.helpers import add_movie

    from napari_mufasa.files.layers import movie_space
    from napari_mufasa.widgets.turns.session import session_of

    viewer = make_napari_viewer(strict_qt="raise", show=True)
    session_of(viewer).set_movie(
        add_movie(viewer, bright_movie.movie, "bright", movie_space(bright_model.acquisition.pixel_size_nm))
    )
    made = WorkflowWidget(viewer)
    viewer.window.add_dock_widget(made)
    viewer.window.activate()
    return made


def controls(panel):
    """What a user operates; parts of combo and spin boxes are theirs."""
    found = []
    for kind in CONTROLS:
        found += [w for w in panel.findChildren(kind) if w.isVisibleTo(panel) and w.isEnabled()]
    inner = (QComboBox, QAbstractSpinBox)
    found = [w for w in found if not isinstance(w, QHeaderView)]
    return [w for w in found if not isinstance(w.parent(), inner) and not w.objectName().startswith("qt_")
            and not any(isinstance(p, inner) for p in parents(w))]  # fmt: skip


def name_of(widget, panel):
    """As Qt tells a screen reader: the name given, the text on it, or the label it belongs to."""
    own = widget.text() if isinstance(widget, QAbstractButton) else ""
    labels = [label.text() for label in panel.findChildren(QLabel) if label.buddy() is widget]
    return widget.accessibleName() or own or "".join(labels)


def parents(widget):
    while (widget := widget.parentWidget()) is not None:
        yield widget


@pytest.mark.parametrize("name", STEPS)
def test_every_control_has_a_name_and_is_reached_by_tab(workflow, name):
    workflow.show_step(STEPS.index(name))
    panel = workflow.step(name)
    operated = controls(panel)
    assert operated
    nameless = [w for w in operated if not name_of(w, panel)]
    assert not nameless, [(type(w).__name__, w.toolTip()) for w in nameless]
    unreached = [w for w in operated if not w.focusPolicy() & Qt.FocusPolicy.TabFocus and w.focusProxy() is None]
    assert not unreached, [(type(w).__name__, w.toolTip()) for w in unreached]
    # The chain that Tab follows comes past all of them.
    chain, at = set(), panel
    while at not in chain:
        chain.add(at)
        at = at.nextInFocusChain()
    assert set(operated) <= chain


def test_the_dock_is_as_wide_as_the_step_that_is_shown(workflow, qtbot):
    for number, name in enumerate(STEPS):
        workflow.show_step(number)
        panel, scrolled = workflow.step(name), workflow.tabs.widget(number)
        qtbot.waitUntil(lambda p=panel, s=scrolled: p.width() <= s.viewport().width(), timeout=5000)  # else it is cut


def test_keys_change_the_step_and_run_it(workflow, qtbot):
    workflow.show_step(0)
    # Keys go to a window that is active, and without a window manager it takes a while to be.
    workflow.window().activateWindow()
    qtbot.waitUntil(workflow.window().isActiveWindow, timeout=10_000)
    workflow.tabs.tabBar().setFocus()
    qtbot.waitUntil(workflow.tabs.tabBar().hasFocus, timeout=10_000)
    qtbot.keyClick(workflow.tabs.tabBar(), Qt.Key.Key_4, Qt.KeyboardModifier.AltModifier)
    assert STEPS[workflow.tabs.currentIndex()] == "Molecules"
    panel = workflow.step("Molecules")
    threshold = panel.form.threshold_sigma.native
    threshold.setFocus()
    with qtbot.waitSignal(panel.run_bar.finished, timeout=60_000):
        qtbot.keyClick(threshold, Qt.Key.Key_Return, Qt.KeyboardModifier.ControlModifier)
    assert panel.traces is not None
    qtbot.keyClick(threshold, Qt.Key.Key_Right, Qt.KeyboardModifier.AltModifier)
    assert STEPS[workflow.tabs.currentIndex()] == "Model"
