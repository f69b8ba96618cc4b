"""Feed the readers and the model parser with what a fuzzer makes up: any exception but `MufasaError` is a find.

    python tools/fuzz.py [tiff zarr model tables microscopes] [--seconds 900]

Each target runs by itself in a process of its own (atheris, guided by the code it reaches). What it finds is kept as
crash-* in the work folder, with --keep what reached new code in tests/trust/corpus, too; the outcome goes to
benchmarks/results/fuzz.md. Seeds are made here, from small good files.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "fuzz.md"
CORPUS = ROOT / "tests" / "trust" / "corpus"
KEPT_BYTES = 2000  # larger inputs are not kept
MOST_PIXELS = 2**22  # what a fuzzer claims beyond that is opened, but not read
WATCHED = [
    "napari_mufasa.files", "napari_mufasa.model", "napari_mufasa.simulate.layout", "tifffile", "zarr", "liffile", "nd2",
    "sif_parser",
]  # fmt: skip
MICROSCOPES = (".pma", ".sif", ".nd2", ".lif", ".czi")


# targets: bytes → a file → its reader ---------------------------------------------------------------------
def tiff(data: bytes, folder: Path) -> None:
    from napari_mufasa import files

    path = folder / "m.ome.tif"
    path.write_bytes(data)
    _read(files.read_movie(path))
    from napari_mufasa.files.layers import is_ours

    is_ours(path)


def zarr(data: bytes, folder: Path) -> None:
    """The first byte chooses the version; description and chunk are parted by a NUL."""
    from napari_mufasa import files

    path = folder / "m.zarr"
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir()
    head, _, chunk = data[1:].partition(b"\0")
    new = not data or data[0] % 2 == 0
    (path / ("zarr.json" if new else ".zarray")).write_bytes(head)
    if new:
        (path / "c" / "0" / "0").mkdir(parents=True)
    (path / ("c/0/0/0" if new else "0.0.0")).write_bytes(chunk)
    _read(files.read_movie(path))


def model(data: bytes, folder: Path) -> None:
    from napari_mufasa.model.model import Model

    path = folder / "model.json"
    path.write_bytes(data)
    good = Model.from_json(path)
    assert Model.from_dict(json.loads(json.dumps(good.to_dict()))) == good


def tables(data: bytes, folder: Path) -> None:
    """The first byte chooses the reader. Not HDF5: libhdf5 itself hangs on some of what a fuzzer makes."""
    from napari_mufasa.files.traces import read_trace_file
    from napari_mufasa.simulate.layout import read_positions

    suffixes = (".csv", ".tif", ".traces", ".pks", "positions")
    suffix = suffixes[data[0] % len(suffixes)] if data else ".csv"
    if suffix == "positions":
        path = folder / "positions.csv"
        path.write_bytes(data[1:])
        read_positions(path, 100.0)
        return
    path = folder / f"t{suffix}"
    path.write_bytes(data[1:])
    if suffix == ".pks":
        import struct

        path = folder / "t.traces"
        path.write_bytes(struct.pack("<ih", 2, 4) + bytes(16))
    read_trace_file(path)


def microscopes(data: bytes, folder: Path) -> None:
    """The first byte chooses the format. Of .czi the library in C++ is not watched, only what becomes of its errors."""
    from napari_mufasa import files
    from napari_mufasa.files.instrument import read_instrument

    path = folder / f"m{MICROSCOPES[data[0] % len(MICROSCOPES)] if data else '.pma'}"
    path.write_bytes(data[1:])
    read_instrument(path)
    _read(files.read_movie(path))


def _read(movie: Any) -> None:
    import numpy as np

    if movie.data.size <= MOST_PIXELS:
        np.asarray(movie.data)
    _ = movie.pixel_size_nm, movie.seed
    from napari_mufasa.model.model import Model

    Model.stored_in(movie.metadata)


TARGETS: dict[str, Callable[[bytes, Path], None]] = {
    "tiff": tiff, "zarr": zarr, "model": model, "tables": tables, "microscopes": microscopes,
}  # fmt: skip


# seeds ----------------------------------------------------------------------------------------------------
def make_seeds(target: str, folder: Path) -> None:
    """Small good files, as bytes that the target takes."""
    import numpy as np
    import tifffile

    import napari_mufasa as nm
    from napari_mufasa import files

    movie = np.arange(2 * 4 * 5, dtype=np.uint16).reshape(2, 4, 5)
    folder.mkdir(parents=True, exist_ok=True)
    plain = nm.preset("FF").with_values({"acquisition.shape_px": (4, 5), "acquisition.n_frames": 2})
    if target == "tiff":
        files.write_movie(folder / "ours.ome.tif", [movie], movie.shape, movie.dtype, model=plain, seed=1)
        for name, options in {
            "plain": {}, "zlib": {"compression": "zlib"}, "big": {"bigtiff": True}, "imagej": {"imagej": True},
            "tiled": {"tile": (16, 16)}, "predictor": {"compression": "zlib", "predictor": True},
        }.items():  # fmt: skip
            tifffile.imwrite(folder / f"{name}.tif", movie, photometric="minisblack", **options)
        tifffile.imwrite(folder / "axes.tif", np.stack([movie, movie], 1), ome=True, metadata={"axes": "TCYX"})
    elif target == "zarr":
        files.write_movie(folder / "m.zarr", [movie], movie.shape, movie.dtype, model=plain, seed=1)
        head, chunk = (folder / "m.zarr" / "zarr.json").read_bytes(), (folder / "m.zarr/c/0/0/0").read_bytes()
        (folder / "three").write_bytes(b"\0" + head + b"\0" + chunk)
        two = {"zarr_format": 2, "shape": [2, 4, 5], "chunks": [2, 4, 5], "dtype": "<u2", "order": "C",
               "compressor": None, "filters": None, "fill_value": 0}  # fmt: skip
        (folder / "two").write_bytes(b"\1" + json.dumps(two).encode() + b"\0" + movie.tobytes())
        shutil.rmtree(folder / "m.zarr")
    elif target == "model":
        for name in ("FF", "PALM", "Blinking"):
            (folder / name).write_text(json.dumps(nm.preset(name).to_dict()))
        for kind, effect in nm.catalogue().items():
            (folder / kind).write_text(json.dumps({**plain.to_dict(), "effects": [effect().model_dump()]}))
    elif target == "microscopes":
        sys.path.insert(0, str(ROOT))
        from tests.files.microscopes import WRITERS

        for at, suffix in enumerate(MICROSCOPES):
            path = WRITERS[suffix](folder / f"m{suffix}", movie + 1)
            (folder / suffix[1:]).write_bytes(bytes([at]) + path.read_bytes())
            path.unlink()
    else:
        from napari_mufasa.files.traces import write_trace_file

        for at, suffix in enumerate(("csv", "tif")):
            write_trace_file(folder / f"t.{suffix}", np.arange(6.0).reshape(2, 3))
            (folder / suffix).write_bytes(bytes([at]) + (folder / f"t.{suffix}").read_bytes())
            (folder / f"t.{suffix}").unlink()
        (folder / "fret").write_bytes(b"\2\2\0\0\0\4\0" + bytes(16))
        (folder / "pks").write_bytes(b"\3" + b"1 10 20 1\n2 110 20 1\n3 30 40 1\n4 130 40 1\n")
        (folder / "positions").write_bytes(b"\4y_px,x_px\n1,2\n3,4\n")


# running --------------------------------------------------------------------------------------------------
def fuzz(target: str, options: list[str]) -> None:
    """The process of one target: never returns."""
    import atheris

    with atheris.instrument_imports(include=WATCHED):
        import liffile  # noqa: F401
        import nd2
        import nd2._parse._clx_lite
        import nd2._parse._clx_xml
        import nd2._parse._parse
        import nd2._readers._modern.modern_reader  # noqa: F401
        import sif_parser  # noqa: F401
        import tifffile  # noqa: F401
        import zarr.core.array
        import zarr.core.metadata  # noqa: F401

        import napari_mufasa.files.layers
        import napari_mufasa.files.traces
        import napari_mufasa.model.model
        import napari_mufasa.simulate.layout  # noqa: F401
    from napari_mufasa.errors import MufasaError

    warnings.simplefilter("ignore")
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    one = TARGETS[target]

    def once(data: bytes) -> None:
        try:
            one(data, folder)
        except MufasaError as told:
            assert str(told).strip(), "an error without words"

    atheris.Setup([sys.argv[0], *options], once)
    atheris.Fuzz()


def run(target: str, seconds: int, work: Path) -> dict[str, Any]:
    """Fuzz one target; what it says at its end."""
    corpus, seeds = work / target, work / f"{target}-seeds"
    corpus.mkdir(parents=True, exist_ok=True)
    make_seeds(target, seeds)
    command = [
        sys.executable, __file__, "--inside", target, str(corpus), str(seeds), f"-max_total_time={seconds}",
        f"-artifact_prefix={work}/crash-{target}-", "-timeout=60", "-rss_limit_mb=6000", "-max_len=20000",
        "-print_final_stats=1",
    ]  # fmt: skip
    ran = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
    (work / f"{target}.log").write_text(ran.stdout)
    units = re.search(r"stat::number_of_executed_units:\s*(\d+)", ran.stdout)
    covered = re.findall(r"cov: (\d+)", ran.stdout)
    done = re.search(r"Done \d+ runs in (\d+) second", ran.stdout)
    return {
        "target": target, "inputs": int(units[1]) if units else 0, "seconds": int(done[1]) if done else 0,
        "covered": int(covered[-1]) if covered else 0, "finds": len(_finds(work, target)),
        "exit": ran.returncode,
    }  # fmt: skip


def _finds(work: Path, target: str) -> list[Path]:
    """What was kept of crashes; inputs that were only slow are kept beside them."""
    return [path for path in work.glob(f"crash-{target}-*") if "slow-unit" not in path.name]


def main() -> int:
    if sys.argv[1:2] == ["--inside"]:
        fuzz(sys.argv[2], sys.argv[3:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", default=list(TARGETS), help=f"of {', '.join(TARGETS)}")
    parser.add_argument("--seconds", type=int, default=900, help="per target")
    parser.add_argument("--keep", action="store_true", help="put the small inputs into tests/trust/corpus")
    parser.add_argument("--work", type=Path, help="folder of corpus, finds and logs (default: a temporary one)")
    given = parser.parse_args()
    work = given.work or Path(tempfile.mkdtemp(prefix="fuzzing-"))
    work.mkdir(parents=True, exist_ok=True)
    rows = []
    for target in given.targets:
        rows.append(run(target, given.seconds, work))
        print(rows[-1], flush=True)
        if given.keep:
            keep(target, work)
    if given.seconds >= 900:
        write_results(rows)
    return int(any(row["exit"] or row["finds"] for row in rows))


def keep(target: str, work: Path) -> None:
    """What reached new code, and is small, as one archive that the tests play again."""
    inputs = sorted(path for path in (work / target).iterdir() if path.stat().st_size <= KEPT_BYTES)
    CORPUS.mkdir(exist_ok=True)
    with zipfile.ZipFile(CORPUS / f"{target}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in inputs:
            archive.writestr(zipfile.ZipInfo(path.name), path.read_bytes(), zipfile.ZIP_DEFLATED)


def write_results(rows: list[dict[str, Any]]) -> None:
    """The last full run of each target: what is told of others stays."""
    head = "# Fuzzing\n\n`make fuzz`: seconds and inputs per target, and uncaught exceptions found.\n\n"
    head += "| target | seconds | inputs | branches reached | finds |\n|---|---|---|---|---|\n"
    old = RESULTS.read_text().splitlines() if RESULTS.exists() else []
    lines = {line.split("|")[1].strip(): line for line in old if line.startswith("|")}
    for r in rows:
        lines[r["target"]] = f"| {r['target']} | {r['seconds']} | {r['inputs']} | {r['covered']} | {r['finds']} |"
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(head + "".join(lines[target] + "\n" for target in TARGETS if target in lines))


if __name__ == "__main__":
    sys.exit(main())
