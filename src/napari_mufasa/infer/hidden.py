"""The chain behind a trace: bright, dark, bleached, not yet activated; and how long a frame of it is bright."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]
PARTS = 4  # of a frame: where a molecule switches within it is known to an eighth
BRIGHT, BLEACHED = 0, 1  # states of every chain


@dataclass(frozen=True)
class Hidden:
    """Rates per s: bleaching and turning off while bright, coming back from the dark state, first activation; 0: none.

    starts_bright : chance that the first frame begins bright; else dark, or waiting where there is activation
    """

    bleaching: float
    off: float = 0.0
    back: float = 0.0
    activation: float = 0.0
    starts_bright: float = 1.0

    @property
    def dark(self) -> list[tuple[float, float]]:
        """(rate into it, rate out of it) of each further state: a dark one, one before activation."""
        return [pair for pair in ((self.off, self.back), (0.0, self.activation)) if pair[1] > 0]

    @property
    def generator(self) -> Array:
        rates = np.zeros((2 + len(self.dark),) * 2)
        rates[BRIGHT, BLEACHED] = self.bleaching
        for state, (into, out) in enumerate(self.dark, 2):
            rates[BRIGHT, state], rates[state, BRIGHT] = into, out
        return np.asarray(rates - np.diag(rates.sum(axis=1)))

    @property
    def start(self) -> Array:
        chances = np.zeros(2 + len(self.dark))
        chances[-1] = 1 - self.starts_bright if self.dark else 0.0
        chances[BRIGHT] = 1 - chances[-1]
        return chances

    def within(self, frame_s: float) -> Array:
        """(share, from, to): chance to go from one state to another in a frame and to be bright for 0, ⅛, … 1 of it."""
        step = expm(self.generator * frame_s / PARTS)
        # Half a part for each of its ends that is bright.
        n = len(step)
        bright = np.zeros(n, dtype=int)
        bright[BRIGHT] = 1
        halves = bright[:, None] + bright[None, :]
        found = np.zeros((2 * PARTS + 1, n, n))
        found[0] = np.eye(n)
        for _ in range(PARTS):
            longer = np.zeros_like(found)
            for add in (0, 1, 2):
                moved = found @ np.where(halves == add, step, 0.0)
                longer[add:] += moved[: len(found) - add]
            found = longer
        return found

    @property
    def widths(self) -> Array:
        """(share,) variance of the shares that each of those of `within` stands for: a switch may be anywhere in its
        part, of which an odd number of eighths has one, an even one two."""
        eighths = np.arange(2 * PARTS + 1)
        switches = np.where(eighths % 2 == 1, 1, 2)
        switches[[0, -1]] = 0
        return np.asarray(switches / PARTS**2 / 12)

    def between(self, dead_s: float) -> Array:
        """(from, to) over the time between frames, in which light falls but none is counted."""
        return np.asarray(expm(self.generator * dead_s))

    def log_seen(self, movie_s: float, least_s: float) -> float:
        """Log of the chance that a molecule comes to light within the movie, and shines for `least_s` before it
        bleaches (in the dark nothing bleaches)."""
        waiting = self.activation if self.activation > 0 else self.back
        never = (1 - self.starts_bright) * np.exp(-waiting * movie_s)
        return float(np.log1p(-min(never, 1 - 1e-9)) - self.bleaching * least_s)
