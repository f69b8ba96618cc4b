"""Solving a design for targets, and the least error of a place, against the simulator."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf
from tests.spec_example import MODEL

import napari_mufasa as nm
from napari_mufasa import MufasaError, camera
from napari_mufasa.design.solve import EXPOSURE, POWER

EXAMPLE = nm.Model.from_dict(MODEL)


@pytest.mark.parametrize("path", [POWER, EXPOSURE])
def test_a_movie_has_the_signal_to_noise_that_was_solved_for(path):
    small = EXAMPLE.with_values({"acquisition.n_frames": 12_000, "acquisition.shape_px": (15, 15)})
    found = nm.solve(small, {"snr_spot": 5}, path)
    assert found.prediction.snr_spot == pytest.approx(5, rel=1e-6) and found.met == {"snr_spot": True}
    place = np.array([[7.0, 7.0]])
    movie = nm.simulate(found.model, positions_px=place, seed=6).movie
    traces = nm.extract_traces(
        movie, found.model.camera, positions_px=place, psf_sigma_px=small.sigma_px, subtract_background=False
    )
    dark = 0.9 * small.optics.background_photons_per_px + small.camera.clock_induced_charge_e
    one = traces.all_traces[0]
    signal = one.mean() - dark * _weight(small.sigma_px)
    # The sd of 12 000 frames of multiplied electrons is known to 0.8 %: 5 % are six of them.
    assert signal / one.std() == pytest.approx(5, rel=0.05)


def _weight(sigma_px: float) -> float:
    """What even light of 1 adds to a least-squares fit of the PSF: Σw/Σw²."""
    line = _line(sigma_px, 0.0, 7)[0]
    return float(np.sum(line) ** 2 / np.sum(line**2) ** 2)


def test_molecules_live_as_many_frames_as_was_solved_for():
    values = {"acquisition.n_frames": 2000, "fluorophore.cycles_before_bleaching": 5e3}
    found = nm.solve(nm.preset("FF").with_values(values), {"frames_before_bleaching": 200})
    emission = nm.simulate_emission(found.model, n_molecules=12_000, seed=7)
    told = found.prediction
    lives = emission.sum(axis=1) / told.emitted_photons_per_frame
    # Exponential lives: a mean of 12 000 is known to 0.9 %, 5 % are five of them; e⁻¹⁰ outlive the movie.
    assert lives.mean() == pytest.approx(200, rel=0.05)
    assert told.bleaching_time_s == pytest.approx(200 * found.model.acquisition.interval_s, rel=1e-6)
    # With dead time between exposures the same life gives less light.
    slow = found.model.with_values({"acquisition.frame_interval_s": 0.02})
    again = nm.simulate_emission(slow, n_molecules=12_000, seed=8).sum(axis=1).mean()
    detected = again * slow.camera.quantum_efficiency * slow.optics.collection_efficiency
    assert detected == pytest.approx(nm.predict(slow).detected_e_before_bleaching, rel=0.05)


def _line(sigma, shift, half):
    """A PSF's profile integrated over pixels, and its derivative by the shift."""
    edges = np.arange(-half - 0.5, half + 1) - np.reshape(shift, (-1, 1))
    profile = np.diff(erf(edges / (np.sqrt(2) * sigma)), axis=1) / 2
    slope = -np.diff(np.exp(-(edges**2) / (2 * sigma**2)), axis=1) / (np.sqrt(2 * np.pi) * sigma)
    return profile, slope


@pytest.mark.parametrize("name", ["EMCCD", "CCD"])
def test_a_fit_places_a_molecule_as_well_as_the_bound_says(name):
    values = {"acquisition.n_frames": 4000, "acquisition.shape_px": (15, 15), POWER: 300.0}
    if name == "CCD":
        values |= {"camera.type": "CCD", "camera.em_gain": None, "camera.read_noise_e": 3.0,
                   "camera.electrons_per_adu": 0.5}  # fmt: skip
    model = EXAMPLE.with_values(values)
    told = nm.predict(model)
    movie = nm.simulate(model, positions_px=np.array([[7.0, 7.0]]), seed=9).movie
    counts = camera.photoelectrons(movie, model.camera).astype(float)
    alpha = 2.0 if name == "EMCCD" else 1.0
    dark = 0.9 * model.optics.background_photons_per_px + model.camera.clock_induced_charge_e
    read = (model.camera.read_noise_e / (model.camera.em_gain or 1.0)) ** 2
    y, x, n = np.zeros(4000), np.zeros(4000), np.full(4000, told.detected_e_per_frame)
    for _ in range(6):  # weighted least squares in place and light, the weights those of the model
        (rows, d_rows), (columns, d_columns) = _line(model.sigma_px, y, 7), _line(model.sigma_px, x, 7)
        shape = np.einsum("fi,fj->fij", rows, columns)
        by = np.stack(
            [n[:, None, None] * np.einsum("fi,fj->fij", d_rows, columns),
             n[:, None, None] * np.einsum("fi,fj->fij", rows, d_columns), shape], axis=1
        ).reshape(4000, 3, -1)  # fmt: skip
        weight = 1 / (alpha * (told.detected_e_per_frame * shape + dark) + read).reshape(4000, 1, -1)
        off = (counts - n[:, None, None] * shape - dark).reshape(4000, -1)
        step = np.linalg.solve(
            np.einsum("fap,fbp->fab", by * weight, by), np.einsum("fap,fp->fa", by * weight, off)[..., None]
        )[..., 0]
        y, x, n = y + step[:, 0], x + step[:, 1], n + step[:, 2]
    reached_nm = np.sqrt((x.var() + y.var()) / 2) * model.acquisition.pixel_size_nm
    # The sd of 8000 places is known to 0.8 %; 5 % are six of them.
    assert reached_nm == pytest.approx(told.localisation_nm, rel=0.05)


def test_targets_that_exclude_each_other_are_told():
    model = nm.preset("FF")
    found = nm.solve(model, {"snr_spot": 5, "frames_before_bleaching": 200})
    assert found.met == {"snr_spot": True, "frames_before_bleaching": False} and found.together == ()
    easy = nm.solve(model, {"snr_spot": 1, "frames_before_bleaching": 50})
    ((low, high),) = easy.together
    for power in (low, high):
        told = nm.predict(model.with_values({POWER: power}))
        assert told.snr_spot >= 1 - 1e-6 and told.frames_before_bleaching >= 50 - 1e-4
    assert min(easy.ranges["snr_spot"][0]) == pytest.approx(easy.value)
    # Of errors less is better.
    sharp = nm.solve(model, {"localisation_nm": 20})
    assert nm.predict(sharp.model.with_values({POWER: 2 * sharp.value})).localisation_nm < 20
    assert sharp.ranges["localisation_nm"][0][0] == pytest.approx(sharp.value)


def test_light_that_makes_a_molecule_stand_out_does_so_from_one_power_on():
    model = nm.preset("Blinking").with_values(
        {"fluorophore.cycles_before_bleaching": None, "fluorophore.isc_ratio": None}
    )  # its camera answers to more light with less and less
    (stretch,) = nm.solve(model, {"detection_sd": 450}).ranges["detection_sd"]
    assert stretch[1] > 1e5


def test_light_that_never_ends_is_enough():
    steady = nm.preset("FF").with_values({"fluorophore.cycles_before_bleaching": None})
    found = nm.solve(steady, {"snr_spot": 5, "detected_e_per_visit": 100, "on_time_s": 1})
    assert all(found.met.values())


def test_a_whole_number_is_solved_for_as_one():
    found = nm.solve(nm.preset("FF"), {"bleached_by_the_end": 0.5}, "acquisition.n_frames")
    assert found.value == int(found.value)
    assert found.prediction.bleached_by_the_end <= 0.5
    longer = found.model.with_values({"acquisition.n_frames": int(found.value) + 3})
    assert nm.predict(longer).bleached_by_the_end > 0.5


@pytest.mark.parametrize(
    ("targets", "path", "words"),
    [
        ({"snr_spot": 5}, "optics.colour", "no number of a model"),
        ({"loudness": 5}, POWER, "unknown"),
        ({}, POWER, "no target"),
        ({"snr_spot": -1}, POWER, "finite number"),
        ({"snr_spot": 1e9}, POWER, "cannot be reached"),
        ({"duty_cycle": 0.5}, POWER, "met throughout"),
    ],
)
def test_what_cannot_be_solved_is_told(targets, path, words):
    with pytest.raises(MufasaError, match=words):
        nm.solve(nm.preset("FF"), targets, path)
