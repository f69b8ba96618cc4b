"""What microscopes write beside TIFF: Nikon .nd2, Andor .sif, Zeiss .czi, Leica .lif, and .pma of smFRET software.

Each is read frame by frame by its own library (``pip install 'napari-mufasa[formats]'``), but for .pma, whose few bytes
of head are read here.
"""

from __future__ import annotations

import io
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.zeiss import check_czi

Read = Callable[[int], NDArray[Any]]
CHUNK_BYTES = 2**22
MOST_TEXT_BYTES = 2**24
WORDS = {"C": "channels", "Z": "planes (z)", "P": "positions", "M": "tiles", "S": "scenes or colours"}


@dataclass(frozen=True)
class Opened:
    """A movie in one of the formats: its frames, and (name, value) pairs of what is said of the instrument."""

    frames: FrameReader
    settings: tuple[tuple[str, Any], ...] = ()


class FrameReader:
    """Frames of a file as an array (frame, y, x), read when they are asked for; the file is open only meanwhile.

    reading : opens the file and gives a function from a frame's number to its (y, x) pixels
    """

    ndim = 3

    def __init__(
        self, shape: tuple[int, int, int], dtype: Any, reading: Callable[[], AbstractContextManager[Read]]
    ) -> None:
        self.shape, self.dtype, self._reading = shape, np.dtype(dtype), reading
        frame_bytes = max(1, shape[1] * shape[2] * self.dtype.itemsize)
        self.chunks = (max(1, min(shape[0], CHUNK_BYTES // frame_bytes)), shape[1], shape[2])
        self._lock = threading.Lock()  # the libraries' files are not made to be read by several threads

    def __getitem__(self, index: Any) -> NDArray[Any]:
        first, *rest = index if isinstance(index, tuple) else (index,)
        numbers = np.arange(self.shape[0])[first]
        with self._lock, self._reading() as read:
            if np.ndim(numbers) == 0:
                frame: NDArray[Any] = np.asarray(read(int(numbers)), self.dtype)[tuple(rest)]
                return frame
            stack = np.empty((len(numbers), *self.shape[1:]), self.dtype)
            for i, number in enumerate(numbers):
                stack[i] = read(int(number))
        cut: NDArray[Any] = stack[(slice(None), *rest)]
        return cut


def is_format(path: Path) -> bool:
    return path.suffix.lower() in FORMATS


def opened(path: Path) -> Opened:
    """The movie of a file in one of `FORMATS`; raises `MufasaError` where it is no single stack of frames, or where the
    library that reads it is missing."""
    found = FORMATS[path.suffix.lower()](path)
    if found.frames.shape[0] == 0 or 0 in found.frames.shape:
        raise MufasaError(f"{path} holds no image: export it anew")
    return found


def _library(name: str, package: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        raise MufasaError(
            f"this format needs the package {package}: pip install 'napari-mufasa[formats]', or export it as TIFF"
        ) from None


def _one_stack(path: Path, sizes: Mapping[str, int]) -> int:
    """How many frames axes of these sizes make; raises for channels, planes, positions beside them."""
    others = {axis: n for axis, n in sizes.items() if axis not in "TYX" and n > 1}
    if others:
        counts = ", ".join(f"{n} {WORDS.get(axis, f'along {axis}')}" for axis, n in others.items())
        raise MufasaError(f"{path} has {counts}: needs one stack (frame, y, x); save one of them as its own file")
    return int(sizes.get("T", 1))


# Nikon ----------------------------------------------------------------------------------------------------
def _nd2(path: Path) -> Opened:
    nd2 = _library("nd2", "nd2")

    @contextmanager
    def reading() -> Iterator[Read]:
        with nd2.ND2File(path) as file:

            def read(number: int) -> NDArray[Any]:
                # A copy: the library gives the file's own memory, which is gone once the file is closed.
                frame = np.array(file.read_frame(number)).reshape(shape[1:])
                # The library gives zeros for frames that a truncated file lacks; no camera records a frame of zeros.
                if not frame.any():
                    raise MufasaError(f"{path} lacks frame {number}: copy it anew")
                return frame

            yield read

    with nd2.ND2File(path) as file:
        sizes = dict(file.sizes)
        shape = (_one_stack(path, sizes), int(sizes["Y"]), int(sizes["X"]))
        return Opened(FrameReader(shape, file.dtype, reading), tuple(_nd2_settings(file)))


def _nd2_settings(file: Any) -> Iterator[tuple[str, Any]]:
    size_um = _nd2_pixel_um(file)
    if size_um and size_um != 1.0:  # 1 µm stands where none was set
        yield "PixelSizeUm", size_um
    for text in dict(file.text_info or {}).values():
        yield from spoken(str(text))
    for loop in file.experiment or []:
        period_ms = getattr(getattr(loop, "parameters", None), "periodMs", None)
        if period_ms:
            yield "Interval_ms", period_ms


def _nd2_pixel_um(file: Any) -> float:
    """From the chunk itself: the library's own way first makes lists as long as a channel claims to have components."""
    if file.is_legacy:
        return float(file.voxel_size().x)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # one of the two is not there
        chunks = file.unstructured_metadata(include={"ImageMetadataSeqLV|0", "ImageMetadataSeq|0"})
    about = next(iter(chunks.values()), None)
    about = _at(about, "SLxPictureMetadata") or about
    return float(_at(about, "Calibration") or 0.0) if _at(about, "Calibrated") else 0.0


def spoken(text: str) -> Iterator[tuple[str, Any]]:
    """(name, value) pairs of lines like "Exposure: 30 ms", times in the unit that the name stands for elsewhere."""
    factor = {"s": 1e3, "ms": 1.0, "µs": 1e-3, "us": 1e-3, "min": 6e4}
    for name, value in re.findall(r"^\s*([A-Za-z][\w .\-]{1,40}?)\s*[=:]\s*(\S[^\r\n]*)\r?$", text, re.MULTILINE):
        if name.strip().lower() in ("exposure", "exposure time"):
            timed = re.match(r"([\d.]+)\s*(s|ms|µs|us|min)\b", value)
            if timed:
                yield "Exposure-ms", float(timed[1]) * factor[timed[2]]
            continue
        yield name, value


# Andor ----------------------------------------------------------------------------------------------------
def _sif(path: Path) -> Opened:
    sif = _library("sif_parser", "sif_parser")
    with warnings.catch_warnings(), _EndsInWords(path.open("rb", buffering=0)) as file:
        warnings.simplefilter("ignore")
        data, info = sif.np_open(file, lazy="memmap")

    @contextmanager
    def reading() -> Iterator[Read]:
        yield lambda number: np.asarray(data[number])

    return Opened(FrameReader(data.shape, data.dtype, reading), tuple((k, v) for k, v in info.items()))


class _EndsInWords(io.BufferedReader):
    """A file whose end is an error: the library would ask for the next word for ever."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > MOST_TEXT_BYTES:
            raise ValueError(f"a text of {size} bytes")
        data = super().read(size)
        if not data and size != 0:
            raise EOFError("it ends too early")
        return data


# Zeiss ----------------------------------------------------------------------------------------------------
def _czi(path: Path) -> Opened:
    czi = _library("pylibCZIrw.czi", "pylibCZIrw")
    check_czi(path)
    kinds = {"Gray8": np.uint8, "Gray16": np.uint16, "Gray32Float": np.float32}

    @contextmanager
    def reading() -> Iterator[Read]:
        with czi.open_czi(str(path)) as file:
            roi = tuple(file.total_bounding_rectangle)
            yield lambda number: file.read(plane={"T": first + number, "C": 0, "Z": 0}, roi=roi)[..., 0]

    with czi.open_czi(str(path)) as file:
        ends = dict(file.total_bounding_box)
        sizes = {axis: int(stop - start) for axis, (start, stop) in ends.items()}
        if len(file.scenes_bounding_rectangle) > 1:
            sizes["S"] = len(file.scenes_bounding_rectangle)
        first, kind = int(ends.get("T", (0, 1))[0]), str(file.get_channel_pixel_type(0))
        if kind not in kinds:
            raise MufasaError(f"{path} holds {kind} pixels, colours or complex numbers: needs one grey stack")
        shape = (_one_stack(path, sizes), sizes["Y"], sizes["X"])
        return Opened(FrameReader(shape, kinds[kind], reading), tuple(_czi_settings(file.metadata)))


def _czi_settings(metadata: Any) -> Iterator[tuple[str, Any]]:
    about = _at(metadata, "ImageDocument", "Metadata")
    for distance in _listed(_at(about, "Scaling", "Items", "Distance")):
        if distance.get("@Id") == "X" and float(distance.get("Value") or 0) > 0:
            yield "PixelSizeUm", float(distance["Value"]) * 1e6
    image = _at(about, "Information", "Image")
    for channel in _listed(_at(image, "Dimensions", "Channels", "Channel")):
        if channel.get("ExposureTime"):
            yield "ExposureTime", float(channel["ExposureTime"]) * 1e-9  # in ns
        yield from (_at(channel, "DetectorSettings") or {}).items()
    interval = _at(image, "Dimensions", "T", "Positions", "Interval", "Increment")
    if interval:
        yield "TimeIncrement", interval
    for detector in _listed(_at(about, "Information", "Instrument", "Detectors", "Detector")):
        yield "Camera", _at(detector, "Manufacturer", "Model") or detector.get("@Name")
    for name, value in (_at(about, "Information", "CustomAttributes", "KeyValue") or {}).items():
        yield str(name), value.get("#text") if isinstance(value, Mapping) else value


def _at(tree: Any, *names: str) -> Any:
    for name in names:
        tree = tree.get(name) if isinstance(tree, Mapping) else None
    return tree


def _listed(found: Any) -> Sequence[Mapping[str, Any]]:
    return [one for one in (found if isinstance(found, list) else [found]) if isinstance(one, Mapping)]


# Leica ----------------------------------------------------------------------------------------------------
def _lif(path: Path) -> Opened:
    lif = _library("liffile", "liffile")
    with path.open("rb") as start:
        # The library also takes texts that name the files where the pixels are; those would be opened.
        if start.read(4) != b"\x70\0\0\0":
            raise MufasaError(f"{path} is no .lif file, or damaged: export it anew")

    @contextmanager
    def reading() -> Iterator[Read]:
        with lif.LifFile(path) as file:
            image = file.images[0]
            yield lambda number: np.asarray(image.frame(**({"T": number} if "T" in image.sizes else {})))

    with lif.LifFile(path) as file:
        if len(file.images) == 0:
            raise MufasaError(f"{path} holds no image: export it anew")
        image, n = file.images[0], len(file.images)
        if n > 1:
            warnings.warn(f"{path} holds {n} series of images: the first, {image.name}, is read", stacklevel=4)
        sizes = dict(image.sizes)
        shape = (_one_stack(path, sizes), int(sizes["Y"]), int(sizes["X"]))
        settings = [*_steps(image.coords, "X", "PixelSizeUm", 1e6), *_steps(image.coords, "T", "TimeIncrement", 1.0)]
        return Opened(FrameReader(shape, image.dtype, reading), tuple(settings))


def _steps(coords: Mapping[str, Any], axis: str, name: str, factor: float) -> Iterator[tuple[str, Any]]:
    """The step along an axis, whose coordinates are in m or s."""
    at = np.asarray(coords.get(axis, ()), dtype=float)
    if len(at) > 1 and at[-1] > at[0]:
        yield name, (at[-1] - at[0]) / (len(at) - 1) * factor


# smFRET ---------------------------------------------------------------------------------------------------
def _pma(path: Path) -> Opened:
    """Two uint16, width and height, then frames of uint8, as the software of single-molecule FRET writes them."""
    with path.open("rb") as file:
        head = np.frombuffer(file.read(4), "<u2")
    n_bytes = path.stat().st_size - 4
    if len(head) < 2 or 0 in head or n_bytes < int(head[0]) * int(head[1]):
        raise MufasaError(f"{path} is no .pma movie, or damaged: copy it anew")
    width, height = int(head[0]), int(head[1])
    n_frames, over = divmod(n_bytes, width * height)
    if over:
        raise MufasaError(
            f"{path} is truncated: {over} bytes after {n_frames} frames of {height} × {width}; copy it anew"
        )

    @contextmanager
    def reading() -> Iterator[Read]:
        with path.open("rb") as file:

            def read(number: int) -> NDArray[Any]:
                file.seek(4 + number * width * height)
                return np.frombuffer(file.read(width * height), np.uint8).reshape(height, width)

            yield read

    return Opened(FrameReader((n_frames, height, width), np.uint8, reading))


FORMATS: dict[str, Callable[[Path], Opened]] = {
    ".nd2": _nd2, ".sif": _sif, ".czi": _czi, ".lif": _lif, ".pma": _pma,
}  # fmt: skip
