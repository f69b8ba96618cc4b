"""Laws of amplifier and converter on flat fields and dark frames; tolerances of four standard errors (6e-5 each).

The CCD of `helpers.ccd` counts electrons: Poisson of the light's mean without an effect. A count is the floor of a
signal: half an ADU less on average, and a variance of 1/12 more, where the signal is no whole number.
"""

import numpy as np
import pytest

from napari_mufasa import simulate, simulate_dark
from napari_mufasa.calibrate.rows import dark_rows
from napari_mufasa.camera.readout import along_rows, code_begins, row_kernel

from .helpers import ccd, cmos, effect, plain, scene_of

EMPTY = np.empty((0, 2))
LIGHT = 400


def flat(*effects, n_frames=60, shape=(40, 64), seed=1, light=LIGHT, **values):
    """Electrons of an evenly lit field without molecules, (frame, y, x)."""
    size = {"acquisition.n_frames": n_frames, "acquisition.shape_px": list(shape)}
    model = ccd(**size | {"optics.background_photons_per_px": light} | values)
    return simulate(model.with_effects(*effects), EMPTY, seed=seed).movie.astype(float) - 100


def dark(*effects, n_frames=60, shape=(40, 64), seed=1, **values):
    model = ccd(**{"acquisition.shape_px": list(shape), "acquisition.n_frames": n_frames} | values)
    return simulate_dark(model.with_effects(*effects), n_frames, seed=seed).astype(float) - 100


def correlation(z, lag, axis=-1):
    z = np.moveaxis(z, axis, -1)
    return float(np.mean(z[..., lag:] * z[..., :-lag]) / np.mean(z**2))


def inner(movie, skip=1):
    """Deviations from the mean, without the first columns, which have no neighbour before them."""
    return (movie - movie.mean(axis=0))[..., skip:]


# Read-out along the row ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [-0.115, -0.051, 0.18])
def test_a_share_of_the_pixel_before_correlates_a_row_and_keeps_the_mean(share):
    movie = flat(effect("serial_readout", share=share))
    z, n = inner(movie), movie.size
    assert movie.mean() + 0.5 == pytest.approx(LIGHT, abs=4 * np.sqrt(LIGHT / n))  # the kernel sums to 1
    signal = LIGHT * (1 + share**2) / (1 + share) ** 2
    variance = (signal + 1 / 12) * (1 - 1 / len(movie))  # about the mean of a pixel's 60 frames
    # Neighbours' squares are correlated by ρ² each: a little more than independent pixels.
    assert np.mean(z**2) == pytest.approx(variance, rel=4 * np.sqrt(2 * (1 + 2 * share**2) / z.size))
    expected = share / (1 + share**2) * signal / (signal + 1 / 12)
    assert correlation(z, 1) == pytest.approx(expected, abs=4 / np.sqrt(n))
    for lag in (2, 3):
        assert abs(correlation(z, lag)) < 4 / np.sqrt(n)
    assert abs(correlation(z, 1, axis=1)) < 4 / np.sqrt(n)


@pytest.mark.parametrize("reach", [0.5, 2.0])
def test_a_tail_falls_over_several_pixels(reach):
    share = 0.2
    movie = flat(effect("serial_readout", share=share, tail_px=reach, form="tail"))
    z, n = inner(movie, skip=15), movie.size
    weights = np.concatenate([[1.0], share * (1 - np.exp(-1 / reach)) * np.exp(-np.arange(15) / reach)])
    power = np.sum(weights**2)
    assert movie.mean() + 0.5 == pytest.approx(LIGHT, abs=4 * np.sqrt(LIGHT / n))
    assert np.mean(z**2) == pytest.approx(LIGHT * power / (1 + share) ** 2 * (1 - 1 / len(movie)), rel=5 / np.sqrt(n))
    for lag in (1, 2, 3):
        expected = np.sum(weights[lag:] * weights[:-lag]) / power
        assert correlation(z, lag) == pytest.approx(expected, abs=5 / np.sqrt(z.size))


@pytest.mark.parametrize("form", ["one_pixel", "tail"])
@pytest.mark.parametrize("ratio", [1.0, 0.0, -0.8])
def test_dark_rows_have_a_share_of_their_own_and_keep_mean_and_rms(ratio, form):
    share = 0.2
    noisy = {"camera.read_noise_e": 10.0, "camera.read_noise_mean_e": 3.0}
    movie = dark(effect("serial_readout", share=share, noise_ratio=ratio, form=form, tail_px=0.5), **noisy)
    z, n = inner(movie, skip=4), movie.size
    mine = share * ratio
    tail = np.array([1.0]) if form == "one_pixel" else np.exp(-np.arange(5) / 0.5)
    weights = np.concatenate([[1.0], mine * tail / tail.sum()])
    assert movie.mean() + 0.5 == pytest.approx(3.0, abs=4 * 10 * (1 + abs(mine)) / np.sqrt(n))
    assert np.mean(z**2) == pytest.approx((100 + 1 / 12) * (1 - 1 / len(movie)), rel=4.5 * np.sqrt(2 / z.size))
    expected = np.sum(weights[1:] * weights[:-1]) / np.sum(weights**2)
    assert correlation(z, 1) == pytest.approx(expected, abs=4.5 / np.sqrt(z.size))
    assert abs(correlation(z, 1, axis=1)) < 4.5 / np.sqrt(z.size)


@pytest.mark.parametrize("kernel", [(1.0,), (1.0, -0.165), (1.0, 0.21, 0.03), (1.0, 0.1, -0.07, -0.15)])
def test_a_kernel_is_known_from_its_correlations(kernel):
    kernel = np.array(kernel)
    found = np.correlate(kernel, kernel, "full")[len(kernel) - 1 :]
    np.testing.assert_allclose(row_kernel(found[1:] / found[0]), kernel, atol=1e-6)
    assert np.all(np.isfinite(row_kernel(np.array([0.9]))))  # more than any noise has


def test_dark_rows_as_measured_beside_a_share_of_the_light():
    """What an iXon 888 shows: light lags by one pixel, read noise rings over several."""
    seen = np.array([0.087, -0.069, -0.136])
    added = effect("serial_readout", share=-0.165, dark_rows=seen.tolist())
    noisy = {"camera.read_noise_e": 10.0}
    movie = dark(added, **noisy)
    z = inner(movie, skip=3)
    assert np.mean(z**2) == pytest.approx((100 + 1 / 12) * (1 - 1 / len(movie)), rel=5 * np.sqrt(2 / z.size))
    for lag, law in enumerate(seen, 1):
        assert correlation(z, lag) == pytest.approx(law, abs=5 / np.sqrt(z.size))
    light = flat(added, **noisy)
    z = inner(light, skip=3)
    signal = np.array([1 + 0.165**2, -0.165, 0, 0]) * LIGHT / (1 - 0.165) ** 2
    total = signal + 100 * np.array([1, *seen])
    for lag in (1, 2, 3):
        assert correlation(z, lag) == pytest.approx(total[lag] / total[0], abs=5 / np.sqrt(z.size))


@pytest.mark.parametrize("offset_adu", [0.0, 6.0])
def test_dark_frames_show_how_rows_are_correlated_and_an_offset_of_rows_is_no_correlation(offset_adu):
    seen = np.array([0.087, -0.069, -0.136])
    added = effect("serial_readout", share=-0.165, dark_rows=seen.tolist()), effect("row_noise", rms_adu=offset_adu)
    found = np.array(dark_rows(dark(*added, **{"camera.read_noise_e": 10.0})))
    sd = 1 / np.sqrt(60 * 40 * 64)
    np.testing.assert_allclose(found[:3], seen, atol=6 * sd)
    assert np.all(np.abs(found[3:]) < 6 * sd)
    assert dark_rows(dark(added[1], **{"camera.read_noise_e": 10.0})) == (0.0,)


@pytest.mark.parametrize("share", [-0.165, 0.12])
def test_spurious_electrons_are_mixed_as_light_and_the_read_noise_has_the_rest_of_what_the_dark_shows(share):
    seen = np.array([0.087, -0.069, -0.136])
    added = effect("serial_readout", share=share, dark_rows=seen.tolist())
    z = inner(dark(added, **{"camera.read_noise_e": 10.0, "camera.clock_induced_charge_e": 40.0}), skip=4)
    for lag, law in enumerate([*seen, 0.0], 1):
        assert correlation(z, lag) == pytest.approx(law, abs=5 / np.sqrt(z.size))


def test_the_share_comes_from_the_left_and_sums_to_the_signal():
    row = np.zeros((1, 1, 7), np.float32)
    row[0, 0, 3] = 10
    np.testing.assert_allclose(along_rows(row, np.array([0.8, 0.15, 0.05]))[0, 0], [0, 0, 0, 8, 1.5, 0.5, 0], atol=1e-6)
    np.testing.assert_allclose(along_rows(row + 1, np.array([0.8, 0.15, 0.05])).sum(), 17, rtol=1e-6)


def test_it_acts_after_all_charge_and_before_the_offsets_whatever_the_order():
    others = effect("image_lag", fraction=0.2), effect("column_offset", rms_adu=20.0)
    mixed = effect("serial_readout", share=-0.3)
    one, two = flat(mixed, *others, n_frames=10), flat(*others, mixed, n_frames=10)
    np.testing.assert_array_equal(one, two)
    stripes = one.mean(axis=(0, 1)) - flat(mixed, others[0], n_frames=10).mean(axis=(0, 1))
    offsets = dark(others[1], n_frames=10).mean(axis=(0, 1))
    np.testing.assert_allclose(stripes, offsets, atol=1.0)  # not mixed; floors differ by less than an ADU


def test_a_sensor_of_parallel_columns_has_no_serial_readout():
    kind = type(effect("serial_readout"))
    assert kind.suits(plain()) and kind.suits(ccd()) and not kind.suits(cmos())


# Baseline from frame to frame ---------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [flat, dark])
def test_a_baseline_that_alternates(make):
    frames = make(effect("frame_baseline", rms_adu=6.0)).mean(axis=(1, 2)) - make().mean(axis=(1, 2))
    sign = np.sign(frames[0]) * (1 - 2 * (np.arange(60) % 2))
    np.testing.assert_allclose(frames, 6 * sign, atol=1e-3)


@pytest.mark.parametrize("make", [flat, dark])
def test_a_baseline_that_jitters(make):
    frames = make(effect("frame_baseline", rms_adu=6.0, form="jitter"), n_frames=400, shape=(8, 8)).mean(axis=(1, 2))
    frames = frames + 0.5 - make(n_frames=400, shape=(8, 8)).mean(axis=(1, 2))
    assert frames.mean() == pytest.approx(0, abs=4 * 6 / 20)
    assert frames.var() == pytest.approx(36 + 1 / 12, rel=4 * np.sqrt(2 / 400))
    assert abs(np.mean(frames[1:] * frames[:-1])) / 36 < 4 / 20


def test_dark_frames_alternate_like_the_movie_and_jitter_on_their_own():
    for form, same in (("alternating", True), ("jitter", False)):
        added = effect("frame_baseline", rms_adu=6.0, form=form)
        light = flat(added, shape=(8, 8)).mean(axis=(1, 2)) - flat(shape=(8, 8)).mean(axis=(1, 2))
        assert (np.corrcoef(light, dark(added, shape=(8, 8)).mean(axis=(1, 2)))[0, 1] > 0.99) == same


# The converter's codes ----------------------------------------------------------------------------------------


def widths_of(begins):
    return np.diff(np.append(begins, begins[0] + len(begins)))


@pytest.mark.parametrize("unevenness", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("form", ["modulo_32", "missing_low_bit"])
def test_codes_come_as_often_as_they_are_wide_and_counts_stay_right_on_average(form, unevenness):
    """Read noise of 50 ADU is even over the period of 32 (its Fourier component: e^−48); each error of n draws."""
    added = effect("converter_codes", unevenness=unevenness, form=form)
    n_frames, values = 100, {"camera.read_noise_e": 50.0, "camera.baseline_adu": 1000}
    movie = dark(added, n_frames=n_frames, **values) + 100
    period = 32 if form == "modulo_32" else 2
    widths = widths_of(scene_of(ccd(**values).with_effects(added)).sensor.code_begins)
    assert len(widths) == period and widths.min() >= 0 and widths.sum() == pytest.approx(period)
    if unevenness < 1:
        assert np.sqrt(np.mean((widths - 1) ** 2)) == pytest.approx(unevenness, rel=0.02)
    share = np.bincount(movie.astype(int).ravel() % period, minlength=period) / movie.size
    p = widths / period
    # Up to 32 shares, each within 4.5 standard errors (2e-4 in all).
    assert np.all(np.abs(share - p) <= 4.5 * np.sqrt(p / movie.size) + 1e-9)
    assert movie.mean() + 0.5 == pytest.approx(1000, abs=4 * 50 / np.sqrt(movie.size))


def test_the_error_of_a_count_has_the_variance_of_its_widths():
    """The same noise counted evenly and unevenly: the difference of the two errors' variances is the law's."""
    values = {"camera.read_noise_e": 50.0, "camera.baseline_adu": 1000, "camera.electrons_per_adu": 1.0}
    added = effect("converter_codes", unevenness=0.4)
    begins = scene_of(ccd(**values).with_effects(added)).sensor.code_begins
    off = np.append(begins - np.arange(32), begins[0])
    law = np.mean(((0.5 + off[1:]) ** 3 - (off[:-1] - 0.5) ** 3) / 3)  # mean square of code + ½ − signal
    fine = {"camera.electrons_per_adu": 1 / 50, "camera.baseline_adu": 30_000, "camera.read_noise_e": 50.0}
    exact = (dark(n_frames=40, **fine) + 100 - 30_000 + 0.5) / 50  # the same draws in fiftieths of an ADU
    error = dark(added, n_frames=40, **values) + 100 - 1000 + 0.5 - exact
    spread = np.std(error**2) / np.sqrt(error.size)
    assert np.mean(error**2) == pytest.approx(law, abs=4 * spread + 1e-3)
    assert np.mean(error) == pytest.approx(0, abs=4 * error.std() / np.sqrt(error.size) + 0.01)
    even = dark(n_frames=40, **values) + 100 - 1000 + 0.5 - exact
    assert np.mean(even**2) == pytest.approx(1 / 12, abs=4 * np.std(even**2) / np.sqrt(even.size) + 1e-3)


def test_codes_as_seen_are_the_codes_made():
    seen = (1.0, 1.3, 0.8, 0.9, 1.2, 0.7, 1.1, 1.0)
    widths = widths_of(code_begins(np.array(seen), float(np.std(seen))))
    np.testing.assert_allclose(widths, seen, atol=1e-12)
    np.testing.assert_allclose(code_begins(np.array([2.0, 2.0]), 0.3), [0.0, 1.0])  # nothing uneven was seen
    made = effect("converter_codes", widths=seen, unevenness=float(np.std(seen)))
    counts = flat(made, light=5000, **{"camera.read_noise_e": 50.0}) + 100
    share = np.bincount(counts.astype(int).ravel() % 8, minlength=8) / counts.size * 8
    assert np.all(np.abs(share - seen) < 4.5 * np.sqrt(8 * np.array(seen) / counts.size))


def test_codes_end_where_the_converter_ends():
    counts = flat(
        effect("converter_codes", unevenness=0.5), light=300, **{"camera.adc_max": 255, "camera.baseline_adu": 5}
    )
    assert counts.max() == 255 - 100
    assert dark(effect("converter_codes"), **{"camera.baseline_adu": 0, "camera.read_noise_e": 5.0}).min() == -100
