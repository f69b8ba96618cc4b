"""The light of both channels in one image, on the donor's pixels: where molecules are looked for, however their light
is divided (docs/two_channels.md)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from napari_mufasa.camera.frames import Frames
from napari_mufasa.channels.transform import Transform


class Together:
    """Donor plus acceptor as an array (frame, y, x) of photoelectrons, made from both when frames are asked for.

    The acceptor's image is read between its pixels (bilinear), beyond its edge as at it: good enough to find molecules
    in, while their light is read from the pixels as they were recorded.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, donor: Frames, acceptor: Frames, transform: Transform) -> None:
        self.donor, self.acceptor = donor, acceptor
        self.shape = donor.shape
        self._warp = _between_pixels(transform, donor.shape[1:], acceptor.shape[1:])

    @property
    def ndim(self) -> int:
        return 3

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, which: int | slice) -> NDArray[np.float32]:
        """The frames of a slice, or one frame."""
        if not isinstance(which, slice):
            return np.asarray(self[which : which + 1][0])
        first = which.indices(len(self))[0]
        donor, acceptor = (
            side.photoelectrons(np.asarray(side.movie[which]), first) for side in (self.donor, self.acceptor)
        )
        flat: Any = np.ascontiguousarray(acceptor.reshape(len(acceptor), -1).T)
        return np.asarray(donor + (self._warp @ flat).T.reshape(donor.shape), dtype=np.float32)


def _between_pixels(transform: Transform, shape_px: tuple[int, int], from_px: tuple[int, int]) -> sparse.csr_matrix:
    """(pixel, pixel there) weights that read an image at the mapped places of all pixels."""
    pixels = np.indices(shape_px, dtype=float).reshape(2, -1).T
    there = np.clip(transform(pixels), 0, np.array(from_px) - 1)
    low = np.minimum(np.floor(there).astype(np.int64), np.maximum(np.array(from_px) - 2, 0))
    part = there - low
    rows, columns, weights = [], [], []
    for dy in (0, 1):
        for dx in (0, 1):
            at = np.minimum(low + np.array([dy, dx]), np.array(from_px) - 1)
            weight = np.abs(1 - dy - part[:, 0]) * np.abs(1 - dx - part[:, 1])
            rows.append(np.arange(len(pixels)))
            columns.append(at[:, 0] * from_px[1] + at[:, 1])
            weights.append(weight)
    data = np.concatenate(weights).astype(np.float32)
    shape = (len(pixels), from_px[0] * from_px[1])
    return sparse.csr_matrix((data, (np.concatenate(rows), np.concatenate(columns))), shape=shape)
