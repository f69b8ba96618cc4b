"""Poisson and SOFI baselines follow their own laws (docs/comparison.md, source note 4)."""

from __future__ import annotations

import numpy as np
import pytest

import napari_mufasa as nm
from napari_mufasa.compare.baselines import (
    TwoState,
    largest_of_a_trace,
    poisson_emission,
    poisson_image,
    poisson_mean_photons,
    sofi_emission,
    tool_defaults,
    two_state_of,
)
from napari_mufasa.compare.distributions import dwell_frames


def test_poisson_mean_is_the_check_value():
    """67.2 photons per 10 ms frame for FF (docs/photophysics.md)."""
    assert poisson_mean_photons(nm.preset("FF")) == pytest.approx(67.249, abs=0.001)


def test_poisson_mean_and_variance():
    model = nm.preset("EGFP")
    emission = poisson_emission(model, 400, np.random.default_rng(0))
    mean = poisson_mean_photons(model)
    n = emission.size
    assert emission.mean() == pytest.approx(mean, abs=4 * np.sqrt(mean / n))
    assert emission.var() == pytest.approx(mean, rel=4 * np.sqrt((2 + 1 / mean) / n))


@pytest.mark.parametrize("kept", [1.0, 0.25, 0.0])
def test_poisson_light_keeps_in_the_image_what_the_model_s_keeps(kept):
    """Baseline and model of molecules never dark are the same light, and so are their movies' inputs."""
    from napari_mufasa.compare.simulated import acquisitions

    never_dark = {"fluorophore.cycles_before_bleaching": None, "optics.emission_noise": kept}
    model = nm.preset("FF").with_values(never_dark)
    made = acquisitions(model, np.full((200, 2), 20.0), 1)
    mean, n = poisson_mean_photons(model), 200 * model.acquisition.n_frames
    for name in ("mufasa", "poisson"):
        photons = made[name].photons
        assert photons.mean() == pytest.approx(mean, abs=4 * np.sqrt(mean / n))
        assert photons.var() == pytest.approx(kept * mean, rel=4 * np.sqrt(2 / n), abs=0.02 * mean * (kept == 0))
    assert poisson_image(model, 3, np.random.default_rng(0)).shape == (3, model.acquisition.n_frames)


def test_sofi_dwell_times_duty_and_constant_light():
    two_state = TwoState(on_s=0.5, off_s=1.5, bleach_s=np.inf, photons_per_frame=20.0)
    emission = sofi_emission(two_state, 300, 4000, 0.01, 0.01, np.random.default_rng(1))
    full = emission[:, 500:]  # past the start, which is on
    assert full.mean() == pytest.approx(20 * 0.25, rel=0.05)
    assert full.max() == pytest.approx(20.0)
    # Within an on time the light is constant: nearly every lit frame is full.
    lit = full > 0
    partial = lit & (full < 20 * (1 - 1e-9))
    assert partial.sum() / lit.sum() == pytest.approx(2 * 0.01 / 0.5 / (1 + 0.01 / 0.5), rel=0.2)
    on = dwell_frames(lit, True) * 0.01
    off = dwell_frames(lit, False) * 0.01
    assert on.mean() == pytest.approx(0.5 + 0.01, rel=0.05)
    assert off.mean() == pytest.approx(1.5 - 0.01, rel=0.06)


def test_sofi_bleaches_after_its_time_in_the_light():
    two_state = TwoState(on_s=0.2, off_s=0.2, bleach_s=1.0, photons_per_frame=1.0)
    emission = sofi_emission(two_state, 4000, 2000, 0.01, 0.01, np.random.default_rng(2))
    lit_s = emission.sum(axis=1) * 0.01
    # Exponential of mean 1 s spent on, cut at about 10 s: mean known to 1/√4000.
    assert lit_s.mean() == pytest.approx(1.0, abs=0.065)
    assert (emission[:, -1] > 0).mean() < 0.01


def test_time_scales_come_from_the_chain():
    model = nm.preset("Alexa647-STORM")
    found = two_state_of(model, 100.0)
    assert found.off_s == pytest.approx(10.0, rel=1e-6)
    assert found.on_s == pytest.approx(0.2129e-3, rel=1e-3)
    assert found.start_on == 0.0  # STORM starts in T1
    plain = two_state_of(nm.preset("EGFP"), 5.0)
    assert np.isinf(plain.on_s)
    assert np.isinf(plain.bleach_s)
    bleaching = two_state_of(nm.preset("FF"), 5.0)
    assert bleaching.bleach_s == pytest.approx(5000 / 6724.9, rel=1e-3)  # N_c cycles at k01
    late = two_state_of(nm.preset("PALM"), 5.0)
    assert late.off_s == pytest.approx(1.0, rel=1e-6)
    assert late.start_on == 0.0


def test_on_intensity_does_not_grow_with_the_number_of_traces():
    rng = np.random.default_rng(5)
    few, many = (largest_of_a_trace(rng.poisson(10.5, (n, 50))) for n in (200, 5000))
    # The largest of 50 Poisson values of mean 10.5 has a spread of 1.8: 4 standard errors of the mean of 200.
    assert few == pytest.approx(many, abs=0.55)
    assert largest_of_a_trace(np.array([[0, 0], [3, 7]])) == 7.0  # a molecule that never emits says nothing
    assert largest_of_a_trace(np.zeros((3, 4), int)) == 0.0


def test_the_tools_own_times():
    emission = sofi_emission(tool_defaults(9.0), 3000, 200, 0.01, 0.01, np.random.default_rng(6))
    # On for a third of the time from the start; 2 s of 80 s to bleach, on a third of them.
    assert emission.mean() == pytest.approx(3.0 * (1 - 2 / 80 / 3 / 2), rel=0.03)
    assert emission[:, 0].mean() == pytest.approx(3.0, rel=0.1)
