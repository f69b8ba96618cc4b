"""Extraction against movies whose molecules are known (docs/traces.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from tests.blind import generator
from tests.real_data import real_data

import napari_mufasa as nm
from napari_mufasa.camera.frames import with_dark_baseline
from napari_mufasa.optics import spot_images
from napari_mufasa.spots.aperture import aperture
from napari_mufasa.spots.times import frames_needed
from napari_mufasa.traces import Options, extract_traces
from napari_mufasa.traces.candidates import least_edge_px
from napari_mufasa.traces.extract import held_share

MODELS = Path(__file__).resolve().parents[2] / "docs" / "models"


def base(**changes):
    """About 10 detected photons in a spot's brightest pixel and frame, 9 of background."""
    return nm.Model.from_dict(generator.base_model("emccd")).with_values(changes)


def matched(found: np.ndarray, truth: np.ndarray, tolerance_px: float = 1.5):
    """Pairs (found, truth) nearer than the tolerance, and their distances."""
    distance = np.hypot(*(found[:, None] - truth[None]).transpose(2, 0, 1))
    rows, columns = linear_sum_assignment(np.minimum(distance, 100.0))
    near = distance[rows, columns] < tolerance_px
    return rows[near], columns[near], distance[rows, columns][near]


@pytest.fixture(scope="module")
def blinking():
    """An independent movie: 0.01 molecules per px², long dark states."""
    movie = generator.make(generator.base_model("emccd"), seed=12, n_molecules=92, effects=[("long_dark_state", 0.5)])
    model = nm.Model.from_dict(movie.believed)
    return movie, model, extract_traces(movie.movie, model.camera, movie.dark, psf_sigma_px=model.sigma_px)


@pytest.mark.parametrize("effects", [[], [("photobleaching", 0.5)], [("long_dark_state", 0.5)]])
def test_isolated_molecules_are_found_and_nothing_else(effects):
    case = generator.make(generator.base_model("emccd"), seed=10 + len(effects), n_molecules=92, effects=effects)
    model = nm.Model.from_dict(case.believed)
    found = extract_traces(case.movie, model.camera, case.dark, psf_sigma_px=model.sigma_px)
    truth = np.array(case.truth["positions_px"])
    positions = found.positions_px[found.kept]
    _, columns, distance = matched(positions, truth)
    inside = np.all((truth > 1.5) & (truth < 94.5), axis=1)
    isolated = inside & (cKDTree(truth).query(truth, k=2)[0][:, 1] > 5.0)
    assert len(distance) / len(positions) >= 0.98
    assert np.isin(np.flatnonzero(isolated), columns).mean() >= 0.9
    assert np.sqrt(np.mean(distance**2)) <= 0.3


def test_randomly_scattered_molecules_overlap_and_are_judged():
    model = base(**{"acquisition.shape_px": (128, 128), "fluorophore.cycles_before_bleaching": 1e5})
    truth = np.random.default_rng(5).uniform(-0.5, 127.5, (164, 2))
    movie = nm.simulate(model, truth, seed=5).movie
    found = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px)
    _, columns, distance = matched(found.positions_px[found.kept], truth)
    apart = cKDTree(truth).query(truth, k=2)[0][:, 1]
    isolated = np.flatnonzero((apart > 5.0) & np.all((truth > 1.5) & (truth < 126.5), axis=1))
    assert len(distance) / found.kept.sum() >= 0.98
    assert np.isin(isolated, columns).mean() >= 0.9
    # The kept spots are single ones: most overlapping pairs 2 … 4 px apart are rejected.
    pairs = np.flatnonzero((apart > 2.0) & (apart < 4.0))
    assert np.isin(pairs, columns).mean() < 0.35
    assert all(found.molecules.loc[~found.kept, "reason"] != "")
    assert all(found.molecules.loc[found.kept, "reason"] == "")


def test_traces_follow_the_truth_as_well_as_shot_noise_allows():
    """Against an oracle that knows position, PSF and background and has the same photons."""
    model = base(**{"acquisition.shape_px": (128, 128)})
    model = model.with_effects(_effect("long_dark_state", off_rate_per_s=2.0))
    truth = _grid(128, 14)
    made = nm.simulate(model, truth, seed=2)
    found = extract_traces(made.movie, model.camera, psf_sigma_px=model.sigma_px)
    rows, columns, _ = matched(found.positions_px[found.kept], truth)
    assert len(rows) > 50
    emitted = made.emission[columns].astype(float)
    signal = found.traces[rows]
    expected = emitted * model.optics.collection_efficiency * model.camera.quantum_efficiency
    assert np.median(signal.mean(axis=1) / expected.mean(axis=1)) == pytest.approx(1.0, abs=0.03)
    oracle = _oracle(made.movie, truth[columns], model)
    reached = [np.corrcoef(s, e)[0, 1] for s, e in zip(signal, emitted, strict=True)]
    allowed = [np.corrcoef(o, e)[0, 1] for o, e in zip(oracle, emitted, strict=True)]
    assert np.median(np.array(reached) / np.array(allowed)) >= 0.95


def _effect(kind, **values):
    from napari_mufasa.effects import effect_from_data

    return effect_from_data({"kind": kind, **values})


def _grid(size: int, spacing: int) -> np.ndarray:
    at = np.arange(spacing / 2, size, spacing)
    place = np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2)
    return place + np.random.default_rng(0).uniform(-0.5, 0.5, place.shape)


def _oracle(movie, positions, model) -> np.ndarray:
    """Weights of the least variance at the molecule's own brightness, true position and true background."""
    from scipy.special import erf

    electrons = (movie + 0.5 - model.camera.baseline_adu) * model.camera.electrons_per_adu / model.camera.em_gain
    background = model.camera.quantum_efficiency * model.optics.background_photons_per_px
    y, x = np.indices(movie.shape[1:])
    traces = []
    for py, px in positions:
        scale = np.sqrt(2) * model.sigma_px
        shares = 0.25 * (erf((y - py + 0.5) / scale) - erf((y - py - 0.5) / scale))
        shares *= erf((x - px + 0.5) / scale) - erf((x - px - 0.5) / scale)
        weight = shares / (50 * shares + background)
        near = shares > 1e-4
        traces.append((electrons[:, near] - background) @ weight[near] / (weight * shares)[near].sum())
    return np.array(traces)


def test_an_empty_movie_gives_no_molecule():
    """Background only, three cameras: none kept, and at most two candidates in all of them together."""
    candidates = 0
    for name in ("emccd", "cmos", "ccd"):
        model = nm.Model.from_dict(generator.base_model(name))
        movie = nm.simulate(model, np.empty((0, 2)), seed=1).movie
        found = extract_traces(movie, model.camera, psf_sigma_px=1.27)
        candidates += len(found.molecules)
        assert not found.kept.any()
    assert candidates <= 2


def test_blinking_is_read_from_the_traces(blinking):
    _case, _, found = blinking
    dark = found.molecules["n_blinks"].sum()
    still = generator.make(generator.base_model("emccd"), seed=12, n_molecules=92)
    model = nm.Model.from_dict(still.believed)
    plain = extract_traces(still.movie, model.camera, still.dark, psf_sigma_px=model.sigma_px)
    assert dark > 20
    assert plain.molecules["n_blinks"].sum() <= 2


def test_bleaching_frame_and_window():
    model = base(**{"fluorophore.cycles_before_bleaching": 1e5})
    truth = _grid(96, 12)
    made = nm.simulate(model, truth, seed=4)
    found = extract_traces(made.movie, model.camera, psf_sigma_px=model.sigma_px, window=30, best=10)
    rows, columns, _ = matched(found.positions_px, truth)
    last = np.array([np.flatnonzero(e)[-1] + 1 for e in made.emission[columns]])
    bleached = (last < 290) & (last > 10)
    error = found.molecules["bleaching_frame"].to_numpy()[rows][bleached] - last[bleached]
    assert bleached.sum() > 20
    assert np.mean(np.abs(error) <= 1) >= 0.9
    assert found.traces.shape == (10, 30)
    assert found.kept.sum() == 10
    for trace, (_, row) in zip(found.traces, found.molecules[found.kept].iterrows(), strict=True):
        end = row.bleaching_frame if row.bleaching_frame >= 0 else 300
        assert row.window_start + 30 == end
        assert trace.mean() > 0.7 * row.brightness  # active throughout
    others = found.molecules[~found.kept]["reason"]
    assert others.str.contains("not among the 10 best|no 30 active frames|border|never on|SNR|narrower").all()


def test_a_molecule_that_drifts_over_the_edge_is_as_near_to_it_as_it_comes():
    """Where the field moves by 5 px to the right, a place 3 px from the right edge ends beyond it."""
    places, motion = np.array([[20.0, 36.5], [20.0, 3.5], [1.0, 20.0]]), np.linspace([0.0, 0.0], [0.0, 5.0], 7)
    np.testing.assert_allclose(least_edge_px(places, motion, (40, 40)), [-2.0, 4.0, 1.5])
    np.testing.assert_allclose(least_edge_px(places, None, (40, 40)), [3.0, 4.0, 1.5])
    # What lies outside is read as nothing, without a complaint of numpy.
    gone = aperture(np.array([[20.0, 90.0]]), (40, 40), 1.2, "psf")
    assert np.all(np.isfinite(gone.weight)) and gone.weight[0] == 0


def test_drift_is_followed():
    model = base().with_effects(_drift())
    truth = _grid(96, 16)
    made = nm.simulate(model, truth, seed=3)
    followed = extract_traces(made.movie, model.camera, psf_sigma_px=model.sigma_px, follow_drift=True)
    fixed = extract_traces(made.movie, model.camera, psf_sigma_px=model.sigma_px)
    assert followed.drift_px is not None

    assert np.hypot(*followed.drift_px[-1]) > 2.0
    fifths = followed.traces.reshape(len(followed.traces), 5, -1).mean(axis=2)
    assert np.median(fifths.min(axis=1) / fifths.max(axis=1)) > 0.85  # no light wanders out of the aperture
    # In the mean of a movie that is not followed a molecule is a line, and none of 36 or one passes for a spot.
    assert len(followed.traces) >= 30 and len(fixed.traces) <= 3
    assert (fixed.molecules["reason"][~fixed.kept] == "edge or line, no spot").mean() > 0.9


@pytest.mark.parametrize(("camera", "seed"), [("emccd", 4), ("cmos", 5)])
def test_a_moving_field_is_noticed_and_followed(camera, seed):
    """Independent movies whose field moves by 3 to 4 px, curved and in one step; see what following is worth."""
    strength = {"emccd": 1.0, "cmos": 0.7}[camera]
    case = generator.make(
        generator.base_model(camera), seed=seed, n_molecules=70, effects=[("stage_drift", strength)]
    )  # fmt: skip
    model = nm.Model.from_dict(case.believed)
    truth = np.array(case.truth["positions_px"])
    fixed, followed = (
        extract_traces(case.movie, model.camera, case.dark, psf_sigma_px=model.sigma_px, follow_drift=follow)
        for follow in (False, True)
    )
    assert "follow the drift" in fixed.notes[0] and followed.notes == ()
    assert len(fixed.molecules) > 1.4 * len(truth)  # molecules count twice
    assert len(followed.molecules) <= 1.05 * len(truth)
    rows, _, distance = matched(followed.positions_px[followed.kept], truth)
    assert len(rows) >= 0.85 * len(truth) > 1.5 * fixed.kept.sum()
    assert np.sqrt(np.mean(distance**2)) < 0.35


@pytest.mark.parametrize("effects", [[], [("molecule_diffusion", 0.7)], [("delayed_activation", 0.8)]])
def test_a_field_at_rest_raises_no_alarm(effects):
    case = generator.make(generator.base_model("emccd_bleach"), seed=1, n_molecules=40, effects=effects)
    model = nm.Model.from_dict(case.believed)
    assert extract_traces(case.movie, model.camera, case.dark, psf_sigma_px=model.sigma_px).notes == ()


def _drift():
    from napari_mufasa.effects import effect_class

    kind = effect_class("stage_drift")
    return kind(**{kind.strength: kind.plausible()[kind.strength][1]})


def test_every_profile_holds_its_share_of_the_light():
    model = base()
    truth = np.rint(_grid(96, 16))
    made = nm.simulate(model, truth, seed=6)
    whole = (made.emission * model.optics.collection_efficiency * model.camera.quantum_efficiency).mean()
    for profile, share in (("psf", 1.0), ("sum", None), ("brightest_pixel", None)):
        found = extract_traces(made.movie, model.camera, psf_sigma_px=model.sigma_px, profile=profile)
        expected = share or {"sum": 0.953, "brightest_pixel": 0.0931}[profile]  # integrals of the PSF at a centre
        assert found.traces.mean() / whole == pytest.approx(expected, rel=0.04)
        assert found.pixel_share == pytest.approx(expected, rel=0.06)


@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize("profile", ["psf", "sum", "brightest_pixel"])
def test_levels_are_above_the_background_that_a_trace_keeps(profile, follow):
    """The same molecules' levels with and without it: means of 60 frames, whose rings differ from the ring's median
    over the movie by 0.1 e a pixel, 2 e of the 20 pixels of a disc."""
    model = base(**{"acquisition.n_frames": 60})
    movie = nm.simulate(model, _grid(96, 19), seed=1).movie
    options = {"psf_sigma_px": model.sigma_px, "profile": profile, "follow_molecules": follow, "min_snr": 0}
    without = extract_traces(movie, model.camera, **options)
    with_it = extract_traces(movie, model.camera, subtract_background=False, **options)
    level, other = (float(np.median(found.molecules["brightness"])) for found in (without, with_it))
    assert with_it.traces.mean() > 1.5 * without.traces.mean()  # much of it is background
    assert other == pytest.approx(level, rel=0.03)


@pytest.mark.parametrize("held", [1, 2, 5, 60])
def test_the_noise_of_a_pixel_does_not_depend_on_how_many_frames_are_held(held, monkeypatch):
    """F² of the background and the read noise over the gain; medians over the pixels of 30 and more steps' mean squares
    are below the mean by less than 3 %, and electron-multiplied noise has heavier tails."""
    model = base(**{"acquisition.n_frames": 60})
    movie = nm.simulate(model, _grid(96, 32), seed=1).movie
    monkeypatch.setattr("napari_mufasa.camera.frames.BLOCK_BYTES", held * 4 * 96 * 96)
    camera, photons = model.camera, model.optics.background_photons_per_px
    level_e = camera.quantum_efficiency * photons + camera.clock_induced_charge_e
    noise_e = np.sqrt(2 * level_e + (camera.read_noise_e / camera.em_gain) ** 2)
    assert extract_traces(movie, camera, psf_sigma_px=model.sigma_px).noise_e == pytest.approx(noise_e, rel=0.06)


def test_a_block_longer_than_the_movie_is_the_movie():
    model = base(**{"acquisition.n_frames": 30})
    movie = nm.simulate(model, _grid(96, 19), seed=1).movie
    long, whole = (
        extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px, time_block=block) for block in (1000, 30)
    )
    assert len(long.molecules) == len(whole.molecules) == 25


def test_hot_pixels_are_not_molecules():
    model = base()
    movie = nm.simulate(model, np.array([[30.2, 40.1]]), seed=1).movie.copy()
    movie[:, 60, 60] += 400
    found = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px)
    hot = found.molecules[np.hypot(found.molecules.y_px - 60, found.molecules.x_px - 60) < 1.5]
    assert len(hot) == 1
    assert not hot["kept"].any()
    assert found.kept.sum() == 1


def test_an_edge_of_light_is_not_a_row_of_molecules():
    model = base()
    rng = np.random.default_rng(0)
    expected = np.where(np.arange(96) < 48, 4.0, 40.0) * np.ones((200, 96, 1))
    electrons = rng.standard_gamma(rng.poisson(expected)) * 300
    movie = (electrons / 12 + 200).astype(np.uint16)
    found = extract_traces(movie, model.camera, psf_sigma_px=1.27)
    assert not found.kept.any()


def test_lazy_and_eager_movies_give_the_same():
    import dask.array as da

    model = base(**{"acquisition.n_frames": 60})
    movie = nm.simulate(model, _grid(96, 16), seed=1).movie
    one = extract_traces(movie, model.camera, psf_sigma_px=1.27)
    two = extract_traces(da.from_array(movie, chunks=(7, 50, 96)), model.camera, psf_sigma_px=1.27)
    assert np.array_equal(one.all_traces, two.all_traces)


def test_units_of_the_movie_do_not_change_the_traces():
    from napari_mufasa import camera

    model = base(**{"acquisition.n_frames": 60})
    movie = nm.simulate(model, _grid(96, 16), seed=1).movie
    electrons = camera.photoelectrons(movie, model.camera)
    adu = extract_traces(movie, model.camera, psf_sigma_px=1.27)
    same = extract_traces(electrons, model.camera, psf_sigma_px=1.27, unit="photoelectrons")
    photons = extract_traces(
        electrons / model.camera.quantum_efficiency, model.camera, psf_sigma_px=1.27, unit="photons"
    )
    np.testing.assert_allclose(same.all_traces, adu.all_traces, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(photons.all_traces, adu.all_traces, rtol=1e-4, atol=1e-2)


def test_dark_frames_give_the_baseline():
    model = base(**{"camera.baseline_adu": 200.0, "camera.clock_induced_charge_e": 0.01})
    dark = nm.simulate_dark(model, 50, seed=1)
    wrong = model.camera.model_copy(update={"baseline_adu": 150.0})
    # 50 frames of 96² pixels with 4 ADU read noise: the mean is known to 0.01 ADU.
    assert with_dark_baseline(wrong, dark, (96, 96)).baseline_adu == pytest.approx(200.0, abs=0.1)


def test_choice_by_hand_and_region_of_interest():
    model = base(**{"acquisition.n_frames": 60})
    movie = nm.simulate(model, _grid(96, 16), seed=1).movie
    triangle = np.array([[-1.0, -1.0], [-1.0, 97.0], [97.0, -1.0]])
    found = extract_traces(movie, model.camera, psf_sigma_px=1.27, roi=[triangle])
    along = found.molecules.y_px + found.molecules.x_px
    inside, outside = along < 95, along > 97  # the mask is cut at whole pixels
    assert (found.molecules.loc[outside, "reason"] == "outside the region of interest").all()
    assert found.molecules.loc[inside, "kept"].any()
    first = int(found.molecules.loc[found.kept, "molecule"].iloc[0])
    fewer = found.with_kept([first], kept=False)
    assert len(fewer.traces) == len(found.traces) - 1
    assert fewer.molecules.loc[first, "reason"] == "rejected by hand"
    assert np.array_equal(fewer.with_kept([first]).traces, found.traces)


def test_progress_ends_and_cancel_stops():
    model = base(**{"acquisition.n_frames": 60})
    movie = nm.simulate(model, _grid(96, 16), seed=1).movie
    seen: list[tuple[int, int]] = []
    extract_traces(movie, model.camera, psf_sigma_px=1.27, progress=lambda *p: seen.append(p))
    assert seen[-1][0] == seen[-1][1] == 120
    with pytest.raises(nm.Cancelled):
        extract_traces(movie, model.camera, psf_sigma_px=1.27, cancel=lambda: True)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"movie": np.zeros((5, 5))}, "shape"),
        ({"dark": np.zeros((3, 7, 7))}, "dark"),
        ({"psf_sigma_px": -1.0}, "psf_sigma_px"),
        ({"profile": "best"}, "profile"),
        ({"threshold": "magic"}, "threshold"),
        ({"window": 1000}, "window"),
        ({"best": 0}, "best"),
        ({"isolation": 3}, "isolation"),
        ({"unit": "volts"}, "volts"),
    ],
)
def test_bad_input_is_named(change, word):
    movie = change.pop("movie", np.full((20, 32, 32), 300, np.uint16))
    with pytest.raises(nm.MufasaError, match=word):
        extract_traces(movie, base().camera, change.pop("dark", None), **{"psf_sigma_px": 1.27, **change})


FLAT = np.full((60, 32, 32), 300, np.uint16)
NOISE = np.random.default_rng(0).integers(200, 300, (60, 32, 32)).astype(np.uint16)


@pytest.mark.parametrize(
    ("movie", "word"),
    [
        (FLAT, "every pixel of the movie is 300: nothing"),
        (FLAT[:1], "every pixel of the movie is 300: nothing"),
        (FLAT + np.arange(60, dtype=np.uint16)[:, None, None], "all pixels of a frame are equal"),
        (np.repeat(NOISE[:1], 60, axis=0), "all frames of the movie are equal"),
        (np.full((60, 32, 32), 65535, np.uint16), "saturated"),
        (np.full((60, 32, 32), 255, np.uint8), "saturated"),
    ],
)
@pytest.mark.parametrize("known", [None, np.array([[16.0, 16.0]])])
def test_a_movie_that_shows_nothing_is_refused(movie, word, known):
    with pytest.raises(nm.MufasaError, match=word):
        extract_traces(movie, base().camera, psf_sigma_px=1.27, positions_px=known)


def test_one_pixel_that_changes_once_is_a_movie():
    """The frames are looked at to the last before a movie is refused."""
    movie = FLAT.copy()
    movie[-1, 3, 3] += 1
    assert extract_traces(movie, base().camera, psf_sigma_px=1.27).kept.sum() == 0


@pytest.mark.parametrize("threshold", ["sigma", "percentile", "otsu", "triangle"])
def test_every_threshold_finds_bright_molecules(threshold):
    model = base(**{"acquisition.n_frames": 60})
    truth = _grid(96, 16)
    movie = nm.simulate(model, truth, seed=1).movie
    found = extract_traces(movie, model.camera, options=Options(psf_sigma_px=1.27, threshold=threshold))
    assert len(matched(found.positions_px, truth)[0]) >= 0.9 * len(truth)


def test_width_of_the_psf_is_measured():
    for fwhm in (250, 400):
        model = base(**{"acquisition.n_frames": 60, "optics.psf_fwhm_nm": fwhm})
        movie = nm.simulate(model, _grid(96, 19), seed=1).movie
        assert extract_traces(movie, model.camera).sigma_px == pytest.approx(model.sigma_px, rel=0.12)


@pytest.mark.parametrize("spacing_px", [16, 24])
@pytest.mark.parametrize("sigma_px", [0.8, 1.0, 1.3, 2.0])
def test_the_measured_width_is_that_of_the_psf_and_not_of_its_pixels(sigma_px, spacing_px):
    """A pixel adds 1/12 to a spot's variance, a top beside the pixel's centre as much: 11 % of a width of 0.8, and 8 %
    of the light that is read with it. Each photon of 10^4 and more that 40 spots show tells the width to 1 of 2 in
    its square: chance is 0.1 %, what is left is that of the parabola and of the grid of widths (1.4 % apart)."""
    rng = np.random.default_rng(3)
    n = 144 // spacing_px
    places = spacing_px * (np.indices((n, n)).reshape(2, -1).T + 0.5) + rng.uniform(-0.5, 0.5, (n * n, 2))
    model = base(**{"acquisition.shape_px": (144, 144), "acquisition.n_frames": 50})
    model = model.with_values({"optics.psf_fwhm_nm": sigma_px * 2.3548 * model.acquisition.pixel_size_nm})
    movie = nm.simulate(model, places, seed=1).movie
    assert extract_traces(movie, model.camera).sigma_px == pytest.approx(sigma_px, rel=0.04)


@pytest.mark.realdata
def test_real_movie_gives_at_least_ninety_molecules_of_one_step():
    path = real_data("smfret_ixon_emccd.tif")
    import tifffile

    model = nm.Model.from_json(MODELS / "smfret_ixon.json")
    found = extract_traces(tifffile.imread(path), model.camera, psf_sigma_px=model.sigma_px, max_steps=1)
    assert found.kept.sum() >= 90
    kept = found.molecules[found.kept]
    assert (kept["n_steps"] <= 1).all()
    bleached = kept[kept.bleaching_frame >= 30]
    for i, row in bleached.iterrows():  # dark after bleaching: below half of the on level
        after = found.all_traces[i, int(row.bleaching_frame) :]
        assert after.mean() < 0.5 * row.brightness


def test_what_is_held_does_not_grow_with_the_number_of_blocks(monkeypatch):
    """200 molecules in 200 blocks of one frame: their lit images, half a megabyte each, are added up as they come."""
    import tracemalloc

    from napari_mufasa.camera import frames

    monkeypatch.setattr(frames, "BLOCK_BYTES", 1)
    rng = np.random.default_rng(0)
    movie = rng.poisson(100.0, (200, 64, 64)).astype(np.uint16)
    given = {"positions_px": rng.uniform(4, 60, (200, 2)), "psf_sigma_px": 1.3}
    camera = base().camera
    extract_traces(movie[:3], camera, **given)  # what is imported and compiled does not count
    tracemalloc.start()
    extract_traces(movie, camera, **given)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6


def test_a_spot_needs_fewer_frames_the_clearer_it_is():
    """A single frame shows s; a mean over 1, 5 or all 100 frames shows the n lit ones in it as s n / sqrt(frames)."""
    all_lit = np.array([100, 100, 100, 100])
    single = np.array([8.0, 3.0, 1.2, np.nan])
    needed = frames_needed(10 * single, all_lit, 100, level=6.0)
    np.testing.assert_allclose(needed[:3], [6 / 8, 6 * 5**0.5 / 3, 6 * 10 / 1.2])
    assert np.isnan(needed[3])  # its place was given
    # Lit in 20 of the frames: clearest in the mean of 5.
    np.testing.assert_allclose(frames_needed(np.array([3 * 5**0.5]), np.array([20]), 100, level=6.0), 6 * 5**0.5 / 3)


@pytest.mark.parametrize("sigma", [0.7, 1.3, 3.0])
@pytest.mark.parametrize("profile", ["psf", "sum", "brightest_pixel"])
def test_a_trace_holds_the_share_of_the_light_that_it_says(profile, sigma):
    places = 30 + np.random.default_rng(1).uniform(-0.5, 0.5, (200, 2))
    spots = spot_images(1000 * np.eye(200), places[None], np.full((1, 2), sigma), (61, 61))
    held = [
        aperture(place[None], (61, 61), sigma, profile).traces(spot[None])[0][0, 0]
        for place, spot in zip(places, spots, strict=True)
    ]
    error = 4 * np.std(held) / 1000 / np.sqrt(200)  # of the mean of 200 places: by chance once in 16 000
    assert held_share(profile, sigma) == pytest.approx(np.mean(held) / 1000, abs=error + 5e-4)  # the ring's own light


def _lights(light, adc_max=65535, background_e=10.0):
    """Counts (frame, y, x) of molecules 16 px apart, `light` (molecule, frame) photoelectrons, on a plain CCD; its
    camera and their places."""
    from napari_mufasa.optics.gaussian import pixel_shares

    camera = nm.preset("PALM").camera.model_copy(
        update={"read_noise_e": 2.0, "electrons_per_adu": 1.0, "baseline_adu": 100.0, "adc_max": adc_max}
    )  # fmt: skip
    rng, places = np.random.default_rng(0), _grid(80, 16)
    y, x = np.mgrid[:80, :80]
    shares = np.array([pixel_shares(y - p[0], x - p[1], 1.3).ravel() for p in places])
    mean = (light.T @ shares).reshape(-1, 80, 80) + background_e
    counts = np.floor(rng.poisson(mean) + rng.normal(0, 2.0, mean.shape)) + 100
    return np.clip(counts, 0, adc_max).astype(np.uint16), camera, places


def test_saturated_molecules_are_told():
    """Ten of 25 saturate a camera of 8 bits in a half of 40 frames; none saturates one of 16."""
    light = np.full((25, 40), 400.0)
    light[:10, :20] = 4000.0
    movie, camera, _ = _lights(light, 255)
    (note,) = extract_traces(movie, camera, psf_sigma_px=1.3).notes
    assert note.startswith("pixels of 10 molecules are saturated, in 50 % of their frames")
    narrow = extract_traces(movie.astype(np.uint8), camera.model_copy(update={"adc_max": 65535}), psf_sigma_px=1.3)
    assert narrow.notes == (note,)  # the end of the numbers, too
    movie, camera, _ = _lights(light)
    assert extract_traces(movie, camera, psf_sigma_px=1.3).notes == ()


@pytest.mark.parametrize("n_frames", [1, 2, 3])
def test_a_movie_of_few_frames_keeps_its_molecules(n_frames):
    movie, camera, _ = _lights(np.full((25, n_frames), 3000.0))
    found = extract_traces(movie, camera, psf_sigma_px=1.3)
    assert found.kept.sum() == 25, set(found.molecules["reason"])
    assert extract_traces(movie, camera, psf_sigma_px=1.3, best=7).kept.sum() == 7


@pytest.mark.parametrize("time_block", [None, 60, 45, 7])
def test_molecules_that_come_late_are_found_whatever_the_block(time_block):
    light = np.full((25, 100), 400.0)
    light[::2, :65] = 0.0
    movie, camera, _ = _lights(light)
    assert len(extract_traces(movie, camera, psf_sigma_px=1.3, time_block=time_block).molecules) == 25
