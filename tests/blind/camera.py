"""The true camera: electrons in, ADU out, in the order in which a real one does it.

charge (light, spurious, hot, particles) -> multiplication register -> pixel gain -> lag -> limited response
-> read noise -> converter with its offsets.
"""

from __future__ import annotations

import numpy as np

from .laws import Rng
from .world import CameraTruth

# docs/camera.md, default CMOS curve: 0.9 e/e to 200, then 0.4 to 1000 (ends at 500), then 0.1.
_CMOS_IN_E = np.array([0.0, 200.0, 1000.0, 1e7])
_CMOS_OUT_E = np.array([0.0, 180.0, 500.0, 500.0 + 0.1 * (1e7 - 1000.0)])


def multiply(electrons: np.ndarray, cam: CameraTruth, rng: Rng) -> np.ndarray:
    """Electron multiplication, float32. Mean gain * n, variance gain**2 * n * (excess_factor - 1).

    Form 0 is a Gamma of another shape, form 1 lets a share of the electrons be multiplied without noise and
    the others exponentially; both are the ideal register (Gamma of shape n) at an excess factor of 2.
    """
    out = np.zeros(electrons.shape, dtype=np.float32)
    hit = electrons > 0
    n = electrons[hit]
    spread = cam.excess_factor - 1.0
    if spread < 1e-3:
        amplified = n.astype(np.float64)
    elif cam.excess_form == 0:
        amplified = rng.standard_gamma(n / spread) * spread
    else:
        noisy = rng.binomial(n, min(spread, 1.0))
        amplified = (n - noisy) + rng.standard_gamma(noisy)
    out[hit] = amplified * cam.em_gain
    return out


def serial_charge(shape: tuple[int, ...], cam: CameraTruth, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Charge born inside the register: flat places and amplitudes; it sees only a part of the gain."""
    size = int(np.prod(shape))
    n = rng.poisson(cam.serial_charge_e * size)
    amplitude = cam.em_gain ** rng.random(n) * rng.standard_exponential(n)
    return rng.integers(size, size=n), amplitude.astype(np.float32)


def hot_charge(shape: tuple[int, ...], cam: CameraTruth, rng: Rng) -> np.ndarray:
    """Electrons of the hot pixels; with switching they are on and off like a telegraph."""
    mean = np.broadcast_to(cam.hot_map_e, shape)
    if cam.hot_switching is None:
        return rng.poisson(mean)
    up, down = cam.hot_switching
    on = rng.random(shape[1:]) < up / (up + down)
    states = np.empty(shape, dtype=bool)
    for t in range(shape[0]):
        flip = rng.random(shape[1:])
        on = np.where(on, flip >= down, flip < up)
        states[t] = on
    return rng.poisson(mean * states)


def particle_charge(shape: tuple[int, int, int], cam: CameraTruth, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Particles: flat places and electrons. Form 0 compact, form 1 a straight track, form 2 a blob."""
    n_frames, ny, nx = shape
    places, charges = [], []
    for t, n in enumerate(rng.poisson(cam.cosmic_per_frame, n_frames)):
        for _ in range(n):
            y, x = rng.integers(ny), rng.integers(nx)
            energy = int(np.exp(rng.normal(np.log(600.0), 0.8)))
            if cam.cosmic_form == 0:
                steps = np.zeros((1, 2), int)
            elif cam.cosmic_form == 1:
                angle = rng.uniform(0, 2 * np.pi)
                reach = np.arange(rng.integers(3, 9))[:, None]
                steps = np.rint(reach * [np.sin(angle), np.cos(angle)]).astype(int)
            else:
                steps = np.array([[0, 0], [0, 1], [1, 0], [0, -1], [-1, 0]])
            share = rng.multinomial(energy, np.full(len(steps), 1 / len(steps)))
            for (dy, dx), e in zip(steps, share, strict=True):
                if 0 <= y + dy < ny and 0 <= x + dx < nx:
                    places.append((t * ny + y + dy) * nx + x + dx)
                    charges.append(e)
    return np.array(places, dtype=np.int64), np.array(charges, dtype=np.int64)


def leave_behind(signal: np.ndarray, share: float, kept: float) -> np.ndarray:
    """Image lag on the amplified signal: ``share`` goes to a store, which gives back 1 - kept per frame."""
    store = signal[0] * share / (1.0 - kept)  # the camera has been running: the store is in its steady state
    for t in range(len(signal)):
        released = store * (1.0 - kept)
        store = store * kept + signal[t] * share
        signal[t] = signal[t] * (1.0 - share) + released
    return signal


def record(
    mean_e: np.ndarray | None,
    spots_e: np.ndarray | None,
    shape: tuple[int, int, int],
    cam: CameraTruth,
    rng: Rng,
    drift_adu: np.ndarray | None = None,
) -> np.ndarray:
    """Record a stack, uint16 (frame, y, x). ``mean_e`` is drawn as Poisson, ``spots_e`` are electrons."""
    spurious = np.broadcast_to(np.float64(cam.spurious_e), shape[1:])
    if cam.spurious_map is not None:
        spurious = spurious * cam.spurious_map
    electrons = rng.poisson(spurious, size=shape) if mean_e is None else rng.poisson(mean_e + spurious)
    if spots_e is not None:
        electrons = electrons + spots_e
    if cam.hot_map_e is not None:
        electrons = electrons + hot_charge(shape, cam, rng)
    if cam.cosmic_per_frame > 0:
        places, charges = particle_charge(shape, cam, rng)
        np.add.at(electrons.reshape(-1), places, charges)

    if cam.kind == "EMCCD":
        signal = multiply(electrons, cam, rng)
    elif cam.kind == "CMOS":
        signal = np.interp(electrons, _CMOS_IN_E, _CMOS_OUT_E).astype(np.float32)
    else:
        signal = electrons.astype(np.float32)
    if cam.serial_charge_e > 0:
        places, amplitudes = serial_charge(shape, cam, rng)
        np.add.at(signal.reshape(-1), places, amplitudes)
    if cam.gain_map is not None:
        signal *= cam.gain_map.astype(np.float32)
    if cam.lag is not None:
        signal = leave_behind(signal, *cam.lag)
    if cam.response is not None:
        signal = cam.response(signal)

    signal += np.float32(cam.read_noise_e) * rng.standard_normal(shape, dtype=np.float32)
    adu = signal / np.float32(cam.electrons_per_adu)
    if cam.row_offset_adu is not None:
        adu += cam.row_offset_adu(shape[0], shape[1], rng)[:, :, None].astype(np.float32)
    if cam.offset_map_adu is not None:
        adu += cam.offset_map_adu.astype(np.float32)
    if drift_adu is not None:
        adu += drift_adu[:, None, None].astype(np.float32)
    # A true baseline need not be an integer; with one, this is the floor of docs/camera.md.
    adu = np.floor(adu + np.float32(cam.baseline_adu))
    return np.clip(adu, 0, cam.adc_max).astype(np.uint16)
