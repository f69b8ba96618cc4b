"""Layers that show where the model fails, and its movie beside the measured one."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
from napari.layers import Image, Points

from napari_mufasa.discover.places import MOLECULE_WORDS, WORDS, Places, place_of
from napari_mufasa.files.movies import METADATA_KEY
from napari_mufasa.report.lines import map_line, molecules_line
from napari_mufasa.widgets.parts.edits import PLACE
from napari_mufasa.widgets.parts.layers import OwnLayers, movie_layer, points_on, space_of

SD_SHOWN = 6.0  # the colours' ends
GAP_PX = 4


def map_of(name: str, places: Places, movie: Image) -> Image:
    """The misfit by place as an image on top of the movie, one for all frames or one for each stretch of them."""
    z, space = _stretches(places.maps[name]), space_of(movie, places.first_frame)
    long, (step, *pixel), start = places.n_frames / len(z), space["scale"], space["translate"][0]
    return Image(
        z, name=f"where: {WORDS[name]}", scale=(long * step, *pixel), units=space["units"],
        axis_labels=space["axis_labels"],
        translate=(start + (long - 1) / 2 * step, *_at(places, movie)),
        colormap="PiYG", contrast_limits=(-SD_SHOWN, SD_SHOWN), metadata={METADATA_KEY: {"role": PLACE}},
    )  # fmt: skip


def molecules_of(number: str, places: Places, movie: Image) -> Points:
    """Molecules coloured by their misfit in a number; all their numbers are features, that one also as "sd"."""
    table = places.molecules
    features = table.drop(columns=["y_px", "x_px"]).assign(sd=table[number].to_numpy(float))
    return points_on(
        movie, table[["y_px", "x_px"]].to_numpy(float), features, f"where: {MOLECULE_WORDS[number]}",
        opacity=0.8, size=5.0 * float(places.model.sigma_px), face_color="sd", face_colormap="PiYG",
        face_contrast_limits=(-SD_SHOWN, SD_SHOWN), border_color="gray", border_width=0.05, ours={"role": PLACE},
    )  # fmt: skip


def simulated_of(places: Places, movie: Image, name: str, more: Any = None) -> Image:
    """The model's movie to the right of the measured one, at the same height and in the same contrast."""
    space, (y, x) = space_of(movie, places.first_frame), _at(places, movie)
    right = (movie.data.shape[-1] + GAP_PX) * movie.scale[-1]
    space["translate"] = (*space["translate"][:-2], y, x + right)
    return movie_layer(
        places.simulated, name, space, places.model, contrast_limits=movie.contrast_limits,
        colormap=movie.colormap.name, ours={"role": "simulated"} | (more or {}),
    )  # fmt: skip


class PlaceLayers(OwnLayers):
    """A map and molecules with the misfit of the chosen observable, and the movie of the model as it stands."""

    @property
    def simulated(self) -> Image | None:
        return self.get("simulated")

    @property
    def showing(self) -> bool:
        """Whether a place is shown."""
        return any(layer is not None and layer.visible for layer in (self.get("map"), self.get("molecules")))

    def clear(self) -> Generator[None, None, None]:
        """Take all away, one at a time: napari collects its garbage at each."""
        for name in ("map", "molecules", "simulated"):
            if self.remove(name):
                yield

    def show(self, name: str, new: Any, movie: Image, at: int | None = None) -> bool:
        is_new = super().show(name, new, movie, at)
        self.get(name).visible = True  # it may have been hidden with the place before
        return is_new

    def hide_place(self) -> None:
        for name in ("map", "molecules"):
            if (layer := self.get(name)) is not None:
                layer.visible = False

    def show_place(self, observable: str, places: Places, movie: Image) -> str:
        """Show the place of an observable on top of `movie`; says in words what is shown."""
        self.hide_place()
        kind, _, number = place_of(observable).partition(":")
        if kind == "molecules":
            if number not in places.molecules or not len(places.molecules):
                return "No molecule was found to show this on."
            self.show("molecules", molecules_of(number, places, movie), movie)
            return molecules_line(f"where: {MOLECULE_WORDS[number]}", places.molecules, number)
        if kind == "frames":
            worst = int(np.argmax(np.abs(places.frames)))
            frame = worst + places.first_frame
            self._go_to(frame, movie)
            return f"Frame {frame} is farthest off: {places.frames[worst]:+.1f} sd in its mean."
        return self._show_map(kind, places, movie) if kind in places.maps else ""

    def show_simulated(self, places: Places, movie: Image, name: str) -> None:
        """The model's movie beside the measured one."""
        if self.show("simulated", simulated_of(places, movie, name), movie):
            self.viewer.reset_view()

    def _show_map(self, name: str, places: Places, movie: Image) -> str:
        new = map_of(name, places, movie)
        self.show("map", new, movie, at=self.viewer.layers.index(movie) + 1)  # below the molecules
        z, frames = _stretches(places.maps[name]), ""
        if len(z) > 1:
            long, worst = places.n_frames / len(z), int(np.argmax(np.square(z).mean(axis=(1, 2))))
            start, stop = (places.first_frame + round(k * long) for k in (worst, worst + 1))
            frames = f"; frames {start} … {stop - 1} are farthest off"
            self._go_to((start + stop - 1) // 2, movie)
        return map_line(new.name, z, frames)

    def _go_to(self, frame: int, movie: Image) -> None:
        """Show a frame, counted in the movie's own frames."""
        if movie.ndim == 3:
            self.viewer.dims.set_point(self.viewer.dims.ndim - 3, float(movie.translate[0] + frame * movie.scale[0]))


def _at(places: Places, movie: Image) -> tuple[float, float]:
    """World place (y, x) of the first pixel that was looked at."""
    y, x = movie.translate[-2:] + np.asarray(places.offset_px) * movie.scale[-2:]
    return float(y), float(x)


def _stretches(z: Any) -> Any:
    """One image for all frames, or one for each stretch, as (stretch, y, x)."""
    return z if z.ndim == 3 else z[np.newaxis]
