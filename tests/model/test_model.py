"""The model: JSON in and out, presets, and errors that name field, value, range and remedy (docs/model.md)."""

import json

import numpy as np
import pytest
import tifffile
from tests.spec_example import MODEL

from napari_mufasa import Model, MufasaError, preset
from napari_mufasa.effects import catalogue
from napari_mufasa.model.setup import Camera

EXAMPLE = MODEL | {"effects": [{"kind": "stage_drift", "distance_px": 2.0}]}


def changed(path, value):
    data = json.loads(json.dumps(EXAMPLE))
    *parents, name = path.split(".")
    target = data
    for parent in parents:
        target = target[int(parent)] if parent.isdecimal() else target[parent]
    target[name] = value
    return data


def complaint(data):
    with pytest.raises(MufasaError) as caught:
        Model.from_dict(data)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 1000
    return message


def test_the_example_of_the_contract_is_a_model():
    model = Model.from_dict(EXAMPLE)
    data = model.to_dict()
    for group, values in EXAMPLE.items():
        if isinstance(values, dict):
            assert {key: data[group][key] for key in values} == values
    assert data["effects"][0]["kind"] == "stage_drift" and data["effects"][0]["distance_px"] == 2.0


@pytest.mark.parametrize("name", ["PALM", "STORM", "FF", "Blinking", "EGFP", "Alexa647-STORM"])
def test_presets_survive_json(tmp_path, name):
    model = preset(name)
    model.to_json(tmp_path / "model.json")
    assert Model.from_json(tmp_path / "model.json") == model


@pytest.mark.parametrize("kind", sorted(catalogue()))
def test_every_effect_survives_json(tmp_path, kind):
    model = preset("FF").with_effects(catalogue()[kind]())
    model.to_json(tmp_path / "model.json")
    back = Model.from_json(tmp_path / "model.json")
    assert back == model and back.effects[0].kind == kind
    assert model.effects[0].model_dump()["kind"] == kind


def test_camera_maps_survive_json_and_come_from_tiff(tmp_path):
    gain = np.linspace(0.9, 1.1, 96 * 96).reshape(96, 96)
    tifffile.imwrite(tmp_path / "gain.tif", gain.astype(np.float32))
    model = Model.from_dict(changed("camera.gain_map", str(tmp_path / "gain.tif")))
    np.testing.assert_allclose(model.camera.gain_map, gain, rtol=1e-6)
    model.to_json(tmp_path / "model.json")
    np.testing.assert_array_equal(Model.from_json(tmp_path / "model.json").camera.gain_map, model.camera.gain_map)


def test_presets_equal_the_tables():
    rows = {
        # camera, read noise, e/ADU, FWHM, frames, power, activation, N_c, α_nr, α_isc
        "PALM": ("CCD", 70.58, 10.04, 1200, 500, 5, 1, 5e5, 10, 1e-2),
        "STORM": ("CCD", 70.58, 100.04, 1200, 500, 7, None, 5e5, 2, 5e-4),
        "FF": ("EMCCD", 60.58, 0.74, 308, 100, 2, None, 5e3, 1, 1e-5),
        "Blinking": ("CMOS", 1.58, 20.74, 308, 100, 3, None, 1e3, 3, 5e-4),
    }
    for name, row in rows.items():
        m = preset(name)
        assert m.protocol == name
        found = (
            m.camera.type, m.camera.read_noise_e, m.camera.electrons_per_adu, m.optics.psf_fwhm_nm,
            m.acquisition.n_frames, m.excitation.power_density_w_per_cm2, m.excitation.activation_rate_per_s,
            m.fluorophore.cycles_before_bleaching, m.fluorophore.triplet_decay_rate_per_s, m.fluorophore.isc_ratio,
        )  # fmt: skip
        assert found == row
        assert m.acquisition.frame_length_s == 0.01 and m.acquisition.pixel_size_nm == 100
        assert m.excitation.wavelength_nm == 647 and m.fluorophore.extinction_coefficient_per_M_cm == 270_000
        assert m.fluorophore.lifetime_s == 2e-9 and m.optics.background_photons_per_px == 20
        assert (m.camera.quantum_efficiency, m.camera.clock_induced_charge_e) == (0.9, 0.002)
        assert (m.camera.baseline_adu, m.camera.adc_max) == (367, 65535)
    assert preset("FF").camera.em_gain == 500


def test_presets_of_tables_4_and_5():
    egfp, alexa = preset("EGFP"), preset("Alexa647-STORM")
    assert egfp.excitation.wavelength_nm == 488 and egfp.fluorophore.quantum_yield == 0.6
    assert egfp.fluorophore.extinction_coefficient_per_M_cm == 55_900 and egfp.fluorophore.lifetime_s == 2.6e-9
    assert (egfp.acquisition.shape_px, egfp.acquisition.n_frames, egfp.camera.type) == ((512, 512), 250, "EMCCD")
    assert alexa.excitation.wavelength_nm == 641 and alexa.excitation.power_density_w_per_cm2 == 1000
    assert (alexa.acquisition.n_frames, alexa.acquisition.frame_length_s) == (2000, 0.036)
    dye = alexa.fluorophore
    assert (dye.extinction_coefficient_per_M_cm, dye.lifetime_s, dye.isc_ratio) == (239_000, 1e-9, 1.6e-3)
    assert (dye.triplet_decay_rate_per_s, dye.cycles_before_bleaching) == (0.1, 1e9)
    assert alexa.camera.type == "CCD" and alexa.acquisition.pixel_size_nm == 100


def test_psf_width_in_pixels():
    assert preset("FF").sigma_px == pytest.approx(308 / 2.354820045 / 100)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        # unknown keys: the key, the nearest, the known ones
        ("optics.psf_fwhm", 300, ["unknown key optics.psf_fwhm", "did you mean psf_fwhm_nm?", "collection_efficiency"]),
        ("camra", {}, ["unknown key camra", "did you mean camera?"]),
        ("effects.0.distance", 1, ["unknown key effects.0.distance", "did you mean distance_px?", "direction_deg"]),
        # out of range: field, value, range
        ("camera.quantum_efficiency", 1.2, ["camera.quantum_efficiency = 1.2", "≤ 1", "photoelectrons per photon"]),
        ("fluorophore.lifetime_s", -1, ["fluorophore.lifetime_s = -1", "> 0", "in s"]),
        ("acquisition.n_frames", 0, ["acquisition.n_frames = 0", "≥ 1"]),
        ("acquisition.shape_px", [0, 96], ["acquisition.shape_px.0 = 0", "greater than or equal to 1"]),
        ("effects.0.distance_px", -1, ["effects.0.distance_px = -1", "≥ 0", "px"]),
        # wrong type
        ("optics.psf_fwhm_nm", "wide", ["optics.psf_fwhm_nm = 'wide'", "a number, without quotes", "nm"]),
        ("acquisition.n_frames", 2.5, ["acquisition.n_frames = 2.5", "integer"]),
        ("camera", 5, ["camera = 5", "Camera"]),
        ("effects", 5, ["effects = 5"]),
        ("effects", [7], ["effects.0", '{"kind"', "7"]),
        ("effects", [{"distance_px": 1}], ["effects.0", '{"kind"']),
        # not a number
        ("optics.psf_fwhm_nm", float("nan"), ["optics.psf_fwhm_nm = nan", "finite"]),
        ("camera.read_noise_mean_e", float("inf"), ["camera.read_noise_mean_e = inf", "finite"]),
        ("effects.0.distance_px", float("nan"), ["effects.0.distance_px = nan"]),
        ("camera.gain_map", [[1.0, float("nan")]], ["camera.gain_map", "finite"]),
        # choices keep their capitals
        ("protocol", "palm", ["protocol = 'palm'", "'PALM'", "'Blinking'"]),
        ("camera.type", "sCMOS", ["camera.type = 'sCMOS'", "'CMOS'"]),
        ("effects.0.form", "round", ["effects.0.form = 'round'", "'wandering'"]),
        ("effects.0.kind", "stage_drifts", ["effects.0", "did you mean stage_drift?", "cosmic_rays"]),
        # what does not fit together
        ("camera.em_gain", None, ["em_gain is missing", "EMCCD"]),
        ("camera.type", "CCD", ["em_gain = 300", "only an EMCCD", "null"]),
        ("acquisition.frame_interval_s", 0.001, ["frame_interval_s = 0.001", "frame_length_s = 0.02"]),
        ("camera.gain_map", [[1.0, 1.0]], ["camera.gain_map", "(1, 2)", "(96, 96)"]),
        ("camera.gain_map", "nowhere.tif", ["camera.gain_map", "nowhere.tif", "TIFF"]),
        ("camera.variance_map_e2", [[-1.0]], ["variance_map_e2", "negative"]),
        ("camera.cmos_gain_curve", [[0, 0], [1000, 500], [1000.5, 340]], ["cmos_gain_curve", "no inverse"]),
        ("camera.gain_map", np.zeros((96, 96)).tolist(), ["gain_map must be positive"]),
    ],
)  # fmt: skip
def test_errors_name_field_value_range_and_remedy(path, value, words):
    message = complaint(changed(path, value))
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("optics.psf_fwhm_nm", ["optics.psf_fwhm_nm is missing", "nm", "> 0"]),
        ("fluorophore", ["fluorophore is missing", "lifetime_s"]),
        ("protocol", ["protocol is missing"]),
    ],
)
def test_missing_values_are_named(path, words):
    data = changed(path, None)
    *parents, name = path.split(".")
    del (data[parents[0]] if parents else data)[name]
    message = complaint(data)
    for word in words:
        assert word in message


def test_several_problems_are_counted():
    data = changed("optics.psf_fwhm_nm", -1)
    data["acquisition"]["n_frames"] = 0
    assert "(and 1 more)" in complaint(data)


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", '{"protocol": "FF"}', "\xff\x00"])
def test_a_bad_model_file_is_one_line_that_names_it(tmp_path, content):
    path = tmp_path / "model.json"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(MufasaError, match=r"model\.json") as caught:
        Model.from_json(path)
    assert "\n" not in str(caught.value)


def test_a_missing_model_file(tmp_path):
    with pytest.raises(MufasaError, match="no file"):
        Model.from_json(tmp_path / "nowhere.json")
    with pytest.raises(MufasaError, match="not readable"):
        Model.from_json(tmp_path)


def test_unknown_preset_lists_the_known():
    with pytest.raises(MufasaError, match=r"'GFP'.*PALM, STORM, FF, Blinking, EGFP, Alexa647-STORM"):
        preset("GFP")


def test_values_by_name():
    model = Model.from_dict(EXAMPLE)
    other = model.with_values({"optics.psf_fwhm_nm": 320, "effects.0.distance_px": 3.5})
    assert (other.optics.psf_fwhm_nm, other.effects[0].distance_px) == (320, 3.5)
    assert model.optics.psf_fwhm_nm == 300 and model.effects[0].distance_px == 2.0
    assert other.with_values({}) == other
    for path in ("optics.fwhm", "lens.fwhm", "effects.4.distance_px", "protocol.name", "effects.x.y", "nothing"):
        with pytest.raises(MufasaError, match=f"no {path}"):
            model.with_values({path: 1})
    with pytest.raises(MufasaError, match=r"optics\.psf_fwhm_nm = -3"):
        model.with_values({"optics.psf_fwhm_nm": -3})


def test_an_effect_of_a_kind_already_there_is_replaced():
    stage_drift, lag = catalogue()["stage_drift"], catalogue()["image_lag"]
    model = preset("FF").with_effects(stage_drift(), lag()).with_effects(stage_drift(distance_px=4.0))
    assert [(e.kind) for e in model.effects] == ["image_lag", "stage_drift"]
    assert model.effects[1].distance_px == 4.0


def test_models_do_not_change():
    with pytest.raises(ValueError, match="frozen"):
        preset("FF").optics.psf_fwhm_nm = 1
    with pytest.raises(ValueError, match="frozen"):
        catalogue()["stage_drift"]().distance_px = 1


def test_a_camera_alone_is_checked_too():
    with pytest.raises(ValueError, match="quantum_efficiency"):
        Camera(type="CCD", quantum_efficiency=0, read_noise_e=1, electrons_per_adu=1, baseline_adu=0)


def test_two_effects_of_a_kind_are_refused():
    with pytest.raises(MufasaError, match=r"effects.1: row_noise is in the model already"):
        preset("FF").with_values({"effects": [{"kind": "row_noise"}, {"kind": "row_noise", "rms_adu": 3.0}]})


def test_a_model_in_another_shape():
    height, width = preset("FF").acquisition.shape_px
    noise = np.arange(height * width, dtype=float).reshape(height, width)
    model = preset("Blinking").in_shape(shape_px=(height, width)).with_values({"camera.offset_map_adu": noise})
    part = model.in_shape(region=(slice(0, 7), slice(3, 9), slice(2, 12)))
    assert part.acquisition.n_frames == 7 and part.acquisition.shape_px == (6, 10)
    np.testing.assert_array_equal(part.camera.offset_map_adu, noise[3:9, 2:12])
    with pytest.raises(MufasaError, match="offset_map_adu"):
        model.in_shape(shape_px=(6, 10))
    assert model.in_shape(shape_px=(6, 10), maps=None).camera.offset_map_adu is None
    back = part.in_shape(n_frames=model.acquisition.n_frames, shape_px=(height, width), maps=model.camera)
    assert back == model and model.in_shape() == model


def test_a_key_given_twice_is_refused(tmp_path):
    text = json.dumps(preset("FF").to_dict())
    (tmp_path / "m.json").write_text(text.replace('"n_frames":', '"n_frames": 7, "n_frames":', 1))
    with pytest.raises(MufasaError, match="'n_frames' is given twice"):
        Model.from_json(tmp_path / "m.json")


def test_a_camera_alone_is_told_from_a_model(tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(preset("FF").to_dict()["camera"]))
    with pytest.raises(MufasaError, match='a camera alone, no model: put it under "camera"'):
        Model.from_json(tmp_path / "camera.json")
