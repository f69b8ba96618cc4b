"""Where molecules are put."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.distance import pdist

from napari_mufasa import MufasaError, preset
from napari_mufasa.simulate.layout import grid, place, read_positions, scatter


def test_random_positions_are_uniform_over_the_pixels_area():
    positions = scatter(20_000, (40, 90), 0.0, np.random.default_rng(1))
    for axis, n in enumerate((40, 90)):  # pixel i covers i − ½ … i + ½; KS at 1e-4
        assert stats.kstest(positions[:, axis], "uniform", args=(-0.5, n)).pvalue > 1e-4
    assert abs(np.corrcoef(positions.T)[0, 1]) < 4 / np.sqrt(20_000)


def test_minimum_distance_is_kept():
    positions = scatter(300, (100, 100), 4.0, np.random.default_rng(2))
    assert positions.shape == (300, 2)
    assert pdist(positions).min() >= 4.0
    assert positions.min() >= -0.5 and positions.max() < 99.5


def test_a_field_that_is_too_small_is_refused():
    with pytest.raises(MufasaError, match=r"100 molecules at least 10\.0 px apart do not fit"):
        scatter(100, (32, 32), 10.0, np.random.default_rng(3))


@pytest.mark.parametrize(
    ("n", "shape"), [(9, (30, 30)), (10, (20, 80)), (1, (5, 5)), (6498, (2048, 2048)), (0, (8, 8))]
)
def test_grid_fills_the_field(n, shape):
    positions = grid(n, shape)
    assert positions.shape == (n, 2)
    if n > 1:
        spacing = np.sqrt(shape[0] * shape[1] / n)
        assert pdist(positions[:200]).min() > 0.6 * spacing
        assert np.all(positions > -0.5) and np.all(positions < np.array(shape) - 0.5)
        assert np.all(np.ptp(positions, axis=0) > np.array(shape) - 2.2 * spacing)


def test_layouts_of_the_model():
    model = preset("FF")
    assert np.array_equal(
        place(model.with_values({"sample.layout": "grid", "sample.n_molecules": 16}), np.random.default_rng(1)),
        grid(16, (128, 128)),
    )
    spread = place(
        model.with_values({"sample.n_molecules": 40, "sample.min_distance_px": 10}), np.random.default_rng(1)
    )
    assert pdist(spread).min() >= 10


@pytest.mark.parametrize(
    "text",
    [
        "y_px,x_px\n1.5,2\n3,4.25\n",
        "x_px, y_px\n2, 1.5\n4.25, 3\n",
        "id,x_px,note,y_px\n7,2,a,1.5\n8,4.25,b,3\n",
        "y_nm,x_nm\n200,250\n350,475\n",  # pixel 0 is centred at 50 nm
        "250,200\n475,350\n",  # no header: x, y in nm
        "250,200,9\n475,350,9\n",
        "# emitters\n250,200\n475,350\n",
    ],
)
def test_positions_from_csv(tmp_path, text):
    path = tmp_path / "p.csv"
    path.write_text(text)
    np.testing.assert_allclose(read_positions(path, 100.0), [[1.5, 2.0], [3.0, 4.25]])


def test_one_emitter_at_equal_coordinates_without_a_header(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("250.0,250.0\n")
    np.testing.assert_allclose(read_positions(path, 100.0), [[2.0, 2.0]])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "not a CSV"),
        (b"a,b\n1,2\n", "needs y_px, x_px"),
        (b"5\n6\n", "needs y_px, x_px"),
        (b"y_px,x_px\n1,2\n3,abc\n", r"not a number \(molecule 2\)"),
        (b"y_px,x_px\n1,\n", r"not a number \(molecule 1\)"),
        (b"y_px,x_px\n1,inf\n", "not a number"),
        (b"\xff\xfe\x00\x01,\n", "not a CSV"),
    ],
)
def test_bad_csv_is_told_in_one_line(tmp_path, content, says):
    path = tmp_path / "p.csv"
    path.write_bytes(content)
    with pytest.raises(MufasaError, match=says) as caught:
        read_positions(path, 100.0)
    assert "\n" not in str(caught.value)


def test_missing_csv(tmp_path):
    with pytest.raises(MufasaError, match="no file"):
        read_positions(tmp_path / "nowhere.csv", 100.0)
