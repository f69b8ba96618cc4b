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
        ("polymerase, its dark half", calibrate(polymerase, dark, em_gain=400)),
    ):
        rows = found.readout
        shares = ", ".join(told(share) for share in rows.shares)
        print(f"\n{name}")
        print(f"  baseline (ADU)         {told(found.baseline_adu)}")
        print(f"  read noise (ADU)       {told(found.read_noise_adu)}")
        print(f"  ADU per photoelectron  {told(found.adu_per_photoelectron)}")
        print(f"  kernel                 {shares}")
        print(f"  neighbours, no spots   along rows {rows.row_correlations[0]:+.4f}, columns "
              f"{rows.column_correlations[0]:+.4f}, each ± {rows.correlations_sd:.4f}")  # fmt: skip
        print(f"  neighbours, all pixels along rows {told(rows.everywhere_row[0])}, columns "
              f"{told(rows.everywhere_column[0])}")  # fmt: skip
        if rows.dark_row_correlations is not None:
            print(f"  neighbours, dark       along rows {', '.join(f'{c:+.3f}' for c in rows.dark_row_correlations)}")
        print(f"  alternation (ADU)      {told(rows.alternation_adu)}")
        print(f"  excess noise factor    {told(found.excess_noise_measured)} by the histogram")
        fits = [f"{fit.name} p = {fit.p_value:.2g}, {100 * fit.distance:.2g} % elsewhere" for fit in found.fits]
        print(f"  test of fit            p = {found.p_value:.2g} ({'; '.join(fits)}; rows p = {found.row_p_value:.2g})")
        for note in found.notes:
            print(f"  note: {note}", flush=True)


if __name__ == "__main__":
    main()
