"""Run time over the number of molecules, as a ratio to that of the fewest (figure 9 of the source note).

    python docs/gallery/runtime.py [--out DIR] [--quick]

Processor time of a whole movie, from molecules to counts, over that of the same protocol with the fewest molecules:
seconds are a machine's, ratios are the program's. The presets with 50 frames of 256 × 256 pixels; the least of
three runs after one that compiles.
"""

from __future__ import annotations

import time

from drawing import arguments, save

import napari_mufasa as nm
from napari_mufasa.report.plots.themes import figure, style

PROTOCOLS = ("PALM", "STORM", "FF", "Blinking")


def processor_s(model: nm.Model, repeats: int) -> float:
    times = []
    for _ in range(repeats + 1):
        begun = time.process_time()
        nm.simulate(model, seed=1)
        times.append(time.process_time() - begun)
    return min(times[1:])


def main() -> None:
    given = arguments(__doc__)
    numbers, shape, repeats = [1000, 2000, 5000, 10_000, 15_000], (256, 256), 3
    if given.quick:
        numbers, shape, repeats = [100, 200, 400], (64, 64), 1
    with style("light") as colours:
        made = figure(5.0, 3.4)
        ax = made.subplots()
        for name, marker in zip(PROTOCOLS, "osD^", strict=True):
            times = []
            for n in numbers:
                values = {"sample.n_molecules": n, "acquisition.shape_px": shape, "acquisition.n_frames": 50}
                times.append(processor_s(nm.preset(name).with_values(values), repeats))
            ratios = [seconds / times[0] for seconds in times]
            print(f"{name}: {', '.join(f'{n} {ratio:.2f}' for n, ratio in zip(numbers, ratios, strict=True))}")
            ax.plot(numbers, ratios, marker=marker, markersize=4, label=name)
        ax.plot(numbers, [n / numbers[0] for n in numbers], "--", color=colours.muted, label="in proportion")
        ax.set(xlabel="molecules", ylabel=f"processor time over that of {numbers[0]}", ylim=(0, None))
        ax.set_title("Run time over molecules")
        ax.legend()
        save(made, given.out / "runtime.png")


if __name__ == "__main__":
    main()
