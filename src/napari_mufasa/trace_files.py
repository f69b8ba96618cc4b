"""Traces and molecules as files: traces.csv and molecules.csv out, traces in (SPEC.md §10)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import io
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    import pandas as pd

    from napari_mufasa.traces import TraceSet

Unit = Literal["photoelectrons", "photons", "adu"]
UNITS = ("photoelectrons", "photons", "adu")


def trace_table(traces: TraceSet) -> pd.DataFrame:
    """The kept traces as rows (molecule, frame, photoelectrons); frames count from the movie's first."""
    import pandas as pd

    kept = traces.molecules[traces.molecules["kept"]]
    n_frames = traces.traces.shape[1]
    start = kept["window_start"].to_numpy() if traces.options.window is not None else np.zeros(len(kept), int)
    return pd.DataFrame(
        {
            "molecule": np.repeat(kept["molecule"].to_numpy(), n_frames),
            "frame": (start[:, None] + np.arange(n_frames)).ravel(),
            "photoelectrons": traces.traces.ravel(),
        }
    )


def write_traces(directory: Path, traces: TraceSet) -> None:
    """traces.csv with the kept traces and molecules.csv with every candidate and its reason."""
    io.write_table(directory / "traces.csv", trace_table(traces))
    io.write_table(directory / "molecules.csv", traces.molecules)


def read_traces(path: Path) -> tuple[NDArray[np.float64], Unit]:
    """Traces (molecule, frame) and their unit, from a table or an image.

    CSV: columns molecule, frame and one of photoelectrons, photons, adu; every molecule needs as many frames.
    TIFF: an image (frame, molecule) as recorded, in ADU. Raises `MufasaError`.
    """
    if path.suffix.lower() in (".tif", ".tiff"):
        image = io.load(path)
        if image.shape[0] != 1:
            raise MufasaError(f"{path} is a movie {image.shape}: traces are one image (frame, molecule) or a CSV")
        return image[0].T.astype(np.float64), "adu"
    import pandas as pd

    try:
        table = pd.read_csv(path)
    except FileNotFoundError:
        raise MufasaError(f"no file {path}: give traces.csv as 'traces' writes it") from None
    except (ValueError, OSError) as error:
        raise MufasaError(f"{path} is not a table of traces ({error})") from None
    unit = next((name for name in UNITS if name in table.columns), None)
    if unit is None or not {"molecule", "frame"} <= set(table.columns):
        raise MufasaError(
            f"{path} has columns {', '.join(map(str, table.columns))}: needs molecule, frame and photoelectrons"
        )
    return _rows(table, unit, path), unit  # type: ignore[return-value]


def _rows(table: pd.DataFrame, unit: str, path: Path) -> NDArray[np.float64]:
    if table.empty:
        raise MufasaError(f"{path} holds no trace")
    lengths = table.groupby("molecule")["frame"].nunique()
    if lengths.nunique() != 1 or lengths.iloc[0] * len(lengths) != len(table):
        raise MufasaError(
            f"{path}: molecules have {lengths.min()} to {lengths.max()} frames; all need the same number, each once"
        )
    ordered: Any = table.sort_values(["molecule", "frame"])[unit].to_numpy()
    try:
        return np.asarray(ordered, dtype=np.float64).reshape(len(lengths), -1)
    except ValueError:
        raise MufasaError(f"{path}: column {unit} holds text; give numbers") from None
