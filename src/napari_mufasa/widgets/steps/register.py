"""Two channels of an image splitter, in step Data: their rectangles, one of them as the movie, and the registration."""

from typing import Annotated, Any, Literal

import numpy as np
from magicgui import magic_factory
from napari.layers import Image, Shapes
from qtpy.QtWidgets import QWidget

from napari_mufasa.channels import Channels, Rectangle
from napari_mufasa.channels import register as find_map
from napari_mufasa.channels.rectangle import around, rectangle
from napari_mufasa.checks import counted
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import contrast, stack_of
from napari_mufasa.files.movies import METADATA_KEY
from napari_mufasa.report.lines import channels_lines
from napari_mufasa.widgets.parts.edits import LayerEdit
from napari_mufasa.widgets.parts.forms import begin, shared
from napari_mufasa.widgets.parts.layers import added, plane_of, space_of
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.pieces import Words, button, column, row
from napari_mufasa.widgets.turns.session import model_in
from napari_mufasa.widgets.turns.steering import steering

Split = Literal["left-right", "right-left", "top-bottom", "bottom-top"]
SPLITS = [
    ("donor left, acceptor right", "left-right"), ("donor right, acceptor left", "right-left"),
    ("donor top, acceptor bottom", "top-bottom"), ("donor bottom, acceptor top", "bottom-top"),
]  # fmt: skip
Beads = Annotated[Image, {"widget_type": LayerEdit, "label": "Beads"}]
Regions = Annotated[Shapes | None, {"widget_type": LayerEdit, "kind": "shapes", "label": "Rectangles"}]
SIDES = ("donor", "acceptor")


def register(
    beads: Beads,
    regions: Regions = None,
    split: Annotated[Split, {"label": "Halves", "widget_type": "ComboBox", "choices": SPLITS}] = "left-right",
) -> Channels:
    """Find which place of the acceptor's channel is which of the donor's.

    Parameters:
        beads: Beads that both channels show, or a movie whose molecules both show
        regions: A Shapes layer whose first shape is around the donor's channel and whose second around the acceptor's
        split: Which halves of the frames they are, where there are no rectangles

    Returns:
        The `Channels`: rectangles, transform, and how far off the beads are.
    """
    progress, cancel = steering()
    donor, acceptor = sides_of(beads, regions, split)
    return find_map(stack_of(beads), donor, acceptor, progress=progress, cancel=cancel)


register_widget = magic_factory(register, call_button="Register", widget_init=begin)


def sides_of(movie: Any, regions: Any, split: Split) -> tuple[Rectangle, Rectangle]:
    """The rectangles of donor and acceptor in a movie's frames."""
    height, width = (int(n) for n in stack_of(movie).shape[1:])
    if regions is None:
        donor, acceptor = (rectangle(name, (height, width)) for name in split.split("-"))
        return donor, acceptor
    if len(regions.data) < 2:
        raise MufasaError(
            f"layer {regions.name} has {counted(len(regions.data), 'shape')}: draw one around the donor's "
            "channel, then one around the acceptor's"
        )
    donor, acceptor = (around(_in_pixels(vertices, regions, movie), (height, width)) for vertices in regions.data[:2])
    return donor, acceptor


def _in_pixels(vertices: Any, regions: Any, movie: Any) -> Any:
    """Vertices (vertex, 2) of a shape in pixels of a movie that lies somewhere else, or has another scale."""
    drawn, shown = plane_of(regions), plane_of(movie)
    world = np.asarray(vertices)[:, -2:] * drawn["scale"] + drawn["translate"]
    return (world - shown["translate"]) / shown["scale"]


def rectangles_on(movie: Any, split: Split) -> Shapes:
    """Two rectangles around the halves of a movie, to be moved."""
    outlines = []
    for side in sides_of(movie, None, split):
        (y0, x0), (y1, x1) = (side.y0 - 0.5, side.x0 - 0.5), (side.y1 - 0.5, side.x1 - 0.5)
        outlines.append([[y0, x0], [y0, x1], [y1, x1], [y1, x0]])
    return Shapes(
        outlines, shape_type="rectangle", name=f"{movie.name}, channels", face_color="transparent",
        edge_color=["#63d297", "#ffa94d"], edge_width=max(1.0, max(movie.data.shape[-2:]) / 200),
        features={"channel": SIDES}, text={"string": "{channel}", "color": "white", "anchor": "center"},
        **plane_of(movie),
    )  # fmt: skip


def part_of(movie: Any, side: Rectangle, name: str, role: str | None = None) -> Image:
    """One channel of a movie, or of its dark frames, in its place, as a layer of its own; nothing is copied."""
    frame_px = tuple(int(n) for n in stack_of(movie).shape[1:])
    data, space, model = side.crop(stack_of(movie)), space_of(movie), model_in(movie)
    at = np.array(space["translate"][-2:]) + side.corner_px * np.array(space["scale"][-2:])
    space["translate"] = (space["translate"][0], *(float(v) for v in at))
    kept = dict(movie.metadata.get(METADATA_KEY) or {}) | ({} if role is None else {"role": role})
    kept.pop("dark_layer", None)
    if model is not None:
        kept["model"] = side.model(model, (frame_px[0], frame_px[1])).to_dict()
    return Image(
        data, name=name, contrast_limits=contrast(data), colormap=movie.colormap.name,
        metadata={METADATA_KEY: kept} if kept else {}, **space,
    )  # fmt: skip


class TwoChannels(QWidget):
    """The part of step Data where a frame holds two channels."""

    def __init__(self, panel: Panel) -> None:
        super().__init__()
        self.panel, self.viewer, self.session = panel, panel.viewer, panel.session
        self.form: Any = shared(register_widget(call_button=False), self.viewer)
        self.said = Words()
        self.draw_button = button(
            "Draw rectangles", lambda: panel.guarded(self.draw), "A Shapes layer with two rectangles to be moved"
        )
        self.take_buttons = {
            name: button(
                f"Take the {name}'s", lambda which=number: panel.guarded(lambda: self.take(which)),  # type: ignore[misc]
                f"Make the {name}'s channel the movie of all steps; nothing is copied",
            )
            for number, name in enumerate(SIDES)
        }  # fmt: skip
        self.register_button = button(
            "Register", lambda: panel.guarded(self.register),
            "Find which place of the acceptor's channel is which of the donor's; step Molecules then reads both",
        )  # fmt: skip
        panel.run_bar.besides.append(self.register_button)
        self.save_button = panel.saver("Save channels …", "Rectangles and transform", self.save, "channels.json")
        column(
            self, Words("Frames of an image splitter: work on one channel, or register both."), self.form.native,
            row(self.draw_button, *self.take_buttons.values()), row(self.register_button, self.save_button),
            self.said,
        )  # fmt: skip

    def draw(self) -> None:
        """Rectangles around the halves, chosen in the form."""
        shapes = rectangles_on(self._beads(), self.form.split.value)
        self.viewer.add_layer(shapes)
        shapes.mode = "select"
        self.form.regions.value = shapes

    def take(self, which: int) -> None:
        """Go on with one channel of the session's movie; its dark frames follow."""
        movie, dark = self.session.movie_layer, self.session.dark_layer
        if movie is None:
            raise MufasaError("no movie chosen: open one, then take a channel of it")
        side = sides_of(movie, self.form.regions.value, self.form.split.value)[which]
        layers: list[Any] = []
        if dark is not None and dark.data.shape[-2:] == movie.data.shape[-2:]:
            layers.append(part_of(dark, side, f"{dark.name}, {SIDES[which]}", "dark frames"))
        layers.append(part_of(movie, side, f"{movie.name}, {SIDES[which]}"))
        for _ in added(self.viewer, layers):
            pass
        movie.visible = False
        dark_frames = self.session.dark_frames  # are those of its channels, too
        self.session.set_movie(layers[-1])
        self.session.set_dark_frames(dark_frames)
        if len(layers) > 1:
            self.session.set_dark(layers[0])

    def register(self) -> None:
        """Register in the background."""
        values, run = self.form.asdict(), self.form.__wrapped__
        self._beads()
        self.panel.run_bar.start("Registering", lambda: run(**values), self.show_channels)

    def show_channels(self, found: Channels) -> None:
        """What was found; step Molecules reads both channels from now on."""
        self.session.set_channels(found)
        self.said.say("<br>".join(channels_lines(found)))
        self.save_button.setEnabled(True)
        self.panel.run_bar.say("Registered: step Molecules reads donor and acceptor.")

    def save(self, path: str) -> str:
        """Write channels.json."""
        self.session.channels.to_json(path)
        return path

    def _beads(self) -> Any:
        beads = self.form.beads.value
        if beads is None:
            raise MufasaError("no beads chosen: open beads that both channels show, or a movie whose molecules both do")
        return beads
