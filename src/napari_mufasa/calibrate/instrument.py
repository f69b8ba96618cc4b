"""From measured numbers to a `Camera` that a model can take."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.calibrate.value import Value

if TYPE_CHECKING:
    from napari_mufasa.calibrate.dark import Dark
    from napari_mufasa.calibrate.found import Calibration
    from napari_mufasa.model.setup import Camera

TYPICAL_GAIN = 300.0
LEAST_MAP_FRAMES = 20  # dark frames for maps of single pixels


def camera_of(
    kind: Any, found: Calibration, em_gain: float | None, electrons_per_adu: float | None, quantum_efficiency: float,
    dark: Dark | None, assumed: Any, adc_max: int, code_widths: tuple[float, ...], notes: list[str],
) -> tuple[Camera, tuple[Value, Value]]:  # fmt: skip
    """The camera, and its EM gain and electrons per ADU with their intervals."""
    from napari_mufasa.model.setup import Camera

    per_electron = found.adu_per_photoelectron
    given = float("nan")
    if kind == "EMCCD":
        if em_gain is None and electrons_per_adu is None:
            em_gain = TYPICAL_GAIN
            notes.append("EM gain 300 assumed: only gain over electrons per ADU is measured")
        if electrons_per_adu is None:
            gain = Value(float(em_gain or 1.0), given)
            per_adu = _over(gain.value, per_electron)
        else:
            per_adu = Value(float(electrons_per_adu), given)
            scale = 1 / electrons_per_adu
            gain = per_electron.over(scale) if em_gain is None else Value(em_gain, given)
    else:
        gain = Value(1.0, given)
        per_adu = _over(1.0, per_electron) if electrons_per_adu is None else Value(float(electrons_per_adu), given)
    believed, (low, high) = gain.value / per_adu.value, per_electron.interval
    if abs(believed - per_electron.value) > 2 * max(high - per_electron.value, per_electron.value - low):
        notes.append(
            f"the values given make {believed:.4g} ADU of a photoelectron, the movie {low:.4g} to {high:.4g}: the "
            "former are taken; check them, and the type of the camera"
        )
    values: dict[str, Any] = {}
    if kind == "CMOS":
        values["cmos_gain_curve"] = ((0.0, 0.0), (1.0, 1.0))
        if dark is not None and dark.variance_map is not None and dark.fit is not None:
            values |= _maps(dark, per_adu.value, found.baseline_adu.value, notes)
    if kind == "EMCCD" and assumed.excess_noise_factor not in (None, 2.0):
        values["excess_noise_factor"] = assumed.excess_noise_factor
    readout = found.readout
    camera = Camera(
        type=kind,
        quantum_efficiency=quantum_efficiency,
        read_noise_e=float(np.nan_to_num(found.read_noise_adu.value) * per_adu.value),
        clock_induced_charge_e=float(np.nan_to_num(found.clock_induced_charge_e.value)),
        electrons_per_adu=per_adu.value,
        baseline_adu=max(found.baseline_adu.value, 0.0),
        adc_max=adc_max,
        em_gain=max(gain.value, 1.0) if kind == "EMCCD" else None,
        readout_kernel=readout.kernel if kind != "CMOS" else (),
        read_noise_kernel=readout.noise_kernel if kind != "CMOS" else (),
        baseline_alternation_adu=float(np.nan_to_num(readout.alternation_adu.value)),
        baseline_jitter_adu=float(np.nan_to_num(readout.jitter_adu.value)),
        code_widths=code_widths,
        **values,
    )
    return camera, (gain, per_adu)


def _over(number: float, value: Value) -> Value:
    low, high = value.interval
    return Value(number / value.value, number * value.sd / value.value**2, number / high, number / max(low, 1e-12))


def _maps(dark: Dark, electrons_per_adu: float, baseline: float, notes: list[str]) -> dict[str, Any]:
    """Offset and read noise of each pixel, where pixels differ by more than their own noise."""
    from scipy import stats

    assert dark.variance_map is not None and dark.fit is not None
    n = dark.n_frames
    if n < LEAST_MAP_FRAMES:
        return {}
    found: dict[str, Any] = {}
    offset = dark.offset_map
    chance = dark.variance / n
    if np.sum(offset**2) / chance > stats.chi2.ppf(0.999, offset.size - 1):
        found["offset_map_adu"] = offset
    variances = dark.variance_map
    spread = np.sum((variances / variances.mean() - 1) ** 2) * (n - 1) / 2
    if spread > stats.chi2.ppf(0.999, variances.size - 1):
        found["variance_map_e2"] = np.maximum(variances - 1 / 12, 0.0) * electrons_per_adu**2
    if found:
        notes.append("pixels differ in " + " and ".join("offset" if "offset" in n else "read noise" for n in found))
    return found
