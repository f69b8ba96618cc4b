"""Small files as microscopes write them: .pma, .sif, .nd2, .lif from what is known of each, .czi by Zeiss' own library.

Each function writes a movie (frame, y, x) to a path and gives the path.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

Movie = np.ndarray[Any, Any]


def write_pma(path: Path, movie: Movie) -> Path:
    """As the software of single-molecule FRET does: two uint16, width and height, then the frames as uint8."""
    head = np.array([movie.shape[2], movie.shape[1]], "<u2")
    path.write_bytes(head.tobytes() + movie.astype(np.uint8).tobytes())
    return path


def write_czi(path: Path, movie: Movie) -> Path:
    """By the writer of Zeiss' own library."""
    czi = pytest.importorskip("pylibCZIrw.czi")
    with czi.create_czi(str(path)) as file:
        for t, frame in enumerate(movie.astype(np.uint16)):
            file.write(data=frame[..., None], plane={"T": t, "C": 0, "Z": 0})
        written = {"ExposureTime": 0.03, "EMGain": 250}
        file.write_metadata("movie", scale_x=107.5e-9, scale_y=107.5e-9, custom_attributes=written)
    return path


def write_sif(path: Path, movie: Movie) -> Path:
    """As Andor's Solis does (version 65559): lines of text, then the frames as float32."""
    n, height, width = movie.shape
    texts = [b"Pixel number", b"Counts", b"Pixel number"]
    head = [
        b"Andor Technology Multi-Channel File",
        b"65538 1",
        b"65559 0 0 1 1540956289 -70 " + b" " * 10 + b"0 0.03 0.04 0.04 1 \0 0.04 1e-07 0 1 250 0 0 0.0 "
        + b"0 " * 16 + b"0.0 0",
        b"DU897_BV",
        b"512 512 9",
        b"movie.sif \n65538 3",
        b"abc\n65538 " + b" " * 8 + b"0 0",
        *[b"0"] * 8,
        b"0 none",
        b"65539 0 1 0 0",
        *[b"0 1 0 0"] * 2,
        b"0",
        *[b"0"] * 3,
    ]  # fmt: skip
    body = b"\n".join(head) + b"\n" + b"".join(b"%d\n%s" % (len(text), text) for text in texts)
    body += b"65541 1 %d %d 1 %d 1 %d %d\n" % (height, width, n, n * height * width, height * width)
    body += b"65538 1 %d %d 1 1 1\n" % (height, width)
    body += b"".join(b"%d\n" % (40000 * t) for t in range(n)) + b"0\n"
    path.write_bytes(body + movie.astype("<f4").tobytes())
    return path


def write_nd2(path: Path, movie: Movie) -> Path:
    """As NIS-Elements does (version 3), not filled up to pages: named chunks, at the end a map of where they are."""
    n, height, width = movie.shape
    size = {"uiWidth": width, "uiWidthBytes": 2 * width, "uiHeight": height, "uiComp": 1, "uiBpcInMemory": 16}
    planes = {"uiCount": 1, "sPlaneNew": {"a0": {"uiCompCount": 1, "pFluorescentProbe": {"m_sName": "dye"}}}}
    times = {"uiCount": n, "dPeriod": 40.0, "dDuration": 40.0 * n, "dStart": 0.0}
    chunks = {
        b"ImageAttributesLV!": _lite(
            {"SLxImageAttributes": {**size, "uiBpcSignificant": 16, "uiSequenceCount": n, "eCompression": 2}}
        ),
        b"ImageMetadataSeqLV|0!": _lite(
            {"SLxPictureMetadata": {"bCalibrated": 1, "dCalibration": 0.1075, "sPicturePlanes": planes}}
        ),
        b"ImageMetadataLV!": _lite({"SLxExperiment": {"eType": 1, "uLoopPars": times}}),
        b"ImageTextInfoLV!": _lite({"SLxImageTextInfo": {"TextInfoItem_5": "Exposure: 30 ms\r\nEM Gain: 250"}}),
    }
    for t, frame in enumerate(movie.astype("<u2")):
        chunks[b"ImageDataSeq|%d!" % t] = bytes(8) + frame.tobytes()
    content, map_of = _chunk(b"ND2 FILE SIGNATURE CHUNK NAME01!", b"Ver3.0".ljust(64, b"\0"), 32), b""
    for name, data in chunks.items():
        map_of += name + struct.pack("<QQ", len(content), len(data))
        content += _chunk(name, data, 4072 if name.startswith(b"ImageData") else len(name) + 20)
    end = b"ND2 CHUNK MAP SIGNATURE 0000001!" + struct.pack("<Q", len(content))
    content += _chunk(b"ND2 FILEMAP SIGNATURE NAME 0001!", map_of + end, 32)
    path.write_bytes(content)
    return path


def _chunk(name: bytes, data: bytes, name_length: int) -> bytes:
    return struct.pack("<IIQ", 0x0ABECEDA, name_length, len(data)) + name.ljust(name_length, b"\0") + data


def _lite(tree: dict[str, Any]) -> bytes:
    """Nikon's "lite variant" of nested values: kind, name in UTF-16, value."""
    out = b""
    for name, value in tree.items():
        kind = 11 if isinstance(value, dict) else 6 if isinstance(value, float) else 8 if isinstance(value, str) else 3
        head = bytes([kind, len(name) + 1]) + (name + "\0").encode("utf-16-le")
        if isinstance(value, dict):
            inner = _lite(value)
            head += struct.pack("<IQ", len(value), len(head) + 12 + len(inner)) + inner + bytes(8 * len(value))
        elif isinstance(value, str):
            head += (value + "\0").encode("utf-16-le")
        else:
            head += struct.pack("<d" if isinstance(value, float) else "<I", value)
        out += head
    return out


def write_lif(path: Path, movie: Movie) -> Path:
    """As LAS X does (version 2): one XML text about everything, then the pixels."""
    n, height, width = movie.shape
    sizes = [(1, width, 2, 107.5e-9 * (width - 1), "m"), (2, height, 2 * width, 107.5e-9 * (height - 1), "m")]
    sizes += [(4, n, 2 * width * height, 0.04 * (n - 1), "s")]
    axes = "".join(
        f'<DimensionDescription DimID="{axis}" NumberOfElements="{count}" Origin="0" Length="{length}" Unit="{unit}" '
        f'BytesInc="{step}" BitInc="0"/>'
        for axis, count, step, length, unit in sizes
    )
    channel = (
        '<ChannelDescription DataType="0" ChannelTag="0" Resolution="16" NameOfMeasuredQuantity="" Min="0" '
        'Max="65535" Unit="" LUTName="Gray" IsLUTInverted="0" BytesInc="0" BitInc="0"/>'
    )
    pixels = movie.astype("<u2").tobytes()
    xml = (
        '<LMSDataContainerHeader Version="2"><Element Name="all" Visibility="1" UniqueID="0"><Children>'
        '<Element Name="movie" Visibility="1" UniqueID="1"><Data><Image><ImageDescription>'
        f"<Channels>{channel}</Channels><Dimensions>{axes}</Dimensions></ImageDescription></Image></Data>"
        f'<Memory Size="{len(pixels)}" MemoryBlockID="MemBlock_1"/></Element></Children></Element>'
        "</LMSDataContainerHeader>"
    )
    block = "MemBlock_1"
    head = struct.pack("<IIBI", 0x70, 2 * len(xml) + 5, 0x2A, len(xml)) + xml.encode("utf-16-le")
    head += struct.pack("<IIBQBI", 0x70, 2 * len(block) + 14, 0x2A, len(pixels), 0x2A, len(block))
    path.write_bytes(head + block.encode("utf-16-le") + pixels)
    return path


def write_micro_manager_stack(path: Path, movie: Movie, announced: int, first: int = 0) -> Path:
    """As Micro-Manager writes a stack: where each frame is, at the end; `announced` frames were asked for, of which
    this file's begin with number `first`; its name holds "_MMStack"."""
    n, height, width = movie.shape
    summary = json.dumps(
        {"MicroManagerVersion": "2.0.0", "Frames": announced, "Slices": 1, "Channels": 1, "Positions": 1}
        | {"TimeFirst": False, "SlicesFirst": True, "Prefix": path.name.split("_MMStack")[0]}
    ).encode()
    told = json.dumps({"Exposure-ms": 30.0, "PixelSizeUm": 0.1075}).encode()
    start, pixels = 40 + len(summary), 2 * height * width
    offsets = [start + t * (162 + pixels + len(told)) for t in range(n)]
    end = offsets[-1] + 162 + pixels + len(told)
    content = b"II*\0" + struct.pack("<IIIIIII", start, 54773648, end, 483765892, 0, 99384722, 0)
    content += struct.pack("<II", 2355492, len(summary)) + summary
    for t, frame in enumerate(movie.astype("<u2")):
        data = offsets[t] + 162
        tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 1)]
        tags += [(273, 4, 1, data), (274, 3, 1, 1), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, pixels)]
        tags += [(284, 3, 1, 1), (296, 3, 1, 3), (51123, 2, len(told), data + pixels)]
        after = offsets[t + 1] if t + 1 < n else 0
        content += struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags)
        content += struct.pack("<I", after) + frame.tobytes() + told
    content += struct.pack("<II", 3453623, n)
    content += b"".join(struct.pack("<IIIII", 0, 0, first + t, 0, offset) for t, offset in enumerate(offsets))
    path.write_bytes(content)
    return path


def write_micro_manager(path: Path, movie: Movie) -> Path:
    """As Micro-Manager 2 does: settings of all devices, as JSON, in a tag of every frame."""
    told = {"PixelSizeUm": 0.1075, "Exposure-ms": 30.0, "Interval_ms": 40.0, "Camera": "Andor"}
    settings = json.dumps(told | {"Andor-Gain": {"PropVal": "250"}})
    with tifffile.TiffWriter(path) as file:
        for frame in movie.astype(np.uint16):
            tags = [(51123, "s", 0, settings, True)]
            file.write(frame, extratags=tags, contiguous=False, metadata=None, photometric="minisblack")
    return path


WRITERS: dict[str, Callable[[Path, Movie], Path]] = {
    ".czi": write_czi, ".lif": write_lif, ".nd2": write_nd2, ".pma": write_pma, ".sif": write_sif,
    ".tif": write_micro_manager,
}  # fmt: skip
