"""The docks: the guided workflow Data → Camera → Denoise → Molecules → Model → Compare → Discover, and single steps."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any

from napari.viewer import Viewer
from qtpy.QtCore import QEvent, QSize, Qt
from qtpy.QtWidgets import QScrollArea, QSizePolicy, QTabWidget, QWidget

from napari_mufasa import widgets
from napari_mufasa.widgets.parts.pieces import button, column, made, row, shortcut
from napari_mufasa.widgets.turns.session import session_of, unwrapped

TAB_STYLE = "QTabBar::tab { padding: 3px 4px; }"  # docks are narrow
# napari puts an empty stretch below widgets that do not ask for the height; it would take half of the dock.
TALL = (QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
STEPS = ("Data", "Camera", "Denoise", "Molecules", "Model", "Compare", "Discover")
HOMES = {
    "Data": "data:DataPanel", "Camera": "calibrate:CameraPanel", "Denoise": "denoise:DenoisePanel",
    "Molecules": "traces:MoleculesPanel", "Model": "model:ModelPanel", "Compare": "compare:ComparePanel",
    "Discover": "discover:DiscoverPanel", "Simulate": "simulate:SimulatePanel", "Design": "design:DesignPanel",
}  # fmt: skip


def panel_of(name: str, viewer: Viewer) -> Any:
    """The panel of a step; imported when it is shown."""
    module, _, kind = HOMES[name].partition(":")
    return getattr(import_module(f"napari_mufasa.widgets.steps.{module}"), kind)(viewer)


class Scrolled(QScrollArea):
    """A panel that scrolls up and down only: it is as wide as what is in it needs to be, with room for the scroll bar,
    whatever the theme's font makes of that later."""

    def __init__(self, panel: QWidget | None = None) -> None:
        super().__init__()
        self.setWidgetResizable(True)
        self.setFrameShape(self.Shape.NoFrame)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setSizePolicy(*TALL)
        self.setWidget(panel)

    def event(self, event: Any) -> bool:
        if event.type() == QEvent.Type.LayoutRequest:
            self.updateGeometry()
        return super().event(event)

    def sizeHint(self) -> QSize:
        return QSize(420, 700)

    def minimumSizeHint(self) -> QSize:
        panel, height = self.widget(), super().minimumSizeHint().height()
        needed = panel.minimumSizeHint().width() + 18 if panel is not None else 0
        return QSize(max(360, min(560, needed)), height)


class WorkflowWidget(QWidget):
    """All steps in one dock. Each works alone and keeps its state; movie, model and results flow forward."""

    def __init__(self, napari_viewer: Viewer) -> None:
        super().__init__()
        self.setSizePolicy(*TALL)
        self.viewer = unwrapped(napari_viewer)
        self.session = session_of(self.viewer)
        self.steps: dict[str, QWidget] = {}
        self.tabs = made(QTabWidget, usesScrollButtons=False, styleSheet=TAB_STYLE)
        for number, name in enumerate(STEPS, 1):
            self.tabs.setTabToolTip(self.tabs.addTab(Scrolled(), f"{number}\n{name}"), f"{name} (Alt+{number})")
            shortcut(self, f"Alt+{number}", partial(self.show_step, number - 1))
        self.tabs.currentChanged.connect(self._on_shown)
        self.back_button = button("‹ Back", partial(self.go, -1), "Step before (Alt+Left)")
        self.next_button = button("Next ›", partial(self.go, 1), "Next step (Alt+Right)")
        shortcut(self, "Alt+Left", partial(self.go, -1))
        shortcut(self, "Alt+Right", partial(self.go, 1))
        bottom = row(self.back_button, QWidget(), self.next_button, shares=(0, 1))
        column(self, self.tabs, bottom, shares=(1,), margins=(2, 2, 2, 2)).addStrut(440)
        self._on_shown(0)

    def sizeHint(self) -> QSize:
        return QSize(460, 760)

    def step(self, name: str) -> Any:
        """The panel of a step, made when it is first needed."""
        if name not in self.steps:
            self.steps[name] = panel = panel_of(name, self.viewer)
            scrolled: Any = self.tabs.widget(STEPS.index(name))
            scrolled.setWidget(panel)
        return self.steps[name]

    def go(self, by: int) -> None:
        self.show_step(self.tabs.currentIndex() + by)

    def show_step(self, index: int) -> None:
        self.tabs.setCurrentIndex(index)  # Qt lets be what is no step

    def _on_shown(self, index: int) -> None:
        self.step(STEPS[index])
        self.back_button.setEnabled(index > 0)
        self.next_button.setEnabled(index < len(STEPS) - 1)


class Single(Scrolled):
    """One step as a dock of its own; made without a viewer it is the step's magicgui widget alone."""

    step_name = ""

    def __new__(cls, napari_viewer: Viewer | None = None) -> Any:
        if napari_viewer is None:
            return getattr(widgets, f"{HOMES[cls.step_name].partition(':')[0]}_widget")()
        return super().__new__(cls)

    def __init__(self, napari_viewer: Viewer) -> None:
        self.panel = panel_of(self.step_name, unwrapped(napari_viewer))
        super().__init__(self.panel)


def single(step: str) -> type[Single]:
    """The dock of a step, for the manifest."""
    return type(f"{step}Widget", (Single,), {"step_name": step})


SimulateWidget, DenoiseWidget, ExtractTracesWidget = single("Simulate"), single("Denoise"), single("Molecules")
CompareWidget, DiscoverWidget = single("Compare"), single("Discover")
CalibrateWidget, DesignWidget = single("Camera"), single("Design")
