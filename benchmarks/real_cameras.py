"""What `calibrate` says of the real movies beside the project: `python -m benchmarks.real_cameras` (../shared/data)."""

from __future__ import annotations

from pathlib import Path

import tifffile

from napari_mufasa.calibrate.measure import calibrate
from napari_mufasa.calibrate.value import Value

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def told(value: Value) -> str:
    low, high = value.interval
    return f"{value.value:.4g} [{low:.4g}, {high:.4g}]"


def main() -> None:
    smfret = tifffile.imread(DATA / "smfret_ixon_emccd.tif")
    yeast = tifffile.imread(DATA / "yeast_slimfield_emccd.tif")
    polymerase = tifffile.imread(DATA / "polymerase_ixon888_emccd.tif")
    dark = tifffile.imread(DATA / "polymerase_ixon888_dark.tif")
    for name, found in (
        ("smFRET, no dark frames", calibrate(smfret, em_gain=300)),
        ("yeast", calibrate(yeast)),
        ("polymerase, its dark half", calibrate(polymerase[:60], dark, em_gain=400)),
    ):
        rows = found.readout
        shares = ", ".join(told(share) for share in rows.shares)
        print(f"\n{name}")
        print(f"  baseline (ADU)         {told(found.baseline_adu)}")
        print(f"  read noise (ADU)       {told(found.read_noise_adu)}")
        print(f"  ADU per photoelectron  {told(found.adu_per_photoelectron)}")
        print(f"  kernel                 {shares}")
        print(f"  along rows             {rows.row_correlations[0]:+.3f}, spots included "
              f"{rows.correlations_everywhere[0]:+.3f}, columns {rows.column_correlations[0]:+.3f}")  # fmt: skip
        print(f"  alternation (ADU)      {told(rows.alternation_adu)}")
        print(f"  test of fit            p = {found.p_value:.2g}", flush=True)


if __name__ == "__main__":
    main()
