"""Traces in the OpenFRET format 1.0, JSON for the exchange of single-molecule traces (docs/files.md).

https://github.com/simol-lab/OpenFRET: a title, and traces of channels, each with a type, its data, and what is known of
exposure and wavelengths; times in s, wavelengths in nm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.whole import PathLike, read_json, write_json
from napari_mufasa.provenance import made_by


def write_openfret(
    path: PathLike, channels: Mapping[str, NDArray[Any]], unit: str, about: Sequence[Mapping[str, Any]], *, title: str,
    exposure_s: float | None = None, excitation_nm: float | None = None, emission_nm: float | None = None,
    holds: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """Write traces (molecule, frame) of each channel ("donor", "acceptor"); `about` : what is known of each; `holds` :
    what the traces hold (see `files.traces.Holds`)."""
    shapes = {name: np.shape(traces) for name, traces in channels.items()}
    if not shapes or any(len(shape) != 2 or shape[0] != len(about) for shape in shapes.values()):
        raise MufasaError(f"channels have shapes {shapes} for {len(about)} molecules: give (molecule, frame) for each")
    known = {"exposure_time": exposure_s, "excitation_wavelength": excitation_nm, "emission_wavelength": emission_nm}
    said = {"unit": unit, **(holds or {})}
    traces = [
        {
            "channels": [
                {"channel_type": name, **known, "data": np.round(v[i].astype(float), 4), "metadata": said}
                for name, v in channels.items()
            ],
            "metadata": dict(molecule),
        }
        for i, molecule in enumerate(about)
    ]  # fmt: skip
    made = {name: text for name, text in made_by().items() if text}
    whole = {"title": title, "traces": traces, "metadata": {"program": "napari-mufasa", "unit": unit, **made}}
    write_json(path, {**whole, "sample_details": {}, "instrument_details": {}})


def read_openfret(path: PathLike, channel: str) -> tuple[NDArray[np.float64], dict[str, Any], NDArray[np.int64]]:
    """Traces (molecule, frame) of a channel ("donor", "acceptor" or their "sum"), what is said of it (the unit), ids.

    A file with one channel gives that one, whatever it is called.
    """
    data = read_json(path, "an OpenFRET file")
    if not isinstance(data, dict) or not isinstance(data.get("traces"), list) or not data["traces"]:
        raise MufasaError(f"cannot read traces from {path}: it holds none in the OpenFRET format; export them anew")
    rows, ids = [], []
    about: dict[str, Any] = {}
    for number, trace in enumerate(data["traces"]):
        named = {str(each["channel_type"]).lower(): each for each in trace["channels"]}
        wanted = list(named) if len(named) == 1 else ["donor", "acceptor"] if channel == "sum" else [channel]
        if missing := [name for name in wanted if name not in named]:
            raise MufasaError(f"{path} has channels {', '.join(named)} in trace {number}: there is no {missing[0]!r}")
        rows.append(np.sum([np.asarray(named[name]["data"], dtype=np.float64) for name in wanted], axis=0))
        about = about or named[wanted[0]].get("metadata") or {}
        ids.append((trace.get("metadata") or {}).get("molecule", number))
    if len({len(row) for row in rows}) != 1:
        lengths = sorted({len(row) for row in rows})
        raise MufasaError(f"{path}: traces have {lengths[0]} to {lengths[-1]} frames; all need the same number")
    numbers = all(isinstance(i, int) for i in ids)
    return np.stack(rows), about, np.array(ids if numbers else range(len(rows)), dtype=np.int64)
