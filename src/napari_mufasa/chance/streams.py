"""Named random streams: one seed gives the same movie whatever the workers and chunks.

Every source of chance has its own stream, so that adding one effect leaves all other random numbers as they
were. What is drawn per frame has one stream per frame; what is drawn per pixel or molecule in a compiled
kernel has a key, under which `variates` counts pixels or molecules.
"""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np

from napari_mufasa import checks


@dataclass(frozen=True)
class Streams:
    """Independent generators of one seed, by name and frame."""

    seed: int

    def __post_init__(self) -> None:
        checks.seed(self.seed)

    def of(self, name: str, frame: int | None = None) -> np.random.Generator:
        """The generator of `name`, or of one frame of it."""
        key = (crc32(name.encode()),) if frame is None else (crc32(name.encode()), int(frame))
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(int(self.seed), spawn_key=key)))

    def key(self, name: str) -> np.uint64:
        """The key of `name` for counter-based variates (see `variates.stream`)."""
        sequence = np.random.SeedSequence(int(self.seed), spawn_key=(crc32(name.encode()),))
        return np.uint64(sequence.generate_state(1, np.uint64)[0])
