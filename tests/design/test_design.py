"""Predictions of `design` against the simulator they stand for."""

from __future__ import annotations

import re

import numpy as np
import pytest
from tests.spec_example import MODEL

from napari_mufasa import MufasaError, camera, compare, extract_traces, preset, simulate, simulate_emission
from napari_mufasa.camera.frames import Frames
from napari_mufasa.design.predict import design, predict
from napari_mufasa.model.model import Model
from napari_mufasa.report.words import derived_values, hardly_seen
from napari_mufasa.spots.find import find_spots

EXAMPLE = Model.from_dict(MODEL)


def test_photons_per_frame_are_those_of_the_simulator():
    model = EXAMPLE.with_values({"acquisition.n_frames": 100})
    emission = simulate_emission(model, n_molecules=200, seed=1)
    # Poisson: the mean of 20 000 frames has a relative sd of 1/√(189·20000) = 5e-4; five of them.
    assert emission.mean() == pytest.approx(predict(model).emitted_photons_per_frame, rel=2.6e-3)


def test_bleaching_time_and_photons_of_a_life():
    model = preset("FF").with_values({"acquisition.n_frames": 4000, "fluorophore.cycles_before_bleaching": 2e3})
    told = predict(model)
    emission = simulate_emission(model, n_molecules=3000, seed=2)
    lit = emission > 0
    last_frame = model.acquisition.n_frames - 1 - np.argmax(lit[:, ::-1], axis=1)
    # One in 2000 bleaches before its first photon: no life to be seen.
    life_s = np.where(lit.any(axis=1), (last_frame + 0.5) * model.acquisition.interval_s, 0.0)
    # Exponential lives and geometric photon numbers: relative sd of a mean of 3000 is 1.8 %; four of them.
    assert life_s.mean() == pytest.approx(told.bleaching_time_s, rel=0.075)
    detected = emission.sum(axis=1).mean() * model.camera.quantum_efficiency
    assert detected == pytest.approx(told.detected_e_before_bleaching, rel=0.075)


def test_duty_cycle_and_dark_time_of_a_blinking_molecule():
    values = {"acquisition.n_frames": 4000, "fluorophore.cycles_before_bleaching": None}
    model = preset("Blinking").with_values(values)
    told = predict(model)
    emission = simulate_emission(model, n_molecules=400, seed=3)[:, 500:]  # it starts in the dark
    share = emission.mean() / told.emitted_photons_per_frame
    # About 35 s / 0.53 s = 66 dark visits in each of 400 traces: 1 % relative sd is generous; four of them.
    assert share == pytest.approx(told.duty_cycle, rel=0.04)
    assert told.dark_time_s == pytest.approx(1 / 3)
    assert told.bleaching_time_s is None


def recorded_by(name: str) -> Model:
    """The example with another camera, 3000 small frames."""
    changes = {"acquisition.n_frames": 3000, "acquisition.shape_px": (15, 15)}
    if name != "EMCCD":
        changes |= {"camera.type": name, "camera.em_gain": None, "camera.read_noise_e": 3.0}
        changes |= {"camera.electrons_per_adu": 0.5}
    return EXAMPLE.with_values(changes)


@pytest.mark.parametrize("name", ["EMCCD", "CCD", "CMOS"])
def test_signal_and_noise_of_the_peak_pixel(name):
    model = recorded_by(name)
    told = predict(model)
    movie = simulate(model, positions_px=np.array([[7.0, 7.0]]), seed=4).movie[:, 7, 7]
    electrons = camera.photoelectrons(movie[:, None, None], model.camera).ravel()
    background_e = model.camera.quantum_efficiency * model.optics.background_photons_per_px
    # Means of 3000 frames have a relative sd below 1 %, sds of 1.3 %; the tolerance is four of them.
    assert electrons.mean() - background_e == pytest.approx(told.peak_pixel_e, abs=4 * electrons.std() / np.sqrt(3000))
    assert electrons.std() == pytest.approx(told.peak_pixel_e / told.snr_peak_pixel, rel=0.06)
    assert movie.mean() == pytest.approx(told.peak_pixel_adu, abs=0.6 + 4 * movie.std() / np.sqrt(3000))


@pytest.mark.parametrize("name", ["EMCCD", "CCD"])
@pytest.mark.parametrize("power", [10, 300])
def test_signal_and_noise_of_the_whole_spot_are_those_of_its_trace(name, power):
    # At 300 W/cm² the spot's own noise is nearly all of it: a PSF fitted without weights has 4/3 of the variance of its
    # detection, and all of that of its emission.
    model = recorded_by(name).with_values({"excitation.power_density_w_per_cm2": power})
    told = predict(model)
    place = np.array([[7.0, 7.0]])
    movie = simulate(model, positions_px=place, seed=4).movie
    found = extract_traces(
        movie, model.camera, positions_px=place, psf_sigma_px=model.sigma_px, subtract_background=False
    )
    # The sd of 3000 frames is known to 1.3 %, of multiplied electrons (longer tails) to 1.5 %; four of them.
    assert found.all_traces[0].std() == pytest.approx(told.detected_e_per_frame / told.snr_spot, rel=0.06)


def with_a_bent_response(power: float) -> Model:
    """The preset Blinking, whose CMOS answers to more light with less and less, without anything that ends the light,
    and with so fine counts that rounding is noise."""
    values = {"fluorophore.cycles_before_bleaching": None, "fluorophore.isc_ratio": None, "acquisition.n_frames": 4000,
              "acquisition.shape_px": (21, 21), "camera.electrons_per_adu": 2.0, "camera.read_noise_e": 8.0,
              "excitation.power_density_w_per_cm2": power}  # fmt: skip
    return preset("Blinking").with_values(values)


@pytest.mark.parametrize("power", [0.0, 10.0, 60.0, 100.0, 300.0, 600.0])
def test_noise_of_a_bent_response_is_that_of_each_pixels_own_light(power):
    model, place = with_a_bent_response(power), np.array([[10.0, 10.0]])
    told = predict(model)
    movie = simulate(model, positions_px=place, seed=4).movie
    electrons = camera.photoelectrons(movie, model.camera).astype(float)
    trace = extract_traces(
        movie, model.camera, positions_px=place, psf_sigma_px=model.sigma_px, subtract_background=False
    ).all_traces[0]
    if not power:
        # Of an empty place the noise is what a molecule stands out of; 1.1 % is the error of the sd of 4000 frames.
        lit = predict(with_a_bent_response(300.0))
        assert trace.std() == pytest.approx(lit.detected_e_per_frame * np.sqrt(4000) / lit.detection_sd, rel=0.05)
        return
    peak = electrons[:, 10, 10]
    empty = electrons[:, :3, :3]
    # Beside a bend the noise is told by its mean slope, to 6 %; far from it to the 1.1 % of 4000 frames, four of them.
    assert peak.mean() - empty.mean() == pytest.approx(told.peak_pixel_e, abs=4 * peak.std() / np.sqrt(4000) + 0.5)
    assert peak.std() == pytest.approx(told.peak_pixel_e / told.snr_peak_pixel, rel=0.08)
    assert trace.std() == pytest.approx(told.detected_e_per_frame / told.snr_spot, rel=0.06)
    assert movie[:, 10, 10].mean() == pytest.approx(told.peak_pixel_adu, abs=0.6 + 4 * movie[:, 10, 10].std() / 63)


def test_more_light_stands_out_more_whatever_the_response():
    powers = np.geomspace(1, 1e5, 60)
    told = [predict(with_a_bent_response(power)) for power in powers]
    assert np.all(np.diff([one.detection_sd for one in told]) > 0)
    # Its last slope goes on, where float32 would not tell it any more.
    far = [predict(with_a_bent_response(power)).snr_peak_pixel for power in (1e6, 1.001e6)]
    assert np.isfinite(far).all() and far[1] == pytest.approx(far[0], rel=1e-2)


def test_rounding_to_whole_counts_is_noise():
    # Counts of 8 electrons over a noise of 4.5: rounding has a quarter of a dark pixel's variance. A noise of half a
    # count and more leaves it within 1 % of 1/12.
    model = recorded_by("CCD").with_values({"camera.electrons_per_adu": 8.0, "acquisition.n_frames": 12_000})
    told = predict(model)
    movie = simulate(model, positions_px=np.array([[7.0, 7.0]]), seed=4).movie[:, 7, 7]
    electrons = camera.photoelectrons(movie[:, None, None], model.camera).ravel()
    # The sd of 12 000 frames is known to 0.65 %, without rounding it would be told 4 % too small; four of them.
    assert electrons.std() == pytest.approx(told.peak_pixel_e / told.snr_peak_pixel, rel=0.026)


@pytest.mark.parametrize("name", ["PALM", "FF", "Blinking"])
def test_molecules_bleach_and_shine_in_a_movie_as_told(name):
    model = preset(name)
    n, told = model.acquisition.n_frames, predict(model)
    longer = model.with_values({"acquisition.n_frames": n + int(12 * told.bleaching_time_s / 0.01)})
    emission = simulate_emission(longer, n_molecules=1500, seed=12)
    bleached = float(np.mean(emission[:, n:].sum(axis=1) == 0))
    # A binomial share of 1500 has an sd of 1.3 % at most; four of them.
    assert bleached == pytest.approx(told.bleached_by_the_end, abs=0.052)
    # The change that is as far from the movie as its halves are from each other is the floor over the mean light.
    light = emission[:, :n].mean() * told.detected_e_per_frame / told.emitted_photons_per_frame
    # Shares of the movie with light are between 0 and 1: the sd of their mean is below 1.3 %, of 0.08 to 0.75; four.
    assert told.w1_floor_e / told.smallest_change == pytest.approx(light, abs=0.052 * told.detected_e_per_frame)


@pytest.mark.parametrize("cycles", [2e3, 5e3, 2e5])
def test_w1_floor_of_molecules_that_bleach_is_that_of_two_halves_of_them(cycles):
    """One is bright for long, another briefly: frames of a molecule are no draws of their own."""
    changes = {"sample.n_molecules": 40, "fluorophore.cycles_before_bleaching": cycles}
    model = preset("FF").with_values(changes)
    told, rng, measured = predict(model), np.random.default_rng(5), []
    noise = told.detected_e_per_frame / told.snr_spot
    for seed in range(20):
        emission = simulate_emission(model, n_molecules=40, seed=seed) / told.emitted_photons_per_frame
        frames = told.detected_e_per_frame * emission + rng.normal(0, noise, emission.shape)
        measured.append(compare.floor(frames, n_splits=50, rng=rng).value)
    # Halves of 40 molecules: the mean of 20 movies has a standard error of some 3 %.
    assert np.mean(measured) == pytest.approx(told.w1_floor_e, rel=0.15)


def test_a_spot_that_the_camera_cannot_hold_has_no_headroom():
    """In movies the brightest pixel of a molecule that never bleaches is cut off in some frames below 2 sd, in none
    above 4."""
    light = {"fluorophore.cycles_before_bleaching": None, "sample.n_molecules": 1, "acquisition.n_frames": 300}
    for power in (5.0, 30.0, 60.0, 120.0):
        model = preset("FF").with_values(light | {"excitation.power_density_w_per_cm2": power})
        told = predict(model)
        at = (np.array([[20.0, 20.0]]),)
        movie = simulate(model.with_values({"acquisition.shape_px": (41, 41)}), *at, seed=3).movie
        cut = (movie[:, 20, 20] >= model.camera.adc_max).mean()
        assert (cut > 0) == (told.headroom_sd < 3.0), (power, told.headroom_sd, cut)
        assert ("is cut off" in hardly_seen(model)) == (told.headroom_sd < 2)


@pytest.mark.parametrize("name", ["FF", "Blinking", "STORM", "PALM"])
def test_the_viewers_numbers_are_those_of_the_prediction(name):
    model = preset(name)
    told, rows = predict(model), {row: value for row, value, _ in derived_values(model)}

    def shown(row: str) -> float:
        return float(re.match(r"[-+.e\d]+", rows[row]).group())

    close = {"rel": 0.006}  # three digits are shown, of ratios two
    assert shown("Excitation rate k01") == pytest.approx(told.k01_per_s, **close)
    assert shown("Photons emitted") == pytest.approx(told.emitted_photons_per_frame, **close)
    assert shown("Photons collected") == pytest.approx(told.collected_photons_per_frame, **close)
    assert shown("Brightest pixel") == pytest.approx(told.peak_pixel_e, **close)
    assert shown("Signal to noise") == pytest.approx(told.snr_peak_pixel, rel=0.06)
    assert shown("Signal to noise, whole spot") == pytest.approx(told.snr_spot, rel=0.06)
    brief = told.on_time_s is not None and told.on_time_s < model.acquisition.frame_length_s
    assert ("Signal to noise, bright visit" in rows) == brief
    assert shown("Bleaching after") == pytest.approx(told.bleaching_time_s, **close)
    assert shown("Movie length") == pytest.approx(told.movie_s, **close)


def test_a_camera_without_noise_in_the_dark_is_predicted():
    dark = EXAMPLE.with_values(
        {"excitation.power_density_w_per_cm2": 0, "optics.background_photons_per_px": 0,
         "camera.clock_induced_charge_e": 0, "camera.read_noise_e": 0}
    )  # fmt: skip
    assert predict(dark).snr_peak_pixel == 0
    assert ("Photons emitted", "0 per frame") in [row[:2] for row in derived_values(dark)]


def test_w1_floor_is_that_of_two_halves():
    model = EXAMPLE.with_values({"sample.n_molecules": 40})
    told = predict(model)
    rng = np.random.default_rng(5)
    traces = rng.normal(told.detected_e_per_frame, told.detected_e_per_frame / told.snr_spot, (40, 300))
    measured = compare.floor(traces, n_splits=200, rng=rng).value
    assert measured == pytest.approx(told.w1_floor_e, rel=0.15)


def test_a_sweep_varies_what_it_is_told():
    table = design(
        EXAMPLE, {"excitation.power_density_w_per_cm2": [10, 20], "acquisition.frame_length_s": [0.01, 0.02]}
    )
    assert len(table) == 4
    photons = table["emitted_photons_per_frame"].to_numpy()
    np.testing.assert_allclose(photons / photons[0], [1, 2, 2, 4], rtol=1e-3)  # far from saturation
    with pytest.raises(MufasaError, match=r"no excitation\.colour"):
        design(EXAMPLE, {"excitation.colour": [1]})
    with pytest.raises(MufasaError, match="combinations"):
        design(EXAMPLE, {"optics.psf_fwhm_nm": []})


def test_a_triplet_without_return_ends_the_light():
    model = preset("Blinking").with_values({"fluorophore.triplet_decay_rate_per_s": None})
    told = predict(model)
    assert told.bleaching_time_s is None and told.dark_time_s is None
    assert told.on_time_s == pytest.approx(1 / (told.k01_per_s * (5e-4 + 1e-3)), rel=0.01)


def test_light_of_a_visit_is_that_of_the_simulator():
    values = {"acquisition.n_frames": 4000, "fluorophore.cycles_before_bleaching": None}
    model = preset("Blinking").with_values(values)
    told = predict(model)
    emission = simulate_emission(model, n_molecules=400, seed=3)[:, 500:]  # it starts in the dark
    visits = emission.shape[1] * model.acquisition.interval_s / (told.on_time_s + told.dark_time_s)
    detected = emission.sum(axis=1).mean() * told.detected_e_per_frame / told.emitted_photons_per_frame
    # Some 85 visits of exponential length in each of 400 molecules: a relative sd below 1 %; four of them.
    assert detected / visits == pytest.approx(told.detected_e_per_visit, rel=0.04)


def test_a_short_visit_is_as_bright_as_its_share_of_a_frame():
    model = preset("Alexa647-STORM")
    told = predict(model)
    share = told.on_time_s / model.acquisition.frame_length_s
    assert share < 0.01 and told.detected_e_per_visit == pytest.approx(share * told.detected_e_per_frame)
    # Beside the visit itself the frame holds 0.4 % of another one; and there is no saturation in so little light.
    as_dim = predict(model.with_values({"excitation.power_density_w_per_cm2": 1000 * share}))
    assert told.snr_visit == pytest.approx(as_dim.snr_spot, rel=0.01)
    steady = predict(EXAMPLE)
    assert steady.snr_visit == steady.snr_spot and steady.detected_e_per_visit is None


def test_a_frame_of_many_visits_has_their_light():
    # A triplet of 1 ms, on for as long: a frame of 10 ms that begins bright holds 5 visits.
    model = preset("Blinking").with_values(
        {"fluorophore.triplet_decay_rate_per_s": 1e3, "fluorophore.isc_ratio": 0.1, "acquisition.n_frames": 400,
         "fluorophore.cycles_before_bleaching": None}
    )  # fmt: skip
    told = predict(model)
    assert told.on_time_s < 0.2 * model.acquisition.frame_length_s
    emission = simulate_emission(model, n_molecules=200, seed=3)[:, 20:]
    light = emission.mean() / told.emitted_photons_per_frame * told.detected_e_per_frame
    # It begins bright, which adds half a visit to the light of the mean frame; the light adds to the noise.
    assert 1.0 < told.snr_visit / (told.snr_spot * light / told.detected_e_per_frame) < 1.3


def test_molecules_stand_out_as_told():
    # Dim ones that are lit all along: the mean of 300 frames tells. Traces ask for 6 sd by a filter that takes the
    # background off around each: it has two thirds of the PSF's signal to noise or more.
    model = EXAMPLE.with_values({"excitation.power_density_w_per_cm2": 3})
    places = np.stack(np.meshgrid(np.arange(10, 90, 13), np.arange(10, 90, 13)), axis=-1).reshape(-1, 2)[:36]
    movie = simulate(model, positions_px=places.astype(float), seed=4).movie
    evidence = find_spots(Frames(movie, model.camera), model.sigma_px).evidence.image
    shown = float(np.mean(evidence[tuple(places.T)]))
    # Each is known to 1 sd, their mean of 36 to 0.17: four of them are 0.08 of what is told.
    assert 2 / 3 - 0.08 < shown / predict(model).detection_sd < 1.08


def test_molecules_that_never_light_do_not_stand_out():
    never = preset("PALM").with_values(
        {"excitation.activation_rate_per_s": 0.0, "excitation.power_density_w_per_cm2": 1e4}
    )
    assert predict(never).detection_sd == 0
    assert predict(never.with_values({"excitation.activation_rate_per_s": 1.0})).detection_sd > 6


@pytest.mark.parametrize("name", ["PALM", "STORM", "EGFP", "Alexa647-STORM"])
def test_it_is_said_where_traces_miss_most_molecules(name):
    assert (
        "may miss most of them" in hardly_seen(preset(name))
        and hardly_seen(preset("FF")) == hardly_seen(preset("Blinking")) == ""
    )
    model = preset(name).with_values({"acquisition.shape_px": (128, 128), "sample.n_molecules": 40})
    movie = simulate(model.with_values({"acquisition.n_frames": min(model.acquisition.n_frames, 500)}), seed=6).movie
    found = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px)
    assert len(found.all_traces) <= 10
