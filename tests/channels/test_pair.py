"""Donor and acceptor side by side, against movies whose efficiency is known (docs/two_channels.md)."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from tests.channels.splitter import BRIGHT, MODEL, splitter

from napari_mufasa import files
from napari_mufasa.camera import photoelectrons
from napari_mufasa.camera.frames import Frames
from napari_mufasa.channels import extract_pair, register, simulate_pair
from napari_mufasa.channels.efficiency import Corrections, frame_by_frame, of_molecules
from napari_mufasa.channels.table import write_pair
from napari_mufasa.channels.together import Together
from napari_mufasa.effects import effect_class
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.traces import read_trace_file

THERE = splitter()
E = np.linspace(0.1, 0.9, 40)[:, None]


@pytest.fixture(scope="module")
def channels():
    return register(simulate_pair(BRIGHT, 0.5, THERE, seed=5).movie)


def extracted(made, channels, **options):
    return extract_pair(made.movie, MODEL.camera, channels, psf_sigma_px=MODEL.sigma_px, **options)


def truth_of(found, made):
    """(kept,) which molecule each kept one is; all of them are one."""
    distance = np.hypot(*(found.donor.positions_px[found.kept][:, None] - made.positions_px).transpose(2, 0, 1))
    assert (distance.min(axis=1) < 0.5).all()
    return distance.argmin(axis=1)


@pytest.fixture(scope="module")
def movies():
    return [simulate_pair(MODEL, E, THERE, seed=seed) for seed in (11, 12, 13)]


@pytest.fixture(scope="module")
def read(movies, channels):
    return [extracted(made, channels) for made in movies]


def test_a_known_efficiency_comes_back_within_its_error(movies, read):
    off, sd = [], []
    for made, found in zip(movies, read, strict=True):
        table = found.molecules[found.kept]
        off += list(table["efficiency"] - made.efficiency[truth_of(found, made), 0])
        sd += list(table["efficiency_sd"])
    assert len(off) > 90 and np.median(sd) < 0.015
    z = np.array(off) / sd
    # Of 95 molecules and more: the mean of z has sd 0.1, its sd an error of 0.07.
    assert abs(z.mean()) < 0.35 and 0.75 < z.std() < 1.3


def test_every_efficiency_has_the_same_chance_to_be_kept(movies, read):
    """Looked for in the sum, molecules of high efficiency are not lost; in the donor's light they are."""
    kept = np.concatenate([truth_of(found, made) for made, found in zip(movies, read, strict=True)])
    low, high = np.count_nonzero(kept < 20), np.count_nonzero(kept >= 20)
    assert abs(low - high) < 20 and min(low, high) > 35


@pytest.mark.parametrize("find_in", ["donor", "sum"])
def test_reasons_are_those_of_the_light_of_both_channels(movies, channels, find_in):
    """By half of their light most molecules are too noisy here, by all of it a fifth. What is kept is what the table
    says."""
    every = extracted(movies[0], channels, find_in=find_in, min_snr=0).molecules
    least = every["snr"].quantile(0.2)
    options = {"find_in": find_in, "min_snr": least, "window": 50, "best": 8}
    found = extracted(movies[0], channels, **options).molecules
    clear = (every["kept"] & (every["snr"] >= least)).to_numpy()
    assert clear.sum() > 8 and found["kept"].sum() == 8
    assert found["reason"][clear & ~found["kept"]].eq("not among the 8 best").all()
    assert found["snr"][found["kept"]].min() >= found["snr"][clear & ~found["kept"]].max()
    noisy = found["reason"].str.startswith("SNR")
    assert noisy.any() and (found["snr"][noisy] < least).all()
    kept = found[found["kept"]]  # nothing bleaches: windows are the last frames
    assert (kept["window_start"] == np.where(kept["bleaching_frame"] < 0, 100, kept["bleaching_frame"]) - 50).all()


def test_molecules_that_differ_in_brightness_and_move_do_so_in_both_channels():
    places = np.array([[12.0, 12.0], [12.0, 36.0], [36.0, 12.0], [36.0, 36.0]])
    effects = [
        effect_class("brightness_heterogeneity")(spread=0.5),
        effect_class("stage_drift")(form="wandering", distance_px=6.0),
    ]
    model = MODEL.in_shape(n_frames=40, shape_px=(48, 48)).with_effects(*effects)
    dark = {"optics.background_photons_per_px": 0.0, "camera.read_noise_e": 0.0}
    made = simulate_pair(model.with_values(dark), 0.5, None, places, seed=2)
    electrons = photoelectrons(made.movie, model.camera)
    halves = [half.reshape(-1, 2, 24, 2, 24).sum(axis=(0, 2, 4)) for half in (electrons[..., :48], electrons[..., 48:])]
    # Ten thousand photons of each in each channel, and register and floor: E is known to 1 %. It scattered by 16 %.
    assert (halves[1] / (halves[0] + halves[1])).ravel() == pytest.approx(np.full(4, 0.5), abs=0.05)
    images = [half[-10:].sum(axis=0) for half in (electrons[..., :48], electrons[..., 48:])]
    centres = [np.array([np.average(axis, weights=image) for axis in np.indices(image.shape)]) for image in images]
    np.testing.assert_allclose(*centres, atol=1.5)


def test_the_light_of_both_channels_is_that_emitted(movies, read):
    made, found = movies[0], read[0]
    which = truth_of(found, made)
    detected = MODEL.optics.collection_efficiency * MODEL.camera.quantum_efficiency
    for side, emitted in ((found.donor, made.donor), (found.acceptor, made.acceptor)):
        ratio = side.traces.mean(axis=1).sum() / (detected * emitted[which].mean(axis=1).sum())
        assert ratio == pytest.approx(1, abs=0.03)


def test_leakage_raises_the_apparent_efficiency_and_is_taken_off(channels):
    made = simulate_pair(MODEL, 0.3, THERE, leakage=0.1, seed=3)
    apparent, corrected = extracted(made, channels), extracted(made, channels, leakage=0.1)
    expected = (0.3 + 0.07) / 1.07  # of 0.7 in the donor's channel a tenth is seen again
    for found, wanted in ((apparent, expected), (corrected, 0.3)):
        table = found.molecules[found.kept]
        assert table["efficiency"].mean() == pytest.approx(wanted, abs=4 * table["efficiency_sd"].mean() / 5)
    assert apparent.corrections.none and not corrected.corrections.none


def test_corrections_are_what_they_say():
    donor, acceptor = np.full((1, 4), 60.0), np.full((1, 4), 61.0)
    lit = np.array([[True, True, True, False]])
    corrections = Corrections(leakage=0.1, direct_excitation_e=5.0, gamma=0.5)
    told = of_molecules(donor, acceptor, lit, corrections)
    assert told["efficiency"][0] == pytest.approx(50 / (30 + 50)) and told["efficiency_sd"][0] == pytest.approx(0)
    assert (told["donor_e"][0], told["acceptor_e"][0]) == (60, 61)  # as they were read
    frames = frame_by_frame(donor, acceptor, lit, corrections)
    np.testing.assert_allclose(frames[0, :3], 50 / 80)
    assert np.isnan(frames[0, 3])
    # A place that is missed by a hundredth of the light moves E by E (1 − E)/100 at most.
    missed = of_molecules(donor, acceptor, lit, corrections, 0.01)["efficiency_sd"][0]
    assert missed == pytest.approx(0.01 * 50 / 80 * 30 / 80)


def test_a_molecule_that_is_never_on_has_no_efficiency():
    told = of_molecules(np.ones((2, 5)), np.ones((2, 5)), np.zeros((2, 5), bool), Corrections())
    assert np.isnan(told["efficiency"]).all() and np.isnan(told["donor_e"]).all()


def test_together_is_the_sum_on_the_donors_pixels(channels):
    made = simulate_pair(BRIGHT, 0.5, THERE, seed=6)
    sides = [
        Frames(side.crop(made.movie), side.camera(MODEL.camera, channels.frame_px))
        for side in (channels.donor, channels.acceptor)
    ]
    both = Together(sides[0], sides[1], channels.transform)
    assert both.shape == (10, 96, 96) and both[2:5].shape == (3, 96, 96)
    np.testing.assert_array_equal(both[4], both[4:5][0])
    image, alone = both[:].mean(axis=0), [side.photoelectrons(side.movie).mean(axis=0) for side in sides]
    inside = np.all((made.positions_px > 8) & (made.positions_px < 87), axis=1)
    for y, x in np.rint(made.positions_px[inside]).astype(int):
        spot = np.s_[y - 3 : y + 4, x - 3 : x + 4]
        # Half of the light is in each channel; nothing of it is lost between the pixels.
        light = image[spot].sum() - 49 * np.median(image)
        assert light == pytest.approx(2 * (alone[0][spot].sum() - 49 * np.median(alone[0])), rel=0.25)


def test_molecules_that_the_acceptors_channel_does_not_hold_say_so(read):
    reasons = pd.concat([found.molecules for found in read])["reason"]
    assert (reasons == "outside the acceptor's channel").any()


def test_what_is_written_is_read_again(read, tmp_path):
    found = read[0]
    write_pair(tmp_path, found, hdf5=True, openfret=True, acquisition=MODEL.acquisition)
    table = pd.read_csv(tmp_path / "traces.csv")
    assert list(table) == ["molecule", "frame", "photoelectrons", "donor", "acceptor", "efficiency"]
    np.testing.assert_allclose(table["photoelectrons"], table["donor"] + table["acceptor"], atol=2e-3)
    for name, side in (("donor", found.donor), ("acceptor", found.acceptor)):
        for path, channel in ((f"{name}.csv", "donor"), ("traces.openfret.json", name)):
            again = read_trace_file(tmp_path / path, channel=channel)
            np.testing.assert_allclose(again.traces, side.traces, atol=1e-3)
            assert again.unit == "photoelectrons"
    np.testing.assert_allclose(read_trace_file(tmp_path / "traces.h5").traces, found.together.traces, atol=1e-3)
    molecules = pd.read_csv(tmp_path / "molecules.csv")
    assert {"kept", "reason", "y_acceptor_px", "x_acceptor_px", "efficiency", "efficiency_sd"} <= set(molecules)
    assert json.loads((tmp_path / "channels.json").read_text())["donor"] == "0:96,0:96"


def test_a_model_of_one_channel_is_no_contradiction_to_a_movie_of_both(movies, channels, tmp_path):
    files.write_movie(tmp_path / "both.ome.tif", [movies[0].movie], movies[0].movie.shape, np.uint16)
    MODEL.to_json(tmp_path / "model.json")
    channels.to_json(tmp_path / "channels.json")
    command = "traces both.ome.tif --model model.json --channels channels.json --out traces"
    done = subprocess.run(
        [sys.executable, "-m", "napari_mufasa", *command.split()], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0 and (tmp_path / "traces" / "donor.csv").exists()
    assert "the model says" not in done.stderr + done.stdout


def test_windows_and_the_choice_by_hand_hold_for_both(movies, channels):
    found = extracted(movies[0], channels, window=30, best=5)
    assert found.donor.traces.shape == found.acceptor.traces.shape == (5, 30)
    fewer = found.with_kept([int(found.molecules["molecule"][found.kept].iloc[0])], False)
    assert fewer.donor.traces.shape == fewer.acceptor.traces.shape == (4, 30)
    assert fewer.kept.sum() == fewer.acceptor.kept.sum() == 4
    assert "rejected by hand" in set(fewer.molecules["reason"])


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"find_in": "acceptor"}, "find_in"), ({"leakage": 1.5}, "leakage"), ({"gamma": 0}, "gamma"),
        ({"direct_excitation_e": -1}, "direct_excitation_e"), ({"follow_molecules": True}, "follow_molecules"),
        ({"subtract_background": False}, "background"), ({"acceptor_sigma_px": 0}, "acceptor_sigma_px"),
        ({"colour": "red"}, "colour"),
    ],
)  # fmt: skip
def test_bad_input_is_named(movies, channels, options, word):
    with pytest.raises(MufasaError, match=word):
        extracted(movies[0], channels, **options)


def test_frames_that_were_not_registered_are_refused(movies, channels):
    with pytest.raises(MufasaError, match="registered on frames of 96 × 192 px"):
        extract_pair(movies[0].movie[:, :, :96], MODEL.camera, channels)
    with pytest.raises(MufasaError, match="channels"):
        extract_pair(movies[0].movie, MODEL.camera, "channels.json")


@pytest.mark.parametrize("efficiency", [1.5, -0.1, np.zeros((3, 3)), "high"])
def test_an_efficiency_that_is_none_is_refused(efficiency):
    with pytest.raises(MufasaError, match="efficiency"):
        simulate_pair(BRIGHT, efficiency)
