"""The whole chain: seeds, blocks, streams, dark frames, every protocol with every camera (docs/words.md)."""

import numpy as np
import pytest

from napari_mufasa import Cancelled, MufasaError, preset, simulate, simulate_dark, simulate_emission
from napari_mufasa.camera.detector import photoelectrons, photons
from napari_mufasa.chance.streams import Streams
from napari_mufasa.effects import catalogue
from napari_mufasa.simulate import movie as simulation

CAMERAS = {
    "CCD": {"type": "CCD", "em_gain": None, "read_noise_e": 5.0, "electrons_per_adu": 2.0},
    "EMCCD": {"type": "EMCCD", "em_gain": 300, "read_noise_e": 50.0, "electrons_per_adu": 12.0},
    "CMOS": {"type": "CMOS", "em_gain": None, "read_noise_e": 1.6, "electrons_per_adu": 0.5},
}


def small(protocol="FF", camera="EMCCD", **values):
    base = {"acquisition.n_frames": 24, "acquisition.shape_px": [20, 28], "sample.n_molecules": 5}
    base |= {f"camera.{name}": value for name, value in CAMERAS[camera].items()} if camera else {}
    data = preset(protocol).model_dump()
    for path, value in (base | values).items():
        group, name = path.split(".")
        data[group][name] = value
    return type(preset(protocol)).from_dict(data)


def effect(kind, **values):
    return catalogue()[kind](**values)


@pytest.mark.parametrize("protocol", ["PALM", "STORM", "FF", "Blinking"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_every_protocol_runs_with_every_camera(protocol, camera):
    model = small(protocol, camera)
    result = simulate(model, seed=1)
    assert result.emission.shape == (5, 24) and result.positions_px.shape == (5, 2)
    assert result.movie.shape == result.optical.shape == (24, 20, 28)
    assert result.movie.dtype == np.uint16 and result.optical.dtype == np.float32
    # What the movie means, through the camera's inverse, is the optical image. |z| > 4: 6e-5; CMOS is bent
    # above 200 e⁻ only, which dim pixels do not reach.
    dim = result.optical < 30
    difference = (photons(photoelectrons(result.movie, model.camera), model.camera) - result.optical)[dim]
    assert abs(difference.mean()) < 4 * difference.std() / np.sqrt(difference.size)


def test_the_optical_image_holds_emission_and_background():
    model = small("FF", **{"optics.collection_efficiency": 0.5, "optics.brightness_correction": 1.2})
    result = simulate(model, positions_px=np.array([[10.0, 14.0]]), seed=2)
    light = result.optical.sum(axis=(1, 2)) - 20 * 20 * 28
    np.testing.assert_allclose(light, 0.6 * result.emission[0], rtol=1e-4, atol=0.1)


@pytest.mark.parametrize(
    ("engine", "asked", "kept"),
    # The exact engine counts photons one by one, and expects what it counts.
    [("fast", 0.0, 0.0), ("fast", 0.5, 0.5), ("fast", 1.0, 1.0), ("exact", 0.0, 1.0)],
)
def test_photon_noise_is_counted_once_or_with_the_emission_s_own(engine, asked, kept):
    """Detected photoelectrons of one steady molecule: variance over mean is 1 + kept · p, p = collection · QE."""
    dark = {"camera.read_noise_e": 0.0, "camera.electrons_per_adu": 1.0, "camera.clock_induced_charge_e": 0.0}
    model = small(
        "FF", "CCD", **dark, **{
            "acquisition.n_frames": 4000, "optics.background_photons_per_px": 0.0, "optics.emission_noise": asked,
            "optics.collection_efficiency": 0.7, "camera.quantum_efficiency": 0.9,
            "fluorophore.cycles_before_bleaching": None,
        },
    )  # fmt: skip
    result = simulate(model, positions_px=np.array([[10.0, 14.0]]), seed=4, engine=engine)
    counts = (result.movie.astype(float) - model.camera.baseline_adu).sum(axis=(1, 2))
    # The ratio's sd is √(2/4000) of it: 4.5 of them, a false alarm of 7e-6.
    assert counts.var(ddof=1) / counts.mean() == pytest.approx(1 + 0.63 * kept, rel=0.1)
    assert counts.mean() == pytest.approx(0.63 * result.emission.mean(), rel=0.02)


def everything():
    """A model with every source of chance that could depend on the order of work."""
    return small().with_effects(
        effect("image_lag", fraction=0.2, form="decaying"),
        effect("row_noise"),
        effect("cosmic_rays", hits_per_frame=2.0, form="tracks"),
        effect("hot_pixels", fraction=0.05, form="telegraph"),
        effect("stage_drift", form="wandering"),
        effect("molecule_diffusion"),
        effect("laser_flicker", form="pink"),
        effect("baseline_drift", form="wandering"),
    )


@pytest.mark.parametrize("block_frames", [1, 5, 24])
@pytest.mark.parametrize("workers", [1, 3])
def test_one_seed_gives_one_movie_whatever_workers_and_blocks(monkeypatch, block_frames, workers):
    model = everything()
    reference = simulate(model, seed=3)
    monkeypatch.setattr(simulation, "BLOCK_BYTES", block_frames * 4 * 20 * 28)
    assert simulation.SimulatedAcquisition(model, seed=3).block_frames() == block_frames
    again = simulate(model, seed=3, workers=workers)
    np.testing.assert_array_equal(again.movie, reference.movie)
    np.testing.assert_array_equal(again.optical, reference.optical)
    np.testing.assert_array_equal(again.emission, reference.emission)


def test_other_seeds_give_other_movies():
    model = small()
    a, b = simulate(model, seed=1), simulate(model, seed=2)
    assert np.mean(a.movie != b.movie) > 0.9 and not np.array_equal(a.positions_px, b.positions_px)
    noise_a, noise_b = (r.movie - r.movie.mean() for r in (a, b))
    correlation = np.corrcoef((noise_a[:, :4] - noise_a[:, :4].mean()).ravel(), noise_b[:, :4].ravel())[0, 1]
    assert abs(correlation) < 0.15


def test_adding_a_camera_effect_changes_nothing_else():
    base = simulate(small(), seed=4)
    drift = simulate(small().with_effects(effect("baseline_drift", drift_adu=24.0)), seed=4)
    np.testing.assert_array_equal(drift.emission, base.emission)
    np.testing.assert_array_equal(drift.optical, base.optical)
    np.testing.assert_array_equal(drift.positions_px, base.positions_px)
    shift = drift.movie.astype(int) - base.movie
    expected = np.linspace(0, 24, 24)[:, None, None]
    assert np.all(np.abs(shift - expected) <= 1)  # the same noise under the same floor


@pytest.mark.parametrize(
    ("added", "same"),
    [
        (effect("stage_drift"), "emission"),
        (effect("astigmatism"), "emission"),
        (effect("background_gradient"), "emission"),
        (effect("molecule_diffusion"), "emission"),
        (effect("em_excess_noise"), "optical"),
        (effect("pixel_gain_variation"), "optical"),
        (effect("cosmic_rays", hits_per_frame=3.0), "optical"),
    ],
)
def test_adding_an_effect_leaves_earlier_chance_alone(added, same):
    base, other = simulate(small(), seed=5), simulate(small().with_effects(added), seed=5)
    np.testing.assert_array_equal(getattr(other, same), getattr(base, same))
    assert np.any(other.movie != base.movie)


def test_effects_keep_their_chance_whatever_other_effects_are_there():
    row, hits = effect("row_noise", rms_adu=50.0), effect("cosmic_rays", hits_per_frame=2.0)
    base = simulate(small(), seed=6).movie.astype(int)
    with_row = simulate(small().with_effects(row), seed=6).movie - base
    with_hits = simulate(small().with_effects(hits), seed=6).movie.astype(int)
    both = simulate(small().with_effects(hits, row), seed=6).movie - with_hits
    usual = (with_hits == base) & (base > 200) & (np.abs(with_row) < 150)
    assert np.mean(usual) > 0.8
    assert np.all(np.abs(both - with_row)[usual] <= 1)


def test_given_positions_are_used():
    positions = np.array([[3.0, 4.0], [15.5, 20.25]])
    result = simulate(small(**{"fluorophore.cycles_before_bleaching": None}), positions, seed=7)
    np.testing.assert_array_equal(result.positions_px, positions)
    bright = result.optical.mean(axis=0)
    assert bright[3, 4] > 24 and bright[15:17, 20].min() > 24 and bright[10, 10] == pytest.approx(20, abs=1e-3)


@pytest.mark.parametrize("positions", [np.zeros((3, 3)), np.zeros(4), np.array([[np.nan, 1.0]])])
def test_wrong_positions_are_refused(positions):
    with pytest.raises(MufasaError, match="positions_px"):
        simulate(small(), positions)


def test_no_molecule_gives_background_only():
    result = simulate(small(), np.empty((0, 2)), seed=8)
    assert result.emission.shape == (0, 24)
    np.testing.assert_allclose(result.optical, 20.0)


@pytest.mark.parametrize("seed", [-1, 1.5, True, None, "1"])
def test_wrong_seeds_are_refused(seed):
    with pytest.raises(MufasaError, match="whole number"):
        Streams(seed)


def test_dark_frames_show_the_camera_alone():
    model = small("FF", "EMCCD", **{"camera.clock_induced_charge_e": 0.1})
    dark = simulate_dark(model, 200, seed=9).astype(float)
    assert dark.shape == (200, 20, 28)
    spread = np.sqrt((2 * 300**2 * 0.1 + 50**2) / 12**2)
    mean = 367 - 0.5 + 300 * 0.1 / 12
    assert dark.mean() == pytest.approx(mean, abs=4 * spread / np.sqrt(dark.size))


def test_dark_frames_share_the_sensor_s_patterns_but_not_the_movie_s_noise():
    model = small("FF", "CCD").with_effects(effect("column_offset", rms_adu=30.0), effect("row_noise", rms_adu=10.0))
    dark = simulate_dark(model, 40, seed=10).astype(float)
    empty = model.with_values({"optics.background_photons_per_px": 0})
    movie = simulate(empty, np.empty((0, 2)), seed=10).movie.astype(float)
    columns = [stack.mean(axis=(0, 1)) for stack in (dark, movie)]
    assert np.corrcoef(*columns)[0, 1] > 0.99
    rows = [stack[:24].mean(axis=2) - stack[:24].mean() for stack in (dark, movie)]
    assert abs(np.corrcoef(rows[0].ravel(), rows[1].ravel())[0, 1]) < 4 / np.sqrt(480)


def test_what_drifts_over_a_movie_of_one_frame_has_not_begun_in_its_dark_frames():
    one = small("FF", "CCD").in_shape(n_frames=1)
    drifting = one.with_effects(effect("baseline_drift", drift_adu=8.0))
    np.testing.assert_array_equal(simulate_dark(drifting, 20, seed=3), simulate_dark(one, 20, seed=3))


@pytest.mark.parametrize("n", [0, -3, 1.5, True])
def test_wrong_number_of_dark_frames_is_refused(n):
    with pytest.raises(MufasaError, match="n_frames"):
        simulate_dark(small(), n)


def test_emission_has_the_shape_of_the_contract():
    counts = simulate_emission(preset("FF"), n_molecules=30, seed=1)
    assert counts.shape == (30, 100) and counts.dtype.kind == "i"
    np.testing.assert_array_equal(counts, simulate_emission(preset("FF"), n_molecules=30, seed=1))


def test_progress_and_cancel(monkeypatch):
    monkeypatch.setattr(simulation, "BLOCK_BYTES", 5 * 4 * 20 * 28)
    seen = []
    simulate(small(), seed=1, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(5, 24), (10, 24), (15, 24), (20, 24), (24, 24)]
    seen.clear()
    with pytest.raises(Cancelled):
        simulate(small(), seed=1, workers=2, progress=lambda d, t: seen.append(d), cancel=lambda: len(seen) == 2)
    assert seen == [5, 10]


def test_fine_grid_gives_the_same_image_to_the_grid_error():
    positions = np.array([[9.3, 11.8], [14.0, 20.5]])
    model = small(**{"acquisition.n_frames": 4})
    exact = simulate(model, positions, seed=11).optical
    on_grid = simulate(model.with_values({"optics.high_resolution_factor": 16}), positions, seed=11).optical
    spots = exact - 20
    assert np.abs(on_grid - exact).sum() / spots.sum() < 0.04
    assert on_grid.sum() == pytest.approx(exact.sum(), rel=1e-5)


def test_fine_grid_follows_moving_molecules():
    model = small(**{"acquisition.n_frames": 4}).with_effects(effect("stage_drift", distance_px=6.0, direction_deg=0.0))
    grid = model.with_values({"optics.high_resolution_factor": 16})
    positions = np.array([[10.0, 10.0]])
    exact, on_grid = (simulate(m, positions, seed=12).optical for m in (model, grid))
    assert np.abs(on_grid - exact).sum() / (exact - 20).sum() < 0.06


def test_the_movie_alone_is_that_of_the_whole_simulation(monkeypatch):
    model = small("FF").with_effects(effect("image_lag"))
    monkeypatch.setattr(simulation, "BLOCK_BYTES", 5 * 4 * 20 * 28)  # blocks of five frames
    alone = simulation.SimulatedAcquisition(model, seed=3).movie()
    np.testing.assert_array_equal(alone, simulate(model, seed=3).movie)
