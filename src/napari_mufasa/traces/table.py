"""Extracted traces as the tables that users get: traces.csv and molecules.csv, by the columns of docs/files.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from napari_mufasa.files.openfret import write_openfret
from napari_mufasa.files.traces import COMPANION, HOLDS, Holds, Unit, hdf5_file, tidy
from napari_mufasa.files.whole import PathLike, write_json, write_table
from napari_mufasa.provenance import provenance

if TYPE_CHECKING:
    import pandas as pd

    from napari_mufasa.model.setup import Acquisition
    from napari_mufasa.traces.extract import TraceSet


FRAMES = ("frame", "bleaching_frame", "window_start", "first_found", "last_found")  # columns that name a frame


def counted_from(first_frame: int, table: pd.DataFrame) -> pd.DataFrame:
    """A table of traces that begin with the movie's `first_frame`, its frames counted from the movie's first; −1 is
    none."""
    frames = (name for name in FRAMES if name in table)
    return table.assign(**{name: table[name] + first_frame * (table[name] >= 0) for name in frames})


def holds(traces: TraceSet) -> Holds:
    """What the traces hold."""
    return Holds(traces.options.profile, traces.options.subtract_background, float(traces.pixel_share))


def write_companion(
    directory: PathLike, traces: TraceSet, tables: Sequence[str] = ("traces.csv",),
    made: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """traces.provenance.json: where the tables come from (`made`, see `provenance`), and what those of traces hold."""
    said = {table: holds(traces)._asdict() for table in tables}
    write_json(Path(directory) / COMPANION, {**(made or provenance()), HOLDS: said})


def trace_table(traces: TraceSet) -> pd.DataFrame:
    """The kept traces, tidy (molecule, frame, photoelectrons); frames count from the first that was read."""
    kept = traces.molecules[traces.kept]
    table = tidy(traces.traces, cast(Unit, traces.units), kept["molecule"].to_numpy())
    if traces.options.window is not None:
        # A molecule kept by hand may have no window of its own: its last frames are shown then (see `TraceSet`).
        last = traces.all_traces.shape[1] - traces.options.window
        start = kept["window_start"].to_numpy()
        table["frame"] += np.repeat(np.where(start < 0, last, start), traces.traces.shape[1])
    return table


def path_table(traces: TraceSet) -> pd.DataFrame:
    """Where the kept molecules were followed to, tidy (molecule, frame, y_px, x_px), from first to last sighting."""
    import pandas as pd

    assert traces.path_px is not None  # they were followed
    parts = []
    for i in np.flatnonzero(traces.kept):
        row = traces.molecules.iloc[i]
        frames = np.arange(row["first_found"], row["last_found"] + 1)
        y, x = traces.path_px[i, frames].T
        parts.append(pd.DataFrame({"molecule": row["molecule"], "frame": frames, "y_px": y, "x_px": x}))
    return pd.concat(parts) if parts else pd.DataFrame(columns=["molecule", "frame", "y_px", "x_px"])


def openfret_table(path: PathLike, traces: TraceSet, acquisition: Acquisition | None = None) -> None:
    """The kept traces in the OpenFRET format, as a donor's; place, brightness and bleaching of each beside it."""
    kept = traces.molecules[traces.kept]
    columns = ("molecule", "y_px", "x_px", "brightness", "snr", "bleaching_frame", "window_start")
    about = kept[[*columns]].to_dict("records")
    exposure_s = None if acquisition is None else acquisition.frame_length_s
    write_openfret(
        path, {"donor": traces.traces}, traces.units, [{str(k): v for k, v in row.items()} for row in about],
        title="Traces of single molecules", exposure_s=exposure_s, holds=holds(traces)._asdict(),
    )  # fmt: skip


def write_traces(
    directory: PathLike, traces: TraceSet, *, hdf5: bool = False, openfret: bool = False,
    acquisition: Acquisition | None = None, first_frame: int = 0, made: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """traces.csv with the kept traces and molecules.csv with every candidate and its reason; of molecules that were
    followed paths.csv; with `hdf5` traces.h5, with `openfret` traces.openfret.json, which tells the exposure of
    the `acquisition`. Where the traces begin with a later `first_frame` of the movie, frames in the CSV tables count
    from the movie's first nevertheless; in the other files from the first of the traces that stand beside them.
    Beside the tables traces.provenance.json says where they come from (`made`) and what the traces hold.

    traces.h5 holds the kept traces (``traces``, ``molecule``), the table's columns in the group ``molecules`` and
    every candidate's whole trace in ``all_traces``.
    """
    tables = {"traces": trace_table(traces), "molecules": traces.molecules}
    if traces.path_px is not None:
        tables["paths"] = path_table(traces).round(3)
    for name, table in tables.items():
        write_table(Path(directory) / f"{name}.csv", counted_from(first_frame, table))
    write_companion(directory, traces, made=made)
    if openfret:
        openfret_table(Path(directory) / "traces.openfret.json", traces, acquisition)
    if not hdf5:
        return
    kept = traces.molecules["molecule"].to_numpy()[traces.kept]
    path, unit = Path(directory) / "traces.h5", cast(Unit, traces.units)
    with hdf5_file(path, traces.traces, unit, kept, holds(traces)) as file:
        file.create_dataset("all_traces", data=traces.all_traces, compression="gzip")
        for name, column in traces.molecules.items():
            values = column.to_numpy()
            file[f"molecules/{name}"] = values.astype(bytes) if values.dtype == object else values
