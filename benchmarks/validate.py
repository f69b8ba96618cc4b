"""The source's validation, redone: EGFP traces by W1 (notes 9, 10), STORM blinking statistics (note 8).

    python -m benchmarks.validate [--out DIR] [--data DIR] [--quick]

Every free choice is printed. Exit 0 when all checks hold, 1 when one does not.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import napari_mufasa as nm
from napari_mufasa.compare import compare_traces, difference_interval
from napari_mufasa.compare.distributions import dwell_frames
from napari_mufasa.files.traces import read_traces
from napari_mufasa.photophysics import rates

ROOT = Path(__file__).resolve().parents[1]
SOURCE = {"mufasa": 2263, "poisson": 2269, "sofi": 3065}  # note 10, ADU

CHOICES = """Free choices, where the note is silent or contradicts itself:
  * N_c = 5000 (Table 3, FF; Table 4 gives none); camera of Table 1, FF: gain 500, 0.74 e/ADU, baseline 367 ADU,
    QE 0.9: 676 ADU per photoelectron; the file holds one pixel per trace with its background, in ADU; W1 over frames
  * frame length: 10 ms (Table 2, FF); the caption of Figure 1 ("every 2.5 s", 250 frames) asks for about 50 ms
  * light: "all in a pixel" = QY 1, no PSF, no background, as an emission trace has it; "full chain" = QY 0.6 and the
    share of a 308 nm PSF in its brightest pixel; background 0, or the 20 photons of Table 1
  * SOFI: I_on = the largest photon number of a MUFASA trace (mean over 1000 traces); on and off times: 20 and 40 ms,
    bleaching 80 s, which SOFI Simulation Tools starts with ("tool"), or those of the FF chain, which is never off
    ("chain")
  * "20 x 50": windows of 50 frames before bleaching in which the trace is active; the 20 of highest SNR, and
    of the simulated ones the same share
  * "fitted": gain, background with a fading part, brightness and bleaching from moments of the same traces
The note says no extra parameter was tuned, that time scales are aligned, and that I_on comes from a trace. The reading
nearest to its words and to its three numbers is the first."""
READINGS: dict[str, dict[str, Any]] = {
    "all in a pixel, tool": {"values": {"fluorophore.quantum_yield": 1.0}, "share": 1.0, "sofi": "tool"},
    "all in a pixel, chain": {"values": {"fluorophore.quantum_yield": 1.0}, "share": 1.0, "sofi": "model"},
    "  with QY 0.6, tool": {"values": {}, "share": 1.0, "sofi": "tool"},
    "full chain, tool": {"values": {}, "share": None, "sofi": "tool"},
    "full chain, chain": {"values": {}, "share": None, "sofi": "model"},
    "  50 ms frames, tool": {"values": {"acquisition.frame_length_s": 0.05}, "share": None, "sofi": "tool"},
    "  background 20, tool": {
        "values": {"optics.background_photons_per_px": 20.0},
        "share": None,
        "sofi": "tool",
    },
}
CUTS: dict[str, dict[str, int]] = {"all 265 x 90": {}, "20 x 50": {"window": 50, "best": 20}}


@dataclass
class Check:
    name: str
    value: float
    expected: str
    holds: bool


def egfp(data: Path, n_simulated: int) -> tuple[list[dict[str, Any]], list[Check]]:
    """W1 of MUFASA, Poisson, SOFI and the fitted model on the EGFP traces, in every reading."""
    traces, unit = read_traces(data / "egfp_emccd_traces.tif")
    model = nm.Model.from_json(ROOT / "docs" / "models" / "egfp.json")
    adu = model.camera.em_gain / model.camera.electrons_per_adu
    rows = []
    for reading, choice in READINGS.items():
        for selection, cut in CUTS.items():
            found = compare_traces(
                traces, model.with_values(choice["values"]), unit=unit, profile="brightest_pixel",
                background_subtracted=False, pixel_share=choice["share"], sofi_times=choice["sofi"],
                n_simulated=n_simulated, n_bootstrap=100, seed=1, fit=reading == next(iter(READINGS)), **cut,
            )  # fmt: skip
            shown = {name: sample.traces for name, sample in found.samples.items()}
            steps = [("mufasa", "poisson"), ("poisson", "sofi")]
            apart = {
                f"{one} - {other}": [adu * v for v in difference_interval(shown["measured"], shown[one], shown[other])]
                for one, other in steps
                if len(shown[one]) and len(shown[other])
            }
            rows.append(
                {
                    "reading": reading,
                    "traces": selection,
                    "w1_adu": {name: v * adu for name, v in found.w1.items() if isinstance(v, float)},
                    "interval_95_adu": {name: [a * adu, b * adu] for name, (a, b) in found.w1_interval.items()},
                    "floor_95_adu": [found.floor.low * adu, found.floor.high * adu],
                    "difference_95_adu": apart,
                    "order": " ".join(_relation(*pair) for pair in apart.values()),
                }
            )
    return rows, _egfp_checks(rows)


def _relation(low: float, high: float) -> str:
    """What an interval of a difference says: less, more, or neither."""
    return "<" if high < 0 else ">" if low > 0 else "="


def _egfp_checks(rows: list[dict[str, Any]]) -> list[Check]:
    whole, few = (next(r for r in rows if r["traces"] == cut) for cut in CUTS)
    checks = [
        Check(
            f"EGFP {name} (all traces, 95 % from {low:.0f} to {high:.0f})",
            (low + high) / 2, "below 0", high < 0,
        )
        for name, (low, high) in whole["difference_95_adu"].items()
    ]  # fmt: skip
    low, high = few["difference_95_adu"]["poisson - sofi"]
    checks.append(
        Check(f"EGFP poisson - sofi (20 x 50, {low:.0f} to {high:.0f})", (low + high) / 2, "below 0", high < 0)
    )
    for name, value in SOURCE.items():
        near = abs(whole["w1_adu"][name] / value - 1) < 0.15
        checks.append(
            Check(f"EGFP W1 of {name} as the source's {value} ADU", whole["w1_adu"][name], "within 15 %", near)
        )
    for row, most in ((whole, 0.1), (few, 0.5)):
        w1 = row["w1_adu"]
        better = w1["fitted"] < most * w1["mufasa"]
        checks.append(Check(f"EGFP fitted ({row['traces']})", w1["fitted"], f"< {most:g} MUFASA", better))
    return checks


def storm(n_molecules: int) -> tuple[dict[str, float], list[Check]]:
    """Frame statistics, blink durations and duty cycle of Alexa 647 (Table 5) against theory."""
    model = nm.preset("Alexa647-STORM")
    emission = nm.simulate_emission(model, n_molecules, seed=3)
    dye, light, timing = model.fluorophore, model.excitation, model.acquisition
    k01 = rates.excitation_rate(dye.extinction_coefficient_per_M_cm, light.power_density_w_per_cm2, light.wavelength_nm)
    assert dye.isc_ratio is not None and dye.triplet_decay_rate_per_s is not None
    per_cycle = 1 / (1 + dye.isc_ratio)
    burst_photons = 1 / dye.isc_ratio
    on_s = (1 / k01 + dye.lifetime_s * per_cycle) / (1 - per_cycle)
    off_s = 1 / dye.triplet_decay_rate_per_s
    n_frames, frame_s = timing.n_frames, timing.frame_length_s
    total_s = n_frames * frame_s
    lit = emission > 0
    bursts = total_s / (on_s + off_s)
    # A frame is lit when light falls into it: a new burst, or one begun before its start.
    lit_share = 1 - np.exp(-frame_s / off_s) * (1 - on_s / (on_s + off_s))
    gaps = dwell_frames(lit, False) * frame_s
    # Gaps seen completely within the movie: of an exponential law, long ones are cut off at its length.
    t = np.linspace(0, total_s, 20001)
    weight = np.exp(-t / off_s) * (total_s - t)
    expected_gap = float((t * weight).sum() / weight.sum())
    n_lit = int(lit.sum())
    photons_per_lit = float(emission[lit].mean())
    expected_per_lit = burst_photons * (bursts / n_frames) / lit_share
    statistics = {
        "photons_per_lit_frame": photons_per_lit,
        "share_of_frames_lit": n_lit / lit.size,
        "duty_cycle": float(emission.sum()) / (lit.size * burst_photons) * on_s / frame_s,
        "duty_cycle_theory": on_s / (on_s + off_s),
        "burst_s": on_s,
        "mean_gap_s": float(gaps.mean()),
        "mean_gap_theory_s": expected_gap,
        "bursts_per_molecule": float(emission.sum()) / burst_photons / len(emission),
        "bursts_per_molecule_theory": bursts,
    }

    def near(name: str, value: float, theory: float, sd: float) -> Check:
        # Four standard deviations: a right simulation fails one of these in 16 000 runs.
        return Check(name, value, f"{theory:.5g} ± {4 * sd:.2g}", abs(value - theory) < 4 * sd)

    n_bursts = bursts * n_molecules
    checks = [
        near("STORM share of frames lit", n_lit / lit.size, lit_share, lit_share / np.sqrt(n_bursts)),
        near("STORM photons per lit frame", photons_per_lit, expected_per_lit, expected_per_lit / np.sqrt(n_lit)),
        near("STORM mean gap, s", float(gaps.mean()), expected_gap, float(gaps.std() / np.sqrt(len(gaps)))),
        near("STORM bursts per molecule", statistics["bursts_per_molecule"], bursts, bursts * np.sqrt(2 / n_bursts)),
    ]
    return statistics, checks


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="The source's validation, redone.")
    parser.add_argument("--out", type=Path, help="folder for validation.json")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--quick", action="store_true", help="fewer simulated molecules")
    args = parser.parse_args(argv)
    checks: list[Check] = []
    results: dict[str, Any] = {}
    if (args.data / "egfp_emccd_traces.tif").is_file():
        rows, found = egfp(args.data, 300 if args.quick else 1000)
        checks += found
        results["egfp"] = rows
        print(CHOICES, "\n")
        print(f"W1 over frames, ADU (the source: {SOURCE})")
        names = ("mufasa", "poisson", "sofi", "fitted", "floor")
        print(f"{'reading':22} {'traces':13}" + "".join(f"{name:>12}" for name in names) + "  mufasa ? poisson ? sofi")
        for row in rows:
            values = "".join(_number(row["w1_adu"].get(name)) for name in names)
            print(f"{row['reading']:22} {row['traces']:13}{values}  {row['order']}")
            ranges = [*(row["interval_95_adu"].get(name) for name in names[:-1]), row["floor_95_adu"]]
            print(" " * 36 + "".join(map(_range, ranges)))
            apart = (f"{name} {low:.0f} to {high:.0f}" for name, (low, high) in row["difference_95_adu"].items())
            print(" " * 36 + "95 % of " + "; ".join(apart))
    else:
        print(f"EGFP skipped: no egfp_emccd_traces.tif in {args.data}")
    results["storm"], found = storm(500 if args.quick else 2000)
    checks += found
    print("\nSTORM, Alexa 647 (Table 5)")
    for name, value in results["storm"].items():
        print(f"  {name:28} {value:.5g}")
    print()
    for check in checks:
        print(f"{'holds' if check.holds else 'FAILS'}  {check.name}: {check.value:.5g} (expected {check.expected})")
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / "validation.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return 0 if all(check.holds for check in checks) else 1


def _number(value: float | None) -> str:
    return " " * 12 if value is None else f"{value:12.0f}"


def _range(pair: list[float] | None) -> str:
    return " " * 12 if pair is None else f"{f'{pair[0]:.0f}-{pair[1]:.0f}':>12}"


if __name__ == "__main__":
    sys.exit(main())
