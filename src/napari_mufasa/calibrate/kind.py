"""Whether a camera multiplies its electrons, by what a calibration as an EMCCD has found."""

from __future__ import annotations

from typing import Literal

import numpy as np

from napari_mufasa.calibrate.found import Calibration

FEW_ADU = 3.0  # ADU² of variance per ADU of light above which a camera multiplies
NO_REGISTER = 1.35  # F² below which it does not
MANY_ADU = 10.0  # of variance per ADU of light that few cameras reach without a register


def kind_of(found: Calibration, electrons_per_adu: float | None = None) -> tuple[Literal["EMCCD", "CCD"], str | None]:
    """EMCCD, or CCD (a CMOS counts its electrons alike), and words where the histogram does not tell, nor the electrons
    per ADU where they are known: a photoelectron then makes a variance of F² times the gain, in electrons²."""
    low, high = found.excess_noise_measured.interval
    if np.isfinite(low) and (high < 1.7 or low > NO_REGISTER):
        return "EMCCD" if low > NO_REGISTER else "CCD", None
    if electrons_per_adu is not None:
        return "EMCCD" if found.slope_adu.value * electrons_per_adu > NO_REGISTER else "CCD", None
    kind: Literal["EMCCD", "CCD"] = "EMCCD" if found.slope_adu.value > FEW_ADU else "CCD"
    return kind, (
        f"the histogram does not tell whether the camera multiplies; {kind} is taken, for a photoelectron makes "
        f"{found.slope_adu.value:.3g} ADU of variance"
    )


def doubt(found: Calibration) -> str | None:
    """Words where what was measured as an EMCCD may be none."""
    rejected = not found.law_holds and found.slope_adu.value < MANY_ADU
    if kind_of(found)[0] == "EMCCD" and not rejected:
        return None
    return (
        "is this really an EMCCD? Its counts do not look like it; if it has no register, give its type, "
        "CMOS or CCD: a photoelectron then makes twice as many counts"
    )
