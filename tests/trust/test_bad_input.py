"""Bad input at every door: one clear line that says what and what to do, exit code 2, nothing left behind.

One case is one row of a table. Those of the command line run as a user's command would; those of Python call the public
functions. `test_there_are_enough_cases` counts them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from tests.trust import broken_files
from tests.trust.broken_files import DARK_MOVIES, MODELS, MOVIES, SHAPE, TRACES, tiff
from tests.trust.refusal import BAD_STACKS, GOOD, MODEL, OBJECTS, PLAIN, SPOILT, check_line, not_none, refused

import napari_mufasa as nm
from napari_mufasa import files
from napari_mufasa.cli import main
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import get_reader, read_layers, write_image
from napari_mufasa.files.traces import read_trace_file, write_trace_file
from napari_mufasa.model.model import Model
from napari_mufasa.simulate.layout import read_positions


# files at the command line ---------------------------------------------------------------------------------
@pytest.mark.parametrize("case", MOVIES)
def test_a_movie_file(case, capfd, place):
    make, word = MOVIES[case]
    refused(capfd, place, word, "denoise", make(place / "in"), "--model", "good/model.json", "--out", "out/d.tif")


@pytest.mark.parametrize("case", [*MOVIES, *DARK_MOVIES])
def test_a_movie_file_for_traces(case, capfd, place):
    make, word = (MOVIES | DARK_MOVIES)[case]
    refused(capfd, place, word, "traces", make(place / "in"), "--model", "good/model.json", "--out", "out/t")


@pytest.mark.parametrize("case", MODELS)
def test_a_model_file(case, capfd, place):
    make, word = MODELS[case]
    refused(capfd, place, word, "simulate", "--model", make(place / "in"), "--out", "out/m.tif")


@pytest.mark.parametrize("case", TRACES)
def test_a_file_of_traces(case, capfd, place):
    make, word = TRACES[case]
    refused(
        capfd, place, word, "compare", "--traces", make(place / "in"), "--model", "good/model.json", "--out", "out/c"
    )


# values of a model -----------------------------------------------------------------------------------------
BAD_VALUES: dict[str, tuple[str, Any]] = {
    "quantum efficiency in percent": ("camera.quantum_efficiency", 90),
    "text for a number": ("camera.quantum_efficiency", "0.9"),
    "no gain": ("camera.em_gain", None),
    "gain below one": ("camera.em_gain", 0.5),
    "no electrons per count": ("camera.electrons_per_adu", 0),
    "unknown camera": ("camera.type", "emccd"),
    "18-bit camera": ("camera.adc_max", 2**18),
    "baseline above the largest count": ("camera.baseline_adu", 70_000),
    "map of another shape": ("camera.offset_map_adu", [[1, 2], [3, 4]]),
    "map of words": ("camera.offset_map_adu", [["a"]]),
    "map of objects": ("camera.gain_map", {"a": 1}),
    "map of huge integers": ("camera.gain_map", [[10**400]]),
    "map that is no TIFF": ("camera.offset_map_adu", "/etc/hostname"),
    "map that is missing": ("camera.offset_map_adu", "nowhere.tif"),
    "curve that falls": ("camera.cmos_gain_curve", [[0, 0], [1, -1]]),
    "curve of nothing": ("camera.cmos_gain_curve", []),
    "no frame": ("acquisition.n_frames", 0),
    "part of a frame": ("acquisition.n_frames", 2.5),
    "yes for a number": ("acquisition.n_frames", True),
    "huge integer": ("acquisition.n_frames", 10**30),
    "no pixel": ("acquisition.shape_px", [0, 5]),
    "one side": ("acquisition.shape_px", [96]),
    "three sides": ("acquisition.shape_px", [9, 9, 9]),
    "words for a shape": ("acquisition.shape_px", "ab"),
    "time backwards": ("acquisition.frame_length_s", -0.01),
    "a list for a part": ("acquisition", [1]),
    "effects that are one": ("effects", {"kind": "stage_drift"}),
    "effect without kind": ("effects", [{"distance_px": 1}]),
    "effect of an unknown kind": ("effects", [{"kind": "stage_drft"}]),
    "effect with an unknown key": ("effects", [{"kind": "stage_drift", "bogus": 1}]),
    "effect twice": ("effects", [{"kind": "stage_drift"}] * 2),
    "wavelength in metres": ("excitation.wavelength_nm", 6.47e-7),
    "lifetime in ns": ("fluorophore.lifetime_s", 2.0),
    "quantum yield in percent": ("fluorophore.quantum_yield", 60),
    "negative power": ("excitation.power_density_w_per_cm2", -3),
    "no PSF": ("optics.psf_fwhm_nm", 0),
    "collection in percent": ("optics.collection_efficiency", 80),
    "unknown key": ("optics.psf_width_nm", 300),
    "unknown part": ("bogus", 1),
    "unknown protocol": ("protocol", "XX"),
    "fewer than no molecules": ("sample.n_molecules", -1),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_VALUES)
def test_a_value_of_a_model(case, capfd, place):
    path, value = BAD_VALUES[case]
    data = json.loads(json.dumps(PLAIN))
    *parents, name = path.split(".")
    target = data
    for parent in parents:
        target = target[parent]
    target[name] = value
    (place / "in/model.json").write_text(json.dumps(data))
    word = name if name != "cmos_gain_curve" else "cmos"
    refused(capfd, place, word, "simulate", "--model", "in/model.json", "--out", "out/m.tif")


# what is asked for -----------------------------------------------------------------------------------------
BAD_COMMANDS: dict[str, tuple[str, str]] = {
    "unknown verb": ("simulat", "no such command"),
    "unknown option": ("simulate --colour red", "no such option"),
    "option without its value": ("simulate --preset", "requires an argument"),
    "neither preset nor model": ("simulate --out out/m.tif", "--preset"),
    "unknown preset": ("simulate --preset FFF --out out/m.tif", "choose one of PALM"),
    "words for frames": ("simulate --preset FF --frames ten --out out/m.tif", "--frames"),
    "no frame": ("simulate --preset FF --frames 0 --out out/m.tif", "--frames"),
    "a negative seed": ("simulate --preset FF --seed -1 --out out/m.tif", "--seed"),
    "an absurd field": ("simulate --preset FF --shape 65536 65536 --frames 10000000 --out out/m.tif", "free"),
    "absurdly many molecules": (
        "simulate --preset FF --n-molecules 10000000 --frames 9999 --out out/m.tif", "of memory",
    ),
    "too many molecules": (
        "simulate --model good/model.json --n-molecules 9000 --effect multiple_emitters:fraction=7 --out out/m.tif",
        "fraction",
    ),
    "an unknown engine": ("simulate --preset FF --engine steam --out out/m.tif", "steam"),
    "an unknown effect": ("simulate --preset FF --effect stage_drft --out out/m.tif", "stage_drift"),
    "an impossible effect": ("simulate --preset FF --effect stage_drift:distance_px=-1 --out out/m.tif", "≥ 0"),
    "an effect of words": ("simulate --preset FF --effect stage_drift:distance_px=far --out out/m.tif", "distance_px"),
    "an effect without value": ("simulate --preset FF --effect row_noise:2 --out out/m.tif", "NAME=VALUE"),
    "no folder": ("simulate --preset FF --out out/none/m.tif", "no folder"),
    "no movie's suffix": ("simulate --preset FF --out out/m.avi", "use .ome.tif"),
    "a file that is there": ("simulate --preset FF --out good/movie.tif", "--overwrite"),
    "a folder of other things": ("simulate --preset FF --out good", "use .ome.tif"),
    "positions that are missing": ("simulate --preset FF --positions none.csv --out out/m.tif", "no file"),
    "positions that are a TIFF": ("simulate --preset FF --positions good/movie.tif --out out/m.tif", "positions"),
    "positions and more molecules": (
        "simulate --preset FF --positions in/p.csv --n-molecules 9 --out out/m.tif", "--n-molecules"
    ),
    "the truth over the inputs": ("simulate --preset FF --truth good/model.json --out out/m.tif", "is a file"),
    "denoising over the movie": (
        "denoise good/movie.tif --model good/model.json --out good/movie.tif --overwrite", "is also read",
    ),
    "neither model nor dark": ("denoise good/movie.tif --out out/d.tif", "--dark"),
    "dark frames of another region": ("denoise good/movie.tif --dark in/other.tif --out out/d.tif", "dark"),
    "an unknown method": ("denoise good/movie.tif --model good/model.json --method magic --out out/d.tif", "magic"),
    "dark of another shape": (
        "traces good/movie.tif --model good/model.json --dark in/other.tif --out out/t", "dark has shape"
    ),
    "a window that is too long": (
        "traces good/movie.tif --model good/model.json --window 31 --out out/t", "window"
    ),
    "a share beyond all": (
        "traces good/movie.tif --model good/model.json --threshold percentile --threshold-value 120 --out out/t",
        "percentile",
    ),
    "traces over older ones": ("traces good/movie.tif --model good/model.json --out in", "--overwrite"),
    "out is a file": ("traces good/movie.tif --model good/model.json --out good/model.json", "is a file"),
    "out is below a file": ("traces good/movie.tif --model good/model.json --out good/model.json/t", "is a file"),
    "movie and traces": ("compare good/movie.tif --traces in/traces.csv --model good/model.json --out out/c", "either"),
    "neither movie nor traces": ("compare --model good/model.json --out out/c", "either"),
    "unit of a movie": ("compare good/movie.tif --unit adu --model good/model.json --out out/c", "--traces"),
    "dark of traces": (
        "compare --traces in/traces.csv --dark good/dark.tif --model good/model.json --out out/c", "dark",
    ),
    "an unknown unit": ("compare --traces in/traces.csv --unit lux --model good/model.json --out out/c", "lux"),
    "calibrating without light": ("calibrate in/dark.tif --out out/camera.json", "give"),
    "quantum efficiency in percent": (
        "calibrate good/movie.tif --quantum-efficiency 90 --out out/camera.json", "--quantum-efficiency"
    ),
    "calibrating over the movie": ("calibrate good/movie.tif --out good/movie.tif --overwrite", "is also read"),
    "calibrating one frame": ("calibrate in/one.tif --out out/camera.json", "at least 4 frames"),
    "a diagnosis over its model": (
        "diagnose good/movie.tif --model good/model.json --out good --overwrite", "is also read",
    ),
    "a truth over its positions": (
        "simulate --preset FF --positions in/positions.csv --truth in --overwrite --out out/m.tif", "is also read",
    ),
    "diagnosing one frame": ("diagnose in/one.tif --model good/model.json --out out/d", "1 frame:"),
    "diagnosing a narrow field": ("diagnose in/narrow.tif --model good/model.json --out out/d", "at least 24 × 24"),
    "counts beyond the camera": ("diagnose good/movie.tif --model in/eight.json --out out/d", "adc_max"),
    "dark frames too few": (
        "diagnose good/movie.tif --model good/model.json --dark in/one.tif --out out/d", "too few"
    ),
    "diagnosing few traces": ("diagnose in/traces.csv --traces --model good/model.json --out out/d", "needs at least"),
    "unit without traces": ("diagnose good/movie.tif --unit adu --model good/model.json --out out/d", "--traces"),
    "adding what is unknown": ("refine good/movie.tif --model good/model.json --add magic --out out/d", "magic"),
    "adding nothing": ("refine good/movie.tif --model good/model.json --out out/d", "--add"),
    "adding what is there": ("refine good/movie.tif --model in/drift.json --add stage_drift --out out/d", "already"),
    "the power to see what is unknown": ("power --model good/model.json --effect magic", "magic"),
    "the power at no strength": ("power --model good/model.json --effect row_noise --strength much", "0.2,0.5,1"),
    "the power at what cannot be": (
        "power --model good/model.json --effect row_noise --strength=-1", "row_noise.rms_adu = -1"
    ),
    "the power over a file": ("power --model good/model.json --effect row_noise --out in/traces.csv", "--overwrite"),
    "a sweep of nothing": ("design --model good/model.json --vary power", "PATH=V1,V2"),
    "a sweep of what is not there": ("design --model good/model.json --vary camera.colour=1,2", "camera.colour"),
    "a sweep of what cannot be": (
        "design --model good/model.json --vary camera.quantum_efficiency=90", "quantum_efficiency"
    ),
    "a table that is there": ("design --model good/model.json --out in/traces.csv", "--overwrite"),
    "a demonstration over files": ("demo --out good", "--overwrite"),
    "an unknown preset to print": ("presets nothing", "choose one of"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_a_command(case, capfd, more):
    words, expected = BAD_COMMANDS[case]
    refused(capfd, more, expected, *words.split())


# Python ----------------------------------------------------------------------------------------------------
STACK_DOORS: dict[str, Callable[[Any], Any]] = {
    "denoise": lambda movie: nm.denoise(movie, MODEL.camera),
    "extract_traces": lambda movie: nm.extract_traces(movie, MODEL.camera),
    "compare_movie": lambda movie: nm.compare_movie(movie, MODEL),
    "diagnose": lambda movie: nm.diagnose(movie, MODEL),
    "refine": lambda movie: nm.refine(movie, MODEL, ["stage_drift"]),
    "Investigation": lambda movie: nm.Investigation(movie, MODEL),
    "calibrate": lambda movie: nm.calibrate(movie),
    "dark of extract_traces": lambda dark: nm.extract_traces(GOOD, MODEL.camera, not_none(dark)),
    "dark of diagnose": lambda dark: nm.diagnose(GOOD, MODEL, not_none(dark)),
    "dark of calibrate": lambda dark: nm.calibrate(GOOD, not_none(dark)),
}


@pytest.mark.parametrize("door", STACK_DOORS)
@pytest.mark.parametrize("case", BAD_STACKS)
def test_a_stack_from_python(case, door):
    value = BAD_STACKS[case]
    with pytest.raises(MufasaError) as told:
        STACK_DOORS[door](value)
    check_line(str(told.value), "")


@pytest.mark.parametrize("case", [*DARK_MOVIES])
@pytest.mark.parametrize("door", ["extract_traces", "compare_movie", "diagnose"])
def test_a_movie_that_shows_nothing_from_python(case, door, tmp_path):
    movie = files.load(DARK_MOVIES[case][0](tmp_path))
    with pytest.raises(MufasaError) as told:
        STACK_DOORS[door](movie)
    check_line(str(told.value), "")


TRACE_TABLE = np.random.default_rng(1).normal(100, 10, (40, 30))
BAD_CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "simulate: no model": (lambda: nm.simulate(None), "model is a NoneType"),
    "simulate: a dictionary": (lambda: nm.simulate(PLAIN), "model is a dict"),
    "simulate: a seed of words": (lambda: nm.simulate(MODEL, seed="one"), "seed"),
    "simulate: half a seed": (lambda: nm.simulate(MODEL, seed=1.5), "seed"),
    "simulate: a negative seed": (lambda: nm.simulate(MODEL, seed=-1), "seed"),
    "simulate: an unknown engine": (lambda: nm.simulate(MODEL, engine="steam"), "engine"),
    "simulate: no engine": (lambda: nm.simulate(MODEL, engine=None), "engine"),
    "simulate: no worker": (lambda: nm.simulate(MODEL, workers=0), "workers"),
    "simulate: positions of words": (lambda: nm.simulate(MODEL, [["a", "b"]]), "positions_px"),
    "simulate: positions of three": (lambda: nm.simulate(MODEL, [[1, 2, 3]]), "positions_px"),
    "simulate: positions nowhere": (lambda: nm.simulate(MODEL, [[np.nan, 1]]), "positions_px"),
    "simulate: positions of objects": (lambda: nm.simulate(MODEL, [[broken_files.Boom(), 1]]), "positions_px"),
    "simulate: an absurd movie": (
        lambda: nm.simulate(MODEL.with_values({"acquisition.n_frames": 10**7, "acquisition.shape_px": (60000, 60000)})),
        "of memory",
    ),
    "simulate: absurdly many molecules": (
        lambda: nm.simulate(MODEL.with_values({"sample.n_molecules": 10**7, "acquisition.n_frames": 10**5})),
        "of memory",
    ),
    "emission: fewer than none": (lambda: nm.simulate_emission(MODEL, -1), "n_molecules"),
    "emission: absurdly many": (lambda: nm.simulate_emission(MODEL, 10**12), "of memory"),
    "emission: half a molecule": (lambda: nm.simulate_emission(MODEL, 1.5), "n_molecules"),
    "dark: no frame": (lambda: nm.simulate_dark(MODEL, 0), "n_frames"),
    "dark: absurdly many": (lambda: nm.simulate_dark(MODEL, 10**12), "of memory"),
    "dark: words": (lambda: nm.simulate_dark(MODEL, "ten"), "n_frames"),
    "denoise: a model for a camera": (lambda: nm.denoise(GOOD, MODEL), "give model.camera"),
    "denoise: an unknown method": (lambda: nm.denoise(GOOD, MODEL.camera, method="magic"), "method"),
    "denoise: a method that is none": (lambda: nm.denoise(GOOD, MODEL.camera, method=None), "method"),
    "denoise: an output of another shape": (lambda: nm.denoise(GOOD, MODEL.camera, out=np.zeros(3)), "out"),
    "denoise: an output that is none": (lambda: nm.denoise(GOOD, MODEL.camera, out="file"), "out"),
    "denoise: maps of another region": (
        lambda: nm.denoise(GOOD[:, :16], MODEL.camera.model_copy(update={"offset_map_adu": np.zeros((32, 32))})),
        "offset_map_adu",
    ),
    "pure_let: words": (lambda: nm.pure_let("image"), "image"),
    "pure_let: nan": (lambda: nm.pure_let(SPOILT[3]), "finite"),
    "pure_let: objects": (lambda: nm.pure_let(OBJECTS[0]), "image"),
    "pure_let: alpha": (lambda: nm.pure_let(GOOD[0].astype(float), alpha=-1), "alpha"),
    "traces: no camera": (lambda: nm.extract_traces(GOOD, None), "give model.camera"),
    "traces: an unknown unit": (lambda: nm.extract_traces(GOOD, MODEL.camera, unit="lux"), "unit"),
    "traces: an unknown option": (lambda: nm.extract_traces(GOOD, MODEL.camera, windw=3), "windw"),
    "traces: half a window": (lambda: nm.extract_traces(GOOD, MODEL.camera, window=2.5), "window"),
    "traces: no best": (lambda: nm.extract_traces(GOOD, MODEL.camera, best=0), "best"),
    "traces: a profile": (lambda: nm.extract_traces(GOOD, MODEL.camera, profile="round"), "profile"),
    "traces: a threshold": (lambda: nm.extract_traces(GOOD, MODEL.camera, threshold="high"), "threshold"),
    "traces: a PSF of words": (lambda: nm.extract_traces(GOOD, MODEL.camera, psf_sigma_px="wide"), "psf_sigma_px"),
    "traces: no PSF": (lambda: nm.extract_traces(GOOD, MODEL.camera, psf_sigma_px=0.0), "psf_sigma_px"),
    "traces: a false alarm": (lambda: nm.extract_traces(GOOD, MODEL.camera, step_false_alarm=2), "step_false_alarm"),
    "traces: a border of words": (lambda: nm.extract_traces(GOOD, MODEL.camera, border_px="wide"), "border_px"),
    "traces: a region": (lambda: nm.extract_traces(GOOD, MODEL.camera, psf_sigma_px=1.3, roi=5), "roi"),
    "traces: a block": (lambda: nm.extract_traces(GOOD, MODEL.camera, time_block=0), "time_block"),
    "traces: positions": (lambda: nm.extract_traces(GOOD, MODEL.camera, positions_px=[1, 2, 3]), "positions_px"),
    "compare: no model": (lambda: nm.compare_movie(GOOD, None), "model is a NoneType"),
    "compare: a seed": (lambda: nm.compare_movie(GOOD, MODEL, seed=-1), "seed"),
    "compare: an unknown option": (lambda: nm.compare_movie(GOOD, MODEL, windw=3), "windw"),
    "compare: times": (lambda: nm.compare_movie(GOOD, MODEL, sofi_times="late"), "sofi_times"),
    "compare: no bootstrap": (lambda: nm.compare_movie(GOOD, MODEL, n_bootstrap=0), "n_bootstrap"),
    "compare traces: no model": (lambda: nm.compare_traces(TRACE_TABLE, PLAIN), "model is a dict"),
    "compare traces: three axes": (lambda: nm.compare_traces(GOOD, MODEL), "traces"),
    "compare traces: words": (lambda: nm.compare_traces([["a"]], MODEL), "traces"),
    "compare traces: objects": (lambda: nm.compare_traces(OBJECTS[0], MODEL), "traces"),
    "compare traces: nan": (lambda: nm.compare_traces(SPOILT[3], MODEL), "finite"),
    "compare traces: none": (lambda: nm.compare_traces(None, MODEL), "traces"),
    "compare traces: a unit": (lambda: nm.compare_traces(TRACE_TABLE, MODEL, unit="lux"), "unit"),
    "compare traces: a profile": (lambda: nm.compare_traces(TRACE_TABLE, MODEL, profile="round"), "profile"),
    "compare traces: a window": (lambda: nm.compare_traces(TRACE_TABLE, MODEL, window=99), "window"),
    "compare traces: half a window": (lambda: nm.compare_traces(TRACE_TABLE, MODEL, window=2.5), "window"),
    "compare traces: a share": (lambda: nm.compare_traces(TRACE_TABLE, MODEL, pixel_share=90), "pixel_share"),
    "wasserstein: complex": (lambda: nm.wasserstein(np.ones((2, 3), complex), np.ones((2, 3))), "measured traces"),
    "wasserstein: objects": (lambda: nm.wasserstein(OBJECTS[0], np.ones((2, 3))), "measured traces"),
    "wasserstein: empty": (lambda: nm.wasserstein(np.ones((0, 3)), np.ones((2, 3))), "measured traces"),
    "wasserstein: unequal": (lambda: nm.wasserstein(np.ones((2, 3)), np.ones((2, 4)), rows="traces"), "equal"),
    "wasserstein: rows": (lambda: nm.wasserstein(np.ones((2, 3)), np.ones((2, 3)), rows="columns"), "rows"),
    "diagnose: no model": (lambda: nm.diagnose(GOOD, None), "model is a NoneType"),
    "diagnose: a seed": (lambda: nm.diagnose(GOOD, MODEL, seed="one"), "seed"),
    "diagnose: an unknown effect": (lambda: nm.diagnose(GOOD, MODEL, effects=["stage_drft"]), "stage_drift"),
    "diagnose: an effect of numbers": (lambda: nm.diagnose(GOOD, MODEL, effects=[5]), "effects"),
    "diagnose: effects of a number": (lambda: nm.diagnose(GOOD, MODEL, effects=5), "effects"),
    "diagnose: half an effect": (lambda: nm.diagnose(GOOD, MODEL, max_effects=1.5), "max_effects"),
    "diagnose: few frames": (lambda: nm.diagnose(GOOD[:5], MODEL), "frames"),
    "diagnose: narrow": (lambda: nm.diagnose(GOOD[:, :9], MODEL), "at least 24 × 24"),
    "diagnose: beyond the camera": (lambda: nm.diagnose(GOOD, _with_adc(205)), "adc_max"),
    "diagnose: dark of another shape": (lambda: nm.diagnose(GOOD, MODEL, GOOD[:, :30]), "dark"),
    "diagnose traces: few": (lambda: nm.diagnose_traces(TRACE_TABLE[:2], MODEL), "needs at least"),
    "diagnose traces: three axes": (lambda: nm.diagnose_traces(GOOD, MODEL), "traces"),
    "diagnose traces: nan": (lambda: nm.diagnose_traces(SPOILT[3], MODEL), "finite"),
    "refine: nothing": (lambda: nm.refine(GOOD, MODEL, []), "add"),
    "refine: a number": (lambda: nm.refine(GOOD, MODEL, 5), "add"),
    "refine: an unknown effect": (lambda: nm.refine(GOOD, MODEL, ["magic"]), "magic"),
    "refine: what is there": (
        lambda: nm.refine(GOOD, MODEL.with_values({"effects": [{"kind": "stage_drift"}]}), ["stage_drift"]), "already",
    ),
    "calibrate: few frames": (lambda: nm.calibrate(GOOD[:2]), "at least 4"),
    "calibrate: quantum efficiency": (lambda: nm.calibrate(GOOD, GOOD, quantum_efficiency=90), "quantum_efficiency"),
    "calibrate: a camera": (lambda: nm.calibrate(GOOD, GOOD, camera_type="phone"), "camera_type"),
    "calibrate: no gain": (lambda: nm.calibrate(GOOD, GOOD, em_gain=0), "em_gain"),
    "calibrate: words": (lambda: nm.calibrate(GOOD, GOOD, baseline_adu="low"), "baseline_adu"),
    "calibrate: a constant movie": (lambda: nm.calibrate(np.full(SHAPE, 300, np.uint16), GOOD), "grow"),
    "design: no model": (lambda: nm.design(None), "model is a NoneType"),
    "design: an unknown path": (lambda: nm.design(MODEL, {"camera.colour": [1]}), "camera.colour"),
    "design: no value": (lambda: nm.design(MODEL, {"camera.em_gain": []}), "combinations"),
    "design: a single value": (lambda: nm.design(MODEL, {"camera.em_gain": 5}), "camera.em_gain"),
    "design: too many": (lambda: nm.design(MODEL, {"camera.em_gain": range(1, 5000)}), "combinations"),
    "predict: no model": (lambda: nm.predict(PLAIN), "model is a dict"),
    "preset: unknown": (lambda: nm.preset("FFF"), "choose one of"),
    "preset: a number": (lambda: nm.preset(5), "choose one of"),
    "preset: a list": (lambda: nm.preset(["FF"]), "choose one of"),
    "model: a list": (lambda: Model.from_dict([1]), "the model"),
    "model: empty": (lambda: Model.from_dict({}), "missing"),
    "model: a value that is not there": (lambda: MODEL.with_values({"camera.colour": 1}), "camera.colour"),
    "model: an effect that is none": (lambda: MODEL.with_effects("stage_drift"), "effect"),
    "write: other frames": (lambda: files.write_movie("m.tif", [GOOD[:3]], SHAPE, np.uint16), "give as many"),
    "write: other suffix": (lambda: files.write_movie("m.avi", [GOOD], SHAPE, np.uint16), "use .ome.tif"),
    "write: no folder": (lambda: files.write_movie("none/m.tif", [GOOD], SHAPE, np.uint16), "no folder"),
    "write: a colour layer": (lambda: write_image("m.tif", np.zeros((9, 9, 3)), {"rgb": True}), "another format"),
    "write: traces of three axes": (lambda: write_trace_file("t.csv", GOOD), "needs non-empty"),
    "write: traces of a unit": (lambda: write_trace_file("t.csv", TRACE_TABLE, "lux"), "unit"),
    "write: traces elsewhere": (lambda: write_trace_file("t.doc", TRACE_TABLE), "use .csv"),
    "read: positions": (lambda: read_positions("none.csv", 100.0), "no file"),
    "read: traces": (lambda: read_trace_file("none.csv"), "no file"),
    "read: layers": (lambda: read_layers("none.tif"), "no file"),
    "read: JSON": (lambda: files.read_json("none.json"), "no file"),
}  # fmt: skip


def _with_adc(most: int) -> Model:
    return MODEL.with_values({"camera.adc_max": most, "camera.baseline_adu": 100})


@pytest.mark.parametrize("case", BAD_CALLS)
def test_a_call_from_python(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, word = BAD_CALLS[case]
    with pytest.raises(MufasaError) as told:
        call()
    check_line(str(told.value), word)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("case", MOVIES)
def test_the_readers_of_the_viewer_leave_it_alone_or_tell(case, tmp_path):
    """napari asks every reader: what is not ours is someone else's, whatever is wrong with it."""
    path = MOVIES[case][0](tmp_path)
    if path.is_fifo():  # opening it would wait for a writer
        return
    assert get_reader(str(path)) is None or case in ("zarr, lost chunk", "zarr, flipped bit", "zarr, link out")
    assert get_reader([str(path), str(path)]) is None


def test_nothing_was_unpickled(tmp_path, monkeypatch):
    """The trap works: who unpickles makes a folder."""
    monkeypatch.chdir(tmp_path)
    import pickle

    pickle.loads(broken_files.PICKLE)
    assert os.listdir() == ["UNPICKLED"]


# what is odd, and taken ------------------------------------------------------------------------------------
def test_axes_of_length_one_are_dropped(tmp_path):
    path = tiff(tmp_path, GOOD[:, None, None], "m.ome.tif", ome=True, metadata={"axes": "TCZYX"})
    np.testing.assert_array_equal(files.load(path), GOOD)
    np.testing.assert_array_equal(np.asarray(files.read_movie(path).data[3:7]), GOOD[3:7])


def test_channels_alone_are_frames_with_a_note(tmp_path):
    path = tiff(tmp_path, GOOD, "m.ome.tif", ome=True, metadata={"axes": "CYX"})
    with pytest.warns(UserWarning, match="30 channels"):
        np.testing.assert_array_equal(files.load(path), GOOD)


def test_a_single_frame_is_a_movie():
    frame = nm.simulate(MODEL, [[10.0, 12.0], [20.0, 22.0]], seed=1).movie[:1]
    assert nm.denoise(frame, MODEL.camera).shape == frame.shape == nm.denoise(frame[0], MODEL.camera).shape
    assert nm.extract_traces(frame, MODEL.camera, psf_sigma_px=1.3).all_traces.shape[1] == 1


def test_a_saturated_movie_is_denoised():
    photons = nm.denoise(np.full(SHAPE, 65535, np.uint16), MODEL.camera)
    assert np.isfinite(photons).all()


def test_a_model_and_a_movie_that_disagree_are_noted(capfd, place):
    """The movie's shape counts: told once, on stderr, as what else speaks against the model."""
    MODEL.with_values({"acquisition.n_frames": 300}).to_json(place / "in/long.json")
    words = "denoise good/movie.tif --model in/long.json --method none --out out/d.tif"
    with pytest.raises(SystemExit) as left:
        main(words.split())
    err = capfd.readouterr().err
    assert not left.value.code and err.count("the movie has 30 frames") == 1 and "the model says 300" in err
    assert all(line.startswith("napari-mufasa: note: ") for line in err.splitlines())


def test_there_are_enough_cases():
    of_commands = len(MOVIES) * 2 + len(DARK_MOVIES) + len(MODELS) + len(TRACES) + len(BAD_VALUES) + len(BAD_COMMANDS)
    of_python = len(BAD_STACKS) * len(STACK_DOORS) + 3 * len(DARK_MOVIES) + len(BAD_CALLS)
    assert of_commands >= 120 and of_python >= 120
