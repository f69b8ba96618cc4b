"""Simulate: a movie from the believed model, its true positions as points, and, if asked for, the image before the
camera."""

from collections.abc import Generator
from typing import Annotated, Any, Literal

from magicgui import magic_factory
from napari.layers import Layer

from napari_mufasa.checks import counted
from napari_mufasa.files.layers import movie_space
from napari_mufasa.model.presets import preset
from napari_mufasa.widgets.parts.forms import DerivedValues, PartEditor, begin
from napari_mufasa.widgets.parts.layers import added, movie_layer, points_on
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.parameters import Believed, Molecules, Seed
from napari_mufasa.widgets.parts.pieces import section
from napari_mufasa.widgets.turns.steering import steering

PARTS = ("acquisition", "sample", "fluorophore", "excitation", "optics", "camera")
ACQUISITION = ("n_frames", "frame_length_s", "pixel_size_nm", "shape_px")


def simulate(
    model: Believed = None,
    molecules: Molecules = None,
    seed: Seed = 1,
    engine: Annotated[Literal["fast", "exact"], {"label": "Engine"}] = "fast",
    positions: Annotated[bool, {"label": "also the true positions"}] = True,
    optical: Annotated[bool, {"label": "also the image before the camera (photons)"}] = False,
) -> list[Layer]:
    """Simulate a movie: molecules, optics and camera of the model (none: preset FF), effects included.

    Parameters:
        molecules: Points to simulate molecules at
        engine: exact draws every jump of every molecule; fast: the same statistics, sooner

    Returns:
        As they lie on each other: the image before the camera, the movie, the true positions.
    """
    import pandas as pd

    from napari_mufasa.simulate.movie import simulate as run

    progress, cancel = steering()
    model = model if model is not None else preset("FF")
    places = molecules.data[:, -2:] if molecules is not None else None
    result = run(model, places, seed=seed, engine=engine, progress=progress, cancel=cancel)
    space, name = movie_space(model.acquisition.pixel_size_nm), f"{model.protocol} simulated"
    movie = movie_layer(result.movie, name, space, model, seed)
    layers: list[Layer] = [movie]
    if optical:
        photons = {"ours": {"role": "photons"}, "visible": False}
        layers.insert(0, movie_layer(result.optical, f"{name}, photons", space, model, seed, **photons))
    if positions:
        emitted = pd.DataFrame({"photons": result.emission[: len(result.positions_px)].sum(axis=1)})
        layers.append(
            points_on(
                movie, result.positions_px, emitted, f"{name}, true positions",
                size=6, border_width=0.12, face_color="transparent", border_color="#5ec4ff", visible=False,
            )
        )  # fmt: skip
    return layers


simulate_widget = magic_factory(simulate, call_button="Simulate", widget_init=begin)


class SimulatePanel(Panel):
    words = "Simulate a movie: molecules, optics and camera of the model, effects included."
    run_label, running = "Simulate", "Simulating"
    form_factory = simulate_widget

    def build(self) -> None:
        self.add(self.form.native, self.run_bar)
        shown = {"acquisition": ACQUISITION}
        self.parts = {part: PartEditor(self.session, part, shown.get(part)) for part in PARTS}
        for part, editor in self.parts.items():
            self.add(section(part.capitalize(), editor, part in ("acquisition", "sample")))
        self.add(section("What follows", DerivedValues(self.session)))
        self.column.addStretch(1)

    def take(self, layers: list[Any]) -> Generator[None, None, None]:
        movie = next(layer for layer in layers if layer.name.endswith("simulated"))
        yield from added(self.viewer, layers)
        self.session.set_movie(movie)
        if movie in self.viewer.layers:
            self.viewer.layers.selection.active = movie
        self.viewer.dims.set_point(0, 0)
        self.run_bar.say(f"{counted(len(movie.data), 'frame')}.")
