"""What a model implies, in the numbers an experimenter knows: rates, photons, signal to noise. No Qt here."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from napari_mufasa.model.model import Model


def derived_values(model: Model) -> list[tuple[str, str, str]]:
    """(name, value with unit, explanation) of what follows from a model, for display."""
    from napari_mufasa.camera.detector import multiplication_noise
    from napari_mufasa.photophysics import rates

    dye, light, optics, camera = model.fluorophore, model.excitation, model.optics, model.camera
    k01 = rates.excitation_rate(dye.extinction_coefficient_per_M_cm, light.power_density_w_per_cm2, light.wavelength_nm)
    k10 = rates.relaxation_rate(dye.lifetime_s)
    cycles_per_s = k01 * k10 / (k01 + k10) if k01 > 0 else 0.0
    emitted = cycles_per_s * dye.quantum_yield * model.acquisition.frame_length_s
    collected = emitted * optics.collection_efficiency * optics.brightness_correction
    peak = collected * math.erf(0.5 / (model.sigma_px * math.sqrt(2))) ** 2
    signal_e = camera.quantum_efficiency * peak
    dark_e = camera.quantum_efficiency * optics.background_photons_per_px + camera.clock_induced_charge_e
    gain = float(camera.em_gain or 1.0) if camera.type == "EMCCD" else 1.0
    noise_e = math.sqrt(multiplication_noise(camera) * (signal_e + dark_e) + (camera.read_noise_e / gain) ** 2)
    rows = [
        ("Excitation rate k01", f"{_short(k01)} /s", "from ε, power density and wavelength"),
        ("Photons emitted", f"{_short(emitted)} per frame", "by one molecule that is on for the whole frame"),
        ("Photons collected", f"{_short(collected)} per frame", "of those, what reaches the detector"),
        ("Brightest pixel", f"{_short(signal_e)} e⁻", "photoelectrons of one molecule in its centre pixel"),
        ("Signal to noise", f"{signal_e / noise_e:.2g}" if noise_e else "∞", "brightest pixel, one frame"),
    ]
    if dye.cycles_before_bleaching is not None and cycles_per_s > 0:
        time_s = dye.cycles_before_bleaching / cycles_per_s
        frames = time_s / model.acquisition.interval_s
        rows.append(
            ("Bleaching after", f"{_short(time_s)} s ({_short(frames)} frames)", "mean time on before bleaching")
        )
    length_s = model.acquisition.n_frames * model.acquisition.interval_s
    rows.append(("Movie length", f"{_short(length_s)} s", "number of frames × frame interval"))
    return rows


def _short(value: float) -> str:
    if value == 0 or not np.isfinite(value):
        return f"{value:g}"
    if abs(value) >= 1e5 or abs(value) < 1e-2:
        return f"{value:.2e}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
