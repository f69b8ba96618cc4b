"""Which movies a batch is of: a folder, or a list (docs/batches.md)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import MOVIE_SUFFIXES

COLUMNS = ("movie", "condition", "model", "dark")
SEPARATORS = ",;\t"


@dataclass(frozen=True)
class Entry:
    """A movie of a batch: `name` is that of its results; `condition` of the experiment, "" where there is one only;
    `model`, `dark`: files, None where those of the batch count."""

    movie: Path
    name: str
    condition: str = ""
    model: Path | None = None
    dark: Path | None = None


def read_entries(source: Path, *, model: Path | None = None, dark: Path | None = None) -> list[Entry]:
    """The movies of a folder or a list, in order; `model` and `dark` are of all that name none themselves.

    A folder: all TIFF and zarr movies in it and in its own folders, whose names are conditions then; other than `dark`.
    A list: a CSV table with a column movie and any of condition, model, dark; or one path in a line. Paths in a list
    count from its folder.

    Raises `MufasaError` for a source without movies, paths that are not there, movies without a model.
    """
    found: list[tuple[Path, str, Path | None, Path | None]]
    if source.is_dir():
        found = [
            (path, "" if path.parent == source else path.parent.name, None, None)
            for path in sorted([*source.iterdir(), *(p for f in source.iterdir() if _opens(f) for p in f.iterdir())])
            if _is_movie(path) and not (dark is not None and path.exists() and dark.exists() and path.samefile(dark))
        ]
        if not found:
            raise MufasaError(f"{source} holds no movie: give a folder of {', '.join(MOVIE_SUFFIXES)}, or a list")
    elif source.is_file():
        found = _listed(source)
    else:
        raise MufasaError(f"no file or folder {source}: give a folder of movies, or a list (CSV) of them")
    for path in {path for row in found for path in (row[0], *row[2:]) if path is not None}:
        if not path.exists():
            raise MufasaError(f"no file {path}, which {source} lists: correct the list")
    for path, _, own, _ in found:
        if own is None and model is None:
            raise MufasaError(f"{path} has no model: add --model MODEL.json, or a column 'model' to the list")
    names = _names([(path, condition) for path, condition, _, _ in found])
    return [
        Entry(path, name, condition, own or model, its_dark or dark)
        for name, (path, condition, own, its_dark) in zip(names, found, strict=True)
    ]


def _opens(path: Path) -> bool:
    return path.is_dir() and not _is_movie(path) and not path.name.startswith(".")


def _is_movie(path: Path) -> bool:
    return path.name.lower().endswith(MOVIE_SUFFIXES) and not path.name.startswith(".")


def _listed(source: Path) -> list[tuple[Path, str, Path | None, Path | None]]:
    import pandas as pd

    try:
        lines = [line for line in source.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except UnicodeDecodeError:
        raise MufasaError(f"{source} is no list: give a folder, a CSV table or one path in a line") from None
    if not lines:
        raise MufasaError(f"{source} is empty: give one movie in a line")
    if "movie" not in [_bare(cell) for cell in re.split(f"[{SEPARATORS}]", lines[0])]:
        return [(_from(source, _bare(line)), "", None, None) for line in lines]
    try:
        # Not guessed by the reader: of a table of one column it takes a letter of the head for the separator.
        mark = next((mark for mark in SEPARATORS if mark in lines[0]), ",")
        named = None if _bare(lines[0].split(mark)[0]) else 0  # R writes a column without a name: the rows' names
        table = pd.read_csv(source, sep=mark, engine="python", dtype=str, encoding="utf-8-sig", index_col=named)
        table = table.fillna("")
    except ValueError as error:
        raise MufasaError(f"{source} is not a readable table ({error}): write it anew") from None
    table.columns = [str(name).strip() for name in table.columns]
    unknown = [name for name in table.columns if name not in COLUMNS]
    if unknown:
        raise MufasaError(f"{source} has a column {unknown[0]!r}: drop it; a list has {', '.join(COLUMNS)}")
    rows = []
    for row in table.to_dict("records"):
        paths = {key: _from(source, text) if (text := str(row.get(key, "")).strip()) else None for key in COLUMNS}
        if paths["movie"] is not None:
            rows.append((paths["movie"], str(row.get("condition", "")).strip(), paths["model"], paths["dark"]))
    if not rows:
        raise MufasaError(f"{source} lists no movie: give one in a line")
    return rows


def _bare(text: str) -> str:
    """A cell or a line without blanks and quotes around it."""
    text = text.strip()
    return text[1:-1].strip() if len(text) > 1 and text[0] == text[-1] == '"' else text


def _from(source: Path, text: str) -> Path:
    path = Path(text)
    return path if path.is_absolute() else source.parent / path


def _names(movies: list[tuple[Path, str]]) -> list[str]:
    """A name for each that no other has, fit for a folder: condition and stem, numbered where that is not enough."""
    names: list[str] = []
    for path, condition in movies:
        stem = re.sub(r"(\.ome)?\.(tiff?|zarr|\w{2,4})$", "", path.name, flags=re.IGNORECASE)
        plain = re.sub(r"[^\w.+-]+", "_", f"{condition}-{stem}" if condition else stem).strip("._") or "movie"
        name, count = plain, 1
        while name.lower() in (taken.lower() for taken in names):
            count += 1
            name = f"{plain}-{count}"
        names.append(name)
    return names
