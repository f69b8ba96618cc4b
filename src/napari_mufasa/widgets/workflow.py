"""The docks: the guided workflow Data → Camera → Denoise → Molecules → Model → Compare → Discover, and single steps."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any

from napari.viewer import Viewer
from qtpy.QtCore import QSize, Qt
from qtpy.QtWidgets import QScrollArea, QSizePolicy, QTabWidget, QWidget

from napari_mufasa.widgets.parts.pieces import button, column, made, row, shortcut
from napari_mufasa.widgets.turns.session import session_of, unwrapped

TAB_STYLE = "QTabBar::tab { padding: 3px 4px; }"  # docks are narrow
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
        never = Qt.ScrollBarPolicy.ScrollBarAlwaysOff
        super().__init__(widgetResizable=True, frameShape=self.Shape.NoFrame, horizontalScrollBarPolicy=never)  # type: ignore[call-arg]
        self.setWidget(panel)

    def minimumSizeHint(self) -> QSize:
        panel, hint = self.widget(), super().minimumSizeHint()
        return QSize(min(560, panel.minimumSizeHint().width() + 18), hint.height()) if panel is not None else hint


class Dock(QWidget):
    """What napari puts into a dock; `size`: the least width, and the size it would like to have."""

    size_px = (360, 420, 700)

    def __init__(self, napari_viewer: Viewer) -> None:
        super().__init__()
        # napari puts an empty stretch below widgets that do not ask for the height; it would take half of the dock.
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
        self.fill(unwrapped(napari_viewer))
        layout: Any = self.layout()
        layout.addStrut(self.size_px[0])

    def fill(self, viewer: Viewer) -> None:
        raise NotImplementedError(f"{type(self).__name__} has no fill()")

    def sizeHint(self) -> QSize:
        return QSize(*self.size_px[1:])


class WorkflowWidget(Dock):
    """All steps in one dock. Each works alone and keeps its state; movie, model and results flow forward."""

    size_px = (440, 460, 760)

    def fill(self, viewer: Viewer) -> None:
        self.viewer, self.session = viewer, session_of(viewer)
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
        column(self, self.tabs, bottom, shares=(1,), margins=(2, 2, 2, 2))
        self._on_shown(0)

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


class Single(Dock):
    """One step as a dock of its own."""

    step_name = ""

    def fill(self, viewer: Viewer) -> None:
        self.panel = panel_of(self.step_name, viewer)
        column(self, Scrolled(self.panel))


def single(step: str) -> type[Single]:
    """The dock of a step, for the manifest."""
    return type(f"{step}Widget", (Single,), {"step_name": step})


SimulateWidget, DenoiseWidget, ExtractTracesWidget = single("Simulate"), single("Denoise"), single("Molecules")
CompareWidget, DiscoverWidget = single("Compare"), single("Discover")
CalibrateWidget, DesignWidget = single("Camera"), single("Design")
