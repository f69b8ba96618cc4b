"""What microscopes write: each format as far as a file of it can be had (docs/files.md)."""

from __future__ import annotations

import contextlib
import struct
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile
from tests.files.microscopes import WRITERS, write_czi, write_nd2, write_pma

from napari_mufasa import MufasaError, files, preset
from napari_mufasa.cli import main
from napari_mufasa.files import formats
from napari_mufasa.files.instrument import Instrument, _take, read_instrument
from napari_mufasa.files.layers import get_reader, instrument_of, movie_layer
from napari_mufasa.files.zeiss import check_czi
from napari_mufasa.propose.written import as_written, values_written
from napari_mufasa.report.lines import instrument_line

MOVIE = np.random.default_rng(3).integers(1, 200, (9, 16, 24))


@pytest.fixture(params=sorted(WRITERS))
def path(request, tmp_path):
    return WRITERS[request.param](tmp_path / f"movie{request.param}", MOVIE)


# files of the format ------------------------------------------------------------------------------------------
def test_movies_are_read_lazily_and_whole(path):
    read = files.read_movie(path)
    kind = {".pma": np.uint8, ".sif": np.float32}.get(path.suffix, np.uint16)
    assert read.data.shape == MOVIE.shape and read.data.dtype == kind
    np.testing.assert_array_equal(files.load(path), MOVIE)
    np.testing.assert_array_equal(np.asarray(read.data[4]), MOVIE[4])
    np.testing.assert_array_equal(np.asarray(read.data[2:7, 3:9, ::2]), MOVIE[2:7, 3:9, ::2])


def test_the_file_is_read_in_parts(tmp_path, monkeypatch):
    monkeypatch.setattr(formats, "CHUNK_BYTES", 2 * 16 * 24)
    path = write_pma(tmp_path / "m.pma", MOVIE)
    read = files.read_movie(path)
    assert read.data.numblocks == (5, 1, 1)
    asked = []
    seek = formats.FrameReader.__getitem__
    monkeypatch.setattr(formats.FrameReader, "__getitem__", lambda self, i: asked.append(i) or seek(self, i))
    np.asarray(read.data[4])
    assert len(asked) == 1


def test_what_a_czi_says_of_the_instrument_is_known_everywhere(tmp_path, capsys):
    path = write_czi(tmp_path / "m.czi", MOVIE)
    written = read_instrument(path)
    assert written.pixel_size_nm == pytest.approx(107.5) and written.exposure_s == pytest.approx(0.03)
    assert written.em_gain == 250
    assert files.read_movie(path).pixel_size_nm == pytest.approx(107.5)
    with pytest.raises(SystemExit) as leaving:
        main(["info", str(path)])
    out = capsys.readouterr().out
    assert leaving.value.code == 0 and "107.5" in out and "0.03" in out and "16 × 24" in out
    model = as_written(preset("FF"), written)
    assert model.acquisition.pixel_size_nm == pytest.approx(107.5) and model.acquisition.frame_length_s == 0.03
    assert values_written(model, written) == {}


@pytest.mark.parametrize(
    ("suffix", "told"),
    [
        (".nd2", Instrument(em_gain=250, exposure_s=pytest.approx(0.03), interval_s=pytest.approx(0.04),
                            pixel_size_nm=pytest.approx(107.5))),
        (".sif", Instrument(camera="DU897_BV", em_gain=250, exposure_s=0.03, interval_s=0.04)),
        (".tif", Instrument(camera="Andor", em_gain=250, exposure_s=pytest.approx(0.03),
                            interval_s=pytest.approx(0.04), pixel_size_nm=pytest.approx(107.5))),
        (".lif", Instrument(interval_s=pytest.approx(0.04), pixel_size_nm=pytest.approx(107.5))),
    ],
)  # fmt: skip
def test_what_files_say_of_the_instrument_is_known(tmp_path, suffix, told):
    assert read_instrument(WRITERS[suffix](tmp_path / f"m{suffix}", MOVIE)) == told


def test_movies_come_into_the_viewer_with_their_scale(path):
    data, options, kind = movie_layer(path)
    assert kind == "image" and data.shape == MOVIE.shape and options["name"] == "movie"
    read = get_reader(str(path))
    assert read is not None and read(str(path))[0][0].shape == MOVIE.shape
    if path.suffix in (".czi", ".nd2", ".tif"):
        assert options["scale"] == pytest.approx((1.0, 0.1075, 0.1075)) and options["units"] == ("pixel", "um", "um")
        layer = SimpleNamespace(metadata=options["metadata"])
        assert instrument_of(layer).exposure_s == pytest.approx(0.03)


def test_other_verbs_take_them_too(tmp_path, capsys):
    model = preset("FF").with_values({"acquisition.n_frames": 30, "acquisition.shape_px": (48, 48)})
    import napari_mufasa as nm

    write_czi(tmp_path / "m.czi", nm.simulate(model, seed=1).movie)
    model.to_json(tmp_path / "model.json")
    arguments = ["traces", tmp_path / "m.czi", "--model", tmp_path / "model.json", "--out", tmp_path / "t"]
    with pytest.raises(SystemExit) as leaving:
        main([str(a) for a in arguments])
    told = capsys.readouterr()
    assert leaving.value.code == 0 and "molecules kept" in told.out
    assert "107.5 nm" in told.err and "exposed for 30 ms" in told.err  # not what the model says


# what cannot be read --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("suffix", sorted(formats.FORMATS))
@pytest.mark.parametrize("content", [b"", b"no movie at all", b"\0" * 2000, bytes(range(256)) * 40])
def test_damaged_files_are_told_in_one_line(tmp_path, suffix, content):
    path = tmp_path / f"broken{suffix}"
    path.write_bytes(content)
    if (
        suffix == ".pma"
        and len(content) > 4
        and content[0]
        and (len(content) - 4) % (content[0] + 256 * content[1]) == 0
    ):
        return
    with pytest.raises(MufasaError) as caught:
        np.asarray(files.read_movie(path).data)
    assert "\n" not in str(caught.value) and "broken" in str(caught.value)
    assert read_instrument(path) == Instrument()


def test_a_truncated_pma_is_told(tmp_path):
    path = write_pma(tmp_path / "m.pma", MOVIE)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(MufasaError, match="truncated"):
        files.read_movie(path)


@pytest.mark.parametrize("suffix", sorted(WRITERS))
def test_truncated_files_are_told_and_end(tmp_path, suffix):
    """Wherever they end: told, or, where what is cut off is no more than the end's filling, read as they were."""
    whole = WRITERS[suffix](tmp_path / f"whole{suffix}", MOVIE).read_bytes()
    path = tmp_path / f"m{suffix}"
    told = 0
    for share in np.linspace(0.0, 0.999, 24):
        path.write_bytes(whole[: int(share * len(whole))])
        try:
            np.testing.assert_array_equal(np.asarray(files.read_movie(path).data), MOVIE[: len(MOVIE)])
        except MufasaError as error:
            assert "\n" not in str(error) and str(path) in str(error)
            told += 1
    assert told >= 23


def test_a_frame_that_a_nikon_file_lacks_is_not_read_as_zeros(tmp_path):
    path = write_nd2(tmp_path / "m.nd2", MOVIE)
    path.write_bytes(path.read_bytes().replace(b"ImageDataSeq|3!", b"ImageDataSeq|9!"))
    with pytest.raises(MufasaError, match="lacks frame 3"):
        np.asarray(files.read_movie(path).data)


def test_a_nikon_file_that_claims_absurdly_many_components_takes_no_memory(tmp_path):
    import tracemalloc

    path = write_nd2(tmp_path / "m.nd2", MOVIE)
    name = "uiCompCount\0".encode("utf-16-le")
    content = path.read_bytes()
    assert content.count(name + bytes([1, 0, 0, 0])) == 1
    path.write_bytes(content.replace(name + bytes([1, 0, 0, 0]), name + bytes([0, 0, 0, 8])))
    tracemalloc.start()
    with contextlib.suppress(MufasaError):
        np.asarray(files.read_movie(path).data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6


@pytest.mark.parametrize(
    ("of", "at", "kind", "value"),
    [
        (b"ZISRAWDIRECTORY", 32 + 128 + 32 + 8, "<i", -2), (b"ZISRAWDIRECTORY", 32 + 128 + 28, "<i", 10**6),
        (b"ZISRAWDIRECTORY", 32, "<i", 2**30), (b"ZISRAWDIRECTORY", 32 + 128 + 6, "<q", 2**50),
        (b"ZISRAWDIRECTORY", 24, "<q", -2), (b"ZISRAWMETADATA", 32, "<i", 2**30), (b"ZISRAWMETADATA", 32, "<i", -5),
        (b"ZISRAWSUBBLOCK", 32 + 8, "<q", 2**40), (b"ZISRAWSUBBLOCK", 32, "<i", -1),
    ],
)  # fmt: skip
def test_a_zeiss_file_that_leads_outside_is_refused_before_its_library_follows(tmp_path, of, at, kind, value):
    """The library ends the process at the first of these."""
    path = write_czi(tmp_path / "m.czi", MOVIE)
    check_czi(path)
    content = bytearray(path.read_bytes())
    struct.pack_into(kind, content, content.index(of) + at, value)
    path.write_bytes(content)
    with pytest.raises(MufasaError, match=r"m\.czi is no .*copy it anew"):
        check_czi(path)
    with pytest.raises(MufasaError):
        files.read_movie(path)


def test_a_leica_text_that_names_other_files_opens_none(tmp_path):
    import tifffile

    tifffile.imwrite(tmp_path / "secret.tif", MOVIE[0].astype(np.uint16))
    xml = (
        '<?xml version="1.0"?><LMSDataContainerHeader Version="2"><Element Name="m"><Data><Image/></Data>'
        '<Memory Size="768" MemoryBlockID="MemBlock_1"><Frame File="secret.tif" Offset="0" Size="768" UUID="1"/>'
        "</Memory></Element></LMSDataContainerHeader>"
    )
    for encoding in ("utf-8", "utf-16", "utf-16-le"):
        (tmp_path / "m.lif").write_bytes(xml.encode(encoding))
        with pytest.raises(MufasaError, match=r"no \.lif file"):
            files.read_movie(tmp_path / "m.lif")


def test_channels_are_refused_with_their_number(tmp_path):
    czi = pytest.importorskip("pylibCZIrw.czi")
    with czi.create_czi(str(tmp_path / "two.czi")) as file:
        for channel in range(2):
            file.write(data=MOVIE[0].astype(np.uint16)[..., None], plane={"T": 0, "C": channel, "Z": 0})
    with pytest.raises(MufasaError, match="2 channels"):
        files.read_movie(tmp_path / "two.czi")


@pytest.mark.parametrize(("suffix", "module"), [(".nd2", "nd2"), (".sif", "sif_parser"), (".lif", "liffile")])
def test_a_missing_library_is_named(tmp_path, monkeypatch, suffix, module):
    import importlib

    imported = importlib.import_module

    def without(name, *rest):
        if name == module:
            raise ImportError(name)
        return imported(name, *rest)

    monkeypatch.setattr(importlib, "import_module", without)
    (tmp_path / f"m{suffix}").write_bytes(b"x")
    with pytest.raises(MufasaError, match=rf"{module}.*napari-mufasa\[formats\]"):
        files.read_movie(tmp_path / f"m{suffix}")


# metadata: names and units of the libraries, without a file ---------------------------------------------------------
def taken(pairs):
    found = {}
    for name, value in pairs:
        _take(found, name, value)
    return Instrument(**found)


def test_zeiss_times_are_in_ns_and_lengths_in_m():
    about = {
        "Scaling": {"Items": {"Distance": [{"@Id": "X", "Value": "6.45e-08"}, {"@Id": "Z", "Value": "1e-6"}]}},
        "Information": {
            "Image": {
                "Dimensions": {
                    "Channels": {"Channel": {"ExposureTime": "50000000", "DetectorSettings": {"Gain": "0"}}},
                    "T": {"Positions": {"Interval": {"Increment": "0.1"}}},
                }
            },
            "Instrument": {"Detectors": {"Detector": {"Manufacturer": {"Model": "Evolve 512"}}}},
        },
    }
    told = taken(formats._czi_settings({"ImageDocument": {"Metadata": about}}))
    assert told == Instrument(camera="Evolve 512", exposure_s=0.05, interval_s=0.1, pixel_size_nm=pytest.approx(64.5))


def test_nikon_exposures_are_said_in_words():
    file = SimpleNamespace(
        is_legacy=False,
        unstructured_metadata=lambda include: {"ImageMetadataSeq|0": {"Calibrated": True, "Calibration": 0.16}},
        text_info={"capturing": "Camera: Andor DU-897\n  Exposure: 2 s\n  EM Gain: 300\n  Readout Mode: EM 17MHz"},
        experiment=[SimpleNamespace(parameters=SimpleNamespace(periodMs=2100.0))],
    )
    told = taken(formats._nd2_settings(file))
    assert told.exposure_s == 2.0 and told.em_gain == 300 and told.interval_s == pytest.approx(2.1)
    assert told.pixel_size_nm == pytest.approx(160)


def test_andor_names_are_known():
    told = taken({"ExposureTime": 0.02, "CycleTime": 0.0215, "GainDAC": 200.0, "DetectorType": "DU-897"}.items())
    assert told == Instrument(camera="DU-897", em_gain=200.0, exposure_s=0.02, interval_s=0.0215)


@pytest.mark.parametrize(
    ("name", "value", "field", "size"),
    [
        ("Exposure", "30", "exposure_s", 0.03),  # in ms where nothing is said
        ("Exposure", "0.5 s", "exposure_s", 0.5),
        ("ExposureTime", "30 ms", "exposure_s", 0.03),
        ("ExposureTime", 3e-2, "exposure_s", 0.03),
        ("Interval_ms", "2 min", "interval_s", 120.0),
        ("PixelSizeUm", "160 nm", "pixel_size_nm", 160.0),
        ("Exposure", "3 fortnights", "exposure_s", None),
    ],
)
def test_a_unit_that_is_said_counts(name, value, field, size):
    assert getattr(taken([(name, value)]), field) == (None if size is None else pytest.approx(size))


@pytest.mark.parametrize(("interval", "unit", "told_s"), [(20, "ms", 0.02), (2, "min", 120.0), (0.02, None, 0.02)])
def test_imagej_intervals_are_in_their_unit(tmp_path, interval, unit, told_s):
    said = {"unit": "\\u00B5m", "finterval": interval} | ({} if unit is None else {"tunit": unit})
    path, counts = tmp_path / "m.tif", MOVIE.astype(np.uint16)
    tifffile.imwrite(path, counts, imagej=True, resolution=(8, 8), metadata=said | {"axes": "TYX"})
    told = read_instrument(path)
    assert told.interval_s == pytest.approx(told_s) and told.pixel_size_nm == pytest.approx(125)


@pytest.mark.parametrize(
    ("settings", "told", "gain"),
    [
        ({"Camera-Gain": "4"}, Instrument(gain=4.0), None),  # a conversion, a preamplifier, a speed: no one knows
        ({"AmplificationGain": "2.5"}, Instrument(gain=2.5), None),
        ({"Andor-Gain": "300", "Andor-Pre-Amp-Gain": "Gain 3"}, Instrument(em_gain=300.0, preamp_gain=3.0), 300.0),
        ({"Evolve-Gain": "3", "Evolve-MultiplierGain": "200"}, Instrument(em_gain=200.0, gain=3.0), 200.0),
        ({"Andor-Gain": "1"}, Instrument(em_gain=1.0), 1.0),
        ({"Andor-Gain": "300", "Andor-Output_Amplifier": "Conventional CCD register"},
         Instrument(em_gain=300.0, register="off"), 1.0),
        ({"Andor-Output_Amplifier": "Standard EMCCD gain register", "Andor-EMSwitch": "On"}, Instrument(), None),
        ({"Andor-Gain": "300", "Andor-EMSwitch": "Off"}, Instrument(em_gain=300.0, register="off"), 1.0),
        ({"Readout Mode": "Conventional 3MHz"}, Instrument(register="off"), 1.0),
    ],
)  # fmt: skip
def test_only_a_gain_that_is_said_to_be_the_registers_is(settings, told, gain):
    found = taken(settings.items())
    assert found == told and found.register_gain == gain
    assert len(instrument_line(found.known()).split(", ")) == max(len(found.known()), 1)  # every setting has its words


def test_metadata_do_not_change_what_they_do_not_say():
    model = preset("FF")
    assert values_written(model, Instrument()) == {} and as_written(model, Instrument()) == model
    said = values_written(model, Instrument(exposure_s=0.05, interval_s=0.1, em_gain=1.0, baseline_adu=90.0))
    assert set(said) == {"acquisition.frame_length_s", "acquisition.frame_interval_s"}
