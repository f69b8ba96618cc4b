"""W1 of MUFASA, Poisson and SOFI Simulation Tools to a table of EGFP traces (figure 3 of the source note).

    python docs/gallery/distances.py [--out DIR] [--quick] [--traces FILE]

20 traces of 50 frames in ADU, read as docs/comparison.md says ("all in a pixel, tool"). The measured table is no
part of the project: without it traces of the same model with 1.4 times the light stand in, and the picture says so.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from drawing import arguments, save

import napari_mufasa as nm
from napari_mufasa.files.traces import read_traces
from napari_mufasa.report.plots.themes import figure, style

ROOT = Path(__file__).resolve().parents[2]
MEASURED = ROOT.parent / "shared" / "data" / "egfp_emccd_traces.tif"
NAMES = {"mufasa": "MUFASA", "poisson": "Poisson", "sofi": "SOFI tools", "fitted": "MUFASA, fitted"}


def stand_in(model: nm.Model) -> np.ndarray:
    """Traces (molecule, frame) in ADU of brighter molecules, each in a pixel of its own."""
    brighter = model.with_values({"optics.brightness_correction": 1.4, "acquisition.n_frames": 90})
    light = nm.simulate_emission(brighter, 60, seed=7) * 1.4
    rng, camera = np.random.default_rng(7), model.camera
    electrons = rng.poisson(light * camera.quantum_efficiency)
    return camera.baseline_adu + rng.gamma(np.maximum(electrons, 1e-9), camera.em_gain) / camera.electrons_per_adu


def main() -> None:
    given = arguments(__doc__)
    model = nm.Model.from_json(ROOT / "docs" / "models" / "egfp.json").with_values({"fluorophore.quantum_yield": 1.0})
    real = MEASURED.is_file() and not given.quick
    traces = read_traces(MEASURED)[0] if real else stand_in(model)
    few = {"n_simulated": 200, "n_bootstrap": 20} if given.quick else {"n_simulated": 2000, "n_bootstrap": 200}
    found = nm.compare_traces(
        traces, model, unit="adu", profile="brightest_pixel", background_subtracted=False, pixel_share=1.0,
        sofi_times="tool", window=50, best=20, seed=1, fit=True, **few,
    )  # fmt: skip
    adu = model.camera.em_gain / model.camera.electrons_per_adu  # per photoelectron, the unit of the comparison
    with style("light") as colours:
        made = figure(5.0, 3.0)
        ax = made.subplots()
        for at, (key, name) in enumerate(NAMES.items()):
            value, low, high = (adu * w1 for w1 in (found.w1[key], *found.w1_interval[key]))
            print(f"{name}: {value:.0f} ({low:.0f} to {high:.0f}) ADU")
            error = [[max(value - low, 0)], [max(high - value, 0)]]
            colour = colours.after if key == "fitted" else colours.muted
            ax.bar(at, value, yerr=error, color=colour, width=0.6, capsize=4, ecolor=colours.text)
        floor = adu * found.w1["floor"]
        print(f"floor: {floor:.0f}")
        ax.axhline(floor, linestyle="--", color=colours.floor, label=f"floor {floor:.0f}")
        ax.set_xticks(range(len(NAMES)), NAMES.values())
        ax.set(ylabel="W1 to the measured traces (ADU)")
        ax.set_title("EGFP, 20 traces of 50 frames" if real else "Simulated traces in place of measured ones")
        ax.legend()
        save(made, given.out / "distances.png")


if __name__ == "__main__":
    main()
