"""What a calibration has found, as data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate.dark import Stray
from napari_mufasa.calibrate.histogram import Fit
from napari_mufasa.calibrate.value import UNKNOWN, Value

if TYPE_CHECKING:
    from napari_mufasa.model.setup import Camera

Array = NDArray[np.float64]
LEVEL = 0.01  # of the test of fit: of right laws some 2 in 100 are below it


@dataclass(frozen=True)
class Readout:
    """What the read-out does to rows and frames.

    Attributes
    ----------
    kernel, noise_kernel : shares of the pixels before, of the signal and of the read noise; `shares`: the former with
        intervals (none where it was given)
    row_correlations, column_correlations : of neighbours' noise at lags 1 …, in pixels without spots, each ±
        `correlations_sd`
    everywhere_row, everywhere_column : of all lit pixels as the movie has them, by differences of successive frames:
        what moving molecules do to neighbours along rows and columns alike is in them
    dark_row_correlations : the same in the dark
    alternation_adu, jitter_adu : of the frames' baselines
    """

    kernel: tuple[float, ...]
    noise_kernel: tuple[float, ...]
    shares: tuple[Value, ...]
    row_correlations: Array
    column_correlations: Array
    everywhere_row: tuple[Value, ...]
    everywhere_column: tuple[Value, ...]
    correlations_sd: float
    dark_row_correlations: Array | None
    alternation_adu: Value
    jitter_adu: Value

    def report(self) -> dict[str, Any]:
        """Plain data."""
        dark = self.dark_row_correlations
        return {
            "kernel": list(self.kernel),
            "shares": [share.plain() for share in self.shares],
            "noise_kernel": list(self.noise_kernel),
            "row_correlations": self.row_correlations.tolist(),
            "column_correlations": self.column_correlations.tolist(),
            "row_correlations_spots_included": [value.plain() for value in self.everywhere_row],
            "column_correlations_spots_included": [value.plain() for value in self.everywhere_column],
            "correlations_sd": self.correlations_sd,
            "dark_row_correlations": None if dark is None else dark.tolist(),
            "alternation_adu": self.alternation_adu.plain(),
            "jitter_adu": self.jitter_adu.plain(),
        }


@dataclass(frozen=True)
class Calibration:
    """What `calibrate` found; every `Value` has a 95 % interval.

    Attributes
    ----------
    baseline_adu, read_noise_adu : from dark frames, or from where the variance vanishes and the histogram
    slope_adu : variance over signal, F²·ADU per photoelectron, put right for the read-out's kernel
    adu_per_photoelectron : slope / excess_noise_factor
    excess_noise_measured : F² by the shape of the histogram, beside the one assumed
    clock_induced_charge_e : electrons per pixel and frame from the tail of the dark frames (nan: unknown)
    tail_fraction : share of dark pixels more than 5 sd above the baseline
    readout : kernel, correlations, alternation
    fits : laws against histograms, dark and lit; row_p_value : what the kernel leaves of the rows' correlations
    em_gain, electrons_per_adu : one of them as given, the other with its interval
    stray : electrons of dark frames that are not quite dark
    saturation_adu : where counts pile up; None: nowhere
    leading_dark, trailing_dark : frames at the movie's beginning and end without light
    camera : a `Camera` with these values; curve : photon transfer (mean − baseline, variance − dark) in ADU
    notes : what was assumed · type_untold : words where the camera's type was not given, and its counts do not tell it
    """

    baseline_adu: Value
    read_noise_adu: Value
    slope_adu: Value
    adu_per_photoelectron: Value
    excess_noise_factor: float
    excess_noise_measured: Value
    clock_induced_charge_e: Value
    tail_fraction: float
    readout: Readout
    fits: tuple[Fit, ...]
    row_p_value: float
    curve: tuple[Array, Array]
    camera: Camera = field(default=None)  # type: ignore[assignment]
    em_gain: Value = UNKNOWN
    electrons_per_adu: Value = UNKNOWN
    saturation_adu: float | None = None
    notes: list[str] = field(default_factory=list)
    stray: Stray | None = None
    leading_dark: int = 0
    trailing_dark: int = 0
    type_untold: str | None = None

    @property
    def law_holds(self) -> bool:
        """Whether the test of fit leaves the law standing. Of right laws some 2 in 100 fall: pixels differ in
        more than the law knows, by little, and the level leaves room for that."""
        return self.p_value >= LEVEL

    @property
    def p_value(self) -> float:
        """Test of fit: chance of a misfit as large as the worst of histograms and rows, where the law is right."""
        found = [fit.p_value for fit in self.fits] + [self.row_p_value]
        return min(1.0, len(found) * min(found))

    def report(self) -> dict[str, Any]:
        """Plain data: values with errors and intervals, the camera, the test of fit, the assumptions."""
        names = (
            "baseline_adu", "read_noise_adu", "slope_adu", "adu_per_photoelectron", "excess_noise_measured",
            "clock_induced_charge_e", "em_gain", "electrons_per_adu",
        )  # fmt: skip
        tail = self.tail_fraction
        return {
            **{name: getattr(self, name).plain() for name in names},
            "excess_noise_factor": self.excess_noise_factor,
            "tail_fraction": tail if np.isfinite(tail) else None,
            "stray": None if self.stray is None else {name: v.plain() for name, v in vars(self.stray).items()},
            "saturation_adu": self.saturation_adu,
            "readout": self.readout.report(),
            "test_of_fit": {
                "law_holds": self.law_holds,
                "p_value": self.p_value,
                "rows": self.row_p_value,
                **{fit.name: {"p_value": fit.p_value, "distance": fit.distance} for fit in self.fits},
            },
            "camera": self.camera.model_dump(mode="json"),
            "curve": {"signal_adu": self.curve[0].tolist(), "variance_adu2": self.curve[1].tolist()},
            "notes": self.notes,
        }
