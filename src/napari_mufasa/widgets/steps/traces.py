"""Extract traces (step Molecules): molecules as points, the trace of the one you click."""

import contextlib
import weakref
from collections.abc import Generator
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from magicgui import magic_factory
from napari.layers import Layer, Points, Tracks
from pydantic import PositiveInt

from napari_mufasa.checks import counted
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import Measurement, measurement_of, stored
from napari_mufasa.files.traces import COMPANION
from napari_mufasa.report.lines import efficiency_line, molecule_line, moving_line
from napari_mufasa.report.offscreen import drawing
from napari_mufasa.report.words import listed
from napari_mufasa.spots.aperture import Profile
from napari_mufasa.widgets.parts.edits import TypedEdit
from napari_mufasa.widgets.parts.forms import begin
from napari_mufasa.widgets.parts.layers import added, ours, points_on, space_of
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.parameters import Believed, Channels, Dark, DarkFrames, Movie
from napari_mufasa.widgets.parts.pieces import button, takes_the_rest
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.turns.session import believed
from napari_mufasa.widgets.turns.steering import steering

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from napari_mufasa.channels import PairedTraces
    from napari_mufasa.model.setup import Camera
    from napari_mufasa.traces import TraceSet

KEPT, REJECTED = "#7bd88f", "#e0605e"
HINT = "The trace of the molecule you click appears here."
PROFILES = [("whole spot (PSF-weighted)", "psf"), ("sum over the spot", "sum"), ("brightest pixel", "brightest_pixel")]
COLUMNS = (
    "molecule", "brightness", "snr", "bleaching_frame", "n_steps", "n_blinks", "kept", "reason", "found_frames",
    "diffusion_px2_per_frame", "drift_y_px_per_frame", "drift_x_px_per_frame",
    "efficiency", "efficiency_sd",
)  # fmt: skip
COUNT: dict[str, Any] = {"widget_type": TypedEdit, "of": PositiveInt}


def traces(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    model: Believed = None,
    profile: Annotated[Profile, {"label": "Signal", "widget_type": "ComboBox", "choices": PROFILES}] = "psf",
    threshold_sigma: Annotated[float, {"label": "Threshold (σ)", "min": 2, "max": 50, "step": 0.5}] = 6.0,
    min_snr: Annotated[float, {"label": "Smallest SNR", "min": 0, "max": 100, "step": 0.25}] = 1.0,
    window: Annotated[int | None, COUNT | {"label": "Window (frames)", "empty": "whole movie"}] = None,
    best: Annotated[int | None, COUNT | {"label": "Keep best", "empty": "all"}] = None,
    follow_drift: Annotated[bool, {"label": "follow the drift of the field"}] = False,
    follow_molecules: Annotated[bool, {"label": "follow each molecule"}] = False,
    channels: Channels = None,
) -> list[Layer]:
    """Find single molecules and read their traces with the model's camera.

    Parameters:
        profile: What is read as the molecule's signal in a frame
        threshold_sigma: How far above the noise a spot must stand
        min_snr: Smallest level over noise per frame
        window: Keep only so many frames just before each molecule bleaches, in which it is active
        best: Keep only the best so many
        follow_molecules: Link each molecule's places from frame to frame and read its trace along its path
        channels: Registered donor and acceptor of whole frames: molecules are looked for in the light of both

    Returns:
        One layer of points, a row of features for each candidate, frames counted from the layer's first; its
        ``metadata["napari_mufasa"]["traces"]`` is the `TraceSet`, which begins with "first_frame" of the layer. Of
        molecules that were followed also a layer of tracks, the paths of the kept ones; of two channels also the places
        in the acceptor's, and the `PairedTraces` under "pair".
    """
    from napari_mufasa.traces import extract_traces

    progress, cancel = steering()
    measurement, camera = measurement_of(movie, dark, dark_frames), believed(model, movie).camera
    options: dict[str, Any] = {
        "profile": profile, "threshold_value": threshold_sigma, "min_snr": min_snr, "window": window, "best": best,
        "follow_drift": follow_drift, "follow_molecules": follow_molecules, "unit": measurement.unit,
        "progress": progress, "cancel": cancel,
    }  # fmt: skip
    if channels is not None:
        return pair_on(movie, pair_of(measurement, camera, channels, options), measurement.first_frame)
    found = extract_traces(measurement.movie, camera, measurement.dark, **options)
    points = molecules_on(movie, found, measurement.first_frame)
    return [points] if found.path_px is None or not found.kept.any() else [
        points, paths_on(movie, found, measurement.first_frame)
    ]  # fmt: skip


def pair_of(measured: Measurement, camera: "Camera", channels: Any, options: dict[str, Any]) -> "PairedTraces":
    """Donor and acceptor, of channels registered or the path of their file."""
    from napari_mufasa.channels import Channels as Registered
    from napari_mufasa.channels import extract_pair

    registered = channels if isinstance(channels, Registered) else Registered.from_json(channels)
    return extract_pair(measured.movie, camera, registered, measured.dark, **options)


traces_widget = magic_factory(traces, call_button="Extract traces", widget_init=begin)


def pair_on(movie: Any, paired: "PairedTraces", first_frame: int = 0) -> list[Layer]:
    """Rings at all candidates in the donor's channel, and the same molecules in the acceptor's."""
    sides = paired.channels
    donors = molecules_on(movie, paired.together, first_frame, sides.donor.corner_px, pair=paired)
    acceptors = molecules_on(movie, paired.acceptor, first_frame, sides.acceptor.corner_px)
    acceptors.name = f"{movie.name}, acceptors"
    return [donors, acceptors]


def molecules_on(
    movie: Any, found: "TraceSet", first_frame: int = 0, corner_px: Any = (0, 0), **more: Any
) -> Points:  # fmt: skip
    """Rings at all candidates, green where they are kept; `first_frame` of the movie is the first that was read, and
    their places count from a corner (y, x)."""
    from napari_mufasa.traces.table import counted_from

    table = counted_from(first_frame, found.molecules)
    features = table[[name for name in COLUMNS if name in table]].copy()
    places = found.positions_px + np.asarray(corner_px)
    features.insert(1, "y", places[:, 0])
    features.insert(2, "x", places[:, 1])
    return points_on(
        movie, places, features.reset_index(drop=True), f"{movie.name}, molecules",
        size=max(4.0, 5 * found.sigma_px), face_color="transparent", border_width=0.07, border_color=_colours(table),
        symbol="disc", ours={"traces": found, "first_frame": first_frame, "movie": weakref.ref(movie)} | more,
    )  # fmt: skip


def paths_on(movie: Any, found: "TraceSet", first_frame: int = 0) -> Tracks:
    """Where the kept molecules were followed to; `first_frame` of the movie is the first that was read."""
    from napari_mufasa.traces.table import path_table

    table, diffusion = path_table(found), found.molecules.set_index("molecule")["diffusion_px2_per_frame"]
    return Tracks(
        table.to_numpy(float), name=f"{movie.name}, paths", features={"diffusion": table["molecule"].map(diffusion)},
        tail_length=found.all_traces.shape[1], **space_of(movie, first_frame),
    )  # fmt: skip


class MoleculesPanel(Panel):
    """The points carry their traces, so that those of an earlier run, or fewer than at first, show their own."""

    words = "Find single molecules and read their traces. Click a ring to see its trace."
    run_label, running = "Extract traces", "Extracting traces"
    form_factory = traces_widget

    def build(self) -> None:
        self.points: Any = None  # the layer looked at
        self.shown: int | None = None
        self.plot = PlotCanvas(self.viewer, HINT, 240)
        takes_the_rest(self.plot, 240)
        self.toggle_button = button(
            "Keep / reject this molecule", lambda: self.guarded(self._toggle),
            "Your own judgement; the reason column says so", enabled=False,
        )  # fmt: skip
        caption = "Folder for traces.csv and molecules.csv"
        self.save_button = self.saver("Save traces as CSV …", caption, self.save, files=self.files)
        self.add(self.form.native, self.run_bar, last=self.plot)
        self.add(self.toggle_button, self.save_button)

    @property
    def traces(self) -> "TraceSet | None":
        """Those of the layer looked at."""
        found: TraceSet | None = stored(self.points, "traces")
        return found

    @property
    def first_frame(self) -> int:
        """The frame of the movie with which they begin."""
        return stored(self.points, "first_frame") or 0

    def prepare(self) -> None:
        self.session.measurement()
        movie = self.form.movie.value
        self.call(self.running, lambda layers: self._show(layers, movie))

    # results ----------------------------------------------------------------------------------------
    def _show(self, layers: list[Any], movie: Any) -> Generator[None, None, None]:
        if movie not in self.viewer.layers:
            raise MufasaError(
                f"layer {movie.name} was removed while its traces were read: open it again to see the molecules"
            )
        points: Points = layers[0]
        self.points, self.shown = points, None
        found: Any = self.traces
        n, candidates = int(found.kept.sum()), counted(len(found.molecules), "candidate")
        said = f"{counted(n, 'molecule')} kept of {candidates}."
        pair, followed = stored(points, "pair"), found.path_px is not None
        more = f" F{moving_line(found)[1:]}." if followed else f" E{efficiency_line(pair)[1:]}." if pair else ""
        self.run_bar.say(said + more)
        self.plot.clear(HINT)
        points.selected_data.events.items_changed.connect(self._on_selection)
        points.mouse_drag_callbacks.append(self._on_click)
        self.save_button.setEnabled(True)
        yield from added(self.viewer, [*layers[1:], points])
        points.mode = "select"  # napari refuses it to a hidden layer
        self.session.set_traces(found, movie)

    def select(self, molecule: int) -> None:
        """Show the trace of one candidate."""
        import pandas as pd

        from napari_mufasa.traces.table import counted_from

        traces, first = self.traces, self.first_frame
        if traces is None or not 0 <= molecule < len(traces.molecules):
            return
        self.shown = molecule
        self.toggle_button.setEnabled(True)
        found = counted_from(first, traces.molecules.iloc[[molecule]]).iloc[0]
        trace, lit = traces.all_traces[molecule], traces.lit[molecule]
        frames = np.arange(first, first + len(trace))
        if (pair := stored(self.points, "pair")) is not None:
            both = pair.donor.all_traces[molecule], pair.acceptor.all_traces[molecule], pair.efficiency[molecule]
            data = pd.DataFrame({"frame": frames, "donor": both[0], "acceptor": both[1], "efficiency": both[2]})
            picture = drawing("donor_and_acceptor", *(_from_start(side, first) for side in both), whole=True)
        else:
            data = pd.DataFrame({"frame": frames, "photoelectrons": trace, "on": lit})
            whole, on = _from_start(trace, first), _from_start(lit, first) > 0
            picture = drawing("lit_trace", whole, on, int(found["bleaching_frame"]))
        self.plot.draw(picture, data, molecule_line(found))

    def _on_selection(self, *_: Any) -> None:
        """The layer's own table says which molecule a point is; one that was added by hand is none."""
        with contextlib.suppress(RuntimeError):  # bound to the layers; the panel may be closed by now
            active = self.viewer.layers.selection.active
            layer = active if stored(active, "traces") is not None else self.points
            index = min(layer.selected_data, default=None) if layer is not None else None
            if index is not None and index < len(layer.features):
                self.points, molecule = layer, layer.features["molecule"].iloc[index]
                if molecule == molecule:
                    self.select(int(molecule))

    def _on_click(self, layer: Points, event: Any) -> None:
        """In pan/zoom mode napari does not select what is clicked."""
        if layer.mode == "pan_zoom":
            index = layer.get_value(
                event.position, view_direction=event.view_direction, dims_displayed=event.dims_displayed, world=True
            )
            layer.selected_data = set() if index is None else {int(index)}

    def _toggle(self) -> None:
        if self.traces is None or self.shown is None:
            return
        keep = not bool(self.traces.molecules["kept"].iloc[self.shown])
        traces = ours(self.points)["traces"] = self.traces.with_kept([self.shown], keep)
        if (pair := stored(self.points, "pair")) is not None:
            ours(self.points)["pair"] = pair.with_kept([self.shown], keep)
        features = self.points.features.copy()
        rows = features["molecule"] == self.shown
        features.loc[rows, ["kept", "reason"]] = [keep, traces.molecules["reason"].iloc[self.shown]]
        self.points.features = features
        self.points.border_color = _colours(features)
        self.session.set_traces(traces, ours(self.points)["movie"]())
        self.select(self.shown)

    def files(self) -> tuple[str, ...]:
        """What `save` writes."""
        if stored(self.points, "pair") is not None:
            return "traces.csv", "donor.csv", "acceptor.csv", "molecules.csv", "channels.json", COMPANION
        followed = self.traces is not None and self.traces.path_px is not None
        return "traces.csv", "molecules.csv", *(("paths.csv",) if followed else ()), COMPANION

    def save(self, folder: str) -> str:
        """Write the kept traces and the table of candidates (docs/files.md)."""
        from napari_mufasa.channels.table import write_pair
        from napari_mufasa.traces.table import write_traces

        assert self.traces is not None
        if (pair := stored(self.points, "pair")) is not None:
            write_pair(folder, pair, first_frame=self.first_frame)
        else:
            write_traces(folder, self.traces, first_frame=self.first_frame)
        return f"{listed(self.files())} in {folder}"


def _from_start(values: "NDArray[Any]", first_frame: int) -> "NDArray[np.float64]":
    """Values (frame,) from the movie's first frame on; nothing is known of those before `first_frame`."""
    return np.pad(np.asarray(values, float), (first_frame, 0), constant_values=np.nan)


def _colours(table: "pd.DataFrame") -> list[str]:
    return [KEPT if kept else REJECTED for kept in table["kept"]]
