"""Camera: mean and variance laws, and its inverse (docs/camera.md).

Laws are tested on a flat field of 160 000 pixel values. Tolerances are four standard errors (false alarm
6e-5 each), the error of a variance taken from the fourth moment.
"""

import numpy as np
import pytest
from scipy import stats

from napari_mufasa import camera as cam
from napari_mufasa.chance.streams import Streams
from napari_mufasa.model.presets import PRESETS
from napari_mufasa.model.setup import Camera

SHAPE = (40, 64, 64)
N = int(np.prod(SHAPE))


def make(kind, **values):
    base = {
        "type": kind,
        "quantum_efficiency": 0.9,
        "read_noise_e": 8.0,
        "clock_induced_charge_e": 0.002,
        "electrons_per_adu": 2.0,
        "baseline_adu": 367,
        "adc_max": 65535,
        "em_gain": 300 if kind == "EMCCD" else None,
    }
    return Camera(**base | values)


def record(camera, photons, seed=1, hooks=cam.IDEAL, shape=SHAPE):
    field = np.broadcast_to(np.float32(photons), shape)
    return cam.expose(field, camera, Streams(seed), np.arange(shape[0]), hooks)


def check_mean(values, mean):
    assert values.mean() == pytest.approx(mean, abs=4 * values.std() / np.sqrt(values.size))


def check_variance(values, variance):
    centred = values - values.mean()
    error = np.sqrt(max((centred**4).mean() - values.var() ** 2, 0) / values.size)
    assert values.var() == pytest.approx(variance, abs=4 * error)


@pytest.mark.parametrize("photons", [0.0, 3.0, 60.0, 2000.0])
def test_ccd(photons):
    camera = make("CCD")
    electrons = cam.output_electrons(record(camera, photons), camera).astype(float)
    expected = 0.9 * photons + 0.002
    check_mean(electrons, expected)
    check_variance(electrons, expected + 8.0**2 + 2.0**2 / 12)  # shot, read, digitisation


@pytest.mark.parametrize("photons", [0.0, 0.2, 3.0, 60.0])
def test_emccd_multiplies_mean_and_noise(photons):
    """Gamma(n, g): mean g·n, and shot noise twice: F² = 2."""
    camera = make("EMCCD", em_gain=300, electrons_per_adu=12.0)
    electrons = cam.output_electrons(record(camera, photons), camera).astype(float)
    expected = 0.9 * photons + 0.002
    check_mean(electrons, 300 * expected)
    check_variance(electrons, 2 * 300**2 * expected + 8.0**2 + 12.0**2 / 12)


@pytest.mark.parametrize("factor", [1.0, 1.4, 2.0, 3.0])
def test_excess_noise_factor_is_variance_over_mean(factor):
    camera = make("EMCCD", read_noise_e=0.0)
    hooks = cam.SensorHooks(excess_noise_factor=factor)
    movie = record(camera, 20.0, hooks=hooks)
    electrons = cam.photoelectrons(movie, camera).astype(float)
    expected = 0.9 * 20 + 0.002
    check_mean(electrons, expected)
    check_variance(electrons, factor * expected + (2.0 / 300) ** 2 / 12)


def test_emccd_gives_the_gamma_law_for_the_electrons_that_came():
    """Without read noise the output is the Poisson mixture of Gamma laws; no electron in, none out."""
    camera = make("EMCCD", read_noise_e=0.0, electrons_per_adu=1.0, clock_induced_charge_e=0.0, em_gain=500)
    movie = record(camera, 1.0, shape=(10, 64, 64)).astype(float) - 367
    dark = np.mean(movie == 0)
    none = np.exp(-0.9)
    # Of one electron, one in 500 comes out below one ADU and looks like none.
    assert none - 4 * np.sqrt(none / movie.size) < dark < none + 0.9 / 500 + 4 * np.sqrt(none / movie.size)
    n = np.arange(1, 15)
    weight = stats.poisson.pmf(n, 0.9)

    def law(x):
        return none + (weight[:, None] * stats.gamma.cdf(np.atleast_1d(x) / 500, n[:, None])).sum(axis=0)

    values = np.sort(movie.ravel())
    at = np.linspace(1, 6000, 300).astype(int)
    empirical = np.searchsorted(values, at, side="left") / values.size  # share below a whole count
    distance = np.abs(empirical - law(at)).max()
    assert stats.kstwobign.sf(distance * np.sqrt(values.size)) > 1e-4


@pytest.mark.parametrize("photons", [5.0, 120.0, 220.0, 900.0, 1110.0, 3000.0])
def test_cmos_gain_curve(photons):
    """Mean and variance of g(n), n Poisson, summed over n: below, at and above the knots 200 and 1000."""
    camera = make("CMOS", read_noise_e=1.58, electrons_per_adu=0.5)
    electrons = cam.output_electrons(record(camera, photons), camera).astype(float)
    n = np.arange(6000)
    g = np.where(n < 200, 0.9 * n, np.where(n < 1000, 180 + 0.4 * (n - 200), 500 + 0.1 * (n - 1000)))
    p = stats.poisson.pmf(n, 0.9 * photons + 0.002)
    mean = (p * g).sum()
    check_mean(electrons, mean)
    check_variance(electrons, (p * g**2).sum() - mean**2 + 1.58**2 + 0.5**2 / 12)


def test_cmos_curve_is_the_joined_one_of_the_specification_and_continues():
    camera = make("CMOS")
    n = np.array([0, 100, 199.9, 200, 600, 999.9, 1000, 2000, 10_000], float)
    g = [0, 90, 179.91, 180, 340, 499.96, 500, 600, 1400]
    np.testing.assert_allclose(cam.cmos_response(n, camera), g, rtol=1e-6)


@pytest.mark.parametrize("gain_map", [None, np.linspace(0.8, 1.2, 48).reshape(6, 8)])
def test_cmos_inverse_undoes_the_response(gain_map):
    camera = make("CMOS", gain_map=gain_map)
    n = np.random.default_rng(1).uniform(-50, 8000, (200, 6, 8))
    np.testing.assert_allclose(cam.cmos_response_inverse(cam.cmos_response(n, camera), camera), n, rtol=2e-4, atol=2e-3)


@pytest.mark.parametrize("kind", ["CCD", "EMCCD", "CMOS"])
@pytest.mark.parametrize("photons", [0.0, 2.0, 80.0])
def test_inverse_is_unbiased(kind, photons):
    """photons(photoelectrons(expose(x))) averages to x: nothing is clipped and the ½ undoes the floor."""
    camera = make(kind, electrons_per_adu=10.04 if kind != "CMOS" else 0.5)
    estimate = cam.photons(cam.photoelectrons(record(camera, photons), camera), camera).astype(float)
    assert estimate.min() < photons  # negative values of the dark are kept
    check_mean(estimate, photons)


@pytest.mark.parametrize("baseline", [100.0, 100.3, 100.5, 100.9])
def test_a_baseline_between_two_counts_is_undone_too(baseline):
    camera = make("CCD", baseline_adu=baseline)
    check_mean(cam.output_electrons(record(camera, 5.0), camera).astype(float), 4.502)


def test_mean_of_the_read_noise_is_known():
    camera = make("CCD", read_noise_mean_e=7.0)
    movie = record(camera, 5.0)
    check_mean((movie + 0.5 - 367.0) * 2.0, 4.502 + 7.0)
    check_mean(cam.output_electrons(movie, camera).astype(float), 4.502)


def test_counts_stay_between_zero_and_the_converter_s_end():
    low = record(make("CCD", baseline_adu=0, read_noise_e=50.0), 0.0)
    assert low.dtype == np.uint16 and low.min() == 0
    assert np.mean(low == 0) == pytest.approx(0.5, abs=0.02)  # half of the noise is negative; below 1 ADU it is 0 too
    high = record(make("CCD", adc_max=4095), 1e5)
    assert high.min() == high.max() == 4095


def test_dark_without_read_noise_is_the_baseline():
    for kind in ("CCD", "EMCCD", "CMOS"):
        movie = record(make(kind, read_noise_e=0.0, clock_induced_charge_e=0.0), 0.0)
        assert np.all(movie == 367)


def test_digitisation_floors():
    camera = make("CCD", read_noise_e=0.0, clock_induced_charge_e=0.0, electrons_per_adu=10.0)
    movie = record(camera, 3000.0)
    # n electrons → ⌊n/10⌋: same streams at 1 e⁻/ADU give n itself.
    exact = record(make("CCD", read_noise_e=0.0, clock_induced_charge_e=0.0, electrons_per_adu=1.0), 3000.0)
    np.testing.assert_array_equal(movie - 367, (exact - 367) // 10)


@pytest.mark.parametrize("kind", ["CCD", "EMCCD", "CMOS"])
def test_maps_act_per_pixel(kind):
    y, x = np.indices((8, 8))
    offset, gain, variance = 3.0 * x, 0.8 + 0.05 * y, 4.0 + 10.0 * x
    camera = make(
        kind, offset_map_adu=offset, gain_map=gain, variance_map_e2=variance, electrons_per_adu=1.0, em_gain=
        20 if kind == "EMCCD" else None,
    )  # fmt: skip
    movie = record(camera, 40.0, shape=(4000, 8, 8)).astype(float)
    n_e = 36.002
    factor = {"CCD": 1.0, "EMCCD": 20.0, "CMOS": 0.9}[kind] * gain
    mean = factor * n_e + 367 + offset - 0.5
    spread = factor**2 * n_e * (2 if kind == "EMCCD" else 1) + variance + 1 / 12
    # 64 pixels each: |z| > 5, overall false alarm 4e-5; the variance's error from a Gaussian, widened for the tail.
    assert np.all(np.abs(movie.mean(axis=0) - mean) < 5 * np.sqrt(spread / 4000))
    assert np.all(np.abs(movie.var(axis=0) / spread - 1) < 6 * np.sqrt(2.2 / 4000))
    estimate = cam.photoelectrons(movie, camera).astype(float)
    assert np.all(np.abs(estimate.mean(axis=0) - n_e) < 5 * np.sqrt(spread / 4000) / factor)


def test_a_map_that_does_not_fit_the_movie_is_refused():
    camera = make("CCD", gain_map=np.ones((8, 8)))
    with pytest.raises(ValueError, match=r"camera\.gain_map is \(8, 8\)"):
        cam.photoelectrons(np.zeros((2, 9, 8), np.uint16), camera)


def test_pixels_and_frames_are_independent():
    movie = record(make("EMCCD"), 10.0).astype(float)
    z = (movie - movie.mean()) / movie.std()
    for a, b in ((z[1:], z[:-1]), (z[:, 1:], z[:, :-1]), (z[..., 1:], z[..., :-1])):
        assert abs(np.mean(a * b)) < 4 / np.sqrt(a.size)


def test_the_tables_cameras_have_the_laws_of_their_type():
    """Source Table 1: excess noise 2 for the EMCCD, 1 otherwise."""
    alpha = {name: cam.multiplication_noise(Camera(**PRESETS[name]["camera"])) for name in PRESETS}
    assert alpha == {"PALM": 1, "STORM": 1, "FF": 2, "Blinking": 1, "EGFP": 2, "Alexa647-STORM": 1}
