"""Traces as files: tidy CSV, 2-D TIFF, HDF5, OpenFRET, and the .traces files of single-molecule FRET software
(docs/files.md)."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.movies import load
from napari_mufasa.files.openfret import read_openfret, write_openfret
from napari_mufasa.files.opening import complaints
from napari_mufasa.files.whole import PathLike, read_json, replacing, write_bytes, write_table
from napari_mufasa.provenance import made_by

if TYPE_CHECKING:
    import pandas as pd

Unit = Literal["photoelectrons", "photons", "adu"]
Channel = Literal["donor", "acceptor", "sum"]
UNITS: tuple[Unit, ...] = ("photoelectrons", "photons", "adu")


Profile = Literal["psf", "sum", "brightest_pixel"]
COMPANION, HOLDS = "traces.provenance.json", "holds"  # beside tables: where they come from, and what each of them holds


class Holds(NamedTuple):
    """What traces hold: of which pixels, with their background or without, and which share of a molecule's light."""

    profile: Profile
    background_subtracted: bool
    pixel_share: float

    @classmethod
    def told(cls, said: Any) -> Holds | None:
        """From plain data, or None where it is not told whole."""
        if not isinstance(said, Mapping) or not set(cls._fields) <= set(said):
            return None
        profile, share = _text(said["profile"]), said["pixel_share"]
        if profile not in get_args(Profile) or not (isinstance(share, (int, float, np.number)) and 0 < share <= 1):
            return None
        return cls(cast(Profile, profile), bool(said["background_subtracted"]), float(share))


@dataclass(frozen=True)
class TraceFile:
    """Traces read from a file; what `compare_traces`, `diagnose_traces` and `infer_photophysics` take as it is.

    traces : (molecule, frame) float64; unit : one of `UNITS`; molecules : (molecule,) ids as in the file
    positions_px : (molecule, 2) (y, x) where the file or a companion gives them, else None
    holds : what the file or a companion says that the traces hold, else None
    """

    traces: NDArray[np.float64]
    unit: Unit
    molecules: NDArray[np.int64]
    path: Path
    positions_px: NDArray[np.float64] | None = None
    holds: Holds | None = None

    @property
    def background_subtracted(self) -> bool:
        """Whether the background was taken off: as the file says, else it is in counts of a TIFF, as recorded, only."""
        if self.holds is not None:
            return self.holds.background_subtracted
        return not (self.unit == "adu" and self.path.suffix.lower() in (".tif", ".tiff"))

    @property
    def profile(self) -> Profile:
        """What each trace is read of: as the file says, else the whole spot, or, as recorded, one pixel."""
        if self.holds is not None:
            return self.holds.profile
        return "psf" if self.background_subtracted else "brightest_pixel"

    @property
    def pixel_share(self) -> float | None:
        """Share of a molecule's light that a trace holds, where the file says it."""
        return None if self.holds is None else self.holds.pixel_share


def read_traces(path: PathLike) -> tuple[NDArray[np.float64], Unit]:
    """Traces (molecule, frame) and their unit; see `read_trace_file`."""
    found = read_trace_file(path)
    return found.traces, found.unit


def read_trace_file(path: PathLike, *, unit: Unit | None = None, channel: Channel = "donor") -> TraceFile:
    """Read traces by the file's suffix.

    * ``.csv``: tidy (molecule, frame, and one column photoelectrons, photons or adu)
    * ``.tif``: 2-D (frame, molecule); whole numbers are taken as ADU, others as photoelectrons
    * ``.h5``: dataset ``traces`` (molecule, frame) with attribute ``unit``, or the file's only 2-D dataset
    * ``.traces``: int32 frames, int16 traces, int16 (frame, trace), donor and acceptor in turn; `channel`
      chooses; in counts with the background taken off already; positions from the ``.pks`` file beside it

    * ``.json``: OpenFRET; `channel` chooses where there are several; counts where it says no unit

    What the traces hold (profile, background, share of the light) is read from HDF5, from OpenFRET, and for a CSV from
    the ``traces.provenance.json`` beside it, where they were written here. `unit` says it where the file does not; of a
    CSV with several columns of values it chooses. Raises `MufasaError` in one clear line, also where the file says
    another unit.
    """
    path = Path(path)
    if not path.is_file():
        raise MufasaError(f"no file {path}: give a .csv, .tif, .h5, .json (OpenFRET) or .traces file of traces")
    if unit is not None and unit not in UNITS:
        raise MufasaError(f"unit {unit!r} is unknown: choose one of {', '.join(UNITS)}")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise MufasaError(f"cannot read traces from {path}: use one of {', '.join(sorted(_READERS))}")
    try:
        found: TraceFile = reader(path, channel, unit)
    except MufasaError:
        raise
    except Exception as error:
        raise MufasaError(f"{path} is not a readable file of traces ({error}): export it anew") from None
    if found.traces.ndim != 2 or found.traces.size == 0:
        raise MufasaError(f"{path} has shape {found.traces.shape}: needs two-dimensional, non-empty traces")
    if not np.isfinite(found.traces).all():
        raise MufasaError(f"{path} has values that are not finite: drop or fill those frames first")
    return found if unit is None else replace(found, unit=unit)


def tidy(traces: NDArray[Any], unit: Unit, molecules: NDArray[np.integer]) -> pd.DataFrame:
    """One row per molecule and frame: molecule, frame, and the value under its unit's name."""
    import pandas as pd

    n, n_frames = traces.shape
    return pd.DataFrame(
        {
            "molecule": np.repeat(molecules, n_frames),
            "frame": np.tile(np.arange(n_frames), n),
            unit: np.round(traces.ravel().astype(np.float64), 4),
        }
    )


def write_trace_file(
    path: PathLike, traces: NDArray[Any], unit: Unit = "photoelectrons", molecules: NDArray[np.integer] | None = None
) -> None:
    """Write traces (molecule, frame) as tidy CSV, 2-D TIFF (frame, molecule) float32, HDF5, or OpenFRET (.json), by the
    suffix."""
    traces = np.asarray(traces)
    if traces.ndim != 2 or traces.size == 0:
        raise MufasaError(f"traces have shape {traces.shape}: needs non-empty (molecule, frame)")
    if unit not in UNITS:
        raise MufasaError(f"unit {unit!r} is unknown: choose one of {', '.join(UNITS)}")
    ids = np.arange(len(traces)) if molecules is None else np.asarray(molecules)
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        write_table(path, tidy(traces, unit, ids))
    elif suffix in (".tif", ".tiff"):
        import tifffile

        with replacing(path) as temporary:
            data = np.ascontiguousarray(traces.T, dtype=np.float32)
            tifffile.imwrite(temporary, data, metadata={"unit": unit}, photometric="minisblack")
    elif suffix in (".h5", ".hdf5"):
        with hdf5_file(path, traces, unit, ids):
            pass
    elif suffix == ".json":
        write_openfret(path, {"donor": traces}, unit, [{"molecule": int(i)} for i in ids], title=Path(path).stem)
    else:
        raise MufasaError(f"cannot write traces to {path}: use .csv, .tif, .h5 or .json (OpenFRET)")


@contextlib.contextmanager
def hdf5_file(
    path: PathLike, traces: NDArray[Any], unit: Unit, ids: NDArray[np.integer], holds: Holds | None = None
) -> Iterator[Any]:
    """A new HDF5 file with these traces and what they hold, open for more; it appears when it is whole.

    Made in memory: on a full disk the library would take the process with it.
    """
    content = io.BytesIO()
    with _h5py().File(content, "w") as file:
        dataset = file.create_dataset("traces", data=traces, compression="gzip" if traces.size else None)
        dataset.attrs["unit"] = unit
        dataset.attrs["axes"] = "molecule, frame"
        dataset.attrs.update({} if holds is None else holds._asdict())
        file.create_dataset("molecule", data=ids)
        file.attrs.update({name: text for name, text in made_by().items() if text})
        yield file
    write_bytes(path, content.getvalue())


def _read_csv(path: Path, channel: Channel, wanted: Unit | None) -> TraceFile:
    import pandas as pd

    table = pd.read_csv(path)
    unit = wanted if wanted in table.columns else next((u for u in UNITS if u in table.columns), None)
    _no_other(path, unit, wanted)
    if unit is None or not {"molecule", "frame"} <= set(table.columns):
        raise MufasaError(
            f"{path} has columns {', '.join(map(str, table.columns))}: needs molecule, frame and one of "
            f"{', '.join(UNITS)}"
        )
    if table.empty:
        raise MufasaError(f"{path} holds no trace: give one row per molecule and frame")
    if table[["molecule", "frame"]].isna().any(axis=None):
        raise MufasaError(f"{path} has rows without molecule or frame: give both in every row, or drop those rows")
    # Windows before bleaching start at another frame for every molecule: only the order counts.
    table = table.sort_values(["molecule", "frame"])
    lengths = table.groupby("molecule")["frame"].size()
    if lengths.nunique() != 1 or table.duplicated(["molecule", "frame"]).any():
        raise MufasaError(
            f"{path}: molecules have {lengths.min()} to {lengths.max()} rows; all need the same number of frames, "
            "each once"
        )
    values = table[unit].to_numpy(dtype=np.float64).reshape(len(lengths), -1)
    return TraceFile(values, unit, lengths.index.to_numpy(dtype=np.int64), path, holds=_companion(path))


def _companion(path: Path) -> Holds | None:
    """What the file beside a table says that it holds; None where there is none, or it names another table."""
    try:
        return Holds.told(read_json(path.with_name(COMPANION))[HOLDS][path.name])
    except (MufasaError, KeyError, TypeError):
        return None


def _read_tiff(path: Path, channel: Channel, wanted: Unit | None) -> TraceFile:
    import tifffile

    image = load(path)
    with complaints(), tifffile.TiffFile(path) as file:
        said = (file.shaped_metadata or [{}])[0].get("unit")
    if len(image) == 1:
        image = image[0]
    if image.ndim != 2:
        raise MufasaError(f"{path} has shape {image.shape}: needs one image (frame, molecule); is it a movie?")
    guess: Unit = "adu" if image.dtype.kind in "ui" else "photoelectrons"
    return TraceFile(image.T.astype(np.float64), _unit(path, said, guess, wanted), np.arange(image.shape[1]), path)


def _read_hdf5(path: Path, channel: Channel, wanted: Unit | None) -> TraceFile:
    h5py = _h5py()
    found: dict[str, Any] = {}

    def collect(name: str, item: Any) -> None:
        if getattr(item, "ndim", 0) == 2:
            found[name] = item

    with h5py.File(path, "r") as file:
        file.visititems(collect)
        name = "traces" if "traces" in found else next(iter(found), None)
        if name is None or (name != "traces" and len(found) > 1):
            raise MufasaError(f"{path} has 2-D datasets {sorted(found)}: needs one, or one named 'traces'")
        values = np.asarray(found[name], dtype=np.float64)
        said, holds = found[name].attrs.get("unit"), Holds.told(dict(found[name].attrs))
        ids = np.asarray(file["molecule"]) if "molecule" in file else np.arange(len(values))
    if ids.shape != (len(values),):
        raise MufasaError(f"{path} has {ids.size} molecule ids for {len(values)} traces: needs one for each")
    return TraceFile(
        values, _unit(path, said, "photoelectrons", wanted), ids.astype(np.int64), path, holds=holds
    )  # fmt: skip


def _read_fret(path: Path, channel: Channel, wanted: Unit | None) -> TraceFile:
    raw = path.read_bytes()
    if len(raw) < 6:
        raise MufasaError(f"{path} is too short for a .traces file: copy it anew")
    n_frames = int(np.frombuffer(raw, "<i4", 1)[0])
    n_traces = int(np.frombuffer(raw, "<i2", 1, 4)[0])
    expected = 6 + 2 * n_frames * n_traces
    if n_frames <= 0 or n_traces <= 0 or n_traces % 2 or len(raw) != expected:
        raise MufasaError(
            f"{path} says {n_frames} frames × {n_traces} traces but holds {len(raw)} bytes instead of {expected}: "
            "not a donor/acceptor .traces file, or damaged; copy it anew"
        )
    values = np.frombuffer(raw, "<i2", offset=6).reshape(n_frames, n_traces).T.astype(np.float64)
    donor, acceptor = values[0::2], values[1::2]
    choices = {"donor": donor, "acceptor": acceptor, "sum": donor + acceptor}
    if channel not in choices:
        raise MufasaError(f"channel {channel!r} is unknown: choose {', '.join(choices)}")
    positions = _read_peaks(path.with_suffix(".pks"), n_traces, channel)
    return TraceFile(choices[channel], "adu", np.arange(n_traces // 2), path, positions)


def _read_peaks(path: Path, n_traces: int, channel: Channel) -> NDArray[np.float64] | None:
    """Positions (molecule, 2) from a .pks file (number, x, y, …), if it fits; else None."""
    if not path.is_file():
        return None
    table = np.loadtxt(path, ndmin=2)
    if len(table) != n_traces or table.shape[1] < 3:
        return None
    rows = table[1::2] if channel == "acceptor" else table[0::2]
    return np.asarray(rows[:, [2, 1]])


def _read_openfret(path: Path, channel: Channel, wanted: Unit | None) -> TraceFile:
    values, about, ids = read_openfret(path, channel)
    return TraceFile(values, _unit(path, about.get("unit"), "adu", wanted), ids, path, holds=Holds.told(about))


def _unit(path: Path, said: Any, guess: Unit, wanted: Unit | None) -> Unit:
    """The unit that the file says, or else the one `wanted`, or a guess where nobody says one."""
    text = _text(said)
    known = next((unit for unit in UNITS if unit == text.lower()), None)
    _no_other(path, known, wanted)
    if wanted is not None or not text:
        return wanted or guess
    if known is None:
        raise MufasaError(f"{path} is in {text!r}: give --unit (unit=), one of {', '.join(UNITS)}")
    return known


def _text(said: Any) -> str:
    return (said.decode() if isinstance(said, bytes) else str(said or "")).strip()


def _no_other(path: Path, said: Unit | None, wanted: Unit | None) -> None:
    if said is not None and wanted not in (None, said):
        raise MufasaError(f"{path} is in {said}, not in {wanted}: drop --unit (unit=), or correct the file")


def _h5py() -> Any:
    try:
        import h5py
    except ImportError:
        raise MufasaError("HDF5 needs the package h5py: pip install h5py, or use .csv") from None
    return h5py


_READERS: dict[str, Any] = {
    ".csv": _read_csv,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
    ".traces": _read_fret,
    ".json": _read_openfret,
}
