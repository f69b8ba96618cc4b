"""Extract traces (step Molecules): molecules as points, the trace of the one you click."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from typing import TYPE_CHECKING, Annotated, Any
from weakref import WeakKeyDictionary

import numpy as np
from napari.layers import Layer

from napari_mufasa.errors import MufasaError
from napari_mufasa.report.lines import molecule_line
from napari_mufasa.spots.aperture import Profile
from napari_mufasa.widgets.parts.edits import NumberEdit
from napari_mufasa.widgets.parts.forms import step_form
from napari_mufasa.widgets.parts.layers import added, ours, points_on
from napari_mufasa.widgets.parts.panel import Panel, button, takes_the_rest
from napari_mufasa.widgets.parts.parameters import Believed, Dark, DarkFrames, Movie
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.turns.jobs import guarded
from napari_mufasa.widgets.turns.session import believed, measurement_of
from napari_mufasa.widgets.turns.steering import steering

if TYPE_CHECKING:
    import pandas as pd
    from magicgui.widgets import FunctionGui
    from napari.layers import Points
    from napari.viewer import Viewer

    from napari_mufasa.traces import TraceSet

KEPT, REJECTED = "#7bd88f", "#e0605e"
PROFILES = [("whole spot (PSF-weighted)", "psf"), ("sum over the spot", "sum"), ("brightest pixel", "brightest_pixel")]
COLUMNS = ("molecule", "brightness", "snr", "bleaching_frame", "n_steps", "n_blinks", "kept", "reason")


def traces(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    model: Believed = None,
    profile: Annotated[
        Profile,
        {
            "label": "Signal", "widget_type": "ComboBox", "choices": PROFILES,
            "tooltip": "What is read as the molecule's signal in a frame",
        },
    ] = "psf",
    threshold_sigma: Annotated[
        float,
        {
            "label": "Threshold (σ)", "min": 2, "max": 50, "step": 0.5,
            "tooltip": "How far above the noise a spot must stand",
        },
    ] = 6.0,
    min_snr: Annotated[
        float,
        {
            "label": "Smallest SNR", "min": 0, "max": 100, "step": 0.25,
            "tooltip": "Smallest level over noise per frame",
        },
    ] = 1.0,
    window: Annotated[
        int | None,
        {
            "widget_type": NumberEdit, "whole": True, "min": 1, "label": "Window (frames)", "empty": "whole movie",
            "tooltip": "Keep only so many frames just before each molecule bleaches, in which it is active",
        },
    ] = None,
    best: Annotated[
        int | None,
        {
            "widget_type": NumberEdit, "whole": True, "min": 1, "label": "Keep best", "empty": "all",
            "tooltip": "Keep only the best so many",
        },
    ] = None,
    follow_drift: Annotated[bool, {"label": "follow the drift of the field"}] = False,
) -> list[Layer]:  # fmt: skip
    """Find single molecules and read their traces with the model's camera.

    Returns one layer of points, a row of features for each candidate; its ``metadata["napari_mufasa"]["traces"]`` is
    the `TraceSet`.
    """
    from napari_mufasa.traces import extract_traces

    progress, cancel = steering()
    measurement, camera = measurement_of(movie, dark, dark_frames), believed(model, movie).camera
    found = extract_traces(
        measurement.movie, camera, measurement.dark, unit=measurement.unit, progress=progress, cancel=cancel,
        profile=profile, threshold_value=threshold_sigma, min_snr=min_snr, window=window, best=best,
        follow_drift=follow_drift,
    )  # fmt: skip
    return [molecules_on(movie, found)]


def traces_widget(viewer: Viewer | None = None, call_button: Any = "Extract traces") -> FunctionGui[..., Any]:
    return step_form(traces, viewer, call_button, {"threshold_sigma": "steps.threshold_sigma"})


def molecules_on(movie: Any, found: TraceSet, **more: Any) -> Points:
    """Rings at all candidates, green where they are kept."""
    table = found.molecules
    features = table[[name for name in COLUMNS if name in table]].copy()
    features.insert(1, "y", table["y_px"])
    features.insert(2, "x", table["x_px"])
    return points_on(
        movie, found.positions_px, features.reset_index(drop=True), f"{movie.name}, molecules",
        size=max(4.0, 5 * found.sigma_px), face_color="transparent", border_width=0.07, border_color=_colours(table),
        symbol="disc", ours={"traces": found} | more,
    )  # fmt: skip


class MoleculesPanel(Panel):
    words = "Find single molecules and read their traces. Click a ring to see its trace."
    run_label, running = "Extract traces", "Extracting traces"
    form_factory = traces_widget

    def build(self) -> None:
        self.plot = PlotCanvas(self.viewer, "The trace of the molecule you click appears here.", 240)
        takes_the_rest(self.plot, 240)
        self.add(self.form.native, self.run_bar)
        self.column.addWidget(self.plot, 1)
        self.toggle_button = button(
            "Keep / reject this molecule", lambda: guarded(self.run_bar, self._toggle),
            "Your own judgement; the reason column says so", enabled=False,
        )  # fmt: skip
        self.save_button = button(
            "Save traces as CSV …",
            lambda: self.ask_where("Folder for traces.csv and molecules.csv", self.save),
            enabled=False,
        )
        self.add(self.toggle_button, self.save_button)
        self.traces: TraceSet | None = None
        self.points: Any = None
        self._sets: WeakKeyDictionary[Any, TraceSet] = WeakKeyDictionary()
        self.shown: int | None = None

    def prepare(self) -> None:
        self.measurement()
        movie = self.form.movie.value
        self.call(self.running, lambda layers: self._show(layers[0], movie))

    # results ----------------------------------------------------------------------------------------
    def _show(self, points: Points, movie: Any) -> Generator[None, None, None]:
        if movie not in self.viewer.layers:
            raise MufasaError(
                f"layer {movie.name} was removed while its traces were read: open it again to see the molecules"
            )
        found: TraceSet = ours(points)["traces"]
        self.traces, self.points, self.shown = found, points, None
        self.run_bar.say(f"{int(found.kept.sum())} molecules kept of {len(found.molecules)} candidates.")
        self.plot.clear()
        self._sets[points] = found
        points.selected_data.events.items_changed.connect(self._on_selection)
        points.mouse_drag_callbacks.append(self._on_click)
        self.save_button.setEnabled(True)
        yield from added(self.viewer, [points])
        points.mode = "select"  # napari refuses it to a hidden layer
        self.session.set_result("traces", found)

    def select(self, molecule: int) -> None:
        """Show the trace of one candidate."""
        import pandas as pd

        if self.traces is None or not 0 <= molecule < len(self.traces.molecules):
            return
        self.shown = molecule
        self.toggle_button.setEnabled(True)
        row = self.traces.molecules.iloc[molecule]
        bleached, title = int(row["bleaching_frame"]), molecule_line(row)
        trace, lit = self.traces.all_traces[molecule], self.traces.lit[molecule]
        data = pd.DataFrame({"frame": np.arange(len(trace)), "photoelectrons": trace, "on": lit})
        self.plot.draw(lambda figure: _draw_trace(figure, trace, lit, bleached), data, title)

    def _select_point(self, layer: Points, index: int) -> None:
        """Points may come from an earlier run, or be fewer than at first: the layer's own table says which it is."""
        if layer not in self._sets or index >= len(layer.features):
            return
        self.points, self.traces = layer, self._sets[layer]
        molecule = layer.features["molecule"].iloc[index]
        if molecule == molecule:  # a point added by hand has none
            self.select(int(molecule))

    def _on_selection(self, *_: Any) -> None:
        # Bound to the layers; the panel may be closed by now.
        with contextlib.suppress(RuntimeError):
            active = self.viewer.layers.selection.active
            layer = active if active in self._sets else self.points
            chosen = sorted(layer.selected_data) if layer is not None else []
            if layer is not None and chosen:
                self._select_point(layer, int(chosen[0]))

    def _on_click(self, layer: Points, event: Any) -> None:
        """In pan/zoom mode a click does not select; look what is under the mouse."""
        if layer.mode != "pan_zoom":
            return
        index = layer.get_value(
            event.position, view_direction=event.view_direction, dims_displayed=event.dims_displayed, world=True
        )
        if index is not None:
            with contextlib.suppress(RuntimeError):
                self._select_point(layer, int(index))

    def _toggle(self) -> None:
        if self.traces is None or self.shown is None:
            return
        keep = not bool(self.traces.molecules["kept"].iloc[self.shown])
        self.traces = self.traces.with_kept([self.shown], keep)
        self.session.set_result("traces", self.traces)
        if self.points is not None and self.points in self.viewer.layers:
            self._sets[self.points] = ours(self.points)["traces"] = self.traces
            features = self.points.features.copy()
            rows = features["molecule"] == self.shown
            features.loc[rows, ["kept", "reason"]] = [keep, self.traces.molecules["reason"].iloc[self.shown]]
            self.points.features = features
            self.points.border_color = _colours(features)
        self.select(self.shown)

    def save(self, folder: str) -> None:
        """Write traces.csv and molecules.csv (docs/files.md)."""
        from napari_mufasa.traces.table import write_traces

        if self.traces is None:
            raise MufasaError("no traces yet: extract them first")
        write_traces(folder, self.traces)
        self.run_bar.say(f"Written: traces.csv and molecules.csv in {folder}")


def _colours(table: pd.DataFrame) -> list[str]:
    return [KEPT if kept else REJECTED for kept in table["kept"]]


def _draw_trace(figure: Any, trace: Any, lit: Any, bleached: int) -> None:
    from napari_mufasa.report import plots as plotting

    axes = figure.subplots()
    plotting.trace(axes, trace)
    at_the_bottom = axes.get_xaxis_transform()
    axes.fill_between(np.arange(len(trace)), 0, 0.025, where=lit, color=KEPT, linewidth=0, transform=at_the_bottom)
    if bleached >= 0:
        axes.axvline(bleached, color=REJECTED, linewidth=1, linestyle="--")
    axes.set_xlabel("frame (green: on; dashed: bleached)")
