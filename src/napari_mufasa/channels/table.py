"""Donor and acceptor as the tables that users get (docs/files.md)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from napari_mufasa.files.openfret import write_openfret
from napari_mufasa.files.traces import Unit, hdf5_file
from napari_mufasa.files.whole import PathLike, write_table
from napari_mufasa.traces.table import counted_from, holds, trace_table, write_companion

if TYPE_CHECKING:
    import pandas as pd

    from napari_mufasa.channels.pair import PairedTraces
    from napari_mufasa.model.setup import Acquisition

ABOUT = (
    "molecule", "y_px", "x_px", "y_acceptor_px", "x_acceptor_px", "brightness", "snr", "bleaching_frame",
    "window_start", "efficiency", "efficiency_sd",
)  # fmt: skip


def pair_table(paired: PairedTraces) -> pd.DataFrame:
    """The kept molecules, tidy: molecule, frame, photoelectrons (of both channels), donor, acceptor, efficiency; the
    last is empty where the molecule is dark."""
    table = trace_table(paired.together)
    for name, side in (("donor", paired.donor), ("acceptor", paired.acceptor)):
        table[name] = trace_table(side)["photoelectrons"]
    molecule = paired.molecules["molecule"].searchsorted(table["molecule"])
    table["efficiency"] = np.round(paired.efficiency[molecule, table["frame"]], 4)
    return table


def openfret_pair(path: PathLike, paired: PairedTraces, acquisition: Acquisition | None = None) -> None:
    """The kept traces of both channels in the OpenFRET format; places and efficiency of each beside them."""
    about = paired.molecules[paired.kept][[*ABOUT]].to_dict("records")
    write_openfret(
        path, {"donor": paired.donor.traces, "acceptor": paired.acceptor.traces}, paired.donor.units,
        [{str(k): v for k, v in row.items()} for row in about], title="Donor and acceptor of single molecules",
        exposure_s=None if acquisition is None else acquisition.frame_length_s, holds=holds(paired.donor)._asdict(),
    )  # fmt: skip


def write_pair(
    directory: PathLike, paired: PairedTraces, *, hdf5: bool = False, openfret: bool = False,
    acquisition: Acquisition | None = None, first_frame: int = 0, made: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """traces.csv (see `pair_table`), donor.csv and acceptor.csv as traces of one channel, molecules.csv with every
    candidate and its reason, channels.json; with `hdf5` traces.h5, with `openfret` traces.openfret.json. Frames of the
    CSV tables, and what traces.provenance.json says of them, as in `write_traces`.

    traces.h5 holds ``traces`` (of both channels together), ``donor`` and ``acceptor`` of the kept molecules.
    """
    folder = Path(directory)
    tables = {
        "traces": pair_table(paired), "donor": trace_table(paired.donor), "acceptor": trace_table(paired.acceptor),
        "molecules": paired.molecules,
    }  # fmt: skip
    for name, table in tables.items():
        write_table(folder / f"{name}.csv", counted_from(first_frame, table))
    write_companion(folder, paired.donor, ("traces.csv", "donor.csv", "acceptor.csv"), made)
    paired.channels.to_json(folder / "channels.json")
    if openfret:
        openfret_pair(folder / "traces.openfret.json", paired, acquisition)
    if hdf5:
        kept = paired.molecules["molecule"].to_numpy()[paired.kept]
        both = paired.together.traces
        with hdf5_file(folder / "traces.h5", both, cast(Unit, paired.donor.units), kept, holds(paired.donor)) as file:
            for name, side in (("donor", paired.donor), ("acceptor", paired.acceptor)):
                file.create_dataset(name, data=side.traces, compression="gzip" if both.size else None)
