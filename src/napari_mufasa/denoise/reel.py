"""A movie as photoelectrons, frame by frame: read in pieces, the last ones held."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[Any]

#: Frames whose past and future are walked through together, at most so many and so many pixels.
BLOCK, BLOCK_PIXELS = 32, 2**25
#: Pixels read, denoised and written together, and pixels of photoelectrons that are held, at most.
PIECE_PIXELS, HELD_PIXELS = 2**23, 2**24


def block_frames(shape: tuple[int, ...]) -> int:
    """Frames whose past and future are walked through together: `BLOCK`, fewer of large ones."""
    return max(8, min(BLOCK, BLOCK_PIXELS // (shape[1] * shape[2])))


def piece_frames(shape: tuple[int, ...]) -> int:
    """Frames read, denoised and written together: a whole block of small ones, fewer of large ones."""
    return max(2, min(block_frames(shape), PIECE_PIXELS // (shape[1] * shape[2])))


class Reel:
    """Frames (y, x) of a movie of ``shape`` (frame, y, x) by their numbers, as ``read`` (first, after the last) gives
    them.

    Held are those that a block and its ``reach`` frames on either side need, fewer of large ones, but three pieces;
    what was let go is read anew.
    """

    def __init__(self, read: Callable[[int, int], Array], shape: tuple[int, ...], reach: int) -> None:
        self.read, self.shape = read, shape
        self.piece = piece_frames(shape)
        needed = block_frames(shape) + 2 * reach + self.piece
        self._most = max(3 * self.piece, min(needed, HELD_PIXELS // (shape[1] * shape[2])))
        self._held: OrderedDict[int, Array] = OrderedDict()

    def __getitem__(self, t: int) -> Array:
        if t not in self._held:
            first = t // self.piece * self.piece
            for number, frame in enumerate(self.read(first, min(first + self.piece, self.shape[0])), first):
                # A frame of its own: a view would hold the whole piece.
                self._held[number] = frame.copy()
                self._held.move_to_end(number)
        self._held.move_to_end(t)
        while len(self._held) > self._most:
            self._held.popitem(last=False)
        return self._held[t]
