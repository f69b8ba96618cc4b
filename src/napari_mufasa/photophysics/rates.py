"""Rates of one fluorophore, per second (docs/photophysics.md)."""

from __future__ import annotations

import numpy as np
from scipy import constants

FEW_EVENTS = 3.0  # events below which only a limit is told


def excitation_rate(extinction_per_M_cm: float, power_w_per_cm2: float, wavelength_nm: float) -> float:
    """k01 = ε P λ 10⁻⁶ ln10 / (N_A h c): absorption cross-section times photon flux."""
    molar_photon_energy = constants.N_A * constants.h * constants.c
    return float(extinction_per_M_cm * power_w_per_cm2 * wavelength_nm * 1e-6 * np.log(10) / molar_photon_energy)


def relaxation_rate(lifetime_s: float) -> float:
    """k10 = 1/τ."""
    return 1.0 / lifetime_s


def intersystem_crossing_rate(isc_ratio: float, lifetime_s: float) -> float:
    """k1T = α_isc · k10."""
    return isc_ratio / lifetime_s


def bleaching_rate(cycles: float, lifetime_s: float) -> float:
    """k1B = 1/(N_c τ): one bleaching in N_c cycles on average."""
    return 1.0 / (cycles * lifetime_s)


def most_per_s(events: float, watched_s: float) -> float:
    """The largest rate, 1/s, at which no more than so many events in `watched_s` are seen once in 40 times."""
    from scipy import stats

    return float(stats.chi2.ppf(0.975, 2 * events + 2) / 2 / watched_s)
