"""The law of a pixel's counts: Poisson electrons, a register that multiplies each by a Gamma number, normal read noise,
a row that mixes neighbours, rounding (docs/camera.md). Shares of a histogram by the characteristic function, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STEPS_PER_BIN = 5  # at which a density is known: linear between them the shares of bins are right to 1e-5
BINS_BEYOND = 40.0  # that the law goes on beyond the edges, lest its ends meet
MOST_POINTS = 2**13
LEAST_LOG = -35.0  # of a characteristic function, below which it is nothing
PHASES = 16  # of the lattice that whole counts about a mean lie on


@dataclass(frozen=True)
class Law:
    """What makes the noise of a pixel.

    Attributes
    ----------
    adu_per_electron : mean response to a photoelectron
    excess_noise_factor : F² of the multiplication; 1: none
    read_noise_adu : rms of the normal part
    charge_e : electrons per pixel and frame that come without light
    weights : what a pixel reads of its own signal and of the ones before it, summing to 1
    """

    adu_per_electron: float
    excess_noise_factor: float
    read_noise_adu: float
    charge_e: float = 0.0
    weights: tuple[float, ...] = (1.0,)

    def log_characteristic(self, t: Array) -> tuple[NDArray[np.complex128], Array]:
        """Of a level before it is rounded, about its mean, at t (1/ADU): what each electron adds, and read noise."""
        electron = np.zeros(len(t), np.complex128)
        for weight in self.weights:
            one = self.adu_per_electron * weight * t
            electron += _multiplied(one, self.excess_noise_factor) - 1 - 1j * one
        return electron, np.asarray((-0.5 * self.read_noise_adu**2) * t**2)

    def electrons(self, signals_adu: Array) -> Array:
        """How many make these signals, those without light included."""
        return np.maximum(signals_adu / self.adu_per_electron + self.charge_e, 0.0)

    def variance(self, signal_adu: float) -> float:
        power = float(np.sum(np.square(self.weights)))
        electrons = float(self.electrons(np.array(signal_adu)))
        light = self.excess_noise_factor * self.adu_per_electron**2 * electrons * power
        return light + self.read_noise_adu**2 + 1 / 12


def _multiplied(t: Array, excess: float) -> NDArray[np.complex128]:
    """Characteristic function of an electron's multiplication, of mean 1 and mean square `excess`."""
    if excess <= 1 + 1e-6:
        return np.asarray(np.exp(1j * t))
    if excess == 2:  # the same, sooner
        return np.asarray(1 / (1 - 1j * t))
    shape = 1 / (excess - 1)
    size = np.exp(-0.5 * shape * np.log1p((t / shape) ** 2))
    turn = shape * np.arctan(t / shape)
    return np.asarray(size * (np.cos(turn) + 1j * np.sin(turn)))


def below(law: Law, signals_adu: Array, edges: Array, n_mean: int = 0, phases: Array | None = None) -> Array:
    """Share of counts, less their mean, that lie below each of the edges (group, edge), which ascend: (group, edge).

    signals_adu : (group, level) of the pixels of a group, as many of each
    n_mean : counts are taken about the mean of so many frames of their own pixel, themselves one of them; 0: about the
        true mean. A random part of a count (even, rms 1/√12) is added to them.
    phases : (group, phase) shares of counts by what is left of them, about their means, modulo 1 ADU, from 0 on: counts
        are whole, and where the noise is small they lie on a lattice; None: anywhere
    """
    numbers = law.electrons(np.asarray(signals_adu))
    # The grid goes by the edges alone: one that moved with the law would make its likelihood rough.
    widths = np.diff(edges, axis=1).min(axis=1)
    reach = 1.2 * float(np.abs(edges).max()) + BINS_BEYOND * float(widths.max())
    points = min(2 ** int(np.ceil(np.log2(2 * reach / float(widths.min()) * STEPS_PER_BIN))), MOST_POINTS)
    step = 2 * reach / points
    t = 2 * np.pi * np.fft.rfftfreq(points, step)
    if n_mean > 1:
        electron, noise = law.log_characteristic(t * (1 - 1 / n_mean))
        others = law.log_characteristic(-t / n_mean)
        electron = electron + (n_mean - 1) * others[0]
        noise = noise + (n_mean - 1) * (others[1] + _rounding(t / n_mean))
    else:
        electron, noise = law.log_characteristic(t)
    x = (np.arange(points) - points // 2) * step
    found = np.empty(np.shape(edges))
    for group, some in enumerate(numbers):
        # Far out, where nothing is left of it, it need not be worked out.
        heard = min(some) * electron.real + noise > LEAST_LOG
        last = len(t) - int(np.argmax(heard[::-1])) if heard.any() else 1
        mixed = np.zeros(len(t), np.complex128)
        mixed[:last] = np.mean([np.exp(n * electron[:last] + noise[:last]) for n in some], axis=0)
        density = np.fft.fftshift(np.fft.irfft(np.conj(mixed), points)) / step
        total = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2) * step])
        own = np.full(PHASES, 1 / PHASES) if phases is None else phases[group]
        found[group] = _recorded(x, total / total[-1], edges[group], own)
    return found


def _recorded(x: Array, total: Array, edges: Array, phases: Array) -> Array:
    """Share of rounded counts below the edges (edge,), of levels of which `total` (x,) lie below x.

    A count c has all levels from c − ½ to c + ½; the random part spreads it evenly over just these.
    """
    at = (np.arange(len(phases)) + 0.5)[:, None] / len(phases)
    cell = np.floor(edges - at - 0.5) + at + 0.5
    low, high = np.interp(cell, x, total), np.interp(cell + 1, x, total)
    return np.asarray(phases @ (low + (edges - cell) * (high - low)))


def _rounding(t: Array) -> Array:
    """Log characteristic function of what rounding adds."""
    return np.asarray(np.log(np.abs(np.sinc(t / (2 * np.pi))) + 1e-300))
