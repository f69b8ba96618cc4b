"""Calibration of movies larger than memory should hold: what is looked at is bounded, and says the same."""

import tracemalloc

import numpy as np
import pytest

import napari_mufasa as nm
from napari_mufasa.calibrate import dark as dark_frames
from napari_mufasa.calibrate import sample
from napari_mufasa.calibrate.dark import DarkFrames, measure_dark
from napari_mufasa.calibrate.rows import Products

PER_ELECTRON, READ_ADU, BASELINE = 2.0, 3.0, 100.0


def counts(n_frames: int, electrons, offset, seed: int) -> np.ndarray:
    """CMOS frames (frame, y, x) of so many electrons a pixel (y, x)."""
    rng = np.random.default_rng(seed)
    found = [
        BASELINE + offset + PER_ELECTRON * rng.poisson(electrons) + rng.normal(0, READ_ADU, np.shape(electrons))
        for _ in range(n_frames)
    ]
    return np.floor(np.maximum(found, 0)).astype(np.uint16)


@pytest.fixture(scope="module")
def movies():
    y, x = np.mgrid[:160, :200]
    light = 20 + 60 * np.exp(-((y - 80) ** 2 + (x - 100) ** 2) / 60**2)
    offset = np.random.default_rng(0).normal(0, 5, light.shape)
    return counts(96, light, offset, 1), counts(96, np.zeros_like(light), offset, 2)


def test_dark_maps_are_mean_and_variance_of_every_pixel(movies):
    _, dark = movies
    found = DarkFrames.of([dark[:50], dark[50:]])
    flat = dark - dark.mean(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(found.per_frame, dark.mean(axis=(1, 2)))
    np.testing.assert_allclose(found.offset_map, flat.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(found.variance_map, flat.var(axis=0, ddof=1), rtol=1e-9)


def test_reading_many_dark_frames_can_be_cancelled(movies, monkeypatch):
    movie, dark = movies
    monkeypatch.setattr(sample, "READ_BYTES", 8 * dark[0].size)  # one at a time
    asked = []
    with pytest.raises(nm.Cancelled):
        nm.calibrate(movie, dark, camera_type="CMOS", cancel=lambda: asked.append(1) or len(asked) > 30)
    assert len(asked) == 31 < len(dark)


def test_products_of_parts_add_up_to_those_of_all(movies):
    movie, _ = movies
    noise = np.diff(movie.astype(np.float32), axis=0)
    whole, parts = Products.of(noise), Products.of(noise[:40]) + Products.of(noise[40:])
    np.testing.assert_allclose(parts.correlations((1, -1)).row, whole.correlations((1, -1)).row)
    assert parts.correlations((1, -1)).sd == pytest.approx(whole.correlations((1, -1)).sd)
    by_hand = np.mean(noise[:, :, 2:] * noise[:, :, :-2], dtype=float) / np.mean(noise**2, dtype=float)
    assert whole.correlations((1, -1)).row[1] == pytest.approx(by_hand, abs=1e-6)


def test_a_part_of_a_large_movie_says_what_all_of_it_says_in_less_memory(movies, monkeypatch):
    """Each value within 5 standard errors of the truth (6e-7), and the two within 5 of each other."""
    movie, dark = movies

    def calibrated():
        tracemalloc.start()
        found = nm.calibrate(movie, dark, camera_type="CMOS")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found, peak

    whole, all_memory = calibrated()
    monkeypatch.setattr(sample, "MOST_PX", 80 * 80)
    monkeypatch.setattr(sample, "CHUNK_BYTES", 4 * 80 * 80 * 8)
    monkeypatch.setattr(dark_frames, "MOST_COUNTS", 80 * 80 * 24)
    monkeypatch.setattr(sample, "READ_BYTES", 2**20)
    part, memory = calibrated()
    assert memory < all_memory / 2
    assert any("middle 80 × 80" in note for note in part.notes)
    truth = {"adu_per_photoelectron": PER_ELECTRON, "baseline_adu": BASELINE, "read_noise_adu": READ_ADU}
    for name, true in truth.items():
        one, other = getattr(part, name), getattr(whole, name)
        offset = 5 / np.sqrt(80 * 80) if name == "baseline_adu" else 0.0  # of the pixels that are looked at
        assert abs(one.value - true) < 5 * np.hypot(one.sd, offset), name
        assert abs(one.value - other.value) < 5 * np.hypot(np.hypot(one.sd, other.sd), offset), name
        assert one.sd < 8 * other.sd, name
    assert np.shape(part.camera.offset_map_adu) == movie.shape[1:]
    # Offsets count from the baseline that is told: of the part looked at.
    here, there = (found.camera.offset_map_adu + found.camera.baseline_adu for found in (part, whole))
    np.testing.assert_allclose(here, there, atol=5 * READ_ADU / np.sqrt(80 * 80 * 24))


def test_the_part_in_the_middle_is_no_larger_than_asked():
    for shape in [(100, 100), (2048, 2048), (512, 4096), (3000, 600), (7, 3_000_000)]:
        rows, columns = sample.window(shape)
        size = (rows.stop - rows.start) * (columns.stop - columns.start)
        assert size == min(np.prod(shape), sample.MOST_PX) or 0.99 * sample.MOST_PX < size <= sample.MOST_PX
        assert abs((rows.start + rows.stop) - shape[0]) <= 1 and abs((columns.start + columns.stop) - shape[1]) <= 1


def test_spurious_electrons_are_found_in_a_part_of_many_dark_frames(monkeypatch):
    """Of 0.01 electrons in 1.2 million counts; within 5 standard errors."""
    rng = np.random.default_rng(6)
    electrons = rng.poisson(0.01, (300, 64, 64))
    made = rng.gamma(np.maximum(electrons, 1e-12), 60.0) * (electrons > 0)
    dark = np.floor(100 + made + rng.normal(0, 4, made.shape))
    monkeypatch.setattr(dark_frames, "MOST_COUNTS", 64 * 64 * 100)
    seen = DarkFrames.of([dark])
    assert len(seen.some) == 100 and len(seen.per_frame) == 300
    found = measure_dark(seen, True)
    assert abs(found.charge.value - 0.01) < 5 * found.charge.sd
    assert abs(found.baseline.value - 100) < 5 * found.baseline.sd
