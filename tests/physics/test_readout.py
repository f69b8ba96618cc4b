"""The camera's own read-out: laws of kernel, baseline and codes, what the inverse undoes, and what it changes not at
all. Tolerances are four to five standard errors."""

import numpy as np
import pytest
from scipy import ndimage
from tests.physics.test_camera import N, make, record

from napari_mufasa import MufasaError, denoise, preset
from napari_mufasa import camera as cam
from napari_mufasa.camera import frames, readout


def rows(z, lag):
    z = z - z.mean(axis=0)
    return float(np.mean(z[..., lag:] * z[..., :-lag]) / np.mean(z**2))


@pytest.mark.parametrize("kernel", [(-0.05,), (-0.13,), (0.17, 0.02)])
def test_the_kernel_correlates_rows_and_its_inverse_takes_that_away(kernel):
    camera = make("EMCCD", readout_kernel=kernel, read_noise_kernel=kernel, read_noise_e=300.0)
    movie = record(camera, 20.0).astype(float)
    weights = np.array([1, *kernel])
    law = np.correlate(weights, weights, "full")[len(kernel) :] / np.sum(weights**2)
    for lag in (1, 2, 3):
        expected = law[lag] if lag <= len(kernel) else 0.0
        assert rows(movie[..., 4:], lag) == pytest.approx(expected, abs=5 / np.sqrt(N))
    electrons = cam.photoelectrons(movie, camera).astype(float)
    for lag in (1, 2, 3):
        assert abs(rows(electrons, lag)) < 5 / np.sqrt(N)
    expected = 0.9 * 20 + 0.002
    read = readout.undone_noise_power(camera)
    assert electrons.mean() == pytest.approx(expected, abs=5 * np.sqrt(2 * expected / N))
    variance = 2 * expected + read * (300 / 300) ** 2
    assert electrons.var() == pytest.approx(variance, rel=5 * np.sqrt(4 / N))


@pytest.mark.parametrize("n", [1, 2, 5, 40])
def test_rows_are_mixed_as_a_convolution_mixes_them(n):
    """Against scipy's, before a row its first pixel again or its end; kernels longer than a row, too."""
    rng = np.random.default_rng(3)
    values, weights = rng.normal(size=(3, 4, 31)).astype(np.float32), rng.normal(size=n)
    for mix, mode in ((readout.along_rows, "nearest"), (readout.noise_along_rows, "wrap")):
        reference = ndimage.convolve1d(values.astype(float), weights, axis=-1, mode=mode, origin=-(n // 2))
        np.testing.assert_allclose(mix(values, weights), reference, atol=1e-5 * n)


def test_the_inverse_is_exact_at_the_first_column_and_in_blocks():
    camera = make("EMCCD", readout_kernel=(0.2, 0.05), baseline_alternation_adu=2.0)
    light = np.random.default_rng(1).gamma(3.0, 10.0, (4, 6, 30)).astype(np.float32)
    mixed = readout.along_rows(light, readout.signal_weights(camera))
    np.testing.assert_allclose(readout.undone_along_rows(mixed, readout.signal_weights(camera)), light, rtol=1e-4)
    movie = record(camera, 20.0, shape=(6, 16, 16))
    whole = cam.photoelectrons(movie, camera)
    np.testing.assert_array_equal(whole[3:], cam.photoelectrons(movie[3:], camera, 3))


def test_a_baseline_that_alternates_and_jitters():
    still = make("CCD", read_noise_e=4.0)
    frames = [
        record(c, 50.0, shape=(400, 16, 16)).mean(axis=(1, 2))
        for c in (still, still.model_copy(update={"baseline_alternation_adu": 3.0}),
                  still.model_copy(update={"baseline_jitter_adu": 3.0}))
    ]  # fmt: skip
    np.testing.assert_allclose(frames[1] - frames[0], 3.0 * (1 - 2 * (np.arange(400) % 2)), atol=0.2)
    jitter = frames[2] - frames[0]
    assert jitter.std() == pytest.approx(3.0, rel=4 / np.sqrt(800))
    assert jitter.mean() == pytest.approx(0.0, abs=4 * 3 / 20)


def test_codes_come_as_often_as_they_are_wide():
    widths = (1.0, 1.4, 0.6, 1.0)
    movie = record(make("CCD", read_noise_e=40.0, electrons_per_adu=1.0, code_widths=widths), 400.0)
    share = np.bincount(movie.ravel() % 4, minlength=4) / movie.size
    np.testing.assert_allclose(share, np.array(widths) / 4, atol=5 * np.sqrt(0.25 / movie.size))
    assert movie.mean() + 0.5 - 367 == pytest.approx(0.9 * 400, abs=5 * 45 / np.sqrt(movie.size))


def test_codes_that_are_wide_for_long_are_undone():
    """Sixteen wide codes, then sixteen narrow ones: they lie up to 3 ADU off their places.
    Means within 4.5 standard errors (7e-6 each), and the variance that the denoiser takes within 5 (6e-7 each)."""
    from napari_mufasa.camera import read_variance

    camera = make("CCD", read_noise_e=3.0, electrons_per_adu=1.0, code_widths=(1.4,) * 16 + (0.6,) * 16)
    for photons in (1.0, 10.0, 30.0):
        electrons = cam.photoelectrons(record(camera, photons), camera).astype(float)
        error = electrons.std() / np.sqrt(electrons.size)
        # 0.02 e: what a law that is not level over a code has of its middle.
        assert electrons.mean() == pytest.approx(0.9 * photons + camera.clock_induced_charge_e, abs=4.5 * error + 0.02)
        variance = 0.9 * photons + float(read_variance(np.zeros((2, 2), np.float32), camera).mean())
        assert electrons.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / electrons.size) + 0.01)
    dark = record(camera.model_copy(update={"clock_induced_charge_e": 0.0}), 0.0)
    found = frames.with_dark_baseline(camera.model_copy(update={"clock_induced_charge_e": 0.0}), dark, dark.shape[1:])
    assert found.baseline_adu == pytest.approx(camera.baseline_adu, abs=4.5 * 3 / np.sqrt(dark.size) + 0.02)


def test_an_excess_noise_factor_of_the_camera():
    camera = make("EMCCD", read_noise_e=0.0, excess_noise_factor=1.5)
    electrons = cam.photoelectrons(record(camera, 20.0), camera).astype(float)
    assert electrons.var() / electrons.mean() == pytest.approx(1.5, rel=5 * np.sqrt(2.3 / N))
    assert cam.multiplication_noise(camera) == 1.5


@pytest.mark.parametrize(
    ("values", "words"),
    [({"readout_kernel": (1.0, 1.0)}, "cannot be undone"), ({"code_widths": (1.0,)}, "two or more"),
     ({"type": "CCD", "em_gain": None, "excess_noise_factor": 2.0}, "only an EMCCD")],
)  # fmt: skip
def test_what_no_readout_is_is_said(values, words):
    model = preset("FF")
    with pytest.raises(MufasaError, match=words):
        model.with_values({f"camera.{name}": value for name, value in values.items()})


def test_denoising_knows_the_kernel():
    """Of a movie whose noise the kernel colours: as good as from the camera without it, and better than not knowing."""
    plain = make("EMCCD", read_noise_e=60.0)
    mixed = plain.model_copy(update={"readout_kernel": (0.18,)})
    y, x = np.indices((64, 64))
    light = 5 + 60 * sum(np.exp(-((y - a) ** 2 + (x - b) ** 2) / 4.5) for a, b in ((15, 20), (40, 45), (50, 12)))
    field = np.broadcast_to(light.astype(np.float32), (12, 64, 64))

    def error(recorded_by, believed):
        movie = record(recorded_by, field, shape=field.shape)
        return float(np.mean((denoise(movie, believed, method="pure-let") - field) ** 2))

    known, unknown, ideal = error(mixed, mixed), error(mixed, plain), error(plain, plain)
    assert known < 1.05 * ideal
    assert known < 0.8 * unknown
