"""Layers that show where the model fails, and its movie beside the measured one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.io import METADATA_KEY
from napari_mufasa.widgets.layers import PLACE, add_movie
from napari_mufasa.widgets.places import MOLECULE_WORDS, WORDS, Places, place_of

if TYPE_CHECKING:
    from napari.layers import Image, Layer
    from napari.viewer import Viewer

SD_SHOWN = 6.0  # the colours' ends
GAP_PX = 4


class PlaceLayers:
    """One layer with the misfit of the chosen observable, one with the movie of the model as it stands."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.place: Layer | None = None
        self.simulated: Layer | None = None

    def clear(self) -> None:
        self.hide_place()
        self.hide_simulated()

    def hide_place(self) -> None:
        self._remove("place")

    def hide_simulated(self) -> None:
        self._remove("simulated")

    def show(self, observable: str, places: Places, movie: Image, first_frame: int = 0) -> str:
        """Show the place of an observable on top of `movie`; says in words what is shown."""
        self._remove("place")
        name = place_of(observable)
        if name.startswith("molecules:"):
            return self._show_molecules(name.removeprefix("molecules:"), places, movie)
        if name == "frames":
            worst = int(np.argmax(np.abs(places.frames)))
            self._go_to(worst + first_frame, movie)
            return f"Frame {worst + first_frame} is farthest off: {places.frames[worst]:+.1f} sd in its mean."
        if name not in places.maps:
            return ""
        return self._show_map(name, places, movie, first_frame)

    def show_simulated(self, places: Places, movie: Image, name: str, first_frame: int = 0) -> None:
        """The model's movie to the right of the measured one, at the same height and in the same contrast."""
        self._remove("simulated")
        here = _at(places, movie)
        right = (movie.data.shape[-1] + GAP_PX) * movie.scale[-1]
        space = {
            "scale": tuple(movie.scale), "units": movie.units,
            "translate": (movie.translate[0] + first_frame * movie.scale[0], here[0], here[1] + right),
        }  # fmt: skip
        self.simulated = add_movie(
            self.viewer, places.simulated, name, space, places.model, contrast_limits=movie.contrast_limits,
            colormap=movie.colormap.name, role="simulated",
        )  # fmt: skip
        self.viewer.layers.selection.active = movie
        self.viewer.reset_view()

    # kinds of places --------------------------------------------------------------------------------
    def _show_map(self, name: str, places: Places, movie: Image, first_frame: int) -> str:
        z = places.maps[name]
        scale, units = tuple(movie.scale[-2:]), tuple(movie.units[-2:])
        translate: tuple[float, ...] = _at(places, movie)
        frames = ""
        if z.ndim == 3:
            long = places.n_frames / len(z)
            worst = int(np.argmax(np.square(z).mean(axis=(1, 2))))
            start, stop = round(worst * long), round((worst + 1) * long) - 1
            frames = f"; frames {start + first_frame} … {stop + first_frame} are farthest off"
            step = float(movie.scale[0])
            scale, units = (long * step, *scale), (movie.units[0], *units)
            translate = (float(movie.translate[0]) + (first_frame + (long - 1) / 2) * step, *translate)
            self._go_to((start + stop) // 2 + first_frame, movie)
        self.place = self.viewer.add_image(
            z, name=f"where: {WORDS[name]}", scale=scale, units=units, translate=translate, colormap="PiYG",
            contrast_limits=(-SD_SHOWN, SD_SHOWN), metadata={METADATA_KEY: {"role": PLACE}},
        )  # fmt: skip
        self.viewer.layers.selection.active = movie
        off = float((np.abs(z) > 4).mean())
        return (
            f"Layer “{self.place.name}”: measured − model in sd (green more, pink less); "
            f"{off:.1%} of the pixels are more than 4 sd off{frames}."
        )

    def _show_molecules(self, number: str, places: Places, movie: Image) -> str:
        table = places.molecules
        if not len(table) or number not in table:
            return "No molecule was found to show this on."
        z = table[number].to_numpy(float)
        words = MOLECULE_WORDS[number]
        size = 5.0 * float(places.model.sigma_px)
        self.place = self.viewer.add_points(
            table[["y_px", "x_px"]].to_numpy(float), name=f"where: {words}", scale=tuple(movie.scale[-2:]),
            units=tuple(movie.units[-2:]), translate=tuple(movie.translate[-2:]), size=size, opacity=0.8,
            features={"sd": z}, face_color="sd", face_colormap="PiYG", face_contrast_limits=(-SD_SHOWN, SD_SHOWN),
            border_color="gray", border_width=0.05, metadata={METADATA_KEY: {"role": PLACE}},
        )  # fmt: skip
        self.viewer.layers.selection.active = movie
        worst = table.iloc[int(np.argmax(np.abs(z)))]
        return (
            f"Layer “{self.place.name}”: each molecule against the model's (green more, pink less); "
            f"{int((np.abs(z) > 3).sum())} of {len(z)} are more than 3 sd off, farthest at "
            f"y {worst['y_px']:.0f}, x {worst['x_px']:.0f} px."
        )

    def _go_to(self, frame: int, movie: Image) -> None:
        """Show a frame, counted in the movie's own frames."""
        if movie.ndim == 3:
            self.viewer.dims.set_point(0, float(movie.translate[0] + frame * movie.scale[0]))

    def _remove(self, name: str) -> None:
        layer: Any = getattr(self, name)
        setattr(self, name, None)
        if layer is not None and layer in self.viewer.layers:
            self.viewer.layers.remove(layer)


def _at(places: Places, movie: Image) -> tuple[float, float]:
    """World place (y, x) of the first pixel that was looked at."""
    y, x = movie.translate[-2:] + np.asarray(places.offset_px) * movie.scale[-2:]
    return float(y), float(x)
