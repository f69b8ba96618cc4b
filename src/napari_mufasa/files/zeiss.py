"""Whether the segments of a .czi file are where and as long as they say, before a library in C++ believes them.

The format is Zeiss' "CZI (ZISRAW) File Format", version 1.2: segments with a head of 32 bytes (name, bytes allocated,
bytes used), the first of which says where the directory of the images, the metadata and the attachments lie.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any, BinaryIO

from napari_mufasa.errors import MufasaError

SEGMENT = struct.Struct("<16sqq")
FILE = struct.Struct("<52xqqiq")  # where directory, metadata and attachments lie
ENTRY = struct.Struct("<2siqiiB5xi")  # schema, pixels, position, part, compression, pyramid, dimensions
DIMENSION = struct.Struct("<4siifi")
SUBBLOCK = struct.Struct("<iiq")  # bytes of metadata, attachment, pixels
DIMENSIONS = "XYCZTRSIHVBM"
MOST_ENTRIES = 10**7
MOST_SIDE = 2**30


def check_czi(path: Path) -> None:
    """Raise `MufasaError` unless all that the library follows stays inside the file."""
    with path.open("rb") as file:
        try:
            _check(file, os.fstat(file.fileno()).st_size)
        except (ValueError, struct.error) as error:
            raise MufasaError(f"{path} is no .czi file, or damaged ({error}): copy it anew") from None


def _check(file: BinaryIO, size: int) -> None:
    first = _segment(file, size, 0, b"ZISRAWFILE")
    directory, metadata, _, attachments = FILE.unpack_from(first)
    listed = _segment(file, size, directory, b"ZISRAWDIRECTORY")
    (count,) = struct.unpack_from("<i", listed)
    if not 0 < count <= MOST_ENTRIES:
        raise ValueError(f"it lists {count} images")
    at = 128
    for _ in range(count):
        position, after = _entry(listed, at)
        block = _segment(file, size, position, b"ZISRAWSUBBLOCK", 16 + after - at)
        parts = SUBBLOCK.unpack_from(block)
        head = max(256, 16 + _entry(block, 16)[1] - 16)
        if min(parts) < 0 or position + SEGMENT.size + head + sum(parts) > size:
            raise ValueError("an image is longer than the file")
        at = after
    if metadata:
        about = _segment(file, size, metadata, b"ZISRAWMETADATA", 8)
        xml, attached = struct.unpack_from("<ii", about)
        if min(xml, attached) < 0 or metadata + SEGMENT.size + 256 + xml + attached > size:
            raise ValueError("its metadata are longer than the file")
    if attachments:
        (count,) = struct.unpack_from("<i", _segment(file, size, attachments, b"ZISRAWATTDIR", 4))
        if not 0 <= count <= (size - attachments) // 128:
            raise ValueError(f"it lists {count} attachments")


def _segment(file: BinaryIO, size: int, position: int, name: bytes, n_bytes: int | None = None) -> bytes:
    """What a segment holds, or its first bytes."""
    if not 0 <= position <= size - SEGMENT.size:
        raise ValueError("a part of it lies outside")
    file.seek(position)
    found, allocated, used = SEGMENT.unpack(file.read(SEGMENT.size))
    if found.rstrip(b"\0") != name:
        raise ValueError(f"no {name.decode()} where it should be")
    longest = size - position - SEGMENT.size
    if not 0 <= used <= longest or not allocated >= 0:
        raise ValueError("a part of it is longer than the file")
    return file.read(min(used or allocated, longest) if n_bytes is None else min(n_bytes, longest))


def _entry(content: Any, at: int) -> tuple[int, int]:
    """Where an image lies, and where its entry ends."""
    schema, _, position, _, _, _, count = ENTRY.unpack_from(content, at)
    at += ENTRY.size
    if schema != b"DV" or not 0 < count <= 4 * len(DIMENSIONS):
        raise ValueError("an image is not described as it should be")
    seen = set()
    for _ in range(count):
        letters, _, length, _, stored = DIMENSION.unpack_from(content, at)
        name = letters.rstrip(b"\0").decode("latin-1")
        least = 1 if name in ("X", "Y") else 0
        if len(name) != 1 or name not in DIMENSIONS or not least <= length < MOST_SIDE or not 0 <= stored < MOST_SIDE:
            raise ValueError("an image has a side that cannot be")
        seen.add(name)
        at += DIMENSION.size
    if not {"X", "Y"} <= seen:
        raise ValueError("an image has no sides")
    return position, at
