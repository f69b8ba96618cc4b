"""The same seed gives the same result: across threads, chunks, processes, and through the file."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import dask.array as da
import numpy as np
import pytest
from threadpoolctl import ThreadpoolController

import napari_mufasa as nm
from napari_mufasa.model.model import Model
from napari_mufasa.one_thread import one_thread
from napari_mufasa.simulate import movie as simulating

#: An effect of every stage, and those with chance of their own.
EFFECTS = [
    {"kind": "triplet_blinking"}, {"kind": "brightness_heterogeneity"}, {"kind": "laser_flicker"},
    {"kind": "stage_drift"}, {"kind": "molecule_diffusion"}, {"kind": "row_noise"}, {"kind": "hot_pixels"},
    {"kind": "image_lag"}, {"kind": "cosmic_rays"},
]  # fmt: skip
MODEL = nm.preset("FF").with_values(
    {
        "acquisition.shape_px": (40, 48), "acquisition.n_frames": 90, "sample.n_molecules": 12,
        "excitation.power_density_w_per_cm2": 30, "effects": EFFECTS,
    }
)  # fmt: skip


@pytest.fixture(scope="module")
def simulation():
    return nm.simulate(MODEL, seed=11)


@pytest.mark.parametrize("workers", [2, 3, 8])
def test_threads_change_nothing(workers, simulation):
    again = nm.simulate(MODEL, seed=11, workers=workers)
    np.testing.assert_array_equal(again.movie, simulation.movie)
    np.testing.assert_array_equal(again.optical, simulation.optical)


@pytest.mark.parametrize("frames", [1, 7, 1000])
def test_blocks_change_nothing(frames, simulation, monkeypatch):
    monkeypatch.setattr(simulating, "BLOCK_BYTES", 4 * 40 * 48 * frames)
    np.testing.assert_array_equal(nm.simulate(MODEL, seed=11).movie, simulation.movie)


def test_a_saved_and_loaded_model_gives_the_same_movie(simulation, tmp_path):
    MODEL.to_json(tmp_path / "model.json")
    again = nm.simulate(Model.from_json(tmp_path / "model.json"), seed=11)
    np.testing.assert_array_equal(again.movie, simulation.movie)
    np.testing.assert_array_equal(again.emission, simulation.emission)


def test_another_seed_gives_another_movie(simulation):
    assert not np.array_equal(nm.simulate(MODEL, seed=12).movie, simulation.movie)


#: What a process of its own finds: the movie, its photons, its traces, its distance, what is diagnosed of it.
FRESH = """
import hashlib, json, sys
import numpy as np
import napari_mufasa as nm
model = nm.Model.from_json(sys.argv[1])
plain = model.with_values({"effects": []})
movie = nm.simulate(model, seed=11, workers=int(sys.argv[2])).movie
photons = nm.denoise(movie, model.camera)
found = nm.extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px)
compared = nm.compare_movie(movie, plain, seed=3, fit=False, n_bootstrap=5)
report = nm.diagnose(movie, plain, seed=3, effects=["laser_flicker"], max_effects=1)
of = lambda array: hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
print(json.dumps([of(movie), of(photons), of(found.all_traces), compared.w1, report.verdict, report.error["before"]]))
"""


def test_processes_and_numbers_of_threads_agree(simulation, tmp_path):
    MODEL.to_json(tmp_path / "model.json")
    told = []
    for workers, threads in (("1", "1"), ("4", "2")):
        command = [sys.executable, "-c", FRESH, str(tmp_path / "model.json"), workers]
        limits = {"NUMBA_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, "PYTHONHASHSEED": workers}
        ran = subprocess.run(command, capture_output=True, text=True, env=os.environ | limits)
        assert ran.returncode == 0, ran.stderr[-2000:]
        told.append(json.loads(ran.stdout))
    assert told[0] == told[1]
    assert told[0][0] == hashlib.sha256(simulation.movie.tobytes()).hexdigest()


@pytest.fixture
def two_threads():
    """Linear algebra on two threads, whatever the machine has; set by a thread that ends: only one may hold it."""
    libraries = ThreadpoolController().select(user_api="blas")
    before = max(library["num_threads"] for library in libraries.info())

    def take(number):
        setter = threading.Thread(target=libraries.limit, kwargs={"limits": number})
        setter.start()
        setter.join()

    take(2)
    yield lambda: {library["num_threads"] for library in libraries.info()}
    take(before)


def test_linear_algebra_takes_one_thread_and_gives_the_others_back(two_threads):
    assert two_threads() == {2}
    seen = one_thread(two_threads)
    assert one_thread(lambda: seen() | two_threads())() == {1}
    with pytest.raises(ZeroDivisionError):
        one_thread(lambda: 1 / 0)()
    assert two_threads() == {2}


def test_linear_algebra_rounds_alike_in_threads_of_their_own(two_threads):
    matrix = np.random.default_rng(1).normal(size=(72, 300))
    product = one_thread(lambda _: (matrix.T @ matrix).tobytes())
    threads = one_thread(lambda _: two_threads())
    with ThreadPoolExecutor(4) as pool:
        assert len({product(0), *pool.map(product, range(100))}) == 1
        assert [*pool.map(threads, range(100))] == [{1}] * 100
    assert two_threads() == {2}


#: What rounds in the last bit if anything does: photons by each method, and the simulated movie.
ROUNDING = """
import hashlib, json, sys
import numpy as np
import napari_mufasa as nm
model = nm.Model.from_json(sys.argv[1])
movie = nm.simulate(model, seed=11).movie
of = lambda array: hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
told = [of(movie), of(nm.denoise(movie, model.camera)), of(nm.denoise(movie[:1], model.camera))]
told.append(of(nm.extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px).all_traces))
print(json.dumps(told))
"""


@pytest.mark.slow
def test_compiling_threads_and_memory_change_no_bit(simulation, tmp_path):
    """Loops just compiled, all found in files, some of them; memory that is not zero when it is handed out."""
    MODEL.to_json(tmp_path / "model.json")
    cache = tmp_path / "cache"

    def told(**changed):
        surroundings = os.environ | {"NUMBA_CACHE_DIR": str(cache)} | changed
        command = [sys.executable, "-c", ROUNDING, str(tmp_path / "model.json")]
        ran = subprocess.run(command, capture_output=True, text=True, env=surroundings)
        assert ran.returncode == 0, ran.stderr[-2000:]
        return json.loads(ran.stdout)

    compiled = told()
    assert compiled[0] == hashlib.sha256(simulation.movie.tobytes()).hexdigest()
    kept = sorted(cache.rglob("*.nbi"))
    assert len(kept) > 40
    assert told(MALLOC_PERTURB_="165", OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1", PYTHONHASHSEED="3") == compiled
    for file in kept[::2]:
        file.unlink()
    assert told(MALLOC_PERTURB_="90", OMP_NUM_THREADS="2", NUMBA_NUM_THREADS="2", PYTHONHASHSEED="4") == compiled


@pytest.mark.parametrize("bytes_off", [2, 8, 18, 34, 62])
def test_where_a_movie_lies_in_memory_changes_nothing(bytes_off, simulation):
    movie = simulation.movie
    room = np.zeros(movie.nbytes + 128, np.uint8)
    begin = -room.ctypes.data % 64 + bytes_off
    moved = room[begin : begin + movie.nbytes].view(movie.dtype).reshape(movie.shape)
    moved[...] = movie
    assert moved.ctypes.data % 64 == bytes_off
    np.testing.assert_array_equal(nm.denoise(moved, MODEL.camera), nm.denoise(movie, MODEL.camera))


@pytest.mark.parametrize("chunks", [(1, 40, 48), (33, 40, 48), (90, 13, 17)])
def test_chunks_of_a_lazy_movie_change_nothing(chunks, simulation):
    lazy = da.from_array(simulation.movie, chunks=chunks)
    np.testing.assert_array_equal(nm.denoise(lazy, MODEL.camera), nm.denoise(simulation.movie, MODEL.camera))
    sigma = MODEL.sigma_px
    one = nm.extract_traces(lazy, MODEL.camera, psf_sigma_px=sigma)
    other = nm.extract_traces(simulation.movie, MODEL.camera, psf_sigma_px=sigma)
    np.testing.assert_array_equal(one.all_traces, other.all_traces)
    assert one.molecules.equals(other.molecules)
