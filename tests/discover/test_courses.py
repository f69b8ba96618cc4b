"""Courses read off a movie: walks and what is none."""

import numpy as np
import pytest
from scipy import fft, signal

import napari_mufasa as nm
from napari_mufasa.discover.read_off import read_off
from napari_mufasa.discover.seen_courses import pink_alone, pink_share, walk_in_noise, walk_of
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


def test_a_movie_of_two_frames_shows_no_walk():
    assert walk_of(np.array([1.0, 2.0]), 1) is None


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


def pink(rng):
    """1/f noise of unit variance, drawn in cosines (of a course between ends that reflect)."""
    drawn = rng.standard_normal(FRAMES) / np.sqrt(np.maximum(np.arange(FRAMES), 1))
    course = fft.idct(drawn, norm="ortho")
    return (course - course.mean()) / course.std()


def relaxing(rng, frames=3.0):
    kept = np.exp(-1 / frames)
    return signal.lfilter([np.sqrt(1 - kept**2)], [1.0, -kept], rng.standard_normal(FRAMES))


LAWS = {
    "white": lambda rng: rng.standard_normal(FRAMES),
    "walk": lambda rng: np.cumsum(rng.standard_normal(FRAMES)),
    "relaxing": relaxing,
    "line": lambda rng: np.linspace(0, 2, FRAMES) + rng.standard_normal(FRAMES),
    "step": lambda rng: 2 * (np.arange(FRAMES) > 100) + rng.standard_normal(FRAMES),
}


def test_one_over_f_noise_is_told_from_other_laws_by_its_spectrum():
    """Of 1000 draws each, in white noise of a tenth, 962 of 1/f noise, 1 of white noise, 0 walks, 96 that relax within
    three frames, 8 lines and 16 steps in white noise of half their height; bounds at four sd for 200 draws."""
    rng = np.random.default_rng(4)

    def told(law):
        return sum(pink_share(law(rng) + 0.1 * rng.standard_normal(FRAMES)) is not None for _ in range(200))

    assert told(pink) >= 181
    most = {"white": 3, "walk": 1, "relaxing": 36, "line": 7, "step": 11}
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
        share = pink_share(measured)
        if share is None:
            continue
        told = pink_alone(measured, share) + noise * rng.standard_normal(FRAMES)
        found.append([np.mean((c[by:] - c[:-by]) ** 2) for c in (told, measured) for by in (1, 10)])
    told, measured = np.reshape(np.mean(found, axis=0), (2, 2))
    assert len(found) > 150
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
