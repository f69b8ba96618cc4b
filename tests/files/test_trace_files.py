"""Traces in and out (docs/files.md)."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from tests.real_data import real_data

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.traces import read_trace_file, read_traces, write_trace_file


@pytest.mark.parametrize("suffix", ["csv", "tif", "h5"])
def test_traces_come_back(tmp_path, suffix):
    traces = np.random.default_rng(0).normal(100, 30, (6, 9)).astype(np.float32)
    path = tmp_path / f"traces.{suffix}"
    write_trace_file(path, traces, "photons", np.arange(6) + 3)
    found = read_trace_file(path)
    np.testing.assert_allclose(found.traces, traces, atol=1e-3)
    assert found.unit == "photons"
    if suffix != "tif":
        assert list(found.molecules) == [3, 4, 5, 6, 7, 8]


def test_a_whole_extraction_in_one_hdf5_file(tmp_path):
    import h5py
    from tests.blind import generator

    import napari_mufasa as nm
    from napari_mufasa.traces.table import write_traces

    model = nm.Model.from_dict(generator.base_model("emccd")).with_values({"acquisition.n_frames": 40})
    places = np.array([[20.2, 30.1], [60.0, 60.4], [62.0, 60.4]])  # one alone, two too near to each other
    found = nm.extract_traces(nm.simulate(model, places, seed=1).movie, model.camera, psf_sigma_px=model.sigma_px)
    write_traces(tmp_path, found, hdf5=True)
    whole, table = read_trace_file(tmp_path / "traces.h5"), read_trace_file(tmp_path / "traces.csv")
    np.testing.assert_array_equal(whole.traces, found.traces)
    np.testing.assert_allclose(table.traces, found.traces, atol=1e-3)
    assert list(whole.molecules) == list(table.molecules) == list(found.molecules["molecule"][found.kept])
    assert whole.unit == table.unit == "photoelectrons"
    with h5py.File(tmp_path / "traces.h5") as file:
        np.testing.assert_array_equal(file["all_traces"], found.all_traces)
        np.testing.assert_array_equal(file["molecules/y_px"], found.molecules["y_px"])
        assert [r.decode() for r in file["molecules/reason"]] == list(found.molecules["reason"])
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "molecules.csv", "traces.csv", "traces.h5", "traces.provenance.json",
    ]  # fmt: skip


def test_bad_hdf5_is_named(tmp_path):
    import h5py

    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["a"], file["b"] = np.zeros((2, 3)), np.zeros((2, 3))
    with h5py.File(tmp_path / "words.h5", "w") as file:
        file["traces"] = np.array([[b"x", b"y"]])
    with h5py.File(tmp_path / "ids.h5", "w") as file:
        file["traces"], file["molecule"] = np.zeros((2, 3)), np.arange(5)
    for name, word in (("two", "one named 'traces'"), ("words", "readable"), ("ids", "5 molecule ids for 2 traces")):
        with pytest.raises(MufasaError, match=word):
            read_trace_file(tmp_path / f"{name}.h5")


def test_whole_numbers_in_a_tiff_are_adu(tmp_path):
    import tifffile

    tifffile.imwrite(tmp_path / "a.tif", np.arange(12, dtype=np.uint16).reshape(4, 3))
    traces, unit = read_traces(tmp_path / "a.tif")
    assert unit == "adu"
    assert traces.shape == (3, 4)
    assert list(traces[1]) == [1, 4, 7, 10]


def test_the_unit_that_is_asked_for_chooses_the_column(tmp_path):
    (tmp_path / "two.csv").write_text("molecule,frame,photoelectrons,photons\n0,0,90,100\n0,1,45,50\n")
    assert read_trace_file(tmp_path / "two.csv").traces.tolist() == [[90, 45]]
    photons = read_trace_file(tmp_path / "two.csv", unit="photons")
    assert photons.unit == "photons" and photons.traces.tolist() == [[100, 50]]


@pytest.mark.parametrize(("said", "unit"), [("ADU ", "adu"), ("Photons", "photons"), ("", "photoelectrons")])
def test_units_are_known_however_they_are_spelt(tmp_path, said, unit):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("traces", data=np.ones((2, 5))).attrs["unit"] = said
    assert read_trace_file(tmp_path / "a.h5").unit == unit


def test_a_unit_that_nobody_knows_is_not_guessed(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("traces", data=np.ones((2, 5))).attrs["unit"] = "counts"
    with pytest.raises(MufasaError, match="is in 'counts': give --unit"):
        read_trace_file(tmp_path / "a.h5")
    assert read_trace_file(tmp_path / "a.h5", unit="adu").unit == "adu"


@pytest.mark.parametrize("suffix", ["csv", "tif", "h5", "json"])
def test_another_unit_than_the_file_says_is_refused(tmp_path, suffix):
    if suffix == "h5":
        pytest.importorskip("h5py")
    write_trace_file(tmp_path / f"a.{suffix}", np.ones((2, 5)), "photons")
    assert read_trace_file(tmp_path / f"a.{suffix}", unit="photons").unit == "photons"
    with pytest.raises(MufasaError, match="is in photons, not in adu: drop --unit"):
        read_trace_file(tmp_path / f"a.{suffix}", unit="adu")


def test_what_a_tiff_holds_hangs_on_the_unit_that_was_given(tmp_path):
    """Counts as decimals are counts all the same: as recorded, one pixel with its background."""
    import tifffile

    tifffile.imwrite(tmp_path / "a.tif", np.ones((20, 3), np.float32))
    table = read_trace_file(tmp_path / "a.tif", unit="adu")
    assert (table.unit, table.profile, table.background_subtracted) == ("adu", "brightest_pixel", False)
    table = read_trace_file(tmp_path / "a.tif")
    assert (table.unit, table.profile, table.background_subtracted) == ("photoelectrons", "psf", True)


def test_fret_traces(tmp_path):
    donor, acceptor = np.arange(10).reshape(2, 5), 100 + np.arange(10).reshape(2, 5)
    rows = np.stack([donor[0], acceptor[0], donor[1], acceptor[1]]).astype("<i2")
    path = tmp_path / "a.traces"
    path.write_bytes(struct.pack("<ih", 5, 4) + rows.T.tobytes())
    (tmp_path / "a.pks").write_text("1 10 20 1\n2 110 20 1\n3 30 40 1\n4 130 40 1\n")
    np.testing.assert_array_equal(read_trace_file(path).traces, donor)
    np.testing.assert_array_equal(read_trace_file(path, channel="acceptor").traces, acceptor)
    np.testing.assert_array_equal(read_trace_file(path, channel="sum").traces, donor + acceptor)
    np.testing.assert_array_equal(read_trace_file(path).positions_px, [[20, 10], [40, 30]])


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("a.csv", "molecule,frame\n0,0\n", "columns"),
        ("a.csv", "molecule,frame,photons\n0,0,1\n0,1,2\n1,0,3\n", "same number"),
        ("a.csv", "molecule,frame,photons\n0,0,1\n0,0,2\n", "once"),
        ("a.csv", "molecule,frame,photons\n", "no trace"),
        ("a.csv", "molecule,frame,photons\n0,0,nan\n", "finite"),
        ("a.csv", "molecule,frame,photons\n0,0,1\n0,1,2\n,0,3\n,1,4\n", "without molecule or frame"),
        ("a.csv", "molecule,frame,photons\n0,0,bright\n", "readable"),
        ("a.csv", "", "readable"),
        ("a.h5", "no hdf5", "readable"),
        ("a.traces", "xxxxxxxxxx", "damaged"),
        ("a.tif", "no tiff", "readable"),
        ("a.doc", "", "use one of"),
    ],
)
def test_bad_files_are_named(tmp_path, name, content, word):
    (tmp_path / name).write_text(content)
    with pytest.raises(MufasaError, match=word):
        read_trace_file(tmp_path / name)


def test_missing_file():
    with pytest.raises(MufasaError, match="no file"):
        read_trace_file("nowhere.csv")


@pytest.mark.realdata
def test_real_fret_traces():
    path = real_data("smfret_traces/hel1.traces")
    found = read_trace_file(path)
    assert found.traces.shape == (520, 1500)
    assert found.positions_px is not None
    assert len(found.positions_px) == 520


def test_openfret_is_what_its_own_library_reads_and_writes(tmp_path):
    openfret = pytest.importorskip("openfret")
    traces = np.random.default_rng(1).normal(100, 10, (5, 30)).round(3)
    write_trace_file(tmp_path / "t.json", traces, "photoelectrons", np.array([3, 5, 8, 9, 20]))
    back = openfret.read_data(str(tmp_path / "t.json"))
    assert [trace.metadata["molecule"] for trace in back.traces] == [3, 5, 8, 9, 20]
    np.testing.assert_allclose([trace.channels[0].data for trace in back.traces], traces)
    own = read_trace_file(tmp_path / "t.json")
    assert own.unit == "photoelectrons" and list(own.molecules) == [3, 5, 8, 9, 20]
    np.testing.assert_allclose(own.traces, traces)
    # A file of theirs, with two channels and no unit.
    channels = [openfret.Channel("donor", list(range(10))), openfret.Channel("acceptor", [2.0] * 10, exposure_time=0.1)]
    openfret.write_data(openfret.Dataset("theirs", [openfret.Trace(channels)] * 3), str(tmp_path / "u.json"))
    theirs = {
        channel: read_trace_file(tmp_path / "u.json", channel=channel) for channel in ("donor", "acceptor", "sum")
    }
    assert theirs["donor"].traces.shape == (3, 10) and theirs["donor"].unit == "adu"
    np.testing.assert_array_equal(theirs["sum"].traces[0], np.arange(10) + 2.0)


@pytest.mark.parametrize("text", ["{}", '{"traces": []}', '{"traces": [{"channels": []}]}', '{"traces": [{}]}', "[1]"])
def test_what_is_no_openfret_is_told_in_one_line(tmp_path, text):
    (tmp_path / "t.json").write_text(text)
    with pytest.raises(MufasaError) as caught:
        read_trace_file(tmp_path / "t.json")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("profile", ["psf", "sum", "brightest_pixel"])
@pytest.mark.parametrize("without", [True, False])
def test_files_say_what_their_traces_hold(tmp_path, profile, without):
    """CSV by the file beside it, HDF5 and OpenFRET by themselves; a table by another name has no companion."""
    import napari_mufasa as nm
    from napari_mufasa.traces import extract_traces
    from napari_mufasa.traces.table import write_traces

    model = nm.preset("FF").with_values({"acquisition.shape_px": (32, 32), "acquisition.n_frames": 30})
    movie = nm.simulate(model, np.array([[10.0, 10.0], [22.0, 22.0]]), seed=1).movie
    found = extract_traces(
        movie, model.camera, psf_sigma_px=model.sigma_px, profile=profile, subtract_background=without, min_snr=0.0
    )  # fmt: skip
    write_traces(tmp_path, found, hdf5=True, openfret=True)
    for name in ("traces.csv", "traces.h5", "traces.openfret.json"):
        read = read_trace_file(tmp_path / name)
        assert (read.profile, read.background_subtracted) == (profile, without), name
        assert read.pixel_share == pytest.approx(found.pixel_share)
    (tmp_path / "other.csv").write_bytes((tmp_path / "traces.csv").read_bytes())
    assert read_trace_file(tmp_path / "other.csv").holds is None
    (tmp_path / "traces.provenance.json").write_text('{"holds": {"traces.csv": {"profile": "rainbow"}}}')
    assert read_trace_file(tmp_path / "traces.csv").profile == "psf"  # what is not told whole is not believed
