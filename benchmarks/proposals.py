"""How often a proposed model holds the truth: `python -m benchmarks.proposals [--movies N]`.

For each preset, movies with their dark frames are proposed a model for; counted are the values that were proposed and
lie in their 95 % interval. What is said to be unknown is not counted, but told.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import napari_mufasa as nm
from napari_mufasa.files.instrument import Instrument
from napari_mufasa.model.model import Model

PRESETS = ("FF", "PALM", "STORM", "Blinking")


def truths(model: Model) -> dict[str, float]:
    camera, expected = model.camera, nm.predict(model)
    (_, _), (into, out), *_ = camera.cmos_gain_curve
    gain = camera.em_gain or (out / into if camera.type == "CMOS" else 1.0)
    found = {
        "optics.psf_fwhm_nm": model.optics.psf_fwhm_nm,
        "optics.background_photons_per_px": model.optics.background_photons_per_px,
        "sample.n_molecules": float(model.sample.n_molecules),
        "photons_per_frame": expected.collected_photons_per_frame,
        "camera.baseline_adu": camera.baseline_adu,
        "camera.read_noise_e": camera.read_noise_e,
        "adu_per_photoelectron": gain / camera.electrons_per_adu,
    }
    if expected.on_time_s is not None:
        cycles, lifetime = model.fluorophore.cycles_before_bleaching, model.fluorophore.lifetime_s
        if cycles is not None:
            k10 = 1 / lifetime
            found["bleaching_rate_per_s"] = expected.k01_per_s / (expected.k01_per_s + k10) * k10 / cycles
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--movies", type=int, default=5, help="of each preset")
    parser.add_argument("--first", type=int, default=0, help="seed of the first movie")
    given = parser.parse_args()
    all_held = all_counted = 0
    for name in PRESETS:
        held: dict[str, list[bool]] = defaultdict(list)
        for seed in range(given.first, given.first + given.movies):
            model = nm.preset(name)
            movie, dark = nm.simulate(model, seed=seed).movie, nm.simulate_dark(model, 60, seed=seed)
            written = Instrument(
                pixel_size_nm=100.0, exposure_s=model.acquisition.frame_length_s, em_gain=model.camera.em_gain
            )
            found = nm.propose_model(movie, dark, instrument=written, camera_type=model.camera.type)
            for value, truth in truths(model).items():
                if value in found.values:
                    held[value].append(found.values[value].holds(truth))
        print(f"\n{name}: {given.movies} movies", flush=True)
        for value, seen in held.items():
            print(f"  {value:36s} {sum(seen)} of {len(seen)}", flush=True)
        all_held += sum(sum(seen) for seen in held.values())
        all_counted += sum(len(seen) for seen in held.values())
        if found.unknown:
            print("  unknown: " + "; ".join(found.unknown), flush=True)
    print(f"\nin all {all_held} of {all_counted}: {100 * all_held / all_counted:.0f} %")


if __name__ == "__main__":
    main()
