"""The Molecules step (widget Extract traces): molecules as points, the trace of the one you click."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from qtpy.QtWidgets import QCheckBox, QComboBox, QDoubleSpinBox, QFileDialog, QFormLayout, QPushButton, QSpinBox

from napari_mufasa.errors import MufasaError
from napari_mufasa.widgets.parts.layers import points_on, slim
from napari_mufasa.widgets.parts.panel import MovieChooser, Panel, takes_the_rest
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.turns.gently import gently, shown_later, without_labels
from napari_mufasa.widgets.turns.jobs import guarded

if TYPE_CHECKING:
    import pandas as pd
    from napari.layers import Image, Points

    from napari_mufasa.traces import TraceSet

KEPT, REJECTED = "#7bd88f", "#e0605e"
PROFILES = {"whole spot (PSF-weighted)": "psf", "sum over the spot": "sum", "brightest pixel": "brightest_pixel"}
COLUMNS = ("molecule", "brightness", "snr", "bleaching_frame", "n_steps", "n_blinks", "kept", "reason")


class MoleculesPanel(Panel):
    """Over `napari_mufasa.extract_traces`."""

    title = "Molecules"
    words = "Find single molecules and read their traces. Click a ring to see its trace."
    run_label = "Extract traces"

    def build(self) -> None:
        self.chooser = MovieChooser(self.session)
        self.column.addWidget(self.chooser)
        self.profile = QComboBox()
        self.profile.addItems(list(PROFILES))
        slim(self.profile)
        self.profile.setToolTip("What is read as the molecule's signal in a frame")
        self.threshold = QDoubleSpinBox()
        self.threshold.setRange(2, 50)
        self.threshold.setValue(float(preference("steps.threshold_sigma")))
        self.threshold.setSingleStep(0.5)
        self.threshold.setSuffix(" σ")
        self.threshold.setToolTip("How far above the noise a spot must stand")
        self.min_snr = QDoubleSpinBox()
        self.min_snr.setRange(0, 100)
        self.min_snr.setValue(1)
        self.min_snr.setSingleStep(0.25)
        self.min_snr.setToolTip("Smallest level over noise per frame")
        self.window_frames = QSpinBox()
        self.window_frames.setRange(0, 100_000)
        self.window_frames.setSpecialValueText("whole movie")
        self.window_frames.setSuffix(" frames before bleaching")
        self.window_frames.setToolTip("Keep only the frames just before each molecule bleaches, in which it is active")
        self.best = QSpinBox()
        self.best.setRange(0, 100_000)
        self.best.setSpecialValueText("all")
        self.best.setToolTip("Keep only the best so many")
        self.drift = QCheckBox("follow the drift of the field")
        form = QFormLayout()
        for label, widget in (
            ("Signal", self.profile), ("Threshold", self.threshold), ("Smallest SNR", self.min_snr),
            ("Window", self.window_frames), ("Keep best", self.best), ("", self.drift),
        ):  # fmt: skip
            form.addRow(label, widget)
        self.column.addLayout(form)
        self.column.addWidget(self.run_bar)
        self.plot = PlotCanvas(self.viewer, "The trace of the molecule you click appears here.", 240)
        takes_the_rest(self.plot, 240)
        self.column.addWidget(self.plot, 1)
        self.toggle_button = QPushButton("Keep / reject this molecule")
        self.toggle_button.setToolTip("Your own judgement; the reason column says so")
        self.toggle_button.setEnabled(False)
        self.toggle_button.clicked.connect(lambda: guarded(self.run_bar, self._toggle))
        self.save_button = QPushButton("Save traces as CSV …")
        self.save_button.setEnabled(False)
        self.save_button.clicked.connect(self._ask_and_save)
        self.column.addWidget(self.toggle_button)
        self.column.addWidget(self.save_button)
        self.traces: TraceSet | None = None
        self.points: Points | None = None
        self._sets: WeakKeyDictionary[Any, TraceSet] = WeakKeyDictionary()
        self.shown: int | None = None

    def prepare(self) -> None:
        measurement, camera = self.session.measurement(), self.session.model.camera
        layer = self.session.movie_layer
        options: dict[str, Any] = {
            "profile": PROFILES[self.profile.currentText()],
            "threshold_value": self.threshold.value(),
            "min_snr": self.min_snr.value(),
            "window": self.window_frames.value() or None,
            "best": self.best.value() or None,
            "follow_drift": self.drift.isChecked(),
        }

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.traces import extract_traces

            return extract_traces(
                measurement.movie,
                camera,
                measurement.dark,
                unit=measurement.unit,
                progress=progress,
                cancel=cancel,
                **options,
            )

        self.start("Extracting traces", work, lambda traces: self._show(traces, layer, measurement.name))

    # results ----------------------------------------------------------------------------------------
    def _show(self, traces: TraceSet, layer: Image | None, name: str) -> Generator[None, None, None]:
        self.traces, self.shown = traces, None
        if layer is None or layer not in self.viewer.layers:
            raise MufasaError(
                f"layer {name} was removed while its traces were read: open it again to see the molecules"
            )
        table = traces.molecules
        kept = int(table["kept"].sum())
        self.run_bar.say(f"{kept} molecules kept of {len(table)} candidates.")
        points = self.points = points_on(
            layer, traces.positions_px, _features(table), f"{name}, molecules",
            size=max(4.0, 5 * traces.sigma_px), face_color="transparent", border_width=0.07,
            border_color=_colours(table), symbol="disc", visible=False,
        )  # fmt: skip
        yield
        with gently(self.viewer):
            self.viewer.add_layer(points)
        without_labels(self.viewer, points)
        self._sets[points] = traces
        points.selected_data.events.items_changed.connect(self._on_selection)
        points.mouse_drag_callbacks.append(self._on_click)
        self.save_button.setEnabled(True)
        self.plot.clear()
        yield from shown_later(self.viewer, points)
        points.mode = "select"  # napari refuses it to a hidden layer
        self.session.set_result("traces", traces)

    def select(self, molecule: int) -> None:
        """Show the trace of one candidate."""
        import pandas as pd

        if self.traces is None or not 0 <= molecule < len(self.traces.molecules):
            return
        self.shown = molecule
        self.toggle_button.setEnabled(True)
        row = self.traces.molecules.iloc[molecule]
        verdict = "kept" if row["kept"] else f"rejected: {row['reason']}"
        bleached = int(row["bleaching_frame"])
        title = (
            f"<b>Molecule {molecule}</b> at y {row['y_px']:.1f}, x {row['x_px']:.1f} px · "
            f"{row['brightness']:.0f} e⁻ per frame, SNR {row['snr']:.1f} · "
            f"{f'bleached at frame {bleached}' if bleached >= 0 else 'not bleached'} · {verdict}"
        )
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
            self._sets[self.points] = self.traces
            features = self.points.features.copy()
            rows = features["molecule"] == self.shown
            features.loc[rows, ["kept", "reason"]] = [keep, self.traces.molecules["reason"].iloc[self.shown]]
            self.points.features = features
            self.points.border_color = _colours(features)
        self.select(self.shown)

    def _ask_and_save(self) -> None:
        folder = QFileDialog.getExistingDirectory(self, "Folder for traces.csv and molecules.csv")
        if folder:
            guarded(self.run_bar, lambda: self.save(folder))

    def save(self, folder: str) -> None:
        """Write traces.csv and molecules.csv (SPEC.md §10)."""
        from pathlib import Path

        import pandas as pd

        from napari_mufasa.files.whole import write_table

        if self.traces is None:
            raise MufasaError("no traces yet: extract them first")
        kept = self.traces.molecules.loc[self.traces.kept, "molecule"].to_numpy()
        n, frames = self.traces.traces.shape
        long = pd.DataFrame(
            {
                "molecule": np.repeat(kept, frames),
                "frame": np.tile(np.arange(frames), n),
                "photoelectrons": self.traces.traces.ravel(),
            }
        )
        write_table(Path(folder) / "traces.csv", long)
        write_table(Path(folder) / "molecules.csv", self.traces.molecules)
        self.run_bar.say(f"Written: traces.csv and molecules.csv in {folder}")


def _features(table: pd.DataFrame) -> pd.DataFrame:
    features = table[[name for name in COLUMNS if name in table]].copy()
    features.insert(1, "y", table["y_px"])
    features.insert(2, "x", table["x_px"])
    return features.reset_index(drop=True)


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
