"""kill -9 at random moments of long writes: never a file under its final name that can be read and is wrong.

    python tools/kill.py [--times 20] [--seed 1]

Each of three commands (simulate to zarr, simulate to OME-TIFF, denoise to zarr) is run once in peace, then killed so
many times at moments drawn over the time that it writes; the second half of them has `--resume`. After every kill the
output must not be there, or be whole and equal to that of the peaceful run; at the end the same command runs to its end
and must give the same movie, from finished blocks where there were some. Outcome: benchmarks/results/kill.md.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from napari_mufasa import files
from napari_mufasa.errors import MufasaError

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "kill.md"
MOVIE = ("--preset", "FF", "--frames", "600", "--shape", "256", "256", "--n-molecules", "200", "--seed", "5")


def command(folder: Path, verb: str, out: str) -> list[str]:
    given = [*MOVIE] if verb == "simulate" else [str(folder / "in.ome.tif"), "--model", str(folder / "model.json")]
    return [sys.executable, "-m", "napari_mufasa", verb, *given, "--out", str(folder / out), "--resume"]


def begins(running: subprocess.Popen[bytes], out: Path) -> None:
    """Wait until it writes: until something hidden of the output's name is there that was not before."""
    while running.poll() is None and not _hidden(out):
        time.sleep(0.005)


def _hidden(out: Path) -> list[Path]:
    return [path for path in out.parent.iterdir() if path.name.startswith(".") and out.name in path.name]


def in_peace(words: list[str], out: Path) -> float:
    """Run to the end; how long it wrote, in s."""
    running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    begins(running, out)
    begun = time.monotonic()
    if running.wait():
        raise SystemExit(f"{' '.join(words)} failed")
    return time.monotonic() - begun


def killed(words: list[str], out: Path, share: float, seconds: float) -> bool:
    """Run, kill after a share of the time that it writes; whether it was still running."""
    before = finished_frames(out)
    running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    # What a killed run left is there from the beginning: then it writes once it is further than that.
    while running.poll() is None and not (_hidden(out) if not before else finished_frames(out) > before):
        time.sleep(0.005)
    try:
        running.wait(share * seconds)
        return False
    except subprocess.TimeoutExpired:
        running.send_signal(signal.SIGKILL)
        running.wait()
        return True


def finished_frames(out: Path) -> int:
    done = out.with_name(f".{out.name}.partial") / "done"
    return int(done.read_text()) if done.is_file() else 0


def trial(folder: Path, verb: str, suffix: str, times: int, chance: random.Random) -> dict[str, object]:
    peaceful = command(folder, verb, f"{verb}-peace{suffix}")
    seconds = in_peace(peaceful, Path(peaceful[-2]))
    good = files.load(folder / f"{verb}-peace{suffix}")
    out = folder / f"{verb}-out{suffix}"
    words = command(folder, verb, out.name)
    kills = wrong = whole = resumed = most = 0
    for _ in range(4 * times):  # some runs are through before they are killed
        if kills == times:
            break
        resume = kills >= times // 2  # the first half of them starts anew
        kills += killed(words if resume else words[:-1], out, chance.random(), seconds)
        now = finished_frames(out)
        resumed += resume and now > most > 0  # it went on from blocks of a run that was killed
        most = now
        if out.exists():
            try:
                same = np.array_equal(files.load(out), good)
            except MufasaError as told:  # there, and told to be damaged: half a file under the final name
                print(told)
                same = False
            wrong += not same
            whole += same
            files.whole.remove(out)
            most = 0
    in_peace(words, out)
    end = np.array_equal(files.load(out), good)
    left = [path.name for path in folder.iterdir() if re.match(rf"\..*{re.escape(out.name)}", path.name)]
    return {
        "command": f"{verb} → {suffix}", "seconds": round(seconds, 2), "kills": kills, "wrong": wrong,
        "whole": whole, "resumed": resumed, "same": end, "left": left,
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    chance = random.Random(given.seed)
    rows = []
    with tempfile.TemporaryDirectory(prefix="kill-", dir=os.environ.get("TMPDIR")) as name:
        folder = Path(name)
        source = [*command(folder, "simulate", "in.ome.tif")]
        source[source.index("--frames") + 1] = "300"
        in_peace(source, folder / "in.ome.tif")
        model = subprocess.run(
            [sys.executable, "-m", "napari_mufasa", "presets", "FF"], check=True, capture_output=True, text=True
        )
        (folder / "model.json").write_text(model.stdout)
        for verb, suffix in (("simulate", ".zarr"), ("simulate", ".ome.tif"), ("denoise", ".zarr")):
            rows.append(trial(folder, verb, suffix, given.times, chance))
            print(rows[-1], flush=True)
    if given.times >= 20:
        write_results(rows, given.times, given.seed)
    return int(any(row["wrong"] or not row["same"] or row["left"] for row in rows))


def write_results(rows: list[dict[str, object]], times: int, seed: int) -> None:
    head = (
        "# kill -9\n\n`make kill`: each command killed at random moments of its writing, the second half with "
        f"`--resume`; {times} times (seed {seed}).\n\n"
        "| command | s of writing in peace | killed while it ran | wrong files | whole files | went on from blocks | "
        "same movie in the end | left behind |\n|---|---|---|---|---|---|---|---|\n"
    )
    lines = [
        f"| {r['command']} | {r['seconds']} | {r['kills']} | {r['wrong']} | {r['whole']} | {r['resumed']} | "
        f"{'yes' if r['same'] else 'no'} | {r['left'] or 'nothing'} |\n"
        for r in rows
    ]
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(head + "".join(lines))


if __name__ == "__main__":
    sys.exit(main())
