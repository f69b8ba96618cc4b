"""One frame at a time, quickly: what the Denoise widget shows before the whole movie is denoised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa import camera as cam

from .pipeline import Method, _Frames

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from napari_mufasa.model.setup import Camera

#: Frames on either side that a preview looks at; the whole movie's run looks further.
NEIGHBOURS = 6


@dataclass(frozen=True)
class Look:
    """One frame before and after, photons per pixel."""

    before: NDArray[np.float32]
    after: NDArray[np.float32]

    @property
    def residual(self) -> NDArray[np.float32]:
        """What was taken away: it should look like noise."""
        return self.before - self.after

    def split(self, share: float) -> NDArray[np.float32]:
        """The frame as recorded in the left ``share`` of the picture, denoised in the rest."""
        out = self.after.copy()
        border = round(min(max(share, 0.0), 1.0) * out.shape[1])
        out[:, :border] = self.before[:, :border]
        return out


class Preview:
    """The denoiser of a movie with its weights learnt, ready for single frames.

    ``gain_db`` is the estimated gain in PSNR over the recorded frames.
    """

    def __init__(
        self,
        movie: Any,
        camera: Camera,
        method: Method = "pure-let-movie",
        excess_noise: bool = True,
        cancel: Callable[[], bool] | None = None,
    ) -> None:
        self.camera = camera
        self._frames = _Frames(movie, camera, tuple(movie.shape), method, excess_noise)
        self._frames.neighbours = min(self._frames.neighbours, NEIGHBOURS)
        self._frames.learn(cancel)
        self.gain_db = self._frames.gain_db

    def look(self, t: int) -> Look:
        """Frame ``t`` before and after."""
        before = cam.photons(self._frames.read(t, t + 1), self.camera)[0]
        return Look(before, self._frames.photons(self._frames.block(t, t + 1))[0])
