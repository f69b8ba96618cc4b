"""The contract of effects (docs/effects.md, docs/model.md): identifiers, data, null strength, forms, third parties."""

import importlib.metadata
from itertools import combinations
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from pydantic import ValidationError

from napari_mufasa import Effect, Model, MufasaError, simulate, simulate_dark, simulate_emission
from napari_mufasa.effects import catalogue, effect_from_data
from napari_mufasa.model.effect import STAGES, parameter

from .helpers import ccd, cmos, effect, plain

CONTRACT = {
    "photophysics": "triplet_blinking long_dark_state photobleaching delayed_activation brightness_heterogeneity "
    "multiple_emitters level_switching dim_population dim_companions brightness_wander",
    "illumination": "illumination_profile laser_drift laser_flicker periodic_modulation",
    "sample motion": "stage_drift focus_drift molecule_diffusion binding directed_motion",
    "optics and background": "astigmatism background_gradient background_decay background_as_measured psf_halo",
    "camera": "em_excess_noise clock_induced_charge pixel_gain_variation column_offset row_noise hot_pixels "
    "detector_saturation image_lag baseline_drift cosmic_rays serial_readout frame_baseline converter_codes",
}
NEW = {
    "level_switching", "dim_population", "dim_companions", "brightness_wander", "binding", "directed_motion",
    "background_as_measured", "psf_halo",
    "serial_readout", "frame_baseline", "converter_codes",
}  # fmt: skip
STRONG = {  # what it takes to be seen within a short movie: rare events, measurements
    "cosmic_rays": {"hits_per_frame": 2.0},
    "background_as_measured": {"map": (0.5, 1.0, 1.0, 1.5), "map_columns": 2, "course": (0.7, 1.3)},
}
KINDS = [kind for kinds in CONTRACT.values() for kind in kinds.split()]
FORMS = [(kind, form) for kind in KINDS for form in catalogue()[kind].forms()]


def with_form(kind, form, **values):
    return effect(kind, **values, **({"form": form} if form else {}))


def test_all_identifiers_are_there_in_order_and_in_their_stage():
    assert list(catalogue())[: len(KINDS)] == KINDS
    for stage, kinds in CONTRACT.items():
        for kind in kinds.split():
            assert catalogue()[kind].stage == stage and stage in STAGES
            assert catalogue()[kind].kind == kind


@pytest.mark.parametrize("kind", KINDS)
def test_an_effect_explains_itself(kind):
    cls = catalogue()[kind]
    for text in (cls.title, cls.what_it_is, cls.what_it_does, cls.how_to_check, cls.separated_by):
        assert len(text) > 8
    assert cls.observables and all(isinstance(o, str) and o for o in cls.observables)
    assert set(cls.rivals) <= set(KINDS) and kind not in cls.rivals
    assert cls.model_fields[cls.strength].description
    for name, (low, high, log) in cls.plausible().items():
        assert low < high and (low > 0 or not log)
        default = cls.model_fields[name].default
        assert low <= default <= high, name
        cls(**{name: low}), cls(**{name: high})  # the hard limits hold the plausible range
    assert cls.strength in cls.plausible()


@pytest.mark.parametrize("kind", KINDS)
def test_a_diagnosis_looks_for_the_new_ones_only_when_asked(kind):
    assert catalogue()[kind].common_in(plain()) == (kind not in NEW)


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_carry_units_in_names_or_are_relative(kind):
    cls = catalogue()[kind]
    for name in cls.plausible():
        unit = cls.unit(name)
        for symbol, ending in (("ADU", "_adu"), ("px", "_px"), ("1/s", "_per_s"), ("s", "_s"), ("deg", "_deg")):
            if unit == symbol:
                assert name.endswith(ending)


@pytest.mark.parametrize(("kind", "form"), FORMS)
def test_null_strength_is_the_base_model(kind, form):
    """Exactly: the same emission, optical image and movie, bit by bit."""
    cls = catalogue()[kind]
    base = simulate(plain(), seed=1)
    null = simulate(
        plain().with_effects(with_form(kind, form, **STRONG.get(kind, {}) | {cls.strength: cls.none_at(plain())})),
        seed=1,
    )
    np.testing.assert_array_equal(null.emission, base.emission)
    if kind in NEW:
        np.testing.assert_array_equal(null.optical, base.optical)
        np.testing.assert_array_equal(null.movie, base.movie)
    np.testing.assert_allclose(null.optical, base.optical, rtol=1e-6)
    assert np.mean(null.movie != base.movie) < 1e-3  # rounding of the light by 1e-7 may move a count


@pytest.mark.parametrize(("kind", "form"), FORMS)
def test_every_form_runs_and_does_something(kind, form):
    model = plain(frame_length_s=0.1)  # 4 s: rare events happen
    base = simulate(model, seed=1)
    changed = simulate(model.with_effects(with_form(kind, form, **STRONG.get(kind, {}))), seed=1)
    assert changed.movie.shape == base.movie.shape
    assert np.any(changed.movie != base.movie)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("protocol", ["PALM", "STORM", "Blinking"])
def test_every_effect_runs_on_every_protocol_and_in_one_frame(kind, protocol):
    values = {"protocol": protocol, "fluorophore.isc_ratio": 1e-3, "fluorophore.triplet_decay_rate_per_s": 10.0}
    values |= {"excitation.activation_rate_per_s": 20.0, "fluorophore.cycles_before_bleaching": 5000}
    model = plain(n_frames=1, shape=(16, 16), **values).with_effects(effect(kind))
    assert simulate(model, seed=1).movie.shape == (1, 16, 16)


@pytest.mark.parametrize(
    ("kind", "camera"), [(k, c) for k in sorted(NEW) for c in (plain, ccd, cmos) if catalogue()[k].suits(c())]
)
def test_new_effects_run_with_both_engines_in_blocks_and_in_the_dark(kind, camera, monkeypatch):
    base = camera(**{"acquisition.n_frames": 6, "acquisition.frame_length_s": 1e-3, "acquisition.shape_px": [16, 16]})
    model = Model.from_dict(base.with_effects(effect(kind, **STRONG.get(kind, {}))).to_dict())
    for engine in ("fast", "exact"):
        whole = simulate(model, seed=1, engine=engine)
        assert whole.movie.shape == (6, 16, 16) and len(whole.emission) == len(whole.positions_px)
    assert simulate_dark(model, 3, seed=1).shape == (3, 16, 16)
    monkeypatch.setattr("napari_mufasa.simulate.movie.BLOCK_BYTES", 1)  # frame by frame, by two workers
    np.testing.assert_array_equal(simulate(model, seed=1, engine="exact", workers=2).movie, whole.movie)


def test_the_order_of_effects_that_add_or_follow_molecules_does_not_matter():
    chosen = [
        effect(k)
        for k in (
            "binding",
            "molecule_diffusion",
            "directed_motion",
            "dim_population",
            "dim_companions",
            "brightness_wander",
            "stage_drift",
        )
    ]
    one, two = (simulate(plain(n_frames=8).with_effects(*order), seed=2) for order in (chosen, chosen[::-1]))
    np.testing.assert_array_equal(one.movie, two.movie)


def test_all_effects_at_once_in_any_order():
    chosen = [effect(kind) for kind in KINDS]
    for order in (chosen, chosen[::-1]):
        result = simulate(plain(n_frames=8).with_effects(*order), seed=2)
        assert len(result.emission) == len(result.positions_px) >= 6


def test_effects_come_from_data():
    made = effect_from_data({"kind": "image_lag", "fraction": 0.2, "form": "decaying"})
    assert made == effect("image_lag", fraction=0.2, form="decaying")
    assert effect_from_data(made) is made
    with pytest.raises(ValueError, match=r"did you mean image_lag\?"):
        effect_from_data({"kind": "image_lags"})


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_parameters_are_refused(kind):
    cls = catalogue()[kind]
    with pytest.raises(ValidationError):
        cls(**{cls.strength: float("nan")})
    with pytest.raises(ValidationError):
        cls(**{cls.strength: "much"})
    with pytest.raises(ValidationError):
        cls(no_such_parameter=1)


def test_em_noise_suits_cameras_that_have_or_may_have_a_register():
    """A camera believed a CCD may have its register on; a diagnosis looks for that only when asked to."""
    em_noise = catalogue()["em_excess_noise"]
    models = {"EMCCD": plain(), "CCD": ccd(), "CMOS": cmos()}
    assert [em_noise.suits(models[c]) for c in ("EMCCD", "CCD", "CMOS")] == [True, True, False]
    assert [em_noise.common_in(models[c]) for c in ("EMCCD", "CCD", "CMOS")] == [True, False, False]
    assert [em_noise.none_at(models[c]) for c in ("EMCCD", "CCD")] == [2.0, 1.0]
    assert em_noise.plausible(ccd())["excess_noise_factor"][:2] == (1.0, 2.0)


class Dimming(Effect):
    """What a third party writes: one class."""

    kind: ClassVar[str] = "test_dimming"
    stage: ClassVar[str] = "illumination"
    strength: ClassVar[str] = "loss"
    title: ClassVar[str] = "Dimming"

    loss: float = parameter(0.5, ge=0, le=1, plausible=(0.1, 0.9), unit="", description="share of the light lost")

    def apply(self, scene, rng):
        scene.light = scene.light * (1 - self.loss)


@pytest.fixture
def installed(monkeypatch):
    """Install effects by the entry-point group, and forget them afterwards."""
    real = importlib.metadata.entry_points

    def install(**points):
        def load(value):
            if isinstance(value, Exception):
                raise value
            return value

        found = [SimpleNamespace(name=n, value=f"pkg:{n}", load=lambda v=v: load(v)) for n, v in points.items()]

        def entry_points(**selection):
            return found if selection.get("group") == "napari_mufasa.effects" else real(**selection)

        monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
        catalogue.cache_clear()

    yield install
    monkeypatch.undo()
    catalogue.cache_clear()


def test_a_third_party_adds_an_effect_by_one_class(installed, tmp_path):
    installed(dimming=Dimming)
    assert list(catalogue())[len(KINDS) :] == ["test_dimming"]
    data = plain().to_dict() | {"effects": [{"kind": "test_dimming", "loss": 0.75}]}
    model = Model.from_dict(data)
    model.to_json(tmp_path / "model.json")
    assert Model.from_json(tmp_path / "model.json").effects == (Dimming(loss=0.75),)
    counts = simulate_emission(model, 500, seed=1)
    assert counts.mean() == pytest.approx(67.25 / 4, abs=4 * np.sqrt(67.25 / 4 / counts.size))
    with pytest.raises(MufasaError, match=r"effects\.0\.loss = 2: .*≤ 1"):
        Model.from_dict(data | {"effects": [{"kind": "test_dimming", "loss": 2}]})


def test_a_broken_plugin_does_not_take_the_others_away(installed):
    installed(broken=ImportError("no module x"), wrong=dict, dimming=Dimming)
    with pytest.warns(UserWarning) as caught:
        kinds = list(catalogue())
    assert kinds == [*KINDS, "test_dimming"]
    assert ["broken" in str(w.message) for w in caught] == [True, False]
    assert "wrong (pkg:wrong) is not an Effect" in str(caught[1].message)


def test_a_plugin_cannot_replace_a_built_in_effect(installed):
    class Impostor(Dimming):
        kind = "stage_drift"

    installed(impostor=Impostor)
    assert catalogue()["stage_drift"] is not Impostor


def test_an_effect_without_apply_says_so():
    class Empty(Effect):
        kind = "empty"

    with pytest.raises(NotImplementedError, match="override apply"):
        simulate(plain(n_frames=1).with_effects(Empty()), seed=1)


def test_a_movie_does_not_depend_on_the_order_in_which_effects_are_listed():
    model = plain(n_frames=12, shape=(24, 24), **{"fluorophore.cycles_before_bleaching": 2e4})
    effects = [kind() for kind in catalogue().values() if kind.suits(model)]
    for two in combinations(effects, 2):
        one, other = (simulate(model.with_effects(*listed), seed=1).movie for listed in (two, two[::-1]))
        np.testing.assert_array_equal(one, other, err_msg=str([e.kind for e in two]))
