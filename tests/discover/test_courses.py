"""Courses read off a movie: drifts, walks, swings, flicker, and what is none of them."""

import types

import numpy as np
import pytest
from scipy import fft, signal
from tests.effects.helpers import effect, plain, scene_of, still_spots

import napari_mufasa as nm
from napari_mufasa.discover.read_off import read_off
from napari_mufasa.discover.seen_courses import (
    course_of,
    flicker_in,
    light_course,
    light_period,
    walk_alone,
    walk_in_noise,
    walk_of,
)
from napari_mufasa.effects import effect_class
from napari_mufasa.observe import observe

FRAMES, STEP, NOISE = 300, 0.003, 0.01  # variances; as those of the width of forty bright spots


def walks(draws, step=STEP, noise=NOISE, seed=0):
    rng = np.random.default_rng(seed)
    paths = np.cumsum(rng.normal(0, np.sqrt(step), (draws, FRAMES)), axis=1)
    return paths, paths + rng.normal(0, np.sqrt(noise), paths.shape)


@pytest.mark.parametrize("far", [2, 15])
def test_steps_and_noise_of_a_walk_are_told_without_bias(far):
    """The mean over 400 draws, within four of its standard errors (by chance once in 16 000)."""
    _, seen = walks(400)
    found = np.array([walk_in_noise(course, far) for course in seen])
    error = found.std(axis=0) / np.sqrt(len(found))
    assert np.all(np.abs(found.mean(axis=0) - (STEP, NOISE)) < 4 * error)


def test_differences_over_more_frames_tell_steps_smaller_than_the_noise():
    _, seen = walks(200)
    near, far = (np.std([walk_in_noise(course, by)[0] for course in seen]) for by in (2, 15))
    assert far < near / 2


def test_a_walk_is_told_with_its_spectrum_and_neither_noise_nor_a_line_is_a_walk():
    """White noise passes three standard deviations in 0.13 % (of 1000 draws more than 8 in one trial of 10 000)."""
    paths, seen = walks(50)
    told = [walk_of(course, 30) for course in seen]
    assert all(course is not None for course in told)
    likeness = [np.corrcoef(path, course)[0, 1] for path, course in zip(paths, told, strict=True)]
    assert np.median(likeness) > 0.97
    roughness = np.mean([np.mean(np.diff(course[::10]) ** 2) for course in told])
    assert roughness == pytest.approx(10 * STEP, rel=0.15)  # of a walk in ten frames; sd of the mean of 50 draws 5 %
    _, noises = walks(1000, step=0.0, seed=1)
    assert sum(walk_of(course, 30) is not None for course in noises) <= 8
    lines = noises[:200] + np.linspace(0, 0.6, FRAMES)
    assert sum(walk_of(course, 30) is not None for course in lines) <= 20


def test_a_movie_of_two_frames_shows_no_walk_and_still_light_no_flicker():
    assert walk_of(np.array([1.0, 2.0]), 1) is None
    assert flicker_in(np.array([1.0, 2.0])) is None and flicker_in(np.full(100, 7.0)) is None


def test_a_focus_that_walks_is_told_for_each_frame():
    """Of 40 bright spots; in ten blocks the course would have lost what happens within thirty frames."""
    walk = walks(1, step=1.0, seed=5)[0][0]
    walk = tuple((walk - walk[0]) / np.abs(walk - walk[0]).max())
    model = nm.preset("FF").with_values({
        "acquisition.n_frames": FRAMES, "acquisition.shape_px": (96, 96), "sample.n_molecules": 40,
        "fluorophore.cycles_before_bleaching": None, "optics.brightness_correction": 3.0,
    })  # fmt: skip
    drifting = model.with_effects(effect_class("focus_drift")(widening=0.4, form="wandering", course=walk))
    course = read_off("focus_drift", observe(nm.simulate(drifting, seed=2).movie, model))["course"]
    assert len(course) == FRAMES
    assert abs(np.corrcoef(course, walk)[0, 1]) > 0.9
    still = read_off("focus_drift", observe(nm.simulate(model, seed=2).movie, model))["course"]
    assert still == ()


def shown(light, noise, rng):
    """Background and spots in the same light, each with noise of its own."""
    course, spots = light + noise * rng.standard_normal((2, len(light)))
    return types.SimpleNamespace(course=course, together=lambda: spots)


@pytest.mark.parametrize("form", ["sine", "square"])
@pytest.mark.parametrize("period", [3.1, 9.0, 27.0])
def test_a_period_is_read_off_the_light_beside_a_drift_and_flicker(period, form):
    """300 frames, flicker and noise half as strong as the swing: the period's sd is 0.5 % at most (draws)."""
    swing = effect("periodic_modulation", amplitude=0.02, period_frames=period, form=form)
    others = effect("laser_drift", change=-0.4), effect("laser_flicker", rms=0.007)
    light = scene_of(plain(n_frames=300).with_effects(swing, *others)).light
    seen = light_period(shown(light, 0.007, np.random.default_rng(4)))
    assert seen["period_frames"] == pytest.approx(period, rel=0.025)


def test_light_without_a_period_has_none():
    """At most one in a thousand walks, flickers or drifts has one (4000 draws each): five of 1200 with chance 0.008."""
    rng, told, n = np.random.default_rng(5), 0, 300
    pink = 1 / np.sqrt(np.maximum(np.fft.rfftfreq(n), 1 / n))
    for _ in range(300):
        walk = np.cumsum(rng.standard_normal(n))
        flicker = np.fft.irfft(pink * np.fft.rfft(rng.standard_normal(n)), n)
        lights = walk, flicker, 3 * rng.standard_normal(n), np.linspace(0, 30, n)
        told += sum(light_period(shown(light, 1.0, rng)) != {} for light in lights)
    assert told < 5


def test_a_course_is_seen_where_readings_agree_and_only_there():
    """White noise: F(19, 285) > 5 happens less than once in 10⁸."""
    rng = np.random.default_rng(8)
    walk = np.cumsum(rng.standard_normal(20))
    seen = np.array(course_of(walk + rng.standard_normal((15, 20)))["course"])
    assert np.corrcoef(seen, walk)[0, 1] > 0.97 and seen[0] == 0 and np.abs(seen).max() == 1
    assert course_of(rng.standard_normal((15, 20)))["course"] == ()


def test_slow_light_has_a_course_and_flicker_has_none():
    """97 % of random walks and 1.5 % of 1/f noise of 300 frames are seen (1000 draws); bounds at 4 sd for 200 each."""
    rng = np.random.default_rng(3)
    f = np.fft.rfftfreq(300)
    f[0] = f[1]

    def seen(light):
        return light_course(still_spots(10 + 0.01 * light))["course"] != ()

    walks = [seen(np.cumsum(rng.standard_normal(300))) for _ in range(200)]
    pink = [seen(np.fft.irfft(np.fft.rfft(rng.standard_normal(300)) / np.sqrt(f), 300)) for _ in range(200)]
    white = [seen(rng.standard_normal(300)) for _ in range(200)]
    assert np.mean(walks) > 0.92 and np.mean(pink) < 0.05 and not any(white)


@pytest.mark.parametrize(("noise", "values"), [(0.15, {300}), (0.7, {300}), (3.0, {60, 300})])
def test_a_walk_is_told_for_each_frame_where_its_steps_stand_out_of_the_noise(noise, values):
    """Five frames of noise 2.04 have a mean as noisy as what a walk goes meanwhile; estimates of it are 40 % off. Of
    walks 97 % are seen, in a noise of 3 79 %: with a chance of 0.1 % fewer than 10 of 20."""
    rng = np.random.default_rng(6)
    seen = []
    for _ in range(20):
        walk = np.cumsum(rng.standard_normal(300))
        course = light_course(still_spots(walk + noise * rng.standard_normal(300)))["course"]
        if course:
            at = (np.arange(len(course)) + 0.5) / len(course) * 300 - 0.5
            seen.append(np.corrcoef(np.interp(np.arange(300), at, course), walk)[0, 1])
            assert len(course) in values
    assert len(seen) >= 10 and np.median(seen) > 0.95


@pytest.mark.parametrize(("wave", "least"), [(np.sin, 32), (lambda turn: np.sign(np.sin(turn)), 15)])
def test_a_swing_hides_no_walk_and_is_no_part_of_it(wave, least):
    """A swing of six steps of the walk, which alone is not slow. Of 300 walks 95 % are seen in a sine (97 % in still
    light), 61 % in a square swing, whose edges stay; fewer than 32 or 15 of 40 with a chance of 0.1 % at most."""
    rng = np.random.default_rng(10)
    found = []
    for _ in range(40):
        walk = np.cumsum(rng.standard_normal(300))
        swinging = walk + 6 * wave(2 * np.pi * np.arange(300) / 22.9 + 1.0)
        light = 1 + 0.01 * np.stack([swinging, swinging + rng.standard_normal(300)])
        course = light_course(types.SimpleNamespace(course=light[0], together=lambda spots=light[1]: spots))["course"]
        if course:
            at = (np.arange(len(course)) + 0.5) / len(course) * 300 - 0.5
            found.append(np.corrcoef(np.interp(np.arange(300), at, course), walk)[0, 1])
    assert len(found) >= least and np.median(found) > 0.97


@pytest.mark.parametrize("noise", [0.15, 0.7, 1.2])
def test_a_walk_that_was_told_has_with_fresh_noise_the_steps_that_were_measured(noise):
    """Mean square over one frame and two: 1 + 2 noise² and 2 + 2 noise²; told with its noise, it would have twice
    that. 200 walks of 300 frames; bounds at 4 sd (each walk 10 %) and 2 % for the reflecting ends."""
    rng = np.random.default_rng(7)
    found = []
    for _ in range(200):
        measured = np.cumsum(rng.standard_normal(300)) + noise * rng.standard_normal(300)
        told = walk_alone(measured, 1.0, noise**2) + noise * rng.standard_normal(300)
        found.append([np.mean((told[by:] - told[:-by]) ** 2) for by in (1, 2)])
    np.testing.assert_allclose(np.mean(found, axis=0), [1 + 2 * noise**2, 2 + 2 * noise**2], rtol=0.05)


def test_the_course_of_each_frame_is_that_of_the_frame():
    """As many values as frames come back as they are, fewer as the means of equal parts, without any shift in time."""
    course = np.abs(np.random.default_rng(9).uniform(-1, 1, 60))
    course[0], course[7] = 0.0, 1.0
    added = effect("laser_drift", change=0.4, form="wandering", course=tuple(course))
    light = scene_of(plain(n_frames=60).with_effects(added)).light
    np.testing.assert_allclose(light / light[0], 1 + 0.4 * course, rtol=1e-6)
    seen = np.array(light_course(still_spots(10 + np.linspace(0.0, 1.0, 203) ** 2))["course"])
    at = (np.arange(len(seen)) + 0.5) / len(seen)
    slope, offset = np.polyfit(seen, at**2, 1)
    assert np.abs(offset + slope * seen - at**2).max() < 0.01  # parts of 203 frames differ by one frame, 0.5 %


def pink(rng):
    """1/f noise of unit variance, drawn in cosines (of a course between ends that reflect)."""
    drawn = rng.standard_normal(FRAMES) / np.sqrt(np.maximum(np.arange(FRAMES), 1))
    course = fft.idct(drawn, norm="ortho")
    return (course - course.mean()) / course.std()


def relaxing(rng, frames=3.0):
    kept = np.exp(-1 / frames)
    return signal.lfilter([np.sqrt(1 - kept**2)], [1.0, -kept], rng.standard_normal(FRAMES))


def far(walk, extent):
    return walk * extent / np.ptp(walk)


LAWS = {
    "white": lambda rng: rng.standard_normal(FRAMES),
    "walk": lambda rng: np.cumsum(rng.standard_normal(FRAMES)),
    "walk in noise": lambda rng: far(np.cumsum(rng.standard_normal(FRAMES)), 10) + rng.standard_normal(FRAMES),
    "relaxing": relaxing,
    "line": lambda rng: np.linspace(0, 2, FRAMES) + rng.standard_normal(FRAMES),
    "step": lambda rng: 2 * (np.arange(FRAMES) > 100) + rng.standard_normal(FRAMES),
}


def test_one_over_f_noise_is_told_from_other_laws_by_its_spectrum():
    """Of 1000 draws each, in white noise of a tenth: 939 of 1/f noise, 183 that relax within three frames, 1 of white
    noise, no walk, line, or step in white noise of half its height; of walks as far as ten times their noise 5. Bounds
    at four sd for 200 draws, and at 3 where the mean is below 0.6 (the limit of none in 1000): by chance once in 300.
    """
    rng = np.random.default_rng(4)

    def told(law):
        return sum(flicker_in(law(rng) + 0.1 * rng.standard_normal(FRAMES)) is not None for _ in range(200))

    assert told(pink) >= 174
    most = {"white": 3, "walk": 3, "walk in noise": 6, "relaxing": 59, "line": 3, "step": 3}
    found = {name: told(law) for name, law in LAWS.items()}
    assert all(found[name] <= most[name] for name in LAWS), found


@pytest.mark.parametrize("noise", [0.1, 0.5, 1.0])
def test_one_over_f_noise_that_was_told_has_with_fresh_noise_the_spectrum_that_was_measured(noise):
    """Mean square over one frame and ten, relative to the measured course's: told with its noise, that would add once
    more. Where there is little noise, spectra tell it too large: what is told lacks up to 7 % over one frame. Means of
    200 draws, 3 % for chance."""
    rng, found = np.random.default_rng(7), []
    for _ in range(200):
        measured = pink(rng) + noise * rng.standard_normal(FRAMES)
        flicker = flicker_in(measured)
        if flicker is None:
            continue
        told = flicker + noise * rng.standard_normal(FRAMES)
        found.append([np.mean((c[by:] - c[:-by]) ** 2) for c in (told, measured) for by in (1, 10)])
    told, measured = np.reshape(np.mean(found, axis=0), (2, 2))
    assert len(found) > 20
    np.testing.assert_allclose(told, measured, rtol=0.1)


def test_light_that_flickers_as_one_over_f_is_told_for_each_frame():
    """Relative to its mean, in units of its rms, as the effect follows it; white flicker is told by its law alone."""
    course = tuple(pink(np.random.default_rng(8)))
    model = nm.preset("FF").with_values({"acquisition.n_frames": FRAMES, "acquisition.shape_px": (64, 64)})
    flicker = effect_class("laser_flicker")

    def read(**values):
        flickering = model.with_effects(flicker(rms=0.05, **values))
        return read_off("laser_flicker", observe(nm.simulate(flickering, seed=3).movie, model))["course"]

    seen = np.array(read(form="pink", course=course))
    assert len(seen) == FRAMES
    assert seen.std() == pytest.approx(1, abs=1e-3) and abs(seen.mean()) < 1e-3
    assert np.corrcoef(seen, course)[0, 1] > 0.95
    assert read(form="white") == ()


def test_a_drift_beside_one_over_f_noise_is_told_apart():
    """A line of 15 times its rms, in 100 draws: what is told as flicker is like it (fewer values than the movie has
    cosines are the line's), the course is the line's."""
    rng, flickers, lines = np.random.default_rng(9), [], []
    line = np.linspace(0, 15, FRAMES)
    for _ in range(100):
        noise = pink(rng)
        light = noise + line + 0.1 * rng.standard_normal(FRAMES)
        flicker, course = flicker_in(light), light_course(still_spots(light))["course"]
        if flicker is not None:
            flickers.append(np.corrcoef(flicker, noise)[0, 1])
            at = (np.arange(len(course)) + 0.5) / len(course)
            lines.append(np.corrcoef(course, at)[0, 1])
    assert len(flickers) > 60 and np.median(flickers) > 0.7 and np.median(lines) > 0.99
