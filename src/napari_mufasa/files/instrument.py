"""What the recording software wrote about the instrument: Micro-Manager, Andor, OME and ImageJ metadata of a TIFF, and
those of the other formats."""

from __future__ import annotations

import contextlib
import json
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from napari_mufasa.files import formats
from napari_mufasa.files.opening import complaints
from napari_mufasa.files.whole import PathLike


@dataclass(frozen=True)
class Instrument:
    """Settings as the software wrote them, None where it did not; a setting is no measurement.

    camera : its name; em_gain, preamp_gain : settings; readout_rate_hz : of pixels; exposure_s, interval_s : of a frame
    (start to start); pixel_size_nm : in the sample; bit_depth : of the converter; baseline_adu : offset asked for;
    wavelength_nm : of the excitation; gain : of which it is not said what it multiplies; register : "off" where the
    electrons did not pass the EM register, or it was switched off
    """

    camera: str | None = None
    em_gain: float | None = None
    preamp_gain: float | None = None
    readout_rate_hz: float | None = None
    exposure_s: float | None = None
    interval_s: float | None = None
    pixel_size_nm: float | None = None
    bit_depth: int | None = None
    baseline_adu: float | None = None
    wavelength_nm: float | None = None
    gain: float | None = None
    register: str | None = None

    @property
    def register_gain(self) -> float | None:
        """By how much the register multiplied: 1 where it was off, None where nothing is said of it."""
        if self.register == "off":
            return 1.0
        return None if self.em_gain is None else max(self.em_gain, 1.0)

    def known(self) -> dict[str, Any]:
        """Only what is there."""
        return {name: value for name, value in asdict(self).items() if value is not None}


# A key's name, lower case without the device's own ("Andor-Gain" is "gain"), and what it gives: field and factor.
NAMES: dict[str, tuple[str, float]] = {
    "gain": ("gain", 1), "amplificationgain": ("gain", 1),  # of a converter, an amplifier or a register
    "andor-gain": ("em_gain", 1),  # so Micro-Manager's Andor adapter calls the register's, beside "Pre-Amp-Gain"
    "em gain": ("em_gain", 1), "emgain": ("em_gain", 1), "multiplier": ("em_gain", 1),
    "multiplicationgain": ("em_gain", 1), "multipliergain": ("em_gain", 1), "andoremdaclevel": ("em_gain", 1),
    "pre-amp-gain": ("preamp_gain", 1), "preampgain": ("preamp_gain", 1), "preamp": ("preamp_gain", 1),
    "readoutmode": ("readout_rate_hz", 1e6), "readoutrate": ("readout_rate_hz", 1e6),
    "pixelreadoutrate": ("readout_rate_hz", 1e6), "readout rate": ("readout_rate_hz", 1e6),
    "exposure-ms": ("exposure_s", 1e-3), "exposure": ("exposure_s", 1e-3), "andorexposuretime": ("exposure_s", 1),
    "exposuretime": ("exposure_s", 1), "interval_ms": ("interval_s", 1e-3), "actualinterval-ms": ("interval_s", 1e-3),
    "andorkineticcycletime": ("interval_s", 1), "timeincrement": ("interval_s", 1),
    "pixelsizeum": ("pixel_size_nm", 1e3), "pixelsize_um": ("pixel_size_nm", 1e3),
    "physicalsizex": ("pixel_size_nm", 1e3), "bitdepth": ("bit_depth", 1), "significantbits": ("bit_depth", 1),
    "camera": ("camera", 1), "cameraname": ("camera", 1), "andormodel": ("camera", 1), "chipname": ("camera", 1),
    "andorbaselineoffset": ("baseline_adu", 1), "gaindac": ("em_gain", 1), "detectortype": ("camera", 1),
    "cycletime": ("interval_s", 1), "emgain setting": ("em_gain", 1), "em multiplier": ("em_gain", 1),
}  # fmt: skip
# Names that say whether the electrons pass the register, and words for that they do not.
REGISTER = ("output_amplifier", "outputamplifier", "emswitch", "readoutmode", "readout mode")
UNUSED = re.compile(r"conventional|^off$", re.IGNORECASE)
SECONDS = {
    "s": 1.0, "sec": 1.0, "ms": 1e-3, "msec": 1e-3, "µs": 1e-6, "us": 1e-6, "usec": 1e-6, "ns": 1e-9, "min": 60.0,
    "h": 3600.0,
}  # fmt: skip
MICROMETRES = {"µm": 1.0, "um": 1.0, "micron": 1.0, "microns": 1.0, "nm": 1e-3, "mm": 1e3, "m": 1e6}
NANOMETRES = {unit: 1e3 * size for unit, size in MICROMETRES.items()}
UNITS = {"exposure_s": SECONDS, "interval_s": SECONDS, "pixel_size_nm": NANOMETRES}  # what may stand behind a number


def read_instrument(path: PathLike) -> Instrument:
    """What a file says of the instrument; nothing for zarr, and where nothing is written or it cannot be read."""
    import tifffile

    path = Path(path)
    if formats.is_format(path) and path.is_file():
        return _of_format(path)
    if path.suffix.lower() not in (".tif", ".tiff") or not path.is_file():
        return Instrument()
    found: dict[str, Any] = {}
    with (
        contextlib.suppress(Exception),
        complaints(),
        tifffile.TiffFile(path) as file,
    ):  # metadata must never stop a movie
        for name, value in _everything(file):
            _take(found, name, value)
    return Instrument(**found)


def _of_format(path: Path) -> Instrument:
    found: dict[str, Any] = {}
    with contextlib.suppress(Exception), warnings.catch_warnings():  # metadata must never stop a movie
        warnings.simplefilter("ignore")
        for name, value in formats.opened(path).settings:
            _take(found, name, value)
    return Instrument(**found)


def _everything(file: Any) -> Iterator[tuple[str, Any]]:
    """(name, value) pairs of all metadata, the most telling first."""
    page = file.pages[0]
    tag = page.tags.get("MicroManagerMetadata")
    for part in (tag.value if tag is not None else None, file.micromanager_metadata):
        yield from _flat(part)
    if page.is_andor:
        yield from _flat(page.andor_tags)
    if file.is_ome:
        yield from _ome(file.ome_metadata)
    described = file.imagej_metadata or {}
    for text in (str(described.get("Info", "")), page.description or ""):
        start, end = text.find("{"), text.rfind("}")
        if 0 <= start < end:
            with contextlib.suppress(json.JSONDecodeError):
                yield from _flat(json.loads(text[start : end + 1]))
        yield from re.findall(r"^\s*([A-Za-z][\w .\-]{1,40}?)\s*[=:]\s*(\S[^\r\n]*)\r?$", text, re.MULTILINE)
    unit = str(described.get("unit", "")).replace("\\u00B5", "µ")  # as ImageJ writes it
    if unit in MICROMETRES and "XResolution" in page.tags:
        over, under = page.tags["XResolution"].value
        if over and under and over != under:
            yield "PhysicalSizeX", under / over * MICROMETRES[unit]
    if "finterval" in described:
        yield "TimeIncrement", f"{described['finterval']} {described.get('tunit', 's')}"


def _flat(data: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(data, Mapping):
        return
    for name, value in data.items():
        if isinstance(value, Mapping):
            if "PropVal" in value:  # Micro-Manager 2
                yield str(name), value["PropVal"]
            else:
                yield from _flat(value)
        else:
            yield str(name), value


def _ome(text: str) -> Iterator[tuple[str, Any]]:
    import xml.etree.ElementTree as ElementTree

    for element in ElementTree.fromstring(text).iter():
        kind, given = element.tag.rpartition("}")[2], element.attrib
        for name in ("PhysicalSizeX", "ExposureTime", "TimeIncrement"):
            if name in given:
                units = MICROMETRES if name == "PhysicalSizeX" else SECONDS
                unit = given.get(f"{name}Unit", "µm" if name == "PhysicalSizeX" else "s")
                yield name, float(given[name]) * units.get(unit, float("nan"))
        if kind == "DetectorSettings":
            for name in ("Gain", "ReadOutRate"):
                if name in given:
                    yield name.replace("ReadOutRate", "readoutrate"), given[name]
        if kind == "Detector":
            for name in ("AmplificationGain", "Model"):
                if name in given:
                    yield name.replace("Model", "camera"), given[name]
        if "SignificantBits" in given:
            yield "SignificantBits", given["SignificantBits"]


def _take(found: dict[str, Any], name: str, value: Any) -> None:
    """Keep a value under the field that its name stands for, unless an earlier one was kept or it says nothing."""
    short = name.lower().strip()
    without_device = re.split(r"-", short, maxsplit=1)[-1]
    if without_device in REGISTER and UNUSED.search(str(value).strip()):
        found["register"] = "off"
    field = NAMES.get(short) or NAMES.get(without_device)
    if field is None or field[0] in found:
        return
    kind, factor = field
    if kind == "camera":
        if isinstance(value, str) and value.strip() and value.lower() not in ("unknown", "default"):
            found[kind] = value.strip()
        return
    number = re.search(r"([-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)\s*([^\W\d_]*)", str(value))
    if number is None:
        return
    if kind in UNITS and number[2]:  # a unit that is said counts, one that is unknown says nothing
        factor = UNITS[kind].get(number[2].lower().replace("μ", "µ"), float("nan"))
    size = float(number[1]) * factor
    if size > 0 and size == size:
        found[kind] = int(size) if kind == "bit_depth" else size


assert {kind for kind, _ in NAMES.values()} <= {field.name for field in fields(Instrument)}
