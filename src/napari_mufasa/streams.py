"""Named random streams: one seed gives the same movie whatever the workers and chunks.

Every source of chance has its own stream, and every frame its own within it, so that a block of frames can
be drawn anywhere and in any order, and adding one effect leaves all other random numbers as they were.
"""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np

from napari_mufasa.errors import MufasaError


@dataclass(frozen=True)
class Streams:
    """Independent generators of one seed, by name and frame."""

    seed: int

    def __post_init__(self) -> None:
        if isinstance(self.seed, bool) or not isinstance(self.seed, (int, np.integer)) or self.seed < 0:
            raise MufasaError(f"seed = {self.seed!r}: give a whole number ≥ 0")

    def of(self, name: str, frame: int | None = None) -> np.random.Generator:
        """The generator of `name`, or of one frame of it."""
        key = (crc32(name.encode()),) if frame is None else (crc32(name.encode()), int(frame))
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(int(self.seed), spawn_key=key)))
