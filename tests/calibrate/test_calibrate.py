"""Photon transfer gives back the camera (docs/camera.md)."""

from __future__ import annotations

import numpy as np
import pytest
from tests.real_data import real_data

import napari_mufasa as nm
from napari_mufasa.calibrate.dark import leading_dark_frames
from napari_mufasa.calibrate.measure import calibrate


def movie_and_dark(name, **changes):
    model = nm.preset(name).with_values({"acquisition.n_frames": 100, "acquisition.shape_px": (64, 64), **changes})
    return model, nm.simulate(model, seed=1).movie, nm.simulate_dark(model, 60, seed=2)


def test_emccd_values_come_back():
    model, movie, dark = movie_and_dark("FF")
    camera = model.camera
    found = calibrate(movie, dark, em_gain=camera.em_gain)
    assert found.baseline_adu.value == pytest.approx(camera.baseline_adu, abs=1.0)
    assert found.read_noise_adu.value == pytest.approx(camera.read_noise_e / camera.electrons_per_adu, rel=0.02)
    assert found.adu_per_photoelectron.value == pytest.approx(camera.em_gain / camera.electrons_per_adu, rel=0.03)
    assert found.camera.electrons_per_adu == pytest.approx(camera.electrons_per_adu, rel=0.03)
    assert found.clock_induced_charge_e.value == pytest.approx(0.002, rel=0.25)  # 490 electrons: 4 sd are 18 %
    assert abs(found.slope_adu.value / 2 - camera.em_gain / camera.electrons_per_adu) < 6 * found.slope_adu.sd
    assert any("excess noise factor 2" in note for note in found.notes)


def test_cmos_has_no_excess_noise():
    linear = ((0.0, 0.0), (1.0, 1.0))
    model, movie, dark = movie_and_dark(
        "Blinking",
        **{
            "fluorophore.isc_ratio": None,
            "fluorophore.cycles_before_bleaching": None,
            "camera.electrons_per_adu": 0.5,
            "camera.cmos_gain_curve": linear,
        },
    )
    found = calibrate(movie, dark, camera_type="CMOS")
    assert found.excess_noise_factor == 1.0
    assert found.camera.electrons_per_adu == pytest.approx(0.5, rel=0.03)
    assert found.camera.read_noise_e == pytest.approx(model.camera.read_noise_e, rel=0.03)


def test_blinking_molecules_do_not_raise_the_gain():
    from napari_mufasa.effects import effect_from_data

    model = nm.preset("FF").with_values({"acquisition.n_frames": 300, "acquisition.shape_px": (96, 96)})
    blinking = effect_from_data({"kind": "triplet_blinking", "off_rate_per_s": 40.0, "dark_time_s": 0.03})
    model = model.with_values({"excitation.power_density_w_per_cm2": 20}).with_effects(blinking)
    found = calibrate(nm.simulate(model, seed=3).movie, nm.simulate_dark(model, 60, seed=4), em_gain=500)
    assert found.camera.electrons_per_adu == pytest.approx(0.74, rel=0.08)


def test_leading_dark_frames_are_found_and_used():
    _, movie, dark = movie_and_dark("FF")
    together = np.concatenate([dark[:20], movie])
    assert leading_dark_frames(together) == 20
    assert leading_dark_frames(movie) == 0
    found = calibrate(together, em_gain=500)
    assert found.camera.electrons_per_adu == pytest.approx(0.74, rel=0.04)


def test_bad_input_is_named():
    _, movie, dark = movie_and_dark("FF")
    with pytest.raises(nm.MufasaError, match="4 frames"):
        calibrate(movie[:3], dark)
    with pytest.raises(nm.MufasaError, match="dark has shape"):
        calibrate(movie, dark[:, :10])
    with pytest.raises(nm.MufasaError, match="record dark frames"):
        calibrate(np.random.default_rng(0).poisson(100, (50, 32, 32)).astype(np.uint16))
    with pytest.raises(nm.MufasaError, match="variance"):
        calibrate(np.full((20, 32, 32), 900, np.uint16), dark=np.full((20, 32, 32), 100, np.uint16))


def real(name):
    import tifffile

    return tifffile.imread(real_data(name))


@pytest.mark.realdata
@pytest.mark.parametrize(("gain", "by_mean"), [(5, 4.8), (25, 23.0), (100, 90.0), (300, 262.0)])
def test_real_gain_series(gain, by_mean):
    """Gain by photon transfer (F² = 2) against gain by the ratio of the means; F² is 1.79 … 1.99 there."""
    folder = "emccd_gain_series/"
    movie = real(f"{folder}{gain}x-gain.tif")
    offset = float(real(f"{folder}{gain}x-gain_no-signal_S0.tif").mean())
    noise = float(real(f"{folder}{gain}x-gain_no-signal_sigma.tif").mean())
    found = calibrate(movie, baseline_adu=offset, read_noise_adu=noise, electrons_per_adu=3.859)
    assert found.camera.em_gain == pytest.approx(by_mean, rel=0.12)


@pytest.mark.realdata
def test_real_yeast_and_smfret():
    yeast = calibrate(real("yeast_slimfield_emccd.tif"))
    assert "frames 0 to 26 are dark" in yeast.notes[0]
    assert yeast.baseline_adu.value == pytest.approx(195.5, abs=1.0)
    assert yeast.read_noise_adu.value == pytest.approx(41, abs=1)
    assert 20 <= yeast.slope_adu.value <= 24
    smfret = calibrate(real("smfret_ixon_emccd.tif"), em_gain=300)
    assert 37 <= smfret.slope_adu.value <= 41
    assert 100 <= smfret.baseline_adu.value <= 118
