"""How often a simulated camera is measured right:
`python -m benchmarks.calibration [--draws N] [--wrong N] [--kind KIND]`.

For every kind of camera, with and without a read-out kernel: the share of draws in which each number lies in its 95 %
interval, how often the test of fit rejects the right law (at most 5 %), and laws without excess noise, without
the kernel, without the tail of spurious electrons (in the first `--wrong` of the draws). In brackets the 95 % interval
of each share (Clopper and Pearson).
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from typing import Any

import numpy as np

import napari_mufasa as nm
from napari_mufasa.calibrate.measure import calibrate
from napari_mufasa.effects import effect_from_data
from napari_mufasa.model.model import Model

KINDS = ("EMCCD", "CCD", "CMOS")


def drawn(kind: str, with_kernel: bool, rng: np.random.Generator) -> Model:
    """A model with a camera of the kind, uneven light, and some molecules."""
    gain = float(rng.uniform(80, 500)) if kind == "EMCCD" else 1.0
    per_adu = gain / rng.uniform(12, 60) if kind == "EMCCD" else float(rng.uniform(0.3, 1.5))
    read_adu = float(rng.uniform(4, 12)) if kind == "EMCCD" else float(rng.uniform(2, 8))
    values: dict[str, Any] = {
        "type": kind,
        "quantum_efficiency": 0.9,
        "read_noise_e": read_adu * per_adu,
        "clock_induced_charge_e": float(rng.uniform(0.004, 0.03)) if kind == "EMCCD" else 0.0,
        "electrons_per_adu": per_adu,
        "baseline_adu": float(rng.uniform(90, 500)),
        "em_gain": gain if kind == "EMCCD" else None,
    }
    if kind == "CMOS":
        values["cmos_gain_curve"] = ((0.0, 0.0), (1.0, 1.0))
    if with_kernel:
        share = float(rng.choice([rng.uniform(-0.16, -0.04), rng.uniform(0.06, 0.2)]))
        values["readout_kernel"] = (share,)
        values["read_noise_kernel"] = (share,)
        values["baseline_alternation_adu"] = float(rng.uniform(0.5, 2.5))
    model = nm.preset("FF").with_values(
        {
            "acquisition.n_frames": 160, "acquisition.shape_px": (64, 64), "sample.n_molecules": 12,
            "fluorophore.cycles_before_bleaching": None,
            "optics.background_photons_per_px": float(np.exp(rng.uniform(np.log(4), np.log(60)))),
        }
    )  # fmt: skip
    camera = nm.Camera.model_validate(values)
    light = effect_from_data({"kind": "illumination_profile"})
    return model.model_copy(update={"camera": camera}).with_effects(light)


def truths(model: Model) -> dict[str, float]:
    camera = model.camera
    gain = camera.em_gain or 1.0
    found = {
        "baseline_adu": camera.baseline_adu,
        "read_noise_adu": camera.read_noise_e / camera.electrons_per_adu,
        "adu_per_photoelectron": gain / camera.electrons_per_adu,
        "electrons_per_adu": camera.electrons_per_adu,
    }
    if camera.type == "EMCCD":
        found |= {"clock_induced_charge_e": camera.clock_induced_charge_e, "excess_noise_measured": 2.0}
    return found


def trial(kind: str, with_kernel: bool, seed: int, wrong_laws: bool) -> dict[str, bool]:
    """What held in one draw; "test: …" tells whether the test of fit rejected."""
    rng = np.random.default_rng(seed)
    model = drawn(kind, with_kernel, rng)
    movie = nm.simulate(model, seed=seed).movie
    dark = nm.simulate_dark(model, 100, seed=seed)
    known = {"camera_type": kind, "em_gain": model.camera.em_gain}
    found = calibrate(movie, dark, **known)  # type: ignore[arg-type]
    held = {name: getattr(found, name).holds(truth) for name, truth in truths(model).items()}
    if with_kernel and kind != "CMOS":
        shares = found.readout.shares
        held["kernel"] = bool(shares) and shares[0].holds(model.camera.readout_kernel[0])
        held["alternation_adu"] = found.readout.alternation_adu.holds(model.camera.baseline_alternation_adu)
    held["test: right law"] = not found.law_holds
    if not wrong_laws:
        return held
    if kind == "EMCCD":
        wrong = calibrate(movie, dark, excess_noise_factor=1.0, **known)
        held["test: no excess noise"] = not wrong.law_holds
        wrong = calibrate(movie, dark, clock_induced_charge_e=0.0, **known)
        held["test: no tail"] = not wrong.law_holds
    if with_kernel and kind != "CMOS":
        held["test: no kernel"] = not calibrate(movie, dark, readout_kernel=(), **known).law_holds
    return held


def told(number: int, of: int) -> str:
    from scipy import stats

    low = stats.beta.ppf(0.025, number, of - number + 1) if number else 0.0
    high = stats.beta.ppf(0.975, number + 1, of - number) if number < of else 1.0
    return f"{number:3d} of {of:3d}  [{100 * low:.0f} %, {100 * high:.0f} %]"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--wrong", type=int, help="how many of them wrong laws are tried on (default: all)")
    parser.add_argument("--kind", choices=KINDS)
    given = parser.parse_args()
    for kind in (given.kind,) if given.kind else KINDS:
        for with_kernel in (False, True) if kind != "CMOS" else (False,):
            counted: dict[str, list[bool]] = defaultdict(list)
            for seed in range(given.draws):
                tried = given.wrong is None or seed < given.wrong
                for name, held in trial(kind, with_kernel, seed, tried).items():
                    counted[name].append(bool(held))
            print(f"\n{kind}{', kernel' if with_kernel else ''} ({given.draws} draws)", flush=True)
            for name, seen in counted.items():
                print(f"  {name:28s} {told(sum(seen), len(seen))}", flush=True)


if __name__ == "__main__":
    main()
