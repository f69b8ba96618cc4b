"""The camera from its own movies: what dark counts, the growth of variance with light, neighbours and histograms tell.

At constant light the variance of a pixel in time grows with its mean: slope = F²·(ADU per photoelectron), with
the excess noise factor F² = 2 for electron multiplication and 1 without (docs/camera.md). Differences of successive
frames take slow changes of the light out of the variance; medians over pixels of like mean take blinking out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.calibrate import rows
from napari_mufasa.calibrate.assessment import Assumed, assessed, kernel_of, weights_of
from napari_mufasa.calibrate.codes import code_widths, saturated_pixels, saturation_adu
from napari_mufasa.calibrate.dark import Dark, DarkFrames, measure_dark
from napari_mufasa.calibrate.found import Calibration
from napari_mufasa.calibrate.instrument import camera_of
from napari_mufasa.calibrate.kind import doubt, kind_of
from napari_mufasa.calibrate.light import Light
from napari_mufasa.calibrate.sample import DIM, lit_chunks, lit_frames, shadow, some_frames
from napari_mufasa.camera.darkness import FRAMES as LOOKED_AT
from napari_mufasa.camera.darkness import light_in_dark, share_shown
from napari_mufasa.errors import MufasaError

CameraType = Literal["CCD", "EMCCD", "CMOS"]
LEAST_UNSATURATED = 0.02  # share of the pixels that must be free of saturation for the others to be left out
SURE = 3.0  # sd by which frames must show less than the light does to be dark
WIDE_PX = 32  # frames from which on the first columns can be spared
DARK_CHARGE_E = 1.0  # electrons per pixel and frame below which a shadow counts as dark


def calibrate(
    movie: Any,
    dark: Any = None,
    *,
    camera_type: CameraType | None = None,
    em_gain: float | None = None,
    electrons_per_adu: float | None = None,
    quantum_efficiency: float = 0.9,
    excess_noise_factor: float | None = None,
    readout_kernel: Sequence[float] | None = None,
    clock_induced_charge_e: float | None = None,
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
    dark : (frame, y, x) frames without light; without them dark frames at the movie's beginning or end are looked
        for, then a part of the chip in shadow, and failing that the baseline is where the fitted variance vanishes,
        with the read noise that the histogram shows: intervals are wider then
    camera_type : None: an EMCCD where an EM gain above 1 is given, else what the histogram, or the counts that a
        photoelectron makes, say (`kind_of`): EMCCD or CCD; a CMOS counts its electrons alike
    em_gain, electrons_per_adu : photon transfer measures only their ratio; give one (default: gain 300 for
        an EMCCD) and the other follows; an EM gain of 1 says CCD, an EMCCD's type or not, unless the histogram shows
        the excess noise of a register: it is then taken as if it were not given
    excess_noise_factor : F² of the multiplication; None: 2 for an EMCCD, 1 else
    readout_kernel, clock_induced_charge_e : taken so instead of measured; () and 0: none, () of the read noise, too
    baseline_adu, read_noise_adu : known values, instead of dark frames; with the baseline alone the read noise is what
        the histogram shows

    Memory: about 1.5 GB, however long or large the movie and the dark frames are (lazy ones are read in part). Of
    frames of more than 1024 × 1024 pixels the middle is looked at, all of them for the maps of a CMOS camera's pixels.

    Raises
    ------
    MufasaError : too few frames; a movie no brighter than the dark; an EM gain of a camera that has none; no dark
        frames and too little range of light for a line, or a baseline alone that leaves the read noise open.
    """
    movie = checks.stack(movie)
    shape = tuple(movie.shape)
    if shape[0] < 4:
        raise MufasaError(f"movie has shape {shape}: calibration needs at least 4 frames (frame, y, x)")
    check_given(
        camera_type or "EMCCD", em_gain, electrons_per_adu, quantum_efficiency, excess_noise_factor, baseline_adu
    )
    if dark is not None:
        dark = checks.dark_stack(dark, shape[1:])
        if told := light_in_dark(movie, dark):
            warnings.warn(told, stacklevel=2)
    kernel = None if readout_kernel is None else tuple(float(share) for share in readout_kernel)
    assumed = Assumed(excess_noise_factor, kernel, clock_induced_charge_e, baseline_adu, read_noise_adu)

    ends = _unlit_ends(movie, dark, baseline_adu, cancel)

    without = em_gain == 1 and camera_type in (None, "EMCCD")

    def taken_for(kind: CameraType) -> Calibration:
        gain = em_gain if kind == "EMCCD" and not without else None
        known = (gain, electrons_per_adu, quantum_efficiency, assumed, adc_max)
        return _calibrated(movie, ends, kind, *known, progress, cancel)

    if not without and (camera_type is not None or em_gain is not None):
        return taken_for(camera_type or "EMCCD")
    found = taken_for("EMCCD")
    kind, untold = kind_of(found, electrons_per_adu)
    if without and untold is not None:
        kind, untold = "CCD", None
    found = found if kind == "EMCCD" else taken_for(kind)
    told = untold or f"as its counts tell, {kind} is taken"
    if without:
        told = "an EM gain of 1 multiplies nothing: CCD is taken"
        if kind == "EMCCD":
            told = (
                "the EM gain is said to be 1, but the counts are those of a register: EMCCD is taken, with a gain of "
                f"{found.em_gain.value:.3g}; give the gain that was set"
            )
    alike = "" if kind == "EMCCD" or camera_type is not None else " (a CMOS counts alike: give its type if it is one)"
    return replace(found, notes=[*found.notes, told + alike], type_untold=untold)


def _calibrated(
    movie: Any, ends: Ends, camera_type: CameraType, em_gain: float | None, electrons_per_adu: float | None,
    quantum_efficiency: float, assumed: Assumed, adc_max: int, progress: Callable[[int, int], None] | None,
    cancel: Callable[[], bool] | None,
) -> Calibration:  # fmt: skip
    """The same of a camera whose type is known."""
    shape, baseline_adu = tuple(movie.shape), assumed.baseline_adu
    excess_noise_factor, clock_induced_charge_e = assumed.excess_noise_factor, assumed.clock_induced_charge_e
    register, notes, dark = camera_type == "EMCCD", list(ends.notes), ends.dark
    first, stop = ends.measured
    movie = checks.unread(movie)[:stop] if stop < shape[0] else movie
    chunks = lit_chunks(movie, first, progress, cancel)
    _, height, width = chunks[0].shape
    if height * width < shape[1] * shape[2]:
        notes.append(f"of {shape[1]} × {shape[2]} pixels the middle {height} × {width} were looked at")
    lit = np.ones((height, width), dtype=bool)
    if width >= WIDE_PX:
        lit[:, : rows.LAGS] = False  # what was read before them is not in the movie
    frames, shaded, seen_dark = None, None, None
    if dark is not None:
        frames = DarkFrames.of([dark], cancel=cancel, register=register)
        lit &= ~frames.hot[frames.region]
        if frames.hot.any():
            number = checks.counted(int(frames.hot.sum()), "pixel")
            notes.append(f"hot in the dark frames: {number}, left out of all but the maps")
    elif baseline_adu is None and register:
        shaded = shadow(chunks)
        frames = None if shaded is None else DarkFrames.of(chunks, shaded, register=register)
    if frames is not None:
        seen_dark = measure_dark(frames, register, clock_induced_charge_e)
        if shaded is not None and not _is_dark(seen_dark):
            frames, shaded, seen_dark = None, None, None
    if shaded is not None:
        lit &= ~shaded
        notes.append(f"{100 * shaded.mean():.0f} % of the pixels lie in shadow and were used in place of dark frames")
    full = saturation_adu(chunks, lit)
    if full is not None:
        notes.append(f"counts pile up at {full:g} ADU: the movie is saturated there; {_spared(chunks, lit, full)}")
    seen = Light(chunks, lit, stop - first)
    if seen_dark is not None and frames is not None and (seen_dark.charge.value > 0 or seen_dark.stray):
        # What an electron looks like in the dark depends on the kernel, which the light tells.
        weights = weights_of(kernel_of(seen, seen_dark, seen_dark.variance, assumed)[0])
        if len(weights) > 1:
            seen_dark = measure_dark(frames, register, clock_induced_charge_e, weights)
    factor = excess_noise_factor or (2.0 if register else 1.0)
    notes.append(f"excess noise factor {factor:g} " + ("given" if excess_noise_factor else f"assumed ({camera_type})"))
    try:
        found = assessed(seen, seen_dark, assumed, factor, notes)
    except MufasaError as error:
        if dark is not None or not ends.notes:
            raise
        raise MufasaError(f"{error}; {'; '.join(ends.notes)}") from error
    camera, gains = camera_of(
        camera_type, found, em_gain, electrons_per_adu, quantum_efficiency, seen_dark, assumed, adc_max,
        code_widths(chunk[:, lit] for chunk in chunks), notes,
    )  # fmt: skip
    if register and (told := doubt(found)) is not None:
        notes.insert(0, told)
    if full is not None:
        camera = camera.model_copy(update={"adc_max": min(int(full), camera.adc_max)})
    return replace(
        found, camera=camera, em_gain=gains[0], electrons_per_adu=gains[1], saturation_adu=full,
        leading_dark=ends.leading_dark, trailing_dark=ends.trailing_dark,
    )  # fmt: skip


@dataclass(frozen=True)
class Ends:
    """measured : the first frame, and that after the last one, by which the light is measured · leading_dark,
    trailing_dark : so many are dark · dark : frames, given or the movie's own, or None"""

    measured: tuple[int, int]
    dark: Any
    leading_dark: int = 0
    trailing_dark: int = 0
    notes: tuple[str, ...] = ()


def _unlit_ends(movie: Any, dark: Any, baseline_adu: float | None, cancel: Callable[[], bool] | None) -> Ends:
    """What is dark of a movie; without dark frames what is dark at its beginning, or at its end, serves as such."""
    n = int(movie.shape[0])
    first, stop = lit_frames(movie, cancel)
    movie = checks.unread(movie)
    ends = [(start, end) for start, end in ((0, first), (stop, n)) if start < end]
    if not ends:
        return Ends((0, n), dark)
    if dark is not None or baseline_adu is not None:
        level = float(baseline_adu or 0.0) if dark is None else float(np.mean(some_frames(dark, LOOKED_AT)))
        most = DIM * (float(np.mean(some_frames(movie[:stop], LOOKED_AT, first))) - level)
        ends = [end for end in ends if abs(float(np.mean(some_frames(movie[slice(*end)], LOOKED_AT))) - level) <= most]
        return _left_out(n, dark, ends, [_told(end, "are dark: left out") for end in ends])
    used, *others = ends
    # An even frame first: the baseline of odd ones may differ.
    own = movie[used[0] + used[0] % 2 : used[1]]
    if light_in_dark(some_frames(movie[:stop], LOOKED_AT, first), own):
        words = "are darker, but show what the others show: not taken for dark frames"
        return Ends((0, n), None, notes=tuple(_told(end, words) for end in ends))
    if used[0] and not _shown_dark(movie[first:stop], own):
        words = "are darker, but nothing shows that they are dark: left out here; give them as dark frames if they are"
        return Ends((first, stop), None, notes=(_told(used, words),))
    notes = [_told(used, "are dark and were used as dark frames")]
    return _left_out(n, own, ends, notes + [_told(end, "are dark: left out") for end in others])


def _left_out(n: int, dark: Any, ends: list[tuple[int, int]], notes: list[str]) -> Ends:
    first, stop = max([end for start, end in ends if not start], default=0), min([s for s, _ in ends if s], default=n)
    return Ends((first, stop), dark, first, n - stop, tuple(notes))


def _told(end: tuple[int, int], words: str) -> str:
    return f"frames {end[0]} to {end[1] - 1} {words}"


def _shown_dark(lit: Any, after: Any) -> bool:
    """Whether frames after the lit ones hold less than `DIM` of their light, whatever the dark level is: by their mean,
    for no level is below 0, or because they show too little of what the last lit ones show."""
    bright, dim = (float(np.mean(some_frames(part, LOOKED_AT))) for part in (lit, after))
    if dim < DIM * bright:
        return True
    n = min(LOOKED_AT, len(after), len(lit) // 2)
    share, sd = share_shown(lit[len(lit) - 2 * n : len(lit) - n], lit[len(lit) - n :], after[:n])
    return share + SURE * sd < DIM


def check_given(
    camera_type: Any, em_gain: Any, electrons_per_adu: Any, quantum_efficiency: Any, excess_noise_factor: Any = None,
    baseline_adu: Any = None,
) -> None:  # fmt: skip
    """Values that the user knows, within what a camera can have."""
    checks.choice(camera_type, "camera_type", get_args(CameraType))
    checks.number(quantum_efficiency, "quantum_efficiency", 1e-3, 1)
    known = {
        "em_gain": (em_gain, 1, 1e5), "electrons_per_adu": (electrons_per_adu, 1e-6, 1e6),
        "excess_noise_factor": (excess_noise_factor, 1, 4), "baseline_adu": (baseline_adu, 0, 65535),
    }  # fmt: skip
    for name, (value, least, most) in known.items():
        if value is not None:
            checks.number(value, name, least, most)
    if em_gain is not None and em_gain > 1 and camera_type != "EMCCD":
        raise MufasaError(f"em_gain = {em_gain:g}: a {camera_type} does not multiply; drop it, or choose EMCCD")


def _spared(chunks: list[NDArray[np.float32]], lit: NDArray[np.bool_], full: float) -> str:
    """Take the pixels that reach `full` out of `lit` (y, x), in place, as long as enough are left; words for it."""
    kept = lit & ~saturated_pixels(chunks, full)
    if kept.sum() <= max(9, LEAST_UNSATURATED * lit.sum()):
        return "hardly a pixel is free of it, so that ADU per photoelectron cannot be right: record with less light"
    words = f"{100 * (1 - kept.sum() / lit.sum()):.2g} % of the pixels come near it and were left out"
    lit &= kept
    return words


def _is_dark(shaded: Dark) -> bool:
    """Whether a part of the chip is dark, not just dim and even: electrons would show, one by one or as stray ones."""
    electrons = shaded.charge if shaded.stray is None else shaded.stray.electrons
    return shaded.fit is not None and not electrons.value > DARK_CHARGE_E
