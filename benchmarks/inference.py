"""How well photophysics comes back from traces: `python -m benchmarks.inference [--repeats N] [--preset NAME]`.

Each repeat simulates 200 molecules, records their light with an EMCCD's noise, and infers the rates. Printed for each
number: the mean of inferred over true, its standard error, and in how many repeats the 95 % interval holds the truth.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

import napari_mufasa as nm
from napari_mufasa.model.model import Model

MOLECULES = 200
READ_NOISE_E = 4.0  # of a trace's frame, background included
CASES: dict[str, dict[str, Any]] = {
    "FF": {"acquisition.n_frames": 200},
    "Blinking": {"acquisition.n_frames": 500, "fluorophore.cycles_before_bleaching": 1e4},
    "STORM": {"acquisition.n_frames": 500, "fluorophore.cycles_before_bleaching": 1e4},
    "PALM": {"acquisition.n_frames": 400, "fluorophore.cycles_before_bleaching": 1e4},
}


def recorded(model: Model, n: int, seed: int) -> NDArray[np.float64]:
    """Traces (molecule, frame), photoelectrons: emission, detection, multiplication, noise."""
    emission = nm.simulate_emission(model, n_molecules=n, seed=seed)
    rng = np.random.default_rng(seed)
    share = model.camera.quantum_efficiency * model.optics.collection_efficiency
    detected = rng.binomial(emission, share).astype(float)
    multiplied = np.where(detected > 0, rng.gamma(np.maximum(detected, 1.0)), 0.0)
    return np.asarray(multiplied + rng.normal(0, READ_NOISE_E, emission.shape))


def truths(model: Model) -> dict[str, float | None]:
    told, dye = nm.predict(model), model.fluorophore
    found = {
        "level_e": told.detected_e_per_frame, "k01_per_s": told.k01_per_s,
        "cycles_before_bleaching": dye.cycles_before_bleaching,
    }  # fmt: skip
    if model.protocol in ("Blinking", "STORM"):
        found |= {"isc_ratio": dye.isc_ratio, "triplet_decay_rate_per_s": dye.triplet_decay_rate_per_s}
    if model.protocol == "PALM":
        found["activation_rate_per_s"] = model.excitation.activation_rate_per_s
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=40)
    parser.add_argument("--preset", choices=tuple(CASES))
    given = parser.parse_args()
    for name in (given.preset,) if given.preset else CASES:
        model = nm.preset(name).with_values(CASES[name])
        ratios: dict[str, list[float]] = defaultdict(list)
        held: dict[str, int] = defaultdict(int)
        for seed in range(given.repeats):
            found = nm.infer_photophysics(recorded(model, MOLECULES, seed), model, all_molecules=True)
            for key, truth in truths(model).items():
                if key in found.values and truth:
                    ratios[key].append(found.values[key].value / truth)
                    held[key] += found.values[key].holds(truth)
        print(f"\n{name}: {given.repeats} repeats of {MOLECULES} molecules", flush=True)
        for key, seen in ratios.items():
            error = np.std(seen) / np.sqrt(len(seen))
            print(f"  {key:28s} {np.mean(seen):.3f} ± {error:.3f}   holds in {held[key]} of {len(seen)}", flush=True)


if __name__ == "__main__":
    main()
