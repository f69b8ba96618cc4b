"""Over which times of a movie spots are looked for (docs/traces.md)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHORT_BLOCKS = 200  # at most this many short blocks per movie: bounds the time detection takes
MIDDLE = 5  # short blocks in the middle time scale


def short_block(n_frames: int, asked: int | None = None) -> int:
    """Frames of a short block."""
    return min(asked or max(1, -(-n_frames // SHORT_BLOCKS)), n_frames)


def averaged_frames(n_frames: int, block: int | None = None) -> tuple[int, int, int]:
    """Over how many frames means are taken: a short block, some of them, the whole movie."""
    short = short_block(n_frames, block)
    return short, min(MIDDLE * short, n_frames), n_frames


def frames_needed(
    significance: NDArray[np.floating], lit_frames: NDArray[np.integer], n_frames: int, level: float,
    block: int | None = None,
) -> NDArray[np.float64]:  # fmt: skip
    """In how many frames (spot,) each spot would have had to be lit to come to a `level` of evidence, from how many it
    was and its significance.

    Of a mean over T frames, n of them lit, the evidence is min(n, T)/√T of that of a single lit frame; the best of the
    three T counts.
    """
    scales = np.array(averaged_frames(n_frames, block), np.float64)
    lit = np.maximum(np.asarray(lit_frames, dtype=np.float64), 1.0)[:, None]
    single = significance / (np.minimum(lit, scales) / np.sqrt(scales)).max(axis=1)
    needed = level * np.sqrt(scales) / np.maximum(single, 1e-12)[:, None]
    return np.asarray(np.where(needed > scales, n_frames, needed).min(axis=1))
