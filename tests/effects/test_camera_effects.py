"""Laws of the camera effects at strong values, on flat fields and dark frames.

The CCD of `helpers.ccd` has one electron per count and no read noise: counts − 100 are electrons, Poisson of
mean 20 without an effect. Tolerances are four standard errors (false alarm 6e-5 each) unless said otherwise.
"""

import numpy as np
import pytest
from scipy import stats

from napari_mufasa import simulate, simulate_dark
from napari_mufasa.camera.detector import photoelectrons

from .helpers import ccd, cmos, effect, plain

EMPTY = np.empty((0, 2))


def flat(*effects, n_frames=100, shape=(40, 40), seed=1, **values):
    """Electrons of an evenly lit field without molecules, (frame, y, x)."""
    model = ccd(**{"acquisition.n_frames": n_frames, "acquisition.shape_px": list(shape)} | values)
    return simulate(model.with_effects(*effects), EMPTY, seed=seed).movie.astype(float) - 100


def dark(*effects, n_frames=100, shape=(40, 40), seed=1, **values):
    model = ccd(**{"acquisition.shape_px": list(shape)} | values)
    return simulate_dark(model.with_effects(*effects), n_frames, seed=seed).astype(float) - 100


@pytest.mark.parametrize("form", ["gamma", "low_gain"])
@pytest.mark.parametrize("factor", [1.0, 1.4, 3.0])
def test_em_excess_noise_is_variance_over_mean(factor, form):
    model = plain(n_frames=100, shape=(40, 40), **{"camera.read_noise_e": 0.0})
    model = model.with_effects(effect("em_excess_noise", excess_noise_factor=factor, form=form))
    electrons = photoelectrons(simulate(model, EMPTY, seed=1).movie, model.camera).astype(float)
    mean = 0.9 * 20 + 0.002
    assert electrons.mean() == pytest.approx(mean, abs=4 * np.sqrt(factor * mean / electrons.size))
    fourth = np.mean((electrons - electrons.mean()) ** 4)
    error = np.sqrt((fourth - electrons.var() ** 2) / electrons.size) / mean
    assert electrons.var() / mean == pytest.approx(factor, abs=4 * error)


@pytest.mark.parametrize("form", ["gamma", "low_gain"])
@pytest.mark.parametrize("factor", [1.0, 1.5, 2.0])
def test_a_register_that_is_on_in_a_camera_believed_a_ccd(factor, form):
    """Mean 20 electrons stay 20; their variance is F² of it (counts are floored: − ½ and + 1/12 where they differ)."""
    added = effect("em_excess_noise", excess_noise_factor=factor, form=form)
    electrons = flat(added, n_frames=200)
    np.testing.assert_array_equal(dark(added, n_frames=3), 0)
    if factor == 1:
        np.testing.assert_array_equal(electrons, flat(n_frames=200))
        return
    assert electrons.mean() == pytest.approx(19.5, abs=4 * np.sqrt(factor * 20 / electrons.size))
    fourth = np.mean((electrons - electrons.mean()) ** 4)
    error = np.sqrt((fourth - electrons.var() ** 2) / electrons.size)
    assert electrons.var() - 1 / 12 == pytest.approx(factor * 20, abs=4 * error)


def test_at_low_gain_every_electron_leaves_with_itself_at_least():
    """A register of gain g in all makes of each electron 1 + an exponential of mean g − 1: F² = 1 + (1 − 1/g)²."""
    g = 3.0
    model = plain(n_frames=200, shape=(40, 40), **{
        "camera.read_noise_e": 0.0, "camera.clock_induced_charge_e": 0.0, "camera.electrons_per_adu": 0.1,
        "camera.em_gain": 1000, "optics.background_photons_per_px": 0.2 / 0.9,
    })  # fmt: skip
    model = model.with_effects(effect("em_excess_noise", excess_noise_factor=1 + (1 - 1 / g) ** 2, form="low_gain"))
    electrons = photoelectrons(simulate(model, EMPTY, seed=1).movie, model.camera)
    one = electrons[(electrons > 1e-3) & (electrons < 2 / g)]  # two electrons are never less than 2/g
    assert one.min() >= 1 / g - 1e-3
    law = stats.truncexpon(b=(1 / g) / (1 - 1 / g), loc=1 / g, scale=1 - 1 / g)
    assert stats.kstest(one, law.cdf).pvalue > 1e-4


def test_clock_induced_charge_adds_its_electrons_in_the_dark_too():
    for electrons, without in ((flat(effect("clock_induced_charge", electrons=0.4)), 20.0),
                               (dark(effect("clock_induced_charge", electrons=0.4)), 0.0)):  # fmt: skip
        mean = without + 0.4
        assert electrons.mean() == pytest.approx(mean, abs=4 * np.sqrt(mean / electrons.size))


@pytest.mark.parametrize("growth", [-1.5, 1.5])
def test_charge_along_columns_grows_with_the_row_and_keeps_its_mean(growth):
    """Each row's mean is 0.4 (1 + growth · t), t from −½ to ½; every row within 4.5 standard errors (of 40: 3e-4)."""
    electrons = dark(effect("clock_induced_charge", electrons=0.4, growth=growth, form="along_columns"), n_frames=200)
    law = 0.4 * (1 + growth * np.linspace(-0.5, 0.5, 40))
    rows = electrons.mean(axis=(0, 2))
    np.testing.assert_array_less(np.abs(rows - law), 4.5 * np.sqrt(law / (200 * 40)))


def test_charge_born_in_the_register_keeps_its_mean_in_smaller_events():
    """Born at u of the register, uniform: exponential of mean gain^-u photoelectrons. Moments of the Poisson sum."""
    model = plain(shape=(40, 40), **{"camera.read_noise_e": 0.0, "camera.clock_induced_charge_e": 0.0})
    gain = model.camera.em_gain
    keeps, keeps2 = (1 - 1 / gain) / np.log(gain), (1 - gain**-2.0) / (2 * np.log(gain))
    variance = 0.4 / keeps * 2 * keeps2
    added = effect("clock_induced_charge", electrons=0.4, form="in_register")
    electrons = photoelectrons(simulate_dark(model.with_effects(added), 100, seed=1), model.camera).astype(float)
    count = model.camera.electrons_per_adu / gain  # one count: its floor is undone by ½ only where there is charge
    n = electrons.size
    assert electrons.mean() == pytest.approx(0.4, abs=4 * np.sqrt(variance / n) + count / 2)
    fourth = np.mean((electrons - electrons.mean()) ** 4)
    assert electrons.var() == pytest.approx(variance, abs=4 * np.sqrt(fourth / n) + count**2)


def test_dull_pixels_are_a_tail_on_one_side():
    pattern = flat(effect("pixel_gain_variation", rms=0.1, form="dull_pixels"), n_frames=400, shape=(64, 64)) / 20
    pattern = pattern.mean(axis=0)
    skewness = ((pattern - pattern.mean()) ** 3).mean() / pattern.std() ** 3
    # Exponential: −2; its standard error with 4096 pixels is about 0.25; shot noise adds a little width.
    assert -3.2 < skewness < -1.0


@pytest.mark.parametrize("form", ["pixels", "columns", "columns_and_pixels"])
def test_gain_pattern_has_its_rms_and_grows_with_the_light(form):
    added = effect("pixel_gain_variation", rms=0.1, form=form)
    pattern = flat(added, n_frames=400, shape=(64, 64)).mean(axis=0) / 20
    bright = flat(added, n_frames=400, shape=(64, 64), **{"optics.background_photons_per_px": 200}).mean(axis=0) / 200
    n = pattern.size if form == "pixels" else 64
    shot = 1 / (400 * 200)  # relative variance of the mean by shot noise; the floor of counts adds ½/200
    assert np.sqrt(bright.var() - shot) == pytest.approx(0.1, abs=4 * 0.1 / np.sqrt(2 * n))
    assert np.corrcoef(pattern.ravel(), bright.ravel())[0, 1] > 0.97
    if form == "columns":
        assert bright.mean(axis=0).std() == pytest.approx(bright.std(), rel=0.02)
    assert np.all(dark(added, n_frames=3) == 0)


@pytest.mark.parametrize("form", ["columns", "pixels", "columns_and_pixels", "alternating"])
def test_offset_pattern_has_its_rms_with_and_without_light(form):
    added = effect("column_offset", rms_adu=6.0, form=form)
    in_dark = dark(added, n_frames=3, shape=(64, 64)).mean(axis=0)
    lit = flat(added, n_frames=400, shape=(64, 64)).mean(axis=0) - 20
    n = in_dark.size if form == "pixels" else 64
    assert in_dark.std() == pytest.approx(np.sqrt(36 + 1 / 12), abs=4 * 6 / np.sqrt(2 * n))
    np.testing.assert_allclose(lit, in_dark, atol=1.0 + 5 * np.sqrt(20 / 400))
    stripes = in_dark.mean(axis=0)
    # By columns: half of the variance, and a 64th of the other half; all of it where there are no pixels of their own.
    share = {"columns": 1, "pixels": 1 / 64, "columns_and_pixels": (1 + 1 / 64) / 2, "alternating": 1}[form]
    assert stripes.var() / in_dark.var() == pytest.approx(share, abs=4 * np.sqrt(2 / 64) * share)
    even_odd = (stripes[1::2].mean() - stripes[::2].mean()) / 2
    assert even_odd == pytest.approx(6 * np.sqrt(0.7) if form == "alternating" else 0, abs=4 * 6 / np.sqrt(64))


@pytest.mark.parametrize("form", ["rows", "drifting_rows"])
def test_row_noise_is_the_variance_of_row_means(form):
    movie = dark(effect("row_noise", rms_adu=5.0, form=form), n_frames=300, shape=(40, 32))
    assert np.all(movie == movie[:, :, :1])  # one offset per row and frame, nothing else in this dark
    rows = movie[:, :, 0] + 0.5
    shared = 0.0 if form == "rows" else np.exp(-1 / 2)  # reach_rows as it is unless told; 40 rows of each frame
    independent = rows.size * (1 - shared**2) / (1 + shared**2)  # products of rows
    assert rows.var() == pytest.approx(25 + 1 / 12, rel=4 * np.sqrt(2 / independent))
    assert rows.mean() == pytest.approx(0, abs=4 * 5 / np.sqrt(rows.size * (1 - shared) / (1 + shared)))
    np.testing.assert_allclose(rows.var(axis=0), 25, rtol=5 * np.sqrt(2 / 300))  # from the first row on
    between_frames = np.mean(rows[1:] * rows[:-1]) / 25
    assert abs(between_frames) < 4 / np.sqrt(independent)
    for lag in (1, 2):
        between_rows = np.mean(rows[:, lag:] * rows[:, :-lag]) / 25
        assert between_rows == pytest.approx(shared**lag, abs=4 * (1 + shared**lag) / np.sqrt(independent))


def test_bursts_hit_their_share_of_rows():
    added = effect("row_noise", rms_adu=20.0, form="bursts", hit_share=0.2)
    rows = dark(added, n_frames=300, shape=(40, 32))[:, :, 0] + 0.5
    n = rows.size
    hit = np.abs(rows) > 0.6  # of the rows that are hit, 1 % have less than half an ADU (sd 45)
    assert hit.mean() == pytest.approx(0.2 * 0.99, abs=4 * np.sqrt(0.16 / n) + 0.002)
    # Variance of a square with kurtosis 3/share: (15 − 1) of the variance squared.
    assert rows.var() == pytest.approx(400 + 1 / 12, rel=4 * np.sqrt(14 / n))


def test_hot_pixels_are_as_many_and_as_hot_as_said():
    added = effect("hot_pixels", fraction=0.02, electrons=40.0)
    movie = dark(added, n_frames=200, shape=(100, 100))
    leak = movie.mean(axis=0)
    hot = leak > 0
    seen = np.exp(-0.005 / 40)  # a leak under 0.005 e⁻ may not show in 200 frames
    assert hot.mean() == pytest.approx(0.02 * seen, abs=4 * np.sqrt(0.02 / 10_000))
    assert leak[hot].mean() == pytest.approx(40, abs=4 * 40 / np.sqrt(hot.sum()))  # exponential: sd = mean
    np.testing.assert_array_equal(hot, dark(added, n_frames=200, shape=(100, 100), seed=1).mean(axis=0) > 0)
    noise = movie.var(axis=0)[hot] / leak[hot]
    assert noise.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / 200) / np.sqrt(hot.sum()) * 1.5)  # Poisson leak


def test_telegraph_pixels_are_on_half_of_the_time():
    steady, telegraph = (
        dark(effect("hot_pixels", fraction=0.02, electrons=400.0, form=form), n_frames=400, shape=(100, 100))
        for form in ("steady", "telegraph")
    )
    hot = steady.mean(axis=0) > 50
    on = telegraph[:, hot] > 20
    # 400 frames are 20 dwell times: the share's sd per pixel is about 0.5·√(2·10/400) = 0.11.
    assert on.mean() == pytest.approx(0.5, abs=4 * 0.12 / np.sqrt(hot.sum()))
    switches = np.mean(on[1:] != on[:-1])
    assert switches == pytest.approx(1 / 20, abs=4 * np.sqrt(0.05 / on[1:].size))
    level = telegraph[:, hot].max(axis=0) / steady[:, hot].max(axis=0)
    assert np.median(level) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("form", ["soft", "hard", "rounded"])
@pytest.mark.parametrize("light", [20, 200, 2000])
def test_saturation_bends_at_its_full_scale(form, light):
    added = effect("detector_saturation", inverse_full_scale=1 / 200, form=form)
    electrons = flat(added, n_frames=50, **{"optics.background_photons_per_px": light})
    n = np.arange(4000)
    p = stats.poisson.pmf(n, light)
    bent = {"hard": np.minimum(n, 200), "soft": n / (1 + n / 200), "rounded": 200 * np.tanh(n / 200)}[form]
    counted = np.floor(bent.astype(np.float32))  # the converter counts whole ADU
    mean = (p * counted).sum()
    variance = (p * counted**2).sum() - mean**2
    assert electrons.mean() == pytest.approx(mean, abs=4 * np.sqrt((variance + 0.1) / electrons.size))
    assert electrons.max() <= 200


def test_saturation_is_in_photoelectrons_for_every_camera():
    model = plain(n_frames=30, **{"optics.background_photons_per_px": 3000, "camera.electrons_per_adu": 60.0})
    model = model.with_effects(effect("detector_saturation", inverse_full_scale=0.01, form="hard"))
    electrons = photoelectrons(simulate(model, EMPTY, seed=1).movie, model.camera)
    assert electrons.mean() == pytest.approx(100, rel=1e-2)


def test_the_charge_of_a_cmos_saturates_and_is_hit_before_its_curve():
    values = {"optics.background_photons_per_px": 3000, "acquisition.n_frames": 30}
    model = cmos(**values).with_effects(effect("detector_saturation", inverse_full_scale=1e-3, form="hard"))
    assert photoelectrons(simulate(model, EMPTY, seed=1).movie, model.camera).mean() == pytest.approx(1000, rel=1e-2)
    hits, charge = 5.0, 2000.0
    model = cmos().with_effects(effect("cosmic_rays", hits_per_frame=hits, electrons=charge))
    total = photoelectrons(simulate_dark(model, 400, seed=2), model.camera).sum(axis=(1, 2), dtype=float)
    assert np.median(total) < hits * charge  # half a count of rounding less, of 1280 pixels
    assert total.mean() == pytest.approx(hits * charge, abs=4 * charge * np.sqrt(2 * hits / 400) + 150)


def test_no_charge_is_beyond_the_well_wherever_it_was_born():
    kinds = {"cosmic_rays": {"hits_per_frame": 5.0}, "pixel_gain_variation": {"rms": 0.2}, "image_lag": {}}
    others = [effect(kind, **values) for kind, values in kinds.items()]
    full = effect("detector_saturation", inverse_full_scale=1 / 50, form="hard")
    assert flat(full, *others, **{"optics.background_photons_per_px": 40}).max() <= 50


@pytest.mark.parametrize(("form", "kept"), [("one_frame", 0.5), ("decaying", 0.5), ("decaying", 0.8), ("decaying", 0)])
@pytest.mark.parametrize("f", [0.1, 0.4])
def test_image_lag_correlates_neighbouring_frames(form, kept, f):
    """Counts are filtered: of a frame 1 − f now, f in the next one or, "decaying", f(1−k)k^(b−1) b frames on."""
    added = effect("image_lag", fraction=f, kept=kept, form=form)
    movie = flat(added, n_frames=200, **{"optics.background_photons_per_px": 400})
    # The mean stays; the floor of a mixture of counts takes half a count.
    spread = np.sqrt(400 / movie.size)
    assert movie.mean() + 0.5 == pytest.approx(400, abs=4 * spread + 0.1)
    z = movie - movie.mean()
    kept = kept if form == "decaying" else 0.0
    weights = np.concatenate([[1 - f], f * (1 - kept) * float(kept) ** np.arange(40)])
    variance = 400 * np.sum(weights**2)
    expected = {lag: 400 * np.sum(weights[lag:] * weights[:-lag]) / variance for lag in (1, 2, 5)}
    later = z[40:]
    assert later.var() == pytest.approx(variance + 1 / 12, rel=5 * np.sqrt(2 * (1 + 4 * f) / later.size) + 1e-3)
    for lag, correlation in expected.items():
        found = np.mean(later[lag:] * later[:-lag]) / later.var()
        assert found == pytest.approx(correlation, abs=5 / np.sqrt(later.size))


@pytest.mark.parametrize("n_frames", [1, 3, 120])
@pytest.mark.parametrize("form", ["one_frame", "decaying"])
def test_the_first_frame_is_as_noisy_as_all_others(form, n_frames):
    """What is left of the light before the movie has noise of its own. 3.5 % is a variance's spread, 2.5 % that of a
    correlation."""
    added = effect("image_lag", fraction=0.3, kept=0.8, form=form)
    long, movie = flat(added, n_frames=120), flat(added, n_frames=n_frames)
    variance, usual = movie.var(axis=(1, 2)), long[60:].var(axis=(1, 2)).mean()
    assert variance[:4] / usual == pytest.approx(1.0, abs=4 * np.sqrt(2 / movie[0].size) + 0.01)
    if n_frames == 120:  # and not that of the last frames
        assert abs(np.corrcoef(movie[0].ravel(), movie[-1].ravel())[0, 1]) < 4 * 0.025


def test_image_lag_of_movies_shorter_than_its_memory():
    for n_frames in (1, 2, 4, 7):
        movie = flat(effect("image_lag", fraction=0.8, kept=0.8, form="decaying"), n_frames=n_frames)
        # Fractions of counts are floored: half a count on average, a whole one where 20 becomes 19.999.
        assert movie.shape[0] == n_frames and movie.mean() == pytest.approx(19.5, abs=1.0)


def test_a_strong_lag_keeps_all_charge():
    movie = flat(
        effect("image_lag", fraction=0.9, kept=0.9, form="decaying"),
        n_frames=20,
        **{"optics.background_photons_per_px": 2000},
    )
    assert movie.mean() == pytest.approx(2000, abs=4 * np.sqrt(2000 / 1600) + 1)  # the start is one frame's noise


def test_image_lag_leaves_a_shadow_of_what_is_gone():
    added = (effect("image_lag", fraction=0.2), effect("laser_drift", change=-0.95, form="step"))
    movie = flat(*added, n_frames=101, **{"optics.background_photons_per_px": 1000}).mean(axis=(1, 2))
    light = 1 - 0.95 * (np.arange(101) >= 50)
    expected = 1000 * (0.8 * light[1:] + 0.2 * light[:-1])
    assert np.all(np.abs(movie[1:] + 0.5 - expected) < 4.5 * np.sqrt(1000 / 1600))  # 100 frames: 7e-4


@pytest.mark.parametrize("form", ["linear", "saturating", "step"])
def test_baseline_drift_moves_the_mean_and_not_the_variance(form):
    movie = flat(effect("baseline_drift", drift_adu=30.0, form=form), shape=(64, 64))
    mean, variance = movie.mean(axis=(1, 2)), movie.var(axis=(1, 2))
    n = 64 * 64
    assert mean[-1] - mean[0] == pytest.approx(30, abs=4 * np.sqrt(2 * 20 / n) + 0.5)
    assert np.all(np.abs(variance / 20 - 1) < 4.5 * np.sqrt(2.05 / n))  # 100 frames: 7e-4
    if form == "linear":
        assert np.polyfit(np.arange(100), mean, 1)[0] == pytest.approx(30 / 99, rel=0.01)


def test_wandering_baseline_stays_within_its_drift():
    movie = flat(effect("baseline_drift", drift_adu=30.0, form="wandering"), shape=(64, 64)).mean(axis=(1, 2))
    assert np.abs(movie - movie[0]).max() == pytest.approx(30, abs=1.0)


def test_dark_frames_do_not_share_the_course_that_was_seen_in_the_movie_but_wander_as_far():
    seen = effect("baseline_drift", drift_adu=30.0, form="wandering", course=(0.0, 1.0, -0.5, 0.2))
    movie = flat(seen, shape=(64, 64)).mean(axis=(1, 2))
    at = np.array([12, 37, 62, 87])  # near the middle of each quarter
    np.testing.assert_allclose(movie[at] - movie[at[0]], [0, 30, -15, 6], atol=2.0)
    as_long = {"acquisition.n_frames": 100}
    courses = [dark(seen, shape=(64, 64), seed=seed, **as_long).mean(axis=(1, 2)) for seed in (1, 2, 3)]
    assert [np.abs(c - c[0]).max() for c in courses] == pytest.approx([30] * 3, abs=1.0)
    assert all(abs(np.corrcoef(c, movie)[0, 1]) < 0.99 for c in courses)
    assert np.abs(courses[0] - courses[1]).max() > 10


def test_a_baseline_that_was_seen_to_wander_in_the_dark_does_so_there_alone():
    drift = effect("baseline_drift", drift_adu=30.0, form="wandering", course=(0.0, 1.0), dark_course=(-8.0, 4.0, 0.0))
    as_long = {"acquisition.n_frames": 99}
    before = dark(drift, shape=(8, 8), **as_long).mean(axis=(1, 2))  # counts are rounded down
    assert before[[16, 49, 82]] - before[-1] == pytest.approx([-8, 4, 0], abs=1.0)
    movie = flat(drift, shape=(64, 64), **as_long).mean(axis=(1, 2))
    assert movie[[24, 74]] - movie[24] == pytest.approx([0, 30], abs=2.0)
    assert not np.any(dark(drift.model_copy(update={"in_dark": 0.0}), shape=(8, 8), **as_long))


def test_a_baseline_that_settles_fast_has_not_come_from_without_bounds():
    """15 (1 − e²) / (1 − e^−10) where it begins to, two time constants before the movie."""
    drift = effect("baseline_drift", drift_adu=15.0, form="saturating", settling_time=0.1)
    before = dark(drift, shape=(8, 8), **{"acquisition.n_frames": 100}).mean(axis=(1, 2))
    assert np.all(before[:75] == before[0]) and before[0] == pytest.approx(15 * (1 - np.exp(2)) - 0.5, abs=0.52)


@pytest.mark.parametrize(
    ("form", "first", "quarter"), [("linear", -15.15, -11.36), ("saturating", -53.29, -33.17), ("step", 0.0, 0.0)]
)
def test_a_baseline_comes_to_the_movie_by_way_of_the_dark_frames_taken_just_before(form, first, quarter):
    """15 (1 − exp(100/99τ)) / (1 − exp(−1/τ)) where it settles, τ = 0.8. There is no noise: counts are rounded down."""
    drift = effect("baseline_drift", drift_adu=15.0, form=form, settling_time=0.8)
    before = dark(drift, shape=(8, 8), **{"acquisition.n_frames": 100}).mean(axis=(1, 2))
    assert before[[0, 25]] == pytest.approx([first - 0.5, quarter - 0.5], abs=0.52)
    assert before[-1] == pytest.approx(-0.5, abs=0.5)  # the movie's first frame follows
    apart = dark(drift.model_copy(update={"in_dark": 0.0}), shape=(8, 8))
    assert np.all(apart == 0)


@pytest.mark.parametrize("form", ["points", "tracks"])
def test_cosmic_rays_come_at_their_rate_with_their_charge(form):
    rate, charge, n_frames = 1.5, 20_000.0, 800
    added = effect("cosmic_rays", hits_per_frame=rate, electrons=charge, form=form)
    movie = dark(added, n_frames=n_frames, shape=(64, 64))
    total = movie.sum(axis=(1, 2))
    # Compound Poisson: mean rate·charge, variance 2·rate·charge² (less where tracks lie in the field in part).
    error = charge * np.sqrt(2 * rate / n_frames)
    assert total.mean() == pytest.approx(rate * charge, abs=4 * error)
    quiet = np.mean(total == 0)
    cut = (
        1.0 if form == "points" else 1 + 4 * 3.5 / (np.pi * 0.5 * 64) / 2
    )  # as many tracks more as cross an edge, about
    assert quiet == pytest.approx(np.exp(-rate * cut), abs=4 * np.sqrt(np.exp(-rate) / n_frames))
    lit = (movie > 0).sum(axis=(1, 2))
    assert lit.mean() == pytest.approx(rate if form == "points" else rate * 4.2, rel=0.2)
    # They do not repeat at a pixel: hits per pixel are Poisson, not clumped.
    per_pixel = (movie > 0).sum(axis=0)
    assert per_pixel.var() / per_pixel.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / 4096) + 0.05)


def test_tracks_of_particles_are_as_dense_at_the_edges_as_within():
    """Each row and column of 24 has its share of 3000 tracks: 5.6 % is the spread of a row's charge by chance."""
    added = effect("cosmic_rays", hits_per_frame=50.0, electrons=2000.0, form="tracks")
    mean = dark(added, n_frames=60, shape=(24, 24)).mean(axis=0)
    for edge in (mean[0], mean[-1], mean[:, 0], mean[:, -1]):
        assert edge.mean() / mean.mean() == pytest.approx(1.0, abs=4 * 0.056)


def test_a_part_of_a_field_is_hit_as_often_for_its_area():
    whole = plain(n_frames=400, shape=(64, 64)).with_effects(effect("cosmic_rays", hits_per_frame=4.0))
    part = whole.in_shape(region=(slice(0, 400), slice(16, 32), slice(0, 32)))
    found = [(simulate_dark(m, 400, 3) > 600).sum() for m in (whole, part)]  # pixels that were hit
    assert found[1] == pytest.approx(found[0] / 8, abs=4 * np.sqrt(found[0] / 8))


def test_cosmic_charge_is_multiplied_by_the_em_register():
    model = plain(shape=(32, 32), **{"camera.electrons_per_adu": 500.0})
    model = model.with_effects(effect("cosmic_rays", hits_per_frame=5.0, electrons=400.0))
    movie = photoelectrons(simulate_dark(model, 200, seed=2), model.camera).astype(float)
    total = movie.sum(axis=(1, 2)) - 0.002 * 1024
    # Counts end at 65535 ADU = 6.5e4 photoelectrons: no hit is cut.
    assert total.mean() == pytest.approx(2000, abs=4 * 400 * np.sqrt(2 * 5 / 200) + 20)
