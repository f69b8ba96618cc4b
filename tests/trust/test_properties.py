"""Laws that hold for any input: hypothesis draws the inputs.

What is random is compared with limits of six standard errors: with some hundred draws a false alarm has a chance below
10⁻⁶, and the draws are the same in every run (derandomize).
"""

from __future__ import annotations

import itertools
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as some

import napari_mufasa as nm
from napari_mufasa import camera as cam
from napari_mufasa.chance.streams import Streams
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.model.setup import Camera
from napari_mufasa.optics.psf import image_on_grid, spot_images

draws = settings(
    max_examples=60, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)  # fmt: skip
SHAPE = (24, 28)
inside = st.tuples(st.floats(10, 13), st.floats(10, 17))  # ten pixels from every edge
sigmas = st.floats(0.6, 2.0)
light = st.floats(0, 1e5, width=32)


# optics ----------------------------------------------------------------------------------------------------
def image(photons: Any, places: Any, sigma: float) -> np.ndarray[Any, Any]:
    photons = np.atleast_2d(np.asarray(photons, float))
    places = np.asarray(places, float).reshape(1, -1, 2)
    return spot_images(photons, places, np.full((len(photons), 2), sigma), SHAPE)[0].astype(float)


@draws
@given(place=inside, sigma=sigmas, photons=light)
def test_no_photon_is_lost_or_made_inside_the_field(place, sigma, photons):
    # Beyond five sd of the PSF lies 6e-7 of the light; float32 keeps 7 digits of each pixel.
    assert image([photons], [place], sigma).sum() == pytest.approx(photons, rel=2e-5, abs=1e-6)


@draws
@given(place=inside, sigma=sigmas, photons=light, factor=st.integers(1, 8))
def test_the_fine_grid_keeps_photons_too(place, sigma, photons, factor):
    fine = image_on_grid(np.array([photons]), np.array([place]), (sigma, sigma), SHAPE, factor)
    assert fine.sum() == pytest.approx(photons, rel=1e-3, abs=1e-6)


@draws
@given(places=st.lists(inside, min_size=2, max_size=4), sigma=sigmas, data=st.data())
def test_optics_is_linear(places, sigma, data):
    a = np.array(data.draw(st.lists(light, min_size=len(places), max_size=len(places))))
    factor = data.draw(st.floats(0, 100))
    alone = sum(image([n], [place], sigma) for n, place in zip(a, places, strict=True))
    together = image(a, places, sigma)
    scale = max(a.max(), 1.0)
    np.testing.assert_allclose(together, alone, atol=1e-5 * scale)
    np.testing.assert_allclose(image(factor * a, places, sigma), factor * together, atol=1e-5 * scale * max(factor, 1))
    assert together.min() >= 0


@draws
@given(place=st.tuples(st.floats(-50, 80), st.floats(-50, 80)), sigma=sigmas, photons=light)
def test_what_leaves_the_field_is_lost_and_nothing_wraps_round(place, sigma, photons):
    total = image([photons], [place], sigma).sum()
    assert -1e-9 <= total <= photons * (1 + 2e-5) + 1e-6
    outside = max(-0.5 - place[0], place[0] - SHAPE[0] + 0.5, -0.5 - place[1], place[1] - SHAPE[1] + 0.5)
    if outside > 6 * sigma:
        assert total <= 1e-6 * photons


# camera ----------------------------------------------------------------------------------------------------
@st.composite
def cameras(draw: Any, noise: bool = False) -> Camera:
    kind = draw(st.sampled_from(["CCD", "EMCCD", "CMOS"]))
    steps = draw(st.lists(st.tuples(st.floats(1, 1000), st.floats(1, 1000)), min_size=1, max_size=4))
    return Camera(
        type=kind,
        quantum_efficiency=draw(st.floats(0.05, 1)),
        read_noise_e=draw(st.floats(0, 50)) if noise else 0.0,
        clock_induced_charge_e=draw(st.floats(0, 1)),
        electrons_per_adu=draw(st.floats(0.1, 50)),
        baseline_adu=draw(st.integers(0, 500)),
        em_gain=draw(st.floats(2, 1000)) if kind == "EMCCD" else None,
        cmos_gain_curve=tuple(map(tuple, np.cumsum([(0.0, 0.0), *steps], axis=0).tolist())),
    )


@draws
@given(camera=cameras(), electrons=some.arrays(np.float32, (3, 4), elements=st.floats(-500, 50_000, width=32)))
def test_the_inverse_undoes_the_cmos_response(camera, electrons):
    assume(camera.type == "CMOS")
    back = cam.cmos_response_inverse(cam.cmos_response(electrons, camera), camera)
    knots = np.array(camera.cmos_gain_curve)
    slope = (np.diff(knots[:, 1]) / np.diff(knots[:, 0])).min()  # a flat curve is inverted with fewer digits
    np.testing.assert_allclose(back, electrons, atol=0.02 / min(slope, 1), rtol=1e-4 / min(slope, 1))


@draws
@given(camera=cameras(), levels=st.lists(st.floats(0, 60_000, width=32), min_size=3, max_size=20, unique=True))
def test_the_camera_response_is_monotone(camera, levels):
    electrons = np.sort(np.array(levels, np.float32)).reshape(1, 1, -1)
    if camera.type == "CMOS":
        assert (np.diff(cam.cmos_response(electrons, camera)) >= 0).all()
    adu = np.linspace(0, camera.adc_max, 50, dtype=np.float32).reshape(1, 1, -1)
    assert (np.diff(cam.photoelectrons(adu, camera)) > 0).all()


@draws
@given(camera=cameras(), adu=some.arrays(np.uint16, (2, 3, 4)))
def test_the_inverse_gives_electrons_that_make_the_same_count(camera, adu):
    """Digitised again, what the inverse gives is the count that it came from: the ½ is in the middle of a code."""
    adu = np.minimum(adu, camera.adc_max)
    electrons = cam.output_electrons(adu, camera).astype(float)
    again = np.floor(electrons / camera.electrons_per_adu) + camera.baseline_adu
    np.testing.assert_array_equal(again, adu)


@draws
@given(camera=cameras(noise=True), level=st.floats(5, 200), seed=st.integers(0, 2**40))
def test_denoising_backwards_is_unbiased(camera, level, seed):
    """Expose even light, undo the camera: the mean is the light. CMOS curves bend, and the mean of a bent curve is not
    the curve of the mean: they are left out. So is what the ADC clips, and read noise below a count: the ½ undoes the
    floor only where noise blurs the counts (by 2 exp(−2π²) of a count at a sd of one)."""
    assume(camera.type != "CMOS")
    camera = camera.model_copy(update={"read_noise_e": max(camera.read_noise_e, camera.electrons_per_adu)})
    photons = np.full((16, 32, 32), level, np.float32)
    movie = cam.expose(photons, camera, Streams(seed), np.arange(16))
    assume(movie.min() > 0 and movie.max() < camera.adc_max)
    back = cam.photons(cam.photoelectrons(movie, camera), camera)
    error = back.std() / np.sqrt(back.size) + camera.electrons_per_adu / (camera.em_gain or 1) / 1000
    assert abs(back.mean() - level) < 6 * error


@draws
@given(camera=cameras(noise=True), seed=st.integers(0, 2**40), cuts=st.lists(st.integers(1, 11), max_size=4))
def test_a_camera_records_the_same_however_frames_are_grouped(camera, seed, cuts):
    photons = np.random.default_rng(0).uniform(0, 50, (12, 6, 7)).astype(np.float32)
    whole = cam.expose(photons.copy(), camera, Streams(seed), np.arange(12))
    edges = [0, *sorted(set(cuts)), 12]
    parts = [
        cam.expose(photons[a:b].copy(), camera, Streams(seed), np.arange(a, b)) for a, b in itertools.pairwise(edges)
    ]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


# units -----------------------------------------------------------------------------------------------------
@draws
@given(factor=st.floats(0.5, 3))
def test_a_field_in_other_pixels_is_the_same_field(factor):
    """PSF and pixel grow together: nothing that is in pixels changes."""
    model = nm.preset("FF")
    grown = model.with_values(
        {"acquisition.pixel_size_nm": 100 * factor, "optics.psf_fwhm_nm": model.optics.psf_fwhm_nm * factor}
    )
    assert grown.sigma_px == pytest.approx(model.sigma_px)


@draws
@given(power=st.floats(0.1, 100), factor=st.floats(0.1, 10), frame=st.floats(1e-3, 0.1))
def test_light_counts_as_power_times_time(power, factor, frame):
    """Far from saturation twice the power is as good as twice the time."""
    values = {"excitation.power_density_w_per_cm2": power, "acquisition.frame_length_s": frame,
              "fluorophore.cycles_before_bleaching": None}  # fmt: skip
    one = nm.predict(nm.preset("FF").with_values(values)).emitted_photons_per_frame
    brighter = nm.preset("FF").with_values(values | {"excitation.power_density_w_per_cm2": power * factor})
    longer = nm.preset("FF").with_values(values | {"acquisition.frame_length_s": frame * factor})
    assert nm.predict(brighter).emitted_photons_per_frame == pytest.approx(factor * one, rel=0.01)
    assert nm.predict(longer).emitted_photons_per_frame == pytest.approx(factor * one)


@draws
@given(shift=st.floats(-1e3, 1e3), scale=st.floats(0.01, 100), seed=st.integers(0, 99))
def test_the_distance_has_the_unit_of_the_traces(shift, scale, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(100, 10, (5, 8)), rng.normal(110, 20, (7, 8))
    for rows in ("frames", "traces"):
        distance = nm.wasserstein(a, b, rows=rows)
        assert nm.wasserstein(scale * a, scale * b, rows=rows) == pytest.approx(scale * distance, rel=1e-6)
        assert nm.wasserstein(a + shift, b + shift, rows=rows) == pytest.approx(distance, rel=1e-6, abs=1e-6)
        assert nm.wasserstein(b, a, rows=rows) == pytest.approx(distance, rel=1e-6)
        assert nm.wasserstein(a, a, rows=rows) == pytest.approx(0, abs=1e-6)


# models ----------------------------------------------------------------------------------------------------
PLAIN = nm.preset("FF").to_dict()
anything = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)


def paths(data: dict[str, Any], before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    found = []
    for key, value in data.items():
        found.append((*before, key))
        if isinstance(value, dict):
            found += paths(value, (*before, key))
    return found


@settings(draws, max_examples=400)
@given(path=st.sampled_from(paths(PLAIN)), value=anything, drop=st.booleans(), add=st.text(max_size=10))
def test_any_change_of_a_model_is_a_model_or_one_line(path, value, drop, add):
    data = json.loads(json.dumps(PLAIN))
    target = data
    for key in path[:-1]:
        target = target[key]
    if drop:
        del target[path[-1]]
    else:
        target[path[-1]] = value
    if add and not drop and len(add) > 8:
        target[add] = value
    try:
        model = Model.from_dict(data)
    except MufasaError as told:
        assert str(told).strip() and "\n" not in str(told).strip()
        return
    assert Model.from_dict(json.loads(json.dumps(model.to_dict()))) == model


@settings(draws, max_examples=200)
@given(data=anything)
def test_any_json_is_a_model_or_one_line(data):
    with pytest.raises(MufasaError) as told:
        Model.from_dict(data)
    assert str(told.value).strip()


@settings(draws, max_examples=200)
@given(kind=st.sampled_from(sorted(nm.catalogue())), data=st.data())
def test_any_effect_within_its_limits_survives_the_file(kind, data):
    effect = nm.catalogue()[kind]
    values = {
        name: data.draw(st.floats(min(low, high), max(low, high)))
        for name, (low, high, _) in effect.plausible().items()
    }
    for name, options in effect.choices().items():
        values[name] = data.draw(st.sampled_from(options))
    try:
        model = nm.preset("FF").with_values({"effects": [{"kind": kind, **values}]})
    except MufasaError as told:  # values that do not go together
        assert "\n" not in str(told)
        return
    assert Model.from_dict(json.loads(json.dumps(model.to_dict()))) == model
