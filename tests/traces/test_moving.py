"""Molecules that move: links, paths, diffusion and drift against movies whose molecules are known (docs/traces.md)."""

from __future__ import annotations

import numpy as np
import pytest
from tests.blind import generator
from tests.real_data import real_data

import napari_mufasa as nm
from napari_mufasa.camera.frames import Frames
from napari_mufasa.effects import effect_from_data
from napari_mufasa.errors import MufasaError
from napari_mufasa.simulate.movie import SimulatedAcquisition
from napari_mufasa.spots.aperture import aperture, read_frame
from napari_mufasa.spots.diffusion import motion_of
from napari_mufasa.spots.link import link
from napari_mufasa.spots.locate import Places, locate
from napari_mufasa.traces import extract_traces


def walks(n, n_frames, step_px, error_px, drift_px=(0.0, 0.0), seed=0):
    """(molecule, frame, 2) sightings of random walks, a tenth of them missing."""
    rng = np.random.default_rng(seed)
    places = np.cumsum(rng.normal(0, step_px, (n, n_frames, 2)), axis=1)
    places += np.arange(n_frames)[:, None] * np.array(drift_px) + rng.normal(0, error_px, places.shape)
    places[rng.random((n, n_frames)) < 0.1] = np.nan
    return places


@pytest.mark.parametrize(("step_px", "error_px"), [(0.05, 0.1), (0.05, 0.25), (0.2, 0.25), (0.5, 0.1), (0.5, 0.25)])
def test_diffusion_drift_and_errors_are_those_of_the_walk(step_px, error_px):
    n, n_frames, drift = 200, 300, (0.02, -0.01)
    told = motion_of(walks(n, n_frames, step_px, error_px, drift))
    wanted = step_px**2 / 2
    # The mean of 200 has its own sd; 4 of them are passed by chance once in 16 000 times.
    spread = told.diffusion_px2.std() / np.sqrt(n)
    assert told.diffusion_px2.mean() == pytest.approx(wanted, abs=4 * spread)
    assert spread / wanted < 0.03
    # An interval of one sd holds the truth in 68 %: of 200 in 68 ± 3.3 %, here within 4 sd of that on the low side.
    assert np.mean(np.abs(told.diffusion_px2 - wanted) < told.diffusion_sd_px2) > 0.55
    assert np.median(told.localisation_px) == pytest.approx(error_px, rel=0.1)
    for axis in range(2):
        miss = (told.drift_px[:, axis] - drift[axis]) / told.drift_sd_px
        assert abs(miss.mean()) < 4 / np.sqrt(n) and miss.std() == pytest.approx(1.0, abs=0.25)


def test_what_happens_within_an_exposure_leaves_diffusion_as_it_is():
    """Places averaged over the exposure (R = 1/6): the offset is σ² − 2 D R, here below 0."""
    rng = np.random.default_rng(2)
    fine = np.cumsum(rng.normal(0, 0.5 / np.sqrt(20), (200, 200 * 20, 2)), axis=1)
    told = motion_of(fine.reshape(200, 200, 20, 2).mean(axis=2) + rng.normal(0, 0.05, (200, 200, 2)))
    spread = told.diffusion_px2.std() / np.sqrt(200)
    assert told.diffusion_px2.mean() == pytest.approx(0.125, abs=4 * spread) and spread < 0.005


def test_the_estimator_agrees_with_that_of_vestergaard_where_spots_are_seen_well():
    """Phys. Rev. E 89, 022726 (2014), eq. 14: D = ⟨Δ²⟩/2 + ⟨Δ Δ'⟩; on average over molecules without drift."""
    rng = np.random.default_rng(5)
    places = np.cumsum(rng.normal(0, 0.4, (300, 200, 2)), axis=1) + rng.normal(0, 0.1, (300, 200, 2))
    steps = np.diff(places, axis=1)
    covariance = (steps**2).mean(axis=(1, 2)) / 2 + (steps[:, 1:] * steps[:, :-1]).mean(axis=(1, 2))
    told = motion_of(places).diffusion_px2
    assert told.mean() == pytest.approx(covariance.mean(), rel=0.02)
    assert told.std() <= 1.05 * covariance.std()


def test_molecules_that_are_seen_too_rarely_have_no_diffusion():
    seen = np.full((2, 10, 2), np.nan)
    seen[0, :3] = 1.0
    told = motion_of(seen)
    assert np.isnan(told.diffusion_px2).all() and np.isnan(told.drift_px).all()


def test_links_go_on_over_gaps_and_not_over_longer_ones():
    frames = np.array([0, 1, 2, 3, 6, 7, 8, 20, 21, 22])
    at = np.column_stack([np.full(len(frames), 5.0), np.linspace(5, 7, len(frames))])
    places = Places(frames, at, np.full(len(frames), 9.0), at)
    paths = link(places, 30, 2.0, max_gap=4, least_frames=3)
    assert [int(n) for n in paths.found.sum(axis=1)] == [7, 3] and paths.shorter == 0
    assert np.isfinite(paths.everywhere()).all()
    assert link(places, 30, 2.0, max_gap=4, least_frames=4).shorter == 1


def moving(step_px, seed, n_molecules=40, n_frames=300, shape=(128, 128), **changes):
    """A movie of molecules that diffuse, about 200 photons in each spot, and their true places (frame, molecule, 2)."""
    base = nm.Model.from_dict(generator.base_model("emccd"))
    walk = effect_from_data({"kind": "molecule_diffusion", "diffusion_px2_per_frame": step_px**2 / 2})
    model = base.with_values(
        {
            "fluorophore.cycles_before_bleaching": 1e8, "sample.n_molecules": n_molecules,
            "acquisition.n_frames": n_frames, "acquisition.shape_px": shape,
            "excitation.power_density_w_per_cm2": 2 * base.excitation.power_density_w_per_cm2, **changes,
        }
    ).with_effects(walk)  # fmt: skip
    acquisition = SimulatedAcquisition(model, None, seed)
    movie = np.concatenate([block.movie for _, block in acquisition.blocks()])
    return model, movie, acquisition.scene.positions_px + acquisition.scene.walk_px


def right_links(path_px, found, truth):
    """How many links of paths join sightings that are nearest to the same molecule, within 1.5 px; and how many not."""
    right = wrong = 0
    for path, seen in zip(path_px, found, strict=True):
        frames = np.flatnonzero(seen)
        distance = np.hypot(*(path[frames][:, None] - truth[frames]).transpose(2, 0, 1))
        nearest, near = distance.argmin(axis=1), distance.min(axis=1) < 1.5
        same = (nearest[1:] == nearest[:-1]) & near[1:] & near[:-1]
        right, wrong = right + int(same.sum()), wrong + int((~same).sum())
    return right, wrong


@pytest.mark.parametrize("step_px", [0.05, 0.2, 0.5])
def test_diffusing_molecules_are_followed_and_their_diffusion_is_told(step_px):
    right = wrong = 0
    told = []
    for seed in (1, 2, 3):
        model, movie, truth = moving(step_px, seed)
        found = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px, follow_molecules=True)
        table = found.molecules
        t = np.arange(len(movie))
        seen = (table["first_found"].to_numpy()[:, None] <= t) & (t <= table["last_found"].to_numpy()[:, None])
        links = right_links(found.path_px, seen, truth)
        right, wrong = right + links[0], wrong + links[1]
        told.append(table[found.kept & (table["found_frames"] >= 50)])
    values = np.concatenate([part["diffusion_px2_per_frame"] for part in told])
    weights = np.concatenate([part["found_frames"] for part in told])
    mean = np.average(values, weights=weights) / (step_px**2 / 2)
    print(
        f"step {step_px}: {right / (right + wrong):.4f} of {right + wrong} links right, D {mean:.3f} of {len(values)}"
    )
    assert right / (right + wrong) >= 0.95
    assert mean == pytest.approx(1.0, abs=0.1)


def test_the_trace_read_along_the_path_keeps_its_light():
    """A molecule that leaves its place by several px: its trace stays level along the path, and falls in one place."""
    model, movie, _truth = moving(0.3, 4, n_molecules=12)
    moved = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px, follow_molecules=True)
    long = np.flatnonzero(moved.kept & (moved.molecules["found_frames"] > 250))
    assert len(long) >= 4
    for i in long:
        trace = moved.all_traces[i]
        assert np.mean(trace[-60:]) == pytest.approx(np.mean(trace[:60]), rel=0.25)
    still = extract_traces(
        movie, model.camera, psf_sigma_px=model.sigma_px, positions_px=moved.path_px[long, 0], subtract_background=True
    )
    assert np.median(still.all_traces[:, -60:].mean(axis=1)) < 0.6 * np.median(
        moved.all_traces[long, -60:].mean(axis=1)
    )


def test_molecules_at_rest_are_found_as_they_are_without_following():
    model, movie, _truth = moving(0.0, 5)
    still = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px)
    moved = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px, follow_molecules=True)
    a, b = still.positions_px[still.kept], moved.path_px[moved.kept].mean(axis=1)
    nearest = np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1)).min(axis=1)
    assert np.mean(nearest < 0.5) > 0.9
    # At rest: D is 0 within three of its sd, for all but a few.
    table = moved.molecules[moved.kept]
    assert np.mean(table["diffusion_px2_per_frame"] < 3 * table["diffusion_sd_px2_per_frame"]) > 0.9


def test_the_drift_of_the_field_is_taken_off_what_molecules_do():
    model, movie, _truth = moving(0.1, 6, n_frames=200)
    model = model.with_effects(effect_from_data({"kind": "stage_drift", "distance_px": 8.0, "direction_deg": 0.0}))
    movie = nm.simulate(model, seed=6).movie
    choice = {"psf_sigma_px": model.sigma_px, "follow_molecules": True}
    alone = extract_traces(movie, model.camera, **choice)
    taken = extract_traces(movie, model.camera, follow_drift=True, **choice)
    for found, wanted in ((alone, 8 / 199), (taken, 0.0)):
        table = found.molecules[found.kept & (found.molecules["found_frames"] > 100)]
        told = table["drift_x_px_per_frame"]
        assert np.median(told) == pytest.approx(wanted, abs=4 * told.std() / np.sqrt(len(told)))


def test_places_of_single_frames_have_no_error_in_common():
    """Sightings in the frames themselves: errors of frames beside each other do not go together."""
    model, movie, _truth = moving(0.0, 7, n_molecules=16)
    places = locate(Frames(movie, model.camera), model.sigma_px)
    paths = link(places, len(movie), 2.5)
    errors = paths.seen_px - np.nanmean(paths.seen_px, axis=1, keepdims=True)
    errors = errors[paths.found.sum(axis=1) > 250]
    product = np.nanmean(errors[:, 1:] * errors[:, :-1]) / np.nanmean(errors**2)
    count = np.isfinite(errors[:, 1:] * errors[:, :-1]).sum()
    assert abs(product) < 5 / np.sqrt(count) + 0.02  # the mean of 300 that is taken off makes −1/300


@pytest.mark.parametrize("profile", ["psf", "sum", "brightest_pixel"])
@pytest.mark.parametrize("subtract", [True, False])
def test_a_frame_is_read_as_by_the_operators(profile, subtract):
    rng = np.random.default_rng(2)
    frame = rng.normal(100, 20, (48, 64)).astype(np.float32)
    for places in (rng.uniform(-2, 66, (40, 2)) * (0.7, 1.0), np.array([[5.0, 5.0], [5.4, 8.2], [40.0, 60.0]])):
        reading = read_frame(frame, places, 1.3, profile, subtract_background=subtract)
        opening = aperture(places, frame.shape, 1.3, profile, subtract_background=subtract)
        trace, background = opening.traces(frame[None])
        np.testing.assert_allclose(reading.trace, trace[:, 0], rtol=1e-4, atol=0.02)
        np.testing.assert_allclose(reading.background, background[:, 0], rtol=1e-5)
        np.testing.assert_array_equal(reading.window, opening.window)


def test_an_empty_movie_has_no_molecules():
    model, movie, _ = moving(0.1, 8, n_molecules=0, n_frames=40, shape=(48, 48))
    found = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px, follow_molecules=True)
    assert len(found.molecules) <= 1 and found.traces.shape[1] == 40


@pytest.mark.parametrize(
    "options",
    [
        {"positions_px": np.array([[5.0, 5.0]])}, {"threshold": "otsu"}, {"position": "brightest_pixel"},
        {"max_step_px": 0.0}, {"max_gap": -1}, {"min_found": 1},
    ],
)  # fmt: skip
def test_what_cannot_be_followed_is_refused(options):
    model, movie, _ = moving(0.1, 8, n_molecules=3, n_frames=10, shape=(48, 48))
    with pytest.raises(MufasaError):
        extract_traces(movie, model.camera, follow_molecules=True, **options)


@pytest.mark.realdata
def test_real_polymerases_are_followed_one_row_each():
    import tifffile

    movie = tifffile.imread(real_data("polymerase_ixon888_emccd.tif"))
    model = nm.Model.from_json("docs/models/smfret_ixon.json")
    camera = model.camera.model_copy(
        update={"baseline_adu": 438.0, "em_gain": 400.0, "electrons_per_adu": 400 / 49, "adc_max": 65535}
    )
    found = extract_traces(movie, camera, psf_sigma_px=1.3, follow_molecules=True)
    table = found.molecules
    long = table["found_frames"] >= 20
    slides = long & (table["drift_y_px_per_frame"] > 5 * table["drift_sd_px_per_frame"])
    print(f"{long.sum()} over 20 frames and more, {slides.sum()} of them slide")
    assert long.sum() >= 60
    # DNA is stretched along y: those that slide go along it.
    along, across = table.loc[slides, "drift_y_px_per_frame"], table.loc[slides, "drift_x_px_per_frame"]
    assert slides.sum() >= 30 and np.median(along) > 10 * abs(np.median(across))
    # One row each: no two go side by side for most of their frames.
    ids = np.flatnonzero(long)
    first, last = table["first_found"].to_numpy(), table["last_found"].to_numpy()
    double = 0
    for k, i in enumerate(ids):
        for j in ids[k + 1 :]:
            both = slice(max(first[i], first[j]), min(last[i], last[j]) + 1)
            shared = both.stop - both.start
            if shared > 0.5 * min(last[i] - first[i], last[j] - first[j]):
                apart = np.hypot(*(found.path_px[i, both] - found.path_px[j, both]).T)
                double += bool(np.median(apart) < 2.0)
    print(f"{double} doubles")
    assert long.sum() - double >= 60 and double <= 3


@pytest.mark.parametrize(("diffusion_px2", "step_px", "low"), [(0.2, 2.6, False), (1.0, 2.6, True), (1.0, 7.0, False)])
def test_molecules_faster_than_they_are_followed_are_told(diffusion_px2, step_px, low):
    """A step in the plane exceeds r in exp(−r²/4D) of the frames: 0.02, 18 and 0.0005 %."""
    model = nm.preset("FF").with_values({"acquisition.shape_px": (120, 120), "excitation.power_density_w_per_cm2": 20})
    places = np.stack(np.meshgrid(*[np.arange(20.0, 110, 30)] * 2), axis=-1).reshape(-1, 1, 2)
    rng = np.random.default_rng(4)
    paths = places + np.cumsum(rng.normal(0, np.sqrt(2 * diffusion_px2), (9, 40, 2)), axis=1)
    movie = np.concatenate(
        [
            nm.simulate(model.with_values({"acquisition.n_frames": 1}), paths[:, t], seed=t).movie
            for t in range(paths.shape[1])
        ]
    )
    found = extract_traces(
        movie, model.camera, psf_sigma_px=model.sigma_px, follow_molecules=True, max_step_px=step_px, min_snr=0.0
    )  # fmt: skip
    assert any("lower limit" in note for note in found.notes) == low
