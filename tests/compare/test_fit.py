"""The fit by moments changes what differs from the simulation, and nothing else (docs/comparison.md)."""

from __future__ import annotations

import numpy as np
import pytest
from tests.blind import generator

import napari_mufasa as nm
from napari_mufasa.compare import compare_movie, fit_model
from napari_mufasa.compare.fit import Ends
from napari_mufasa.compare.simulated import FarApart
from napari_mufasa.effects import effect_class
from napari_mufasa.traces import Options


def ff(**changes):
    strong = {"excitation.power_density_w_per_cm2": 10.0, "optics.background_photons_per_px": 2.0}
    return nm.preset("FF").with_values(strong | changes)


def bleaching(rate_per_s, **changes):
    model = ff(**{"fluorophore.cycles_before_bleaching": None}, **changes)
    return model.with_effects(effect_class("photobleaching")(rate_per_s=rate_per_s)) if rate_per_s else model


def fitted_to(truth, believed, seed, n=200):
    field = FarApart(truth.sigma_px, n, Options(psf_sigma_px=truth.sigma_px), seed, quick=True)
    traces = field.traces(field.acquisition(truth, 100 + seed))
    return traces, fit_model(traces, believed, lambda candidate: field.traces(field.acquisition(candidate, seed)))


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0, 2.0])
def test_a_bleaching_that_is_off_is_found(factor):
    """Lives of 10 of 100 frames. Of 200 molecules 160 are seen and bleach, in measurement and simulation alike: the
    rate is known to 0.11. By the share bleached, which is all of them, it was 0.58 of it."""
    true = 10.0
    truth, believed = (bleaching(rate, **{"acquisition.n_frames": 100}) for rate in (true, factor * true))
    _, fit = fitted_to(truth, believed, seed=9)
    assert fit.values["photobleaching.rate_per_s"] == pytest.approx(true, rel=3 * 0.11)
    assert fit.values["optics.brightness_correction"] == pytest.approx(1.0, abs=0.05)


def test_light_between_frames_bleaches_too():
    """Frames of 10 ms every 50 ms, for 5 s: 63 % of 200 molecules bleach, and rates are known to 13 %. Divided by the
    share of time that frames take, the fitted model bleached five times too fast."""
    slow = {"acquisition.frame_interval_s": 0.05, "acquisition.n_frames": 100}
    traces, fit = fitted_to(bleaching(0.2, **slow), bleaching(0.0, **slow), seed=9)
    [effect] = fit.model.effects[:1]
    assert effect.kind == "photobleaching" and effect.rate_per_s == fit.values["photobleaching.rate_per_s"]
    assert effect.rate_per_s == pytest.approx(0.2, rel=3 * 0.13)
    ends = Ends.of(traces)
    assert ends.events / ends.frames / 0.05 == pytest.approx(0.2, rel=3 * 0.09)


@pytest.mark.parametrize("dark_rate", [1.0, 0.3])
def test_dark_at_the_end_is_not_bleached(dark_rate):
    """Molecules that blink and never bleach, by the very model: at the end many are dark, as many as simulated ones.
    The converter is too coarse for its noise (Blinking), and reads 16 background photons of 20 in both: set to what is
    read, background was 0.82 of what it is, and brightness 1.4 and 1.8 in two such movies."""
    model = nm.preset("Blinking").with_values(
        {
            "acquisition.shape_px": (100, 100), "acquisition.n_frames": 150, "sample.n_molecules": 50,
            "sample.min_distance_px": 10, "fluorophore.cycles_before_bleaching": None,
            "fluorophore.triplet_decay_rate_per_s": dark_rate,
        }
    )  # fmt: skip
    found = compare_movie(nm.simulate(model, seed=5).movie, model, seed=2, n_bootstrap=2)
    assert (found.samples["measured"].dynamics.bleaching_frame >= 0).mean() > 0.2
    values, ends = found.fit.values, Ends.of(found.measured)
    told = ends.events / ends.frames / model.acquisition.interval_s
    assert values["photobleaching.rate_per_s"] < 0.2 * told  # of 15 or 40 molecules: beyond one error, seldom
    assert values["optics.background_photons_per_px"] == pytest.approx(20, rel=0.02)
    assert found.w1["fitted"] < max(1.5 * found.w1["mufasa"], found.w1["floor"])


def test_a_bleaching_that_no_molecule_tells_is_the_model_s():
    """Three of 40 that bleach tell the rate, two its limit, and traces that never shine tell nothing. Of 400 simulated
    ones as many bleach as the model says, at even chances."""
    model = nm.Model.from_dict(generator.base_model("cmos")).with_values({"acquisition.n_frames": 50})
    believed = model.with_effects(effect_class("photobleaching")(rate_per_s=0.9))
    frame_s = model.acquisition.interval_s
    rng = np.random.default_rng(0)
    traces = rng.normal(90, 15, (40, 50))

    def shown(candidate):
        rate = sum(effect.rate_per_s for effect in candidate.effects if effect.kind == "photobleaching")
        ends = -np.log((np.arange(400) + 0.5) / 400) / max(rate * frame_s, 1e-9)
        return rng.normal(90 * (np.arange(50) + 0.5 < ends[:, None]), 15)

    for bleached in (3, 2):
        some = traces.copy()
        some[:bleached, 25:] -= 90
        fit = fit_model(some, believed, shown)
        ends = Ends.of(some)
        assert ends == Ends(40, bleached, (40 - bleached) * 47.5 + bleached * 22.5)  # 3 frames it takes to be seen
        rate, told = fit.values["photobleaching.rate_per_s"], ends.events / ends.frames / frame_s
        assert rate == pytest.approx(told, rel=1.7 / np.sqrt(bleached))  # nothing moves within one error
        assert len(fit.notes) == (bleached < 3)
    # Rates at which two or fewer are seen once in 40 times in the time watched: 7.22 of them are expected.
    assert f"up to {7.22 / (38 * 47.5 + 2 * 22.5) / frame_s:.3g} 1/s" in fit.notes[0]
    dark = fit_model(np.random.default_rng(1).normal(0, 15, (40, 50)), believed, shown)
    assert "photobleaching.rate_per_s" not in dark.values
    assert [e for e in dark.model.effects if e.kind == "photobleaching"] == list(believed.effects)
    assert "no molecule tells" in dark.notes[0]
