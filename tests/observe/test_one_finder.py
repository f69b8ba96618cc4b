"""The molecules that a user sees in traces are those that are diagnosed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.blind import generator
from tests.real_data import real_data

import napari_mufasa as nm
from napari_mufasa.observe import observe
from napari_mufasa.traces import extract_traces

MODELS = Path(__file__).resolve().parents[2] / "docs" / "models"


def test_traces_and_observations_start_from_the_same_places(monkeypatch):
    from napari_mufasa.spots import find, follow
    from napari_mufasa.traces import candidates

    finder = find.find_spots
    for camera in ("emccd", "ccd", "cmos"):
        case = generator.make(generator.base_model(camera), seed=5, n_molecules=60, effects=[("long_dark_state", 0.5)])
        model = nm.Model.from_dict(case.believed)
        places = []

        def spy(*args, places=places, **kwargs):
            found = finder(*args, **kwargs)
            places.append(found.positions_px)
            return found

        monkeypatch.setattr(candidates.find, "find_spots", spy)
        monkeypatch.setattr(follow, "find_spots", spy)
        extract_traces(case.movie, model.camera, psf_sigma_px=model.sigma_px)
        spots = observe(case.movie, model).spots
        monkeypatch.undo()
        assert len(places) == 2 and len(places[0]) > 50
        np.testing.assert_array_equal(places[0], places[1])
        np.testing.assert_array_equal(spots.positions_px, places[1])


@pytest.mark.realdata
def test_a_real_movie_has_the_same_molecules_in_both():
    import tifffile

    model = nm.Model.from_json(MODELS / "smfret_ixon.json")
    with tifffile.TiffFile(real_data("smfret_ixon_emccd.tif")) as file:
        movie = file.asarray()[:300, :128, :128]
    model = model.in_shape(n_frames=len(movie), shape_px=movie.shape[1:], maps=None)
    found = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px, position="fit")
    spots = observe(movie, model).spots
    assert len(found.molecules) == len(spots.positions_px) > 30
    # In the table the places are refined by the lit images, by at most 1.5 σ.
    moved = np.hypot(*(found.positions_px - spots.positions_px).T)
    assert np.median(moved) < 0.3 and moved.max() <= 1.5 * np.sqrt(2) * model.sigma_px + 1e-6
