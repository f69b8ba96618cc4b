"""The pipeline's laws: no bias, no harm to moving scenes, blocks that agree with the whole, honest errors."""

from __future__ import annotations

import dask.array as da
import numpy as np
import pytest
import zarr

import napari_mufasa as nm
from napari_mufasa import camera as cam
from napari_mufasa.camera import read_variance
from napari_mufasa.denoise import pure_let_movie, reel, temporal
from napari_mufasa.denoise.viewing import taken_away
from napari_mufasa.errors import Cancelled, MufasaError
from napari_mufasa.model.setup import Camera

EMCCD = Camera(
    type="EMCCD", quantum_efficiency=0.9, read_noise_e=50, clock_induced_charge_e=0.002, electrons_per_adu=12,
    baseline_adu=200, em_gain=300,
)  # fmt: skip
CCD = Camera(type="CCD", quantum_efficiency=0.8, read_noise_e=1.5, electrons_per_adu=0.5, baseline_adu=100)
CMOS = Camera(type="CMOS", quantum_efficiency=0.8, read_noise_e=1.5, electrons_per_adu=0.4, baseline_adu=100)


def record(photons, camera, rng):
    """Counts by docs/camera.md, written here anew: a test of the inverse must not use the camera's own code."""
    e = rng.poisson(camera.quantum_efficiency * photons + camera.clock_induced_charge_e).astype(float)
    if camera.type == "EMCCD":
        e = rng.standard_gamma(e) * camera.em_gain
    elif camera.type == "CMOS":
        e = np.interp(e, [0, 200, 1000, 3000], [0, 180, 500, 700])
    e = e + rng.normal(0, camera.read_noise_e, photons.shape)
    return np.clip(np.floor(e / camera.electrons_per_adu) + camera.baseline_adu, 0, 65535).astype(np.uint16)


def blobs(frames=24, side=72, speed=0.0):
    y, x = np.mgrid[:side, :side]
    movie = np.full((frames, side, side), 0.1)
    for k in range(20):
        angle, cy, cx = 2.4 * k, (17 * k) % side, (29 * k) % side
        for t in range(frames):
            py, px = cy + speed * t * np.sin(angle), cx + speed * t * np.cos(angle)
            movie[t] += np.exp(-((y - py) ** 2 + (x - px) ** 2) / (2 * 1.4**2))
    return movie


@pytest.mark.parametrize("camera", [EMCCD, CCD, CMOS], ids=lambda c: c.type)
@pytest.mark.parametrize("method", ["pure-let", "pure-let-movie", "none"])
def test_the_mean_is_unbiased_down_to_half_a_photon(camera, method):
    # 40 x 128 x 128 pixels at mean 0.5 photons: the standard error of the mean is at most 0.53 % (CMOS; 0.3 % for the
    # others), the limit of 1.6 % stands three of them off. The benchmark measures the 1 % on ten times the pixels.
    rng = np.random.default_rng(1)
    truth = blobs(40, 128) * 1.0
    truth *= 0.5 / truth.mean()
    out = nm.denoise(record(truth, camera, rng), camera, method=method)
    assert out.mean(dtype=float) / truth.mean() == pytest.approx(1.0, abs=0.016)


COARSE = CCD.model_copy(update={"read_noise_e": 6.0, "electrons_per_adu": 12.0})


@pytest.mark.parametrize("kernel", [(), (-0.2,)])
def test_the_noise_is_that_of_the_data_where_the_converter_is_coarse(kernel):
    # 60 x 64 x 64 values: the standard error of a variance is 0.3 %; without the rounding it would be off by a fifth.
    camera = COARSE.model_copy(update={"readout_kernel": kernel})
    light = camera.quantum_efficiency * 20
    electrons = np.random.default_rng(1).poisson(light, (60, 64, 80)).astype(float)
    mixed = (electrons + sum(kernel) * np.roll(electrons, 1, axis=2)) / (1 + sum(kernel))
    mixed += np.random.default_rng(2).normal(0, camera.read_noise_e, mixed.shape)
    counts = (np.floor(mixed / camera.electrons_per_adu) + camera.baseline_adu).astype(np.uint16)
    seen = cam.photoelectrons(counts, camera)[..., 16:]
    told = light + read_variance(seen[0], camera).mean()
    assert seen.var(dtype=float) / told == pytest.approx(1.0, abs=0.01)


def test_a_coarse_converter_takes_little_of_what_denoising_gains():
    truth = blobs() * 20.0
    counts = record(truth, COARSE, np.random.default_rng(3))
    errors = {m: np.mean((nm.denoise(counts, COARSE, method=m) - truth) ** 2) for m in ("none", "pure-let-movie")}
    assert errors["pure-let-movie"] < 0.02 * errors["none"]


def test_a_movie_whose_noise_is_not_the_cameras_is_left_as_it_was_recorded():
    # Blinking: read noise of less than a tenth of a count, so that counts are no sum of light and noise.
    model = nm.preset("Blinking").with_values({"acquisition.n_frames": 20, "acquisition.shape_px": [128, 128]})
    movie = nm.simulate(model, seed=1).movie
    with pytest.warns(UserWarning, match="left as it was recorded"):
        found = nm.denoise(movie, model.camera)
    np.testing.assert_array_equal(found, nm.denoise(movie, model.camera, method="none"))


@pytest.mark.parametrize("said_e", [5.4, 7.7])
def test_a_movie_of_less_noise_than_its_camera_says_is_denoised_by_the_noise_it_has(said_e):
    # 120 000 values: the variance is known to 0.4 %, the share is halved down to 2 %.
    truth, camera = blobs() * 20.0, CCD.model_copy(update={"read_noise_e": 4.0})
    counts = record(truth, camera, np.random.default_rng(4))
    light = camera.quantum_efficiency * truth.mean()
    with pytest.warns(UserWarning, match="less noise than its camera says") as told:
        found = nm.denoise(counts, camera.model_copy(update={"read_noise_e": said_e}))
    less = float(str(told[0].message).split(" %")[0].split()[-1])
    assert less == pytest.approx(100 * (1 - (light + 4.0**2) / (light + said_e**2)), abs=3)
    recorded = nm.denoise(counts, camera, method="none")
    assert np.mean((found - truth) ** 2) < 0.01 * np.mean((recorded - truth) ** 2)


def test_a_saturated_movie_is_told_as_one_and_its_camera_is_not_blamed():
    truth, camera = blobs() * 400.0, CCD.model_copy(update={"read_noise_e": 4.0})
    counts = record(truth, camera, np.random.default_rng(4))
    most = int(np.percentile(counts, 70))
    camera = camera.model_copy(update={"adc_max": most})
    with pytest.warns(UserWarning, match="largest count, which have none: record with less light") as told:
        nm.denoise(np.minimum(counts, most), camera)
    assert "calibrate" not in str(told[0].message)


@pytest.mark.parametrize("speed", [0.0, 1.0])
@pytest.mark.parametrize("peak", [3.0, 20.0])
def test_neighbouring_frames_help_and_never_smear(speed, peak):
    rng = np.random.default_rng(2)
    truth = blobs(speed=speed) * peak
    movie = record(truth, EMCCD, rng)
    error = {
        m: np.mean((nm.denoise(movie, EMCCD, method=m) - truth) ** 2) for m in ("none", "pure-let", "pure-let-movie")
    }
    assert error["pure-let"] < 0.4 * error["none"]
    # Where nothing moves the neighbours must help a lot; where everything moves they must not hurt.
    assert error["pure-let-movie"] < (0.6 if speed == 0 else 1.02) * error["pure-let"]


def test_excess_noise_is_worth_knowing():
    rng = np.random.default_rng(3)
    truth = blobs() * 5
    movie = record(truth, EMCCD, rng)
    aware = np.mean((nm.denoise(movie, EMCCD) - truth) ** 2)
    literal = np.mean((nm.denoise(movie, EMCCD, excess_noise=False) - truth) ** 2)
    recipe = np.mean((nm.denoise(movie, EMCCD, method="source") - truth) ** 2)
    assert aware < 0.5 * min(literal, recipe)


def test_cmos_slope_and_maps_are_undone():
    rng = np.random.default_rng(4)
    truth = blobs() * 700 + 20  # reaches the second and third piece of the gain curve
    camera = CMOS.model_copy(update={"gain_map": 1 + 0.2 * rng.standard_normal((72, 72)).clip(-2, 2)})
    e = np.interp(rng.poisson(0.8 * truth), [0, 200, 1000, 3000], [0, 180, 500, 700]) * camera.gain_map
    counts = np.floor((e + rng.normal(0, 1.5, e.shape)) / 0.4) + 100
    out = nm.denoise(counts.astype(np.uint16), camera)
    raw = nm.denoise(counts.astype(np.uint16), camera, method="none")
    assert np.mean((out - truth) ** 2) < 0.5 * np.mean((raw - truth) ** 2)
    assert out.mean() == pytest.approx(truth.mean(), rel=0.01)


def test_dask_zarr_and_blocks_give_the_same_as_numpy(tmp_path):
    movie = record(blobs(37) * 5, EMCCD, np.random.default_rng(5))
    whole = nm.denoise(movie, EMCCD)
    np.testing.assert_allclose(nm.denoise(da.from_array(movie, chunks=(5, 72, 72)), EMCCD), whole, atol=1e-5)
    stored = zarr.open(str(tmp_path / "in.zarr"), mode="w", shape=movie.shape, chunks=(8, 72, 72), dtype="u2")
    stored[:] = movie
    out = zarr.open(str(tmp_path / "out.zarr"), mode="w", shape=movie.shape, chunks=(8, 72, 72), dtype="f4")
    assert nm.denoise(stored, EMCCD, out=out) is out
    np.testing.assert_allclose(out[:], whole, atol=1e-5)


def test_no_more_than_a_block_is_read_at_once():
    # A movie larger than memory must stream: count the frames of the largest single read.
    class Watched:
        def __init__(self, data):
            self.data, self.shape, self.largest = data, data.shape, 0

        def __getitem__(self, key):
            part = self.data[key]
            self.largest = max(self.largest, len(part))
            return part

    watched = Watched(record(blobs(160), EMCCD, np.random.default_rng(6)))
    nm.denoise(watched, EMCCD)
    assert watched.largest <= reel.BLOCK + 2 * temporal.NEIGHBOURS


def test_a_single_frame_and_a_two_dimensional_one():
    movie = record(blobs(1) * 5, EMCCD, np.random.default_rng(7))
    a, b = nm.denoise(movie, EMCCD), nm.denoise(movie[0], EMCCD)
    assert a.shape == b.shape == (1, 72, 72)
    assert a.dtype == np.float32
    np.testing.assert_array_equal(a, b)


def test_progress_and_cancel():
    movie = record(blobs(40), EMCCD, np.random.default_rng(8))
    seen: list[tuple[int, int]] = []
    nm.denoise(movie, EMCCD, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(32, 40), (40, 40)]
    with pytest.raises(Cancelled):
        nm.denoise(movie, EMCCD, cancel=lambda: True)


def test_the_package_is_also_the_function():
    import napari_mufasa.denoise.purelet  # noqa: F401 - importing it must not hide the function

    movie = record(blobs(2), EMCCD, np.random.default_rng(9))
    assert nm.denoise(movie, EMCCD, method="none").shape == movie.shape


@pytest.mark.parametrize(
    ("movie", "options", "message"),
    [
        (np.zeros((2, 2, 2, 2)), {}, "4 axes"),
        (np.zeros((0, 4, 4)), {}, "empty"),
        (np.full((2, 8, 8), np.nan), {}, "not finite"),
        (np.where(np.arange(192).reshape(3, 8, 8) == 70, np.nan, 120.0), {"method": "source"}, "not finite"),
        (np.zeros((2, 8, 8)), {"method": "magic"}, "pure-let-movie"),
        (np.array([[["a"]]]), {}, "real numbers"),
        (np.zeros((2, 8, 8)), {"out": np.zeros((2, 8, 7))}, "same shape"),
    ],
)
def test_bad_input_is_told_in_one_line(movie, options, message):
    with pytest.raises(MufasaError, match=message) as caught:
        nm.denoise(movie, EMCCD, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["gain_map", "offset_map_adu", "variance_map_e2"])
@pytest.mark.parametrize("method", ["pure-let-movie", "none"])
def test_maps_of_another_shape_are_refused(name, method):
    camera = CMOS.model_copy(update={name: np.ones((4, 4))})
    with pytest.raises(MufasaError, match=name):
        nm.denoise(np.full((2, 8, 8), 120.0), camera, method=method)


def test_what_was_taken_away_knows_that_the_baseline_alternates():
    """Frames alternate by ± 30 ADU = ± 18.75 photons; without noise of the photons what is taken away has mean 0."""
    camera = CCD.model_copy(update={"baseline_alternation_adu": 30.0})
    movie = np.full((4, 8, 8), 150, np.uint16) + np.array([30, -30, 30, -30], np.int16)[:, None, None]
    photons = nm.denoise(movie, camera, method="none")
    assert photons == pytest.approx(photons.mean(), abs=1e-4)
    assert np.asarray(taken_away(movie, camera, photons)) == pytest.approx(0.0, abs=1e-4)


def test_pure_let_movie_beats_single_frames():
    rng = np.random.default_rng(10)
    truth = blobs() * 6
    y = rng.poisson(truth)
    multi = np.mean((pure_let_movie(y) - truth) ** 2)
    single = np.mean((pure_let_movie(y, neighbours=0) - truth) ** 2)
    assert multi < 0.6 * single


def test_without_a_camera_it_is_measured_on_the_movie_and_its_dark_frames():
    # Still light of 2 to 12 photons: photon transfer finds ADU per photoelectron to a few per cent.
    rng = np.random.default_rng(15)
    truth = np.broadcast_to(np.linspace(2, 12, 64)[None, None, :], (60, 64, 64))
    movie, dark = record(truth, EMCCD, rng), record(np.zeros((40, 64, 64)), EMCCD, rng)
    out = nm.denoise(movie, dark=dark)
    assert out.mean() / truth.mean() == pytest.approx(1.0, abs=0.08)
    with pytest.raises(MufasaError, match="no camera was given"):
        nm.denoise(movie[:2])


def test_a_preview_is_the_frame_before_and_after():
    from napari_mufasa.denoise.preview import Preview

    rng = np.random.default_rng(16)
    truth = blobs(30) * 5
    movie = record(truth, EMCCD, rng)
    preview = Preview(movie, EMCCD)
    look = preview.look(12)
    np.testing.assert_allclose(look.before, nm.denoise(movie[12:13], EMCCD, method="none")[0], rtol=1e-6)
    np.testing.assert_allclose(look.residual, look.before - look.after)
    np.testing.assert_array_equal(look.split(0.25)[:, :18], look.before[:, :18])
    np.testing.assert_array_equal(look.split(0.25)[:, 18:], look.after[:, 18:])
    before, after = (np.mean((plane - truth[12]) ** 2) for plane in (look.before, look.after))
    # The gain of one frame scatters around that of the movie by about 1 dB.
    assert 10 * np.log10(before / after) == pytest.approx(preview.gain_db, abs=4)


def test_like_patches_are_no_worse_than_frames_alone():
    rng = np.random.default_rng(17)
    truth = blobs(4) * 15
    movie = record(truth, EMCCD, rng)
    error = {m: np.mean((nm.denoise(movie, EMCCD, method=m) - truth) ** 2) for m in ("pure-let", "pure-let-patches")}
    assert error["pure-let-patches"] < 1.02 * error["pure-let"]
