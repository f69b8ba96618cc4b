"""A first model holds the truth in its intervals; movies and models that contradict each other are told."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import tifffile
import zarr
from tests.real_data import real_data

import napari_mufasa as nm
from napari_mufasa.camera.detector import photoelectrons
from napari_mufasa.effects import effect_class
from napari_mufasa.files.instrument import Instrument, read_instrument
from napari_mufasa.model.cameras import CAMERAS, camera_type_of
from napari_mufasa.propose import fluctuations, light, proposal
from napari_mufasa.propose.written import camera_told

SHAPE = {"acquisition.shape_px": (96, 96), "acquisition.n_frames": 150, "sample.n_molecules": 40}


@pytest.fixture(scope="module")
def bright():
    model = nm.preset("FF").with_values(SHAPE | {"excitation.power_density_w_per_cm2": 12})
    return model, nm.simulate(model, seed=1).movie, nm.simulate_dark(model, 60, seed=1)


def test_a_simulated_movie_is_proposed_as_it_was_made(bright):
    model, movie, dark = bright
    written = Instrument(pixel_size_nm=100.0, exposure_s=0.01, em_gain=500.0, camera="DU897_BV")
    found = nm.propose_model(movie, dark, instrument=written)
    truth = {
        "optics.psf_fwhm_nm": 308.0, "optics.background_photons_per_px": 20.0, "sample.n_molecules": 40.0,
        "camera.baseline_adu": 367.0, "camera.read_noise_e": 60.58, "adu_per_photoelectron": 500 / 0.74,
        "photons_per_frame": nm.predict(model).collected_photons_per_frame,
    }  # fmt: skip
    held = {name: found.values[name].holds(value) for name, value in truth.items()}
    assert sum(held.values()) >= len(held) - 1, held  # each with 5 % of error
    assert found.model.acquisition.frame_length_s == 0.01 and found.model.camera.em_gain == 500
    assert "camera.quantum_efficiency" in found.unknown and "acquisition.pixel_size_nm" not in found.unknown
    assert nm.predict(found.model).detected_e_per_frame == pytest.approx(found.values["on_level_e"].value, rel=0.02)
    assert nm.mismatches(movie, found.model, dark, written) == []
    assert json.dumps(found.report())


def test_molecules_brighter_than_a_typical_dye_are_proposed_as_bright_as_they_are():
    # 508 photoelectrons in 1 ms: the typical dye would have to be in S1 for 3 % of the time.
    fast = {"acquisition.frame_length_s": 1e-3, "optics.collection_efficiency": 0.6, "sample.min_distance_px": 8.0}
    model = nm.preset("EGFP").with_values(SHAPE | fast | {"excitation.power_density_w_per_cm2": 3e3})
    written = Instrument(pixel_size_nm=100.0, exposure_s=1e-3, em_gain=500.0)
    found = nm.propose_model(nm.simulate(model, seed=1).movie, nm.simulate_dark(model, 60, seed=1), instrument=written)
    level, told = found.values["on_level_e"], nm.predict(found.model).detected_e_per_frame
    assert level.holds(nm.predict(model).detected_e_per_frame) and told == pytest.approx(level.value, rel=1e-3)


@pytest.mark.parametrize(("head", "given"), [("dark", False), ("dark", True), ("dim", False)])
def test_frames_before_the_light_are_left_out_and_dim_ones_are_not(monkeypatch, head, given, tmp_path):
    uneven = effect_class("illumination_profile")(edge_dimming=0.8)
    light_on = {"excitation.power_density_w_per_cm2": 12.0, "optics.background_photons_per_px": 60.0}
    model = nm.preset("FF").with_values(SHAPE | light_on | {"camera.electrons_per_adu": 20.0}).with_effects(uneven)
    dim = model.with_values({name: value / 3 for name, value in light_on.items()})
    before = nm.simulate_dark(model, 20, seed=1) if head == "dark" else nm.simulate(dim, seed=1).movie[:20]
    looked_at = []

    def seen_in(movie, *rest, **how):
        looked_at.append(movie)
        return light.seen_in(movie, *rest, **how)

    monkeypatch.setattr(proposal, "seen_in", seen_in)
    movie = nm.simulate(model, seed=1).movie
    whole = zarr.create_array(tmp_path / "whole.zarr", data=np.concatenate([before, movie]), chunks=(10, 96, 96))
    dark = nm.simulate_dark(model, 60, seed=2) if given else None
    found = nm.propose_model(whole, dark, instrument=Instrument(em_gain=500.0))
    assert "frames 0 to 19 are dark" in found.calibration.notes[0]
    assert looked_at[0].shape[0] == len(movie) + (20 if head == "dim" else 0)
    assert not isinstance(looked_at[0], np.ndarray)  # of an array on disk no part was read at once


@pytest.mark.parametrize("n_dark", [20, 21])
@pytest.mark.parametrize("given", [True, False])
def test_an_alternating_baseline_keeps_its_phase_whatever_the_number_of_dark_frames(monkeypatch, n_dark, given):
    """It is told of the whole movie's even and odd frames, and taken off what is looked at as it lies there: by an odd
    number of frames cut off, twice of it was left: 6 ADU of even less odd frames."""
    rng = np.random.default_rng(3)
    electrons = np.zeros((n_dark + 100, 64, 64))
    electrons[n_dark:] = np.linspace(10, 60, 64)

    def counted(expected):
        even = 1.5 * (1 - 2 * (np.arange(len(expected)) % 2))[:, None, None]
        return np.floor(100 + even + rng.poisson(expected) + rng.normal(0, 4, expected.shape)).astype(np.uint16)

    looked_at = []

    def seen_in(movie, camera, *rest, **how):
        looked_at.append(photoelectrons(np.asarray(movie), camera).mean(axis=(1, 2)))
        return light.seen_in(movie, camera, *rest, **how)

    monkeypatch.setattr(proposal, "seen_in", seen_in)
    dark = counted(np.zeros((60, 64, 64))) if given else None
    found = nm.propose_model(counted(electrons), dark, camera_type="CCD")
    assert found.model.camera.baseline_alternation_adu == pytest.approx(1.5, abs=0.1)
    (level,) = looked_at
    # Means of 4096 pixels of some 39 electrons: 0.1 in a frame, 0.014 in 50 pairs of them.
    assert abs(level[0::2].mean() - level[1::2].mean()) < 0.1
    assert len(level) == 100 - n_dark % 2


def test_the_width_by_fluctuations_reads_a_few_frames_at_a_time(bright):
    """An array that reads whatever is asked of it at once, as zarr's do."""
    model, movie, _ = bright
    asked = []

    class Eager:
        shape, dtype = movie.shape, movie.dtype

        def __getitem__(self, key):
            asked.append(movie[key].shape[0])
            return movie[key].copy()

    seen = fluctuations.fluctuation_width(Eager(), model.camera)
    assert max(asked) == fluctuations.WINDOW
    assert repr(seen) == repr(fluctuations.fluctuation_width(movie, model.camera))


def test_a_model_is_not_proposed_from_three_frames(bright):
    _, movie, dark = bright
    with pytest.raises(nm.MufasaError, match="3 frames: give 4 or more"):
        nm.propose_model(movie[:3], dark)


def test_more_counts_than_the_metadata_have_bits_are_told(bright):
    _, movie, dark = bright
    found = nm.propose_model(movie, dark, instrument=Instrument(bit_depth=10, em_gain=500.0))
    assert found.model.camera.adc_max == 65535 and any("10 bits" in note for note in found.notes)


def test_an_offset_map_is_part_of_the_dark_level(bright):
    model, movie, dark = bright
    map_adu = np.random.default_rng(1).normal(367, 2, SHAPE["acquisition.shape_px"])
    alone = model.with_values({"camera.baseline_adu": 0.0, "camera.offset_map_adu": map_adu})
    assert nm.mismatches(movie, alone, dark) == []
    assert [one.field for one in nm.mismatches(movie + 500, alone, dark + 500)] == ["camera.baseline_adu"]


def test_a_conversion_that_no_sensor_could_have_counts_as_not_measured(bright, monkeypatch):
    """Noise that is almost none would mean millions of photoelectrons in every pixel."""
    from napari_mufasa.propose import proposal

    def too_sure(*given, **more):
        found = calibrate(*given, **more)
        few = replace(found.adu_per_photoelectron, value=1e-6)
        return replace(found, adu_per_photoelectron=few)

    calibrate = proposal.calibrate
    monkeypatch.setattr(proposal, "calibrate", too_sure)
    found = nm.propose_model(*bright[1:])
    assert "photoelectrons in every pixel" in found.unknown["camera"] and found.values == {}


def test_what_cannot_be_known_is_said(bright):
    _, movie, dark = bright
    found = nm.propose_model(movie, dark)
    for name in ("acquisition.pixel_size_nm", "acquisition.frame_length_s", "camera.em_gain", "fluorophore"):
        assert found.unknown[name]


@pytest.mark.parametrize(
    ("changes", "field"),
    [({"camera.baseline_adu": 15000.0}, "camera.baseline_adu"), ({"camera.em_gain": 150.0}, "camera.em_gain"),
     ({"acquisition.pixel_size_nm": 160.0}, "acquisition.pixel_size_nm"),
     ({"acquisition.frame_length_s": 0.02}, "acquisition.frame_length_s")],
)  # fmt: skip
def test_a_movie_and_a_model_that_cannot_belong_together(bright, changes, field):
    model, movie, dark = bright
    written = Instrument(pixel_size_nm=100.0, exposure_s=0.01)
    assert nm.mismatches(movie, model, None, written) == nm.mismatches(movie, model, dark, written) == []
    told = nm.mismatches(movie, model.with_values(changes), None, written)
    assert [one.field for one in told] == [field] and told[0].words


def test_settings_of_micro_manager_are_read(tmp_path):
    settings = {
        "Andor-Gain": "300", "Andor-Exposure": "50.00", "Andor-Pre-Amp-Gain": "Gain 3", "Exposure-ms": 50,
        "Andor-ReadoutMode": "17.000 MHz", "PixelSizeUm": 0.16, "Interval_ms": 55.0, "BitDepth": 16,
        "Camera": "Andor | DU-897",
    }  # fmt: skip
    path = tmp_path / "mm.tif"
    tag = (51123, "s", 0, json.dumps(settings), True)
    tifffile.imwrite(path, np.zeros((3, 8, 8), np.uint16), extratags=[tag])
    found = read_instrument(path)
    assert found == Instrument("Andor | DU-897", 300.0, 3.0, 17e6, 0.05, pytest.approx(0.055), 160.0, 16)
    assert camera_type_of(found.camera) == "EMCCD"


def test_settings_of_ome_and_of_our_own_movies_are_read(tmp_path, bright):
    from napari_mufasa import files

    path = tmp_path / "o.ome.tif"
    tifffile.imwrite(
        path, np.zeros((2, 8, 8), np.uint16),
        metadata={"axes": "TYX", "PhysicalSizeX": 0.11, "PhysicalSizeXUnit": "µm",
                  "Plane": {"ExposureTime": [30.0, 30.0], "ExposureTimeUnit": ["ms", "ms"]}},
    )  # fmt: skip
    found = read_instrument(path)
    assert found.pixel_size_nm == pytest.approx(110.0) and found.exposure_s == pytest.approx(0.03)
    model, movie, _ = bright
    files.write_movie(tmp_path / "own.ome.tif", [movie], movie.shape, np.uint16, model=model, seed=1)
    assert read_instrument(tmp_path / "own.ome.tif").pixel_size_nm == pytest.approx(100.0)
    assert read_instrument(tmp_path / "none.tif") == Instrument()


@pytest.mark.parametrize(
    ("written", "given", "told", "words"),
    [
        (Instrument(gain=4.0), (None, None), (None, None), "a gain of 4, but of no EM gain"),
        (Instrument(camera="iXon", gain=4.0), (None, None), (None, None), "EM register (iXon) and a gain of 4"),
        (Instrument(camera="iXon", em_gain=300.0), (None, None), ("EMCCD", 300.0), None),
        (Instrument(camera="iXon", em_gain=1.0), (None, None), (None, 1.0), None),
        (
            Instrument(camera="iXon", em_gain=300.0, register="off"),
            (None, None),
            (None, 1.0),
            "not pass the EM register",
        ),
        (Instrument(camera="iXon", register="off"), ("EMCCD", None), ("EMCCD", None), None),
        (Instrument(camera="iXon", em_gain=300.0), (None, 1.0), (None, 1.0), None),
        (Instrument(camera="iXon", em_gain=300.0), ("CCD", None), ("CCD", None), None),
        (Instrument(camera="Zyla", em_gain=4.0), (None, None), ("CMOS", None), None),
        (Instrument(), (None, 300.0), ("EMCCD", 300.0), None),
        (Instrument(), (None, None), (None, None), None),
    ],
)
def test_what_is_told_of_the_camera_says_no_register_that_did_not_multiply(written, given, told, words):
    kind, gain, notes = camera_told(written, *given)
    assert (kind, gain) == told
    assert (words is None and notes == []) or words in " ".join(notes)


def test_an_em_gain_of_1_in_the_metadata_that_the_counts_refute_is_not_taken(bright):
    """A wheel that the software did not read: the register multiplied all the same."""
    _, movie, dark = bright
    found = nm.propose_model(movie, dark, instrument=Instrument(camera="iXon", em_gain=1.0))
    assert (found.model.camera.type, found.model.camera.em_gain) == ("EMCCD", 300.0)
    assert "gain 300 is taken" in found.unknown["camera.em_gain"]
    assert sum("the EM gain is said to be 1, but" in note for note in found.notes) == 1


@pytest.mark.parametrize(("camera", "em_gain"), [("iXon", None), ("iXon", 1.0), (None, None)])
def test_a_register_that_did_not_multiply_does_not_double_the_light(camera, em_gain):
    """The name of such a camera, a gain of no said kind, and an EM gain of 1 made an EMCCD of a CCD's counts."""
    rng = np.random.default_rng(0)
    light = np.broadcast_to(np.linspace(10, 60, 64), (60, 64, 64))
    movie, dark = (
        np.floor(100 + 2 * (rng.poisson(electrons) + rng.normal(0, 4, (60, 64, 64)))).astype(np.uint16)
        for electrons in (light, 0 * light)
    )
    found = nm.propose_model(movie, dark, instrument=Instrument(camera=camera, gain=4.0), em_gain=em_gain)
    assert found.model.camera.type == "CCD"
    assert found.values["adu_per_photoelectron"].value == pytest.approx(2.0, rel=0.05)
    told = "an EM gain of 1 multiplies nothing: CCD is taken" if em_gain else "but of no EM gain: the counts decide"
    assert sum(told in note for note in found.notes) == 1


def test_named_cameras_are_cameras():
    for name, values in CAMERAS.items():
        assert nm.Camera.model_validate(values).type == (camera_type_of(name) or values["type"]), name


def gaussian_width(image, sigma):
    """Of one spot, by least squares, pixels integrated; σ in px."""
    from scipy.optimize import curve_fit
    from scipy.special import erf

    y, x = np.indices(image.shape) - len(image) // 2

    def spot(_, a, b, cy, cx, s):
        wide = s * np.sqrt(2)
        along = [erf((z - c + 0.5) / wide) - erf((z - c - 0.5) / wide) for z, c in ((y, cy), (x, cx))]
        return (b + a * along[0] * along[1]).ravel()

    start = (np.ptp(image), image.min(), 0, 0, sigma)
    return float(curve_fit(spot, None, image.ravel(), p0=start, maxfev=2000)[0][4])


@pytest.mark.realdata
def test_the_width_of_a_real_movie_is_that_of_a_fit_to_isolated_spots():
    movie = tifffile.imread(real_data("smfret_ixon_emccd.tif"))
    found = nm.propose_model(movie, em_gain=300, frame_length_s=0.15)
    sigma = found.values["psf_sigma_px"].value
    traces = nm.extract_traces(movie, found.model.camera, psf_sigma_px=sigma)
    widths = []
    for (y, x), lit in zip(traces.positions_px[traces.kept], traces.lit[traces.kept], strict=True):
        cy, cx = round(y), round(x)
        if 4 <= cy < movie.shape[1] - 4 and 4 <= cx < movie.shape[2] - 4:
            widths.append(gaussian_width(movie[lit, cy - 3 : cy + 4, cx - 3 : cx + 4].mean(axis=0), sigma))
    assert sigma == pytest.approx(float(np.median(widths)), rel=0.1)
    assert found.values["camera.baseline_adu"].value == pytest.approx(108, abs=10)
    assert nm.mismatches(movie, found.model) == []
    told = nm.mismatches(movie, nm.preset("FF"))
    assert told[0].field == "camera.baseline_adu" and "darkest pixels" in told[0].words


@pytest.mark.realdata
def test_the_settings_of_a_real_movie():
    assert read_instrument(real_data("emccd_gain_series/300x-gain.tif")).bit_depth == 16
