"""The guided workflow: one dock with the steps Data → Camera → Denoise → Molecules → Model → Compare → Discover."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QSize, Qt
from qtpy.QtWidgets import (
    QButtonGroup,
    QHBoxLayout,
    QScrollArea,
    QSizePolicy,
    QStackedWidget,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from napari_mufasa.widgets.parts.panel import button, shortcut
from napari_mufasa.widgets.turns.session import session_of, unwrapped

if TYPE_CHECKING:
    from napari.viewer import Viewer

# napari's own style hides which tool button is checked.
STEP_STYLE = """
QToolButton { padding: 3px 1px; border: none; border-bottom: 3px solid transparent; border-radius: 0px; }
QToolButton:checked { border-bottom: 3px solid #4a90d9; background: rgba(74, 144, 217, 45); }
QToolButton:hover { background: rgba(128, 128, 128, 60); }
"""
STEPS = ("Data", "Camera", "Denoise", "Molecules", "Model", "Compare", "Discover")


class WorkflowWidget(QWidget):
    """All steps in one dock. Each works alone and keeps its state; movie, model and results flow forward."""

    def __init__(self, napari_viewer: Viewer) -> None:
        super().__init__()
        self._viewer = unwrapped(napari_viewer)
        self.session = session_of(self._viewer)
        self.steps: dict[str, QWidget] = {}
        self.buttons = QButtonGroup(self)
        self.buttons.setExclusive(True)
        row = QHBoxLayout()
        row.setSpacing(1)
        self.stack = QStackedWidget()
        for number, name in enumerate(STEPS):
            made = QToolButton()
            made.setText(f"{number + 1}\n{name}")
            made.setCheckable(True)
            made.setToolTip(f"Step {number + 1}: {name} (Alt+{number + 1})")
            made.setAccessibleName(f"Step {number + 1}: {name}")
            made.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
            shortcut(self, f"Alt+{number + 1}", partial(self.show_step, number))
            made.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
            made.setMinimumWidth(made.fontMetrics().horizontalAdvance(name) + 6)
            made.setStyleSheet(STEP_STYLE)
            self.buttons.addButton(made, number)
            row.addWidget(made, 1)
            self.stack.addWidget(QWidget())
        self.buttons.idClicked.connect(self.show_step)
        self.back_button = button("‹ Back", partial(self.go, -1), "Step before (Alt+Left)")
        self.next_button = button("Next ›", partial(self.go, 1), "Next step (Alt+Right)")
        shortcut(self, "Alt+Left", partial(self.go, -1))
        shortcut(self, "Alt+Right", partial(self.go, 1))
        bottom = QHBoxLayout()
        bottom.addWidget(self.back_button)
        bottom.addStretch(1)
        bottom.addWidget(self.next_button)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(2, 2, 2, 2)
        layout.addLayout(row)
        layout.addWidget(self.stack, 1)
        layout.addLayout(bottom)
        self.setMinimumWidth(440)
        fill_the_dock(self)
        self.show_step(0)

    def sizeHint(self) -> QSize:
        return QSize(460, 760)

    def step(self, name: str) -> Any:
        """The panel of a step, made when it is first needed."""
        if name not in self.steps:
            self.steps[name] = panel = panel_class(name)(self._viewer)
            index = STEPS.index(name)
            placeholder: Any = self.stack.widget(index)
            self.stack.removeWidget(placeholder)
            placeholder.deleteLater()
            self.stack.insertWidget(index, Scrolled(panel))
        return self.steps[name]

    def go(self, by: int) -> None:
        self.show_step(self.stack.currentIndex() + by)

    def show_step(self, index: int) -> None:
        index = max(0, min(index, len(STEPS) - 1))
        self.step(STEPS[index])
        self.stack.setCurrentIndex(index)
        chosen: Any = self.buttons.button(index)
        chosen.setChecked(True)
        self.back_button.setEnabled(index > 0)
        self.next_button.setEnabled(index < len(STEPS) - 1)


HOMES = {
    "Data": "data:DataPanel", "Camera": "calibrate:CameraPanel", "Denoise": "denoise:DenoisePanel",
    "Molecules": "traces:MoleculesPanel", "Model": "model:ModelPanel", "Compare": "compare:ComparePanel",
    "Discover": "discover:DiscoverPanel", "Simulate": "simulate:SimulatePanel", "Design": "design:DesignPanel",
}  # fmt: skip


def panel_class(name: str) -> Any:
    """The panel of a step; imported when it is shown."""
    module, _, kind = HOMES[name].partition(":")
    return getattr(import_module(f"napari_mufasa.widgets.steps.{module}"), kind)


class Scrolled(QScrollArea):
    """A panel that scrolls up and down only: it is as wide as what is in it needs to be, with room for the scroll bar,
    whatever the theme's font makes of that later."""

    def __init__(self, panel: QWidget) -> None:
        super().__init__()
        self.setWidgetResizable(True)
        self.setFrameShape(QScrollArea.Shape.NoFrame)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setWidget(panel)

    def minimumSizeHint(self) -> QSize:
        panel: Any = self.widget()
        return QSize(min(560, panel.minimumSizeHint().width() + 18), super().minimumSizeHint().height())


def fill_the_dock(widget: QWidget) -> None:
    """napari puts an empty stretch below widgets that do not ask for the height; it would take half of the dock."""
    widget.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)


class _Single(QWidget):
    """One step as a dock of its own."""

    step_name = ""

    def __init__(self, napari_viewer: Viewer) -> None:
        super().__init__()
        self.panel = panel_class(self.step_name)(unwrapped(napari_viewer))
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(Scrolled(self.panel))
        self.setMinimumWidth(360)
        fill_the_dock(self)

    def sizeHint(self) -> QSize:
        return QSize(420, 700)


def single(step: str) -> type[_Single]:
    """The dock of a step, for the manifest."""
    return type(f"{step}Widget", (_Single,), {"step_name": step})


SimulateWidget, DenoiseWidget, ExtractTracesWidget = single("Simulate"), single("Denoise"), single("Molecules")
CompareWidget, DiscoverWidget = single("Compare"), single("Discover")
CalibrateWidget, DesignWidget = single("Camera"), single("Design")
