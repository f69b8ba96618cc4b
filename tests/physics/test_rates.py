"""Check values of docs/photophysics.md, to all digits given there."""

import numpy as np
import pytest

from napari_mufasa import preset, simulate_emission
from napari_mufasa.photophysics import rates
from napari_mufasa.photophysics.protocols import protocol_chain


@pytest.mark.parametrize(
    ("epsilon", "wavelength_nm", "power", "expected", "digits"),
    [
        (55_900, 488, 2, 1050.15, 0.005),  # EGFP, Table 4
        (270_000, 647, 2, 6724.90, 0.005),  # FF, Tables 2 and 3
        (239_000, 641, 1000, 2.949e6, 500),  # Alexa647-STORM, Table 5
    ],
)
def test_excitation_rates_of_the_tables(epsilon, wavelength_nm, power, expected, digits):
    assert rates.excitation_rate(epsilon, power, wavelength_nm) == pytest.approx(expected, abs=digits)


def test_excitation_rate_is_cross_section_times_photon_flux():
    h, c, avogadro = 6.62607015e-34, 299_792_458.0, 6.02214076e23
    sigma_cm2 = 1000 * np.log(10) * 55_900 / avogadro
    photons_per_cm2_s = 30 / (h * c / 488e-9)
    assert rates.excitation_rate(55_900, 30, 488) == pytest.approx(sigma_cm2 * photons_per_cm2_s, rel=1e-9)


def test_presets_have_the_rates_of_the_tables():
    for name, expected in (("EGFP", 1050.15), ("FF", 6724.90), ("Alexa647-STORM", 2.949e6)):
        chain = protocol_chain(preset(name))
        assert chain.matrix(driven=True).sum() == pytest.approx(expected, rel=2e-4)


def test_other_rates():
    assert rates.relaxation_rate(2e-9) == pytest.approx(5e8)
    assert rates.intersystem_crossing_rate(1e-2, 2e-9) == pytest.approx(5e6)
    assert rates.bleaching_rate(5e5, 2e-9) == pytest.approx(1000.0)


def test_ff_gives_67_2_photons_per_10_ms_frame():
    model = preset("FF").with_values({"fluorophore.cycles_before_bleaching": None, "acquisition.n_frames": 100})
    counts = simulate_emission(model, 500, seed=3)
    # 50 000 Poisson counts of mean 67.25: sd of the mean 0.037; ±4 sd, false alarm 6e-5.
    assert counts.mean() == pytest.approx(67.249, abs=0.147)
    assert counts.var() == pytest.approx(67.249, rel=4 * np.sqrt(2 / counts.size) + 1e-3)


def test_alexa647_bursts_hold_625_photons():
    """A burst ends by intersystem crossing once in 1/α_isc = 625 cycles, after about 0.2 ms."""
    model = preset("Alexa647-STORM").with_values({"acquisition.n_frames": 1000})
    chain = protocol_chain(model)
    rate = dict(zip(chain.states, chain.matrix(driven=False)[chain.states.index("S1")], strict=True))
    up = chain.matrix(driven=True).sum()
    assert rate["S0"] / rate["T1"] == pytest.approx(625)
    assert 1 / (up * rate["T1"] / (rate["T1"] + rate["S0"] + up)) == pytest.approx(0.2e-3, rel=0.1)
    counts = simulate_emission(model, 4000, seed=5)
    # 36 s at 0.1 returns per s: frames with light nearly always hold one burst (geometric, sd ≈ mean = 625).
    bursts = counts[counts > 0]
    one_in_a_frame = bursts.mean() / (1 + 0.5 * 0.1 * 0.036)  # a second burst in the same frame: 0.18 %
    # A burst of 0.2 ms is cut by a frame edge in 0.6 % of the cases, which makes two bursts of one.
    assert one_in_a_frame == pytest.approx(625, abs=4 * 625 / np.sqrt(bursts.size) + 0.01 * 625)
