"""Two channels: registration and efficiency against simulated splitters whose map and efficiency are known.

    python -m benchmarks.channels [--movies N] [--write]

Prints the tables of docs/two_channels.md; `--write` puts them there.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

import napari_mufasa as nm
from benchmarks.pages import header, row, write
from napari_mufasa.channels import Channels, extract_pair, register, simulate_pair

MODEL = nm.preset("FF").with_values(
    {
        "acquisition.n_frames": 100, "acquisition.shape_px": (96, 96), "excitation.power_density_w_per_cm2": 10,
        "optics.background_photons_per_px": 10, "fluorophore.cycles_before_bleaching": None, "sample.n_molecules": 40,
        "sample.min_distance_px": 10,
    }
)  # fmt: skip
BEADS = MODEL.with_values({"acquisition.n_frames": 10, "excitation.power_density_w_per_cm2": 60})
TITLES = ("Registration", "Efficiency")
PAGE = "two_channels.md"


def splitter(places: NDArray[np.float64]) -> NDArray[np.float64]:
    turn = np.radians(1.5)
    linear = 1.02 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.asarray((places - 47.5) @ linear.T + 47.5 + np.array([3.3, -5.7]))


def registration(n: int) -> Iterator[str]:
    """How far off the mapped places are all over the channel, beside what is stated."""
    yield "### Registration"
    yield ""
    yield from header("spots", "matched", "residual, left out, px", "map off by, px rms", "stated sd of the map, px")
    grid = np.stack(np.meshgrid(np.linspace(8, 87, 9), np.linspace(8, 87, 9), indexing="ij"), axis=-1).reshape(-1, 2)
    for name, model, efficiency in (
        ("beads, 10 frames", BEADS, 0.5), ("molecules of the movie, E 0.5", MODEL, 0.5),
        ("molecules of the movie, E 0.2", MODEL, 0.2), ("12 beads", BEADS.with_values({"sample.n_molecules": 12}), 0.5),
    ):  # fmt: skip
        found = [register(simulate_pair(model, efficiency, splitter, seed=seed).movie) for seed in range(1, n + 1)]
        off = np.array([each.transform(grid) - splitter(grid) for each in found])
        sd = np.array([each.transform.sd_at(grid) for each in found])
        yield row(
            name, f"{np.mean([len(each.donor_px) for each in found]):.0f}",
            f"{np.mean([each.residual_px.value for each in found]):.3f}",
            f"{np.sqrt(np.mean(np.square(off).sum(axis=2))):.3f}", f"{np.sqrt(2 * np.mean(sd**2)):.3f}",
        )  # fmt: skip
    yield ""
    yield f"{n} recordings each; distances in the plane."


def efficiency(n: int, channels: Channels) -> Iterator[str]:
    """E read against E simulated, and the stated error of a molecule against the true one."""
    yield "### Efficiency"
    yield ""
    yield from header(
        "E simulated",
        "molecules",
        "mean E read",
        "its error",
        "stated sd of a molecule",
        "true sd",
        "within 1.96 sd, %",
    )
    for true in (0.1, 0.3, 0.5, 0.7, 0.9):
        values, stated = [], []
        for seed in range(1, n + 1):
            movie = simulate_pair(MODEL, true, splitter, seed=100 * seed + round(10 * true)).movie
            table = extract_pair(movie, MODEL.camera, channels, psf_sigma_px=MODEL.sigma_px).molecules
            kept = table[table["kept"]]
            values += list(kept["efficiency"])
            stated += list(kept["efficiency_sd"])
        read, sd = np.array(values), np.array(stated)
        yield row(
            true, len(read), f"{read.mean():.4f}", f"{read.std() / np.sqrt(len(read)):.4f}", f"{sd.mean():.4f}",
            f"{np.sqrt(np.mean((read - true) ** 2)):.4f}", f"{100 * np.mean(np.abs(read - true) < 1.96 * sd):.0f}",
        )  # fmt: skip
    yield ""
    yield f"{n} movies each; nothing leaks and nothing is excited directly."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--movies", type=int, default=6)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    channels = register(simulate_pair(BEADS, 0.5, splitter, seed=5).movie)
    for title, lines in zip(TITLES, (registration(args.movies), efficiency(args.movies, channels)), strict=True):
        section = "\n".join(lines)
        print(section, flush=True)
        if args.write:
            write(PAGE, title, section, TITLES)


if __name__ == "__main__":
    main()
