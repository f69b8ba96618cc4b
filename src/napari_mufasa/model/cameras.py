"""Named cameras to start from."""

from __future__ import annotations

from typing import Any

#: Typical cameras to start from; electrons per count and baseline are on the camera's data sheet.
CAMERAS: dict[str, dict[str, Any]] = {
    "EMCCD, gain 300": {
        "type": "EMCCD", "quantum_efficiency": 0.9, "read_noise_e": 50.0, "clock_induced_charge_e": 0.002,
        "electrons_per_adu": 12.0, "baseline_adu": 200.0, "em_gain": 300.0,
    },
    "sCMOS, linear": {
        "type": "CMOS", "quantum_efficiency": 0.8, "read_noise_e": 1.6, "electrons_per_adu": 0.46,
        "baseline_adu": 100.0, "cmos_gain_curve": ((0.0, 0.0), (1.0, 1.0)),
    },
    "CCD": {
        "type": "CCD", "quantum_efficiency": 0.7, "read_noise_e": 6.0, "electrons_per_adu": 1.0, "baseline_adu": 100.0,
    },
}  # fmt: skip
