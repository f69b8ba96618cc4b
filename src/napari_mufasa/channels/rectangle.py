"""One channel of a frame that holds several side by side: a rectangle, and what lies in it (docs/two_channels.md)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.setup import MAPS

if TYPE_CHECKING:
    from napari_mufasa.model.model import Model
    from napari_mufasa.model.setup import Camera

HALVES = ("left", "right", "top", "bottom")
LEAST_PX = 8  # a side of a channel: less holds no spot and its surroundings
NOTATION = f"give Y0:Y1,X0:X1 in pixels, or one of {', '.join(HALVES)}"


@dataclass(frozen=True)
class Rectangle:
    """The pixels y0 … y1 − 1 and x0 … x1 − 1 of a frame."""

    y0: int
    y1: int
    x0: int
    x1: int

    def __str__(self) -> str:
        return f"{self.y0}:{self.y1},{self.x0}:{self.x1}"

    @property
    def shape_px(self) -> tuple[int, int]:
        """Height and width."""
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def corner_px(self) -> NDArray[np.float64]:
        """(y, x) of its first pixel."""
        return np.array([self.y0, self.x0], dtype=float)

    def crop(self, movie: Any) -> Any:
        """This part of a movie (frame, y, x), or of dark frames; nothing is read or copied.

        Raises `MufasaError` where the movie does not hold it.
        """
        stack = checks.stack(movie, single=True)
        height, width = int(stack.shape[1]), int(stack.shape[2])
        if self.y1 > height or self.x1 > width:
            raise MufasaError(f"channel {self} leaves the frames of {height} × {width} px: {NOTATION}")
        return checks.unread(stack)[:, self.y0 : self.y1, self.x0 : self.x1]

    def camera(self, camera: Camera, frame_px: tuple[int, int]) -> Camera:
        """The camera as these pixels of frames of `frame_px` have it: its maps of pixels are cut out."""
        maps = [pixels for name in MAPS if (pixels := getattr(camera, name)) is not None]
        if any(pixels.shape != tuple(frame_px) for pixels in maps):
            return camera
        return camera.of_part(slice(self.y0, self.y1), slice(self.x0, self.x1))

    def model(self, model: Model, frame_px: tuple[int, int]) -> Model:
        """The model of this part of frames of `frame_px`: its shape, and its camera's maps."""
        camera = self.camera(model.camera, frame_px)
        timing = model.acquisition
        if tuple(timing.shape_px) == tuple(frame_px):
            timing = timing.model_copy(update={"shape_px": self.shape_px})
        return model.model_copy(update={"camera": camera, "acquisition": timing})


def rectangle(where: str | Rectangle, frame_px: tuple[int, int]) -> Rectangle:
    """A rectangle of frames of `frame_px` (height, width): "left", "right", "top", "bottom", or "Y0:Y1,X0:X1".

    Halves of an odd number of pixels leave the middle one out. Raises `MufasaError` for anything else, or what the
    frames do not hold.
    """
    height, width = int(frame_px[0]), int(frame_px[1])
    if isinstance(where, str) and where.strip().lower() in HALVES:
        tall, wide = height // 2, width // 2
        found = {
            "left": Rectangle(0, height, 0, wide),
            "right": Rectangle(0, height, width - wide, width),
            "top": Rectangle(0, tall, 0, width),
            "bottom": Rectangle(height - tall, height, 0, width),
        }[where.strip().lower()]
    elif isinstance(where, str) and (parts := re.fullmatch(r"\s*(\d+):(\d+)\s*,\s*(\d+):(\d+)\s*", where)):
        found = Rectangle(*(int(part) for part in parts.groups()))
    elif isinstance(where, Rectangle):
        found = where
    else:
        raise MufasaError(f"channel {checks.told(where)} is no rectangle: {NOTATION}")
    if min(found.shape_px) < LEAST_PX or found.y0 < 0 or found.x0 < 0:
        raise MufasaError(f"channel {found} is narrower than {LEAST_PX} px: {NOTATION}")
    if found.y1 > height or found.x1 > width:
        raise MufasaError(f"channel {found} leaves the frames of {height} × {width} px: {NOTATION}")
    return found


def around(vertices_px: Any, frame_px: tuple[int, int]) -> Rectangle:
    """The rectangle of whole pixels that a drawn shape (vertex, 2 or more; (y, x) last) encloses within the frames.

    A pixel belongs to it when its centre does.
    """
    corners = np.asarray(vertices_px, dtype=float)[:, -2:]
    low = np.maximum(np.ceil(corners.min(axis=0)), 0).astype(int)
    high = np.minimum(np.floor(corners.max(axis=0)).astype(int) + 1, frame_px)
    if np.any(high - low < LEAST_PX):
        raise MufasaError(f"the shape encloses less than {LEAST_PX} px of the frames on a side: draw it larger")
    return Rectangle(int(low[0]), int(high[0]), int(low[1]), int(high[1]))


def check_apart(donor: Rectangle, acceptor: Rectangle) -> None:
    """Raise `MufasaError` where two channels share pixels."""
    apart = donor.y1 <= acceptor.y0 or acceptor.y1 <= donor.y0 or donor.x1 <= acceptor.x0 or acceptor.x1 <= donor.x0
    if not apart:
        raise MufasaError(
            f"donor {donor} and acceptor {acceptor} share pixels: give two rectangles apart from each other"
        )
