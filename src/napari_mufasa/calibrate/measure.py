"""The camera from its own movies: baseline, read noise, digital counts per photoelectron (photon transfer).

At constant light the variance of a pixel in time grows with its mean: slope = F²·(ADU per photoelectron), with
the excess noise factor F² = 2 for electron multiplication and 1 without (docs/camera.md). Differences of successive
frames take slow changes of the light out of the variance; medians over pixels of like mean take blinking out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate.dark import clock_induced, dark_frames, leading_dark_frames
from napari_mufasa.calibrate.transfer import curve, line, photon_transfer, slope_through_origin, steady_pixels
from napari_mufasa.calibrate.value import Value
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from napari_mufasa.model.setup import Camera

CameraType = Literal["CCD", "EMCCD", "CMOS"]


@dataclass(frozen=True)
class Calibration:
    """What `calibrate` found.

    Attributes
    ----------
    baseline_adu, read_noise_adu : from dark frames, or (baseline) where the variance vanishes
    slope_adu : variance over signal, F²·ADU per photoelectron
    adu_per_photoelectron : slope / excess_noise_factor
    clock_induced_charge_e : electrons per pixel and frame from the tail of the dark frames (nan: unknown)
    tail_fraction : share of dark pixels more than 5 sd above the baseline
    camera : a `Camera` with these values; curve : photon transfer (mean − baseline, variance − dark) in ADU
    notes : what was assumed
    """

    baseline_adu: Value
    read_noise_adu: Value
    slope_adu: Value
    adu_per_photoelectron: Value
    excess_noise_factor: float
    clock_induced_charge_e: Value
    tail_fraction: float
    camera: Camera
    curve: tuple[NDArray[np.float64], NDArray[np.float64]]
    notes: list[str] = field(default_factory=list)

    def report(self) -> dict[str, Any]:
        """Plain data: every value with its standard error, the camera, the assumptions."""
        names = ("baseline_adu", "read_noise_adu", "slope_adu", "adu_per_photoelectron", "clock_induced_charge_e")
        return {
            **{name: {"value": getattr(self, name).value, "sd": getattr(self, name).sd} for name in names},
            "excess_noise_factor": self.excess_noise_factor,
            "tail_fraction": self.tail_fraction,
            "camera": self.camera.model_dump(mode="json"),
            "curve": {"signal_adu": self.curve[0].tolist(), "variance_adu2": self.curve[1].tolist()},
            "notes": self.notes,
        }


def calibrate(
    movie: Any,
    dark: Any = None,
    *,
    camera_type: CameraType = "EMCCD",
    em_gain: float | None = None,
    electrons_per_adu: float | None = None,
    quantum_efficiency: float = 0.9,
    excess_noise_factor: float | None = None,
    baseline_adu: float | None = None,
    read_noise_adu: float | None = None,
    adc_max: int = 65535,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Calibration:
    """Measure the camera from a movie and its dark frames.

    Parameters
    ----------
    movie : (frame, y, x) ADU under light that is steady from frame to frame
    dark : (frame, y, x) frames without light; without them dark frames at the movie's beginning are looked
        for, and failing that the baseline is where the fitted variance vanishes (then it is a lower bound:
        read noise is taken as `read_noise_adu` or 0)
    em_gain, electrons_per_adu : photon transfer measures only their ratio; give one (default: gain 300 for
        an EMCCD) and the other follows
    excess_noise_factor : F² of the multiplication; None: 2 for an EMCCD, 1 else
    baseline_adu, read_noise_adu : known values, instead of dark frames

    Raises
    ------
    MufasaError : too few frames, or no dark frames and too little range of light for a line.
    """
    shape = tuple(getattr(movie, "shape", ()))
    if len(shape) != 3 or shape[0] < 4:
        raise MufasaError(f"movie has shape {shape}: calibration needs at least 4 frames (frame, y, x)")
    notes: list[str] = []
    first = 0
    if dark is None and baseline_adu is None:
        first = leading_dark_frames(movie)
        if first:
            dark = np.asarray(movie[:first])
            notes.append(f"frames 0 to {first - 1} are dark and were used as dark frames")
    base, read, tail, values = dark_frames(dark, baseline_adu, read_noise_adu, shape[1:], notes)
    means, variances = photon_transfer(movie, first, progress, cancel)
    steady = steady_pixels(means, variances)
    means, variances = means[:, steady], variances[:, steady]
    if np.isnan(base.value):
        base, slopes = line(means, variances, int(shape[0]) - first, read.value, notes)
    else:
        slopes = np.array(
            [slope_through_origin(m - base.value, v - read.value**2) for m, v in zip(means, variances, strict=True)]
        )
    slopes = slopes[np.isfinite(slopes)]
    if len(slopes) == 0 or np.median(slopes) <= 0:
        raise MufasaError(
            "the variance does not grow with the signal: the movie is dark, saturated or already processed; "
            "give raw frames under light"
        )
    slope = Value(float(np.mean(slopes)), float(np.std(slopes) / np.sqrt(max(len(slopes) - 1, 1))))
    factor = excess_noise_factor or (2.0 if camera_type == "EMCCD" else 1.0)
    notes.append(f"excess noise factor {factor:g} " + ("given" if excess_noise_factor else f"assumed ({camera_type})"))
    per_electron = Value(slope.value / factor, slope.sd / factor)
    charge = clock_induced(values, base.value, read.value, per_electron.value)
    camera = _camera(
        camera_type, per_electron.value, em_gain, electrons_per_adu, quantum_efficiency, base.value, read.value,
        charge.value, adc_max, notes,
    )  # fmt: skip
    return Calibration(
        base, read, slope, per_electron, factor, charge, tail, camera,
        curve(means.mean(axis=0) - base.value, variances.mean(axis=0) - np.nan_to_num(read.value) ** 2), notes,
    )  # fmt: skip


def _camera(
    kind: CameraType, adu_per_electron: float, em_gain: float | None, electrons_per_adu: float | None,
    quantum_efficiency: float, baseline: float, read_noise_adu: float, charge: float, adc_max: int, notes: list[str],
) -> Camera:  # fmt: skip
    from napari_mufasa.model.setup import Camera

    if kind == "EMCCD":
        if em_gain is None and electrons_per_adu is None:
            em_gain = 300.0
            notes.append("EM gain 300 assumed: only gain over electrons per ADU is measured")
        if electrons_per_adu is None:
            electrons_per_adu = float(em_gain or 1) / adu_per_electron
        elif em_gain is None:
            em_gain = electrons_per_adu * adu_per_electron
    else:
        em_gain, electrons_per_adu = None, 1 / adu_per_electron
    curve = {"cmos_gain_curve": ((0.0, 0.0), (1.0, 1.0))} if kind == "CMOS" else {}
    return Camera(
        type=kind,
        quantum_efficiency=quantum_efficiency,
        read_noise_e=float(np.nan_to_num(read_noise_adu) * electrons_per_adu),
        clock_induced_charge_e=float(np.nan_to_num(charge)),
        electrons_per_adu=electrons_per_adu,
        baseline_adu=max(baseline, 0.0),
        adc_max=adc_max,
        em_gain=max(em_gain, 1.0) if em_gain is not None else None,
        **curve,
    )
