"""The viewer's widgets: magicgui over the package's functions. Qt and napari are imported only here, on first use.

from napari_mufasa.widgets import denoise_widget

widget = denoise_widget()           # docked in a viewer: movie, dark frames and model are those of all steps there
widget.movie.value = layer          # an Image layer; the others as they are in widget.asdict()
layers = widget()                   # new layers; they are also added to the viewer, if there is one
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from napari_mufasa.widgets.steps.calibrate import calibrate_widget
    from napari_mufasa.widgets.steps.compare import compare_widget
    from napari_mufasa.widgets.steps.denoise import denoise_widget
    from napari_mufasa.widgets.steps.design import design_widget
    from napari_mufasa.widgets.steps.discover import discover_widget
    from napari_mufasa.widgets.steps.power import power_widget
    from napari_mufasa.widgets.steps.propose import propose_widget
    from napari_mufasa.widgets.steps.register import register_widget
    from napari_mufasa.widgets.steps.simulate import simulate_widget
    from napari_mufasa.widgets.steps.traces import traces_widget

__all__ = [
    "calibrate_widget", "compare_widget", "denoise_widget", "design_widget", "discover_widget", "power_widget",
    "propose_widget", "register_widget", "simulate_widget", "traces_widget",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"napari_mufasa.widgets has no {name}; it has {', '.join(__all__)}")
    return getattr(import_module(f"napari_mufasa.widgets.steps.{name.removesuffix('_widget')}"), name)
