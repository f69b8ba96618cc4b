"""How fast things are, as ratios measured in one run: `make bench`, or `python -m benchmarks.speed`.

Times are processor time of one core (but for workers: by the clock), the least of some repetitions, after everything is
compiled. Run it with nothing else at work. What is printed is kept in benchmarks/results/speed.md.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import napari_mufasa as nm
from benchmarks.pages import header, row
from napari_mufasa.denoise.pipeline import denoised
from napari_mufasa.simulate.movie import SimulatedAcquisition
from napari_mufasa.traces import extract_traces

RESULT = Path(__file__).resolve().parent / "results" / "speed.md"
PROTOCOLS = ("PALM", "STORM", "FF", "Blinking")
LARGE = "FF"
TURNS = 12  # of what is compared within milliseconds


def processor_s(run: Callable[[], object], repeats: int = 3) -> float:
    """Least processor time of some runs, after one that compiles."""
    run()
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        run()
        times.append(time.process_time() - begun)
    return min(times)


def clock_s(run: Callable[[], object], repeats: int = 3) -> float:
    run()
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        run()
        times.append(time.perf_counter() - begun)
    return min(times)


def slope(sizes: list[int], times: list[float]) -> float:
    """Of log time over log size: 1 where twice as much takes twice as long."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def sized(preset: str, n_molecules: int, shape: tuple[int, int], n_frames: int) -> nm.Model:
    values = {"sample.n_molecules": n_molecules, "acquisition.shape_px": shape, "acquisition.n_frames": n_frames}
    return nm.preset(preset).with_values(values)


def emissions(quick: bool) -> Iterator[str]:
    """Photons of every molecule and frame, against every jump followed, and against a bare draw."""
    yield "### Photons of molecules"
    yield from header(
        "protocol", "molecules × frames", "jump by jump / ours",
        "ours / one Poisson draw per molecule and bright frame", "one worker / two, by the clock",
    )  # fmt: skip
    rng = np.random.default_rng(0)
    few, many = (200, 3000) if quick else (500, 15_000)
    for preset in PROTOCOLS:
        small, large = sized(preset, few, (256, 256), 200), sized(preset, many, (1024, 1024), 200)
        exact = processor_s(lambda m=small: SimulatedAcquisition(m, seed=1, engine="exact"), 1)
        fast = processor_s(lambda m=small: SimulatedAcquisition(m, seed=1))
        light = SimulatedAcquisition(large, seed=1).emission
        means = light[light > 0].astype(float)
        turns = [
            (
                processor_s(lambda m=large: SimulatedAcquisition(m, seed=1), 1),
                processor_s(lambda v=means: rng.poisson(v), 1),
            )
            for _ in range(TURNS)
        ]
        whole, bare = np.min(turns, axis=0)  # in turns: the machine is not as fast all the time
        one, two = (clock_s(lambda m=large, w=w: SimulatedAcquisition(m, seed=1, workers=w)) for w in (1, 2))
        yield row(preset, f"{few} and {many} × 200", exact / fast, whole / max(bare, 1e-6), one / two)


def movies(quick: bool) -> Iterator[str]:
    yield "### Whole movies"
    yield from header("movie", "ours / one float32 normal draw per pixel", "one worker / two, by the clock")
    rng = np.random.default_rng(0)
    shape = (30, 256, 256) if quick else (100, 512, 512)
    model = sized(LARGE, 1600 if quick else 6498, shape[1:], shape[0])
    ours = processor_s(lambda: nm.simulate(model, seed=1))
    bare = processor_s(lambda: rng.standard_normal(shape, dtype=np.float32))
    one, two = (clock_s(lambda w=w: nm.simulate(model, seed=1, workers=w)) for w in (1, 2))
    yield row(f"{shape[0]} × {shape[1]} × {shape[2]}, {model.sample.n_molecules} molecules", ours / bare, one / two)


def growth(quick: bool) -> Iterator[str]:
    yield "### Growth"
    yield from header("with", "from … to", "slope of log time")
    counts = [1000, 3000, 10_000] if quick else [1000, 10_000, 100_000, 1_000_000]
    for preset in ("PALM", "STORM"):
        times = [processor_s(lambda n=n, p=preset: SimulatedAcquisition(sized(p, n, (2048, 2048), 100), seed=1), 2)
                 for n in counts]  # fmt: skip
        yield row(f"molecules, photons ({preset})", f"{counts[0]} … {counts[-1]}", slope(counts, times))
    frames = [50, 100, 200] if quick else [100, 300, 1000]
    times = [processor_s(lambda n=n: nm.simulate(sized(LARGE, 200, (128, 128), n), seed=1), 2) for n in frames]
    yield row("frames, movie", f"{frames[0]} … {frames[-1]}", slope(frames, times))
    sides = [64, 128, 256] if quick else [128, 256, 512]
    models = [sized(LARGE, round(100 * (side / 128) ** 2), (side, side), 100) for side in sides]
    times = [processor_s(lambda m=m: nm.simulate(m, seed=1), 2) for m in models]
    yield row("pixels, movie (as dense)", f"{sides[0]}² … {sides[-1]}²", slope([s * s for s in sides], times))
    made = [nm.simulate(m, seed=1).movie for m in models]
    for name, options in (("in their places", {}), ("followed", {"follow_molecules": True})):
        times = [
            processor_s(lambda v=v, m=m, o=options: extract_traces(v, m.camera, psf_sigma_px=m.sigma_px, **o), 2)
            for v, m in zip(made, models, strict=True)
        ]
        yield row(
            f"pixels, traces of molecules {name}", f"{sides[0]}² … {sides[-1]}²", slope([s * s for s in sides], times)
        )


def denoising(quick: bool) -> Iterator[str]:
    yield "### Denoising short movies"
    lengths = [20, 100] if quick else [20, 100, 500]
    yield from header("frames", f"time per frame / that of {lengths[-1]} frames")
    model = sized(LARGE, 100, (128, 128), lengths[-1])
    movie = nm.simulate(model, seed=1).movie
    times = [processor_s(lambda n=n: list(denoised(movie[:n], model.camera)), 2) / n for n in lengths]
    for n, each in zip(lengths, times, strict=True):
        yield row(n, each / times[-1])


def memory(quick: bool, frames: int = 256, side: int = 1024) -> Iterator[str]:
    """Anonymous memory (RssAnon) of commands, looked at twenty times a second; as many dark frames as frames."""
    n_frames, side = (64, 256) if quick else (frames, side)
    size_gb = 2 * n_frames * side**2 / 1e9
    yield "### Memory"
    yield from header(f"{n_frames} × {side} × {side} movie ({size_gb:.2f} GB)", "most anonymous memory, GB")
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home)
        believed, unlit = nm.preset(LARGE), nm.preset(LARGE).with_values({"optics.background_photons_per_px": 0.0})
        believed.to_json(folder / "model.json")
        unlit.to_json(folder / "unlit.json")
        model, movie, dark = ("--model", f"{home}/model.json"), f"{home}/m.zarr", f"{home}/dark.zarr"
        size = ["--frames", str(n_frames), "--shape", str(side), str(side)]
        many = ["--n-molecules", str(side * side // 160)]
        nothing = ["--model", f"{home}/unlit.json", "--n-molecules", "0"]
        most_anonymous_gb(["simulate", *nothing, *size, "--out", dark])
        commands = {
            "simulate": [*model, *size, *many, "--out", movie],
            "denoise": [movie, *model, "--out", f"{home}/d.zarr"],
            "traces": [movie, *model, "--dark", dark, "--out", f"{home}/t"],
            "traces --follow-molecules": [movie, *model, "--follow-molecules", "--out", f"{home}/f"],
            "compare": [movie, *model, "--dark", dark, "--out", f"{home}/c"],
            "calibrate": [movie, "--dark", dark, "--out", f"{home}/camera.json"],
            "propose": [movie, "--dark", dark, "--out", f"{home}/proposed.json"],
        }
        for name, arguments in commands.items():
            yield row(name, most_anonymous_gb([name.split()[0], *arguments]))


def most_anonymous_gb(arguments: list[str]) -> float:
    process = subprocess.Popen([sys.executable, "-m", "napari_mufasa", *arguments], stdout=subprocess.DEVNULL)
    most = 0
    while process.poll() is None:
        try:
            status = Path(f"/proc/{process.pid}/status").read_text()
            most = max([most, *(int(line.split()[1]) for line in status.splitlines() if line.startswith("RssAnon"))])
        except OSError:
            pass
        time.sleep(0.05)
    if process.returncode:
        raise SystemExit(f"napari-mufasa {' '.join(arguments)} failed")
    return most * 1024 / 1e9


PARTS: dict[str, Callable[[bool], Iterator[str]]] = {
    "emissions": emissions, "movies": movies, "growth": growth, "denoising": denoising, "memory": memory,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smaller sizes, a minute; nothing is kept")
    parser.add_argument("--only", choices=PARTS, help="one part; nothing is kept")
    parser.add_argument("--frames", type=int, default=256, help="of the movie that memory is measured on (2000: 4 GB)")
    parser.add_argument("--side", type=int, default=1024, help="of its frames, pixels")
    options = parser.parse_args()
    lines = [
        "# Speed", "",
        "`make bench`: ratios of one run. Times are processor time of one core (but for workers: by the clock), the",
        "least of some repetitions, after everything is compiled. Photons of molecules are with layout and scene.",
        f"Load of the machine when it began: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores.",
    ]  # fmt: skip
    for part in [options.only] if options.only else PARTS:
        told = memory(options.quick, options.frames, options.side) if part == "memory" else PARTS[part](options.quick)
        for line in told:
            if line.startswith("###"):
                lines += ["", line[1:], ""]
                print(f"\n{line[1:]}\n", flush=True)
            else:
                lines.append(line)
                print(line, flush=True)
    if not (options.quick or options.only):
        RESULT.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
