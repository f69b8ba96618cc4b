"""What the scripts of the gallery share: their arguments, and how a figure becomes a small file."""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from napari_mufasa import files
from napari_mufasa.report.plots.themes import image_bytes

IMAGES = Path(__file__).resolve().parents[1] / "images"


def arguments(about: str, folder: str = "gallery", more: Sequence[str] = ()) -> Any:
    """--out: where the pictures go; --quick: few molecules and frames, to see that it runs; `more`: switches."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=IMAGES / folder)
    parser.add_argument("--quick", action="store_true")
    for name in more:
        parser.add_argument(name, action="store_true")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    return given


def save(figure: Any, path: Path, dpi: int = 110) -> None:
    """A PNG of 128 colours: figures do not need more."""
    from PIL import Image

    image = Image.open(io.BytesIO(image_bytes(figure, dpi=dpi))).convert("RGB")
    buffer = io.BytesIO()
    image.quantize(128, dither=Image.Dither.NONE).save(buffer, "png", optimize=True)
    files.write_bytes(path, buffer.getvalue())
    print(f"{path.name}: {path.stat().st_size // 1000} kB")
