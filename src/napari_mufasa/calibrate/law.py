"""The law of a pixel's counts: Poisson electrons, a register that multiplies each by a Gamma number, normal read noise,
a row that mixes neighbours, rounding (docs/camera.md). Shares of a histogram by the characteristic function, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
POINTS = 2**13
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
        """Of a level before it is rounded, about its mean, at t in 1/ADU: what each electron adds, and the read noise."""
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
    shape = 1 / (excess - 1)
    return np.asarray((1 - 1j * t / shape) ** -shape)


def below(law: Law, signals_adu: Array, edges: Array, n_mean: int = 0, phases: Array | None = None) -> Array:
    """Share of counts, less their mean, that lie below each of the edges (edge,), which ascend.

    signals_adu : (level,) of the pixels, as many of each
    n_mean : counts are taken about the mean of so many frames of their own pixel, themselves one of them; 0: about the
        true mean. A random part of a count (even, rms 1/√12) is added to them.
    phases : (phase,) shares of counts by what is left of them, about their means, modulo 1 ADU, from 0 on: counts are
        whole, and where the noise is small they lie on a lattice; None: anywhere
    """
    reach = 1.2 * max(abs(edges[0]), abs(edges[-1])) + 8 * np.sqrt(law.variance(float(np.max(signals_adu))))
    step = 2 * reach / POINTS
    t = 2 * np.pi * np.fft.rfftfreq(POINTS, step)
    if n_mean > 1:
        electron, noise = law.log_characteristic(t * (1 - 1 / n_mean))
        others = law.log_characteristic(-t / n_mean)
        electron = electron + (n_mean - 1) * others[0]
        noise = noise + (n_mean - 1) * (others[1] + _rounding(t / n_mean))
    else:
        electron, noise = law.log_characteristic(t)
    mixed = np.mean([np.exp(n * electron + noise) for n in law.electrons(np.asarray(signals_adu))], axis=0)
    density = np.fft.irfft(np.conj(mixed), POINTS) / step
    density = np.fft.fftshift(density)
    x = (np.arange(POINTS) - POINTS // 2) * step
    total = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2) * step])
    shares = np.full(PHASES, 1 / PHASES) if phases is None else phases
    # A count c has all levels from c − ½ to c + ½; the random part spreads it evenly over just these.
    found = np.zeros(len(edges))
    for phase, share in zip((np.arange(len(shares)) + 0.5) / len(shares), shares, strict=True):
        cell = np.floor(edges - phase - 0.5) + phase + 0.5
        low, high = np.interp(cell, x, total), np.interp(cell + 1, x, total)
        found += share * (low + (edges - cell) * (high - low))
    return np.asarray(found / total[-1])


def _rounding(t: Array) -> Array:
    """Log characteristic function of what rounding adds."""
    return np.asarray(np.log(np.abs(np.sinc(t / (2 * np.pi))) + 1e-300))
