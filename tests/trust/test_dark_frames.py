"""Dark frames with light in them are told; those with the camera's own patterns are not."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import napari_mufasa as nm
from napari_mufasa.camera.darkness import light_in_dark

MODEL = nm.preset("FF").with_values(
    {
        "acquisition.shape_px": (48, 48), "acquisition.n_frames": 40, "sample.n_molecules": 25,
        "excitation.power_density_w_per_cm2": 30, "camera.em_gain": 300, "camera.electrons_per_adu": 12,
    }
)  # fmt: skip
PATTERNS = [{"kind": "column_offset"}, {"kind": "hot_pixels"}, {"kind": "row_noise"}, {"kind": "pixel_gain_variation"}]


@pytest.mark.parametrize("seed", range(10))
def test_a_cameras_own_patterns_are_no_light(seed):
    # Six sd: a false alarm in 10⁹ where the correlation is normal; ten seeds with all patterns at their defaults.
    model = MODEL.with_values({"effects": PATTERNS})
    assert light_in_dark(nm.simulate(model, seed=seed).movie, nm.simulate_dark(model, 20, seed=seed)) is None


@pytest.mark.parametrize("n", [50, 200])
def test_hot_pixels_that_outshine_the_noise_are_no_light(n):
    """Of 16 384 pixels, sixty times the noise: what they add to a smooth image, their neighbours have in common."""
    rng = np.random.default_rng(n)
    hot = np.zeros((128, 128))
    hot.flat[rng.choice(hot.size, n, replace=False)] = rng.exponential(60.0, n)
    assert light_in_dark(hot + rng.normal(1, 1, hot.shape), hot + rng.normal(0, 1, hot.shape)) is None


def test_light_is_told(recwarn):
    movie = nm.simulate(MODEL, seed=1).movie
    assert "brighter than the movie" in light_in_dark(movie, movie[:20] + 3)
    leak = MODEL.with_values({"excitation.power_density_w_per_cm2": 3, "optics.background_photons_per_px": 2})
    at = nm.simulate(MODEL, seed=1).positions_px
    leaked = nm.simulate(leak, at, seed=2).movie[:20]  # a tenth of the light, and the same molecules
    assert leaked.mean() < movie.mean()
    assert "show what the movie shows" in light_in_dark(movie, leaked)
    for call in (
        lambda: nm.extract_traces(movie, MODEL.camera, leaked),
        lambda: nm.calibrate(movie, leaked),
    ):
        with pytest.warns(UserWarning, match="is there light in them"):
            call()


def test_good_dark_frames_are_no_news():
    movie, dark = nm.simulate(MODEL, seed=1).movie, nm.simulate_dark(MODEL, 20, seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        nm.extract_traces(movie, MODEL.camera, dark)
        nm.extract_traces(movie, MODEL.camera, np.asarray(dark[0]))
