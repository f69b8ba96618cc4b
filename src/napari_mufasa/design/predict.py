"""Planning an experiment: what a model predicts before any movie is taken, by formulas (docs/photophysics.md,
docs/optics.md, docs/camera.md, docs/comparison.md).

The formulas are those of the base model: `model.effects` are not in them. To see an effect, simulate.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.camera.detector import multiplication_noise
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.photophysics import rates

if TYPE_CHECKING:
    import pandas as pd

MAX_POINTS = 1000
SATURATES = 2.0  # sd: a pixel whose mean is not so far below the largest count is cut off in some frames
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Prediction:
    """What to expect of one molecule and one movie; None where the model has no such thing.

    Attributes
    ----------
    k01_per_s : excitation rate
    emitted_photons_per_frame, collected_photons_per_frame, detected_e_per_frame : of a molecule that is bright for
        the whole frame: in all directions, on the detector, as photoelectrons
    peak_pixel_e, peak_pixel_adu : its signal in the pixel it is centred on (ADU: with baseline and background)
    headroom_sd : by how many sd of its noise that lies below the largest count; below 2 (`SATURATES`) it is cut off
    snr_peak_pixel, snr_spot : signal over noise in a frame, in that pixel and fitted with the PSF over the whole
        spot (what `extract_traces` does); noise of emission and detection, the camera's multiplication, background,
        read noise and rounding to whole counts (1/12 of their square) included; infinite without any noise
    on_time_s, dark_time_s : mean visit to the bright and to the dark state
    detected_e_per_visit : photoelectrons of a mean visit to the bright state (None where it does not end)
    snr_visit : signal over noise of the whole spot in a frame at whose beginning it is bright: where a visit is shorter
        than a frame no frame is as bright as those above
    detection_sd : by how many sd of the noise of empty pixels it stands out, fitted with the PSF, in means over the
        times that `extract_traces` looks at (docs/traces.md), which asks for 6; of many visits the longest do more
    duty_cycle : share of its life the molecule is bright
    bleaching_time_s : mean time until bleaching, dark times and activation included
    detected_e_before_bleaching : photoelectrons of a life, those of the exposures only
    frames_before_bleaching : frames of full light in a life, dark times not counted
    localisation_nm : least sd along one axis with which a frame can place it (Cramér–Rao bound)
    bleached_by_the_end : share of molecules bleached when the movie ends, as many as were activated and came back
    w1_floor_e : Wasserstein distance expected between the traces of two halves of the molecules, of which some are
        bright for longer than others
    smallest_change : relative change of brightness whose distance equals that floor
    movie_s : length of the movie
    """

    k01_per_s: float
    emitted_photons_per_frame: float
    collected_photons_per_frame: float
    detected_e_per_frame: float
    peak_pixel_e: float
    peak_pixel_adu: float
    headroom_sd: float
    snr_peak_pixel: float
    snr_spot: float
    on_time_s: float | None
    detected_e_per_visit: float | None
    snr_visit: float
    dark_time_s: float | None
    detection_sd: float
    duty_cycle: float
    bleaching_time_s: float | None
    detected_e_before_bleaching: float | None
    frames_before_bleaching: float | None
    localisation_nm: float | None
    bleached_by_the_end: float | None
    w1_floor_e: float
    smallest_change: float | None
    movie_s: float


def predict(model: Model) -> Prediction:
    """What to expect of a model, by formulas: no movie is simulated, and effects are left out."""
    from napari_mufasa.model.model import Model
    from napari_mufasa.spots.times import averaged_frames

    checks.need(model, Model, "model", "give preset(NAME) or Model.from_json(PATH)")
    dye, light, optics, timing = model.fluorophore, model.excitation, model.optics, model.acquisition
    k01 = rates.excitation_rate(dye.extinction_coefficient_per_M_cm, light.power_density_w_per_cm2, light.wavelength_nm)
    k10 = rates.relaxation_rate(dye.lifetime_s)
    blinks = model.protocol in ("Blinking", "STORM") and bool(dye.isc_ratio)
    k1t = rates.intersystem_crossing_rate(dye.isc_ratio or 0.0, dye.lifetime_s) if blinks else 0.0
    cycles = dye.cycles_before_bleaching
    k1b = rates.bleaching_rate(cycles, dye.lifetime_s) if cycles is not None else 0.0
    excited = k01 / (k01 + k10 + k1t + k1b)  # share of the bright time spent in S1
    off_rate, bleach_rate = excited * k1t, excited * k1b
    dark_s = 1 / dye.triplet_decay_rate_per_s if blinks and dye.triplet_decay_rate_per_s else None
    returns = dark_s is not None or not blinks  # a triplet without decay never comes back
    duty = 1 / (1 + off_rate * dark_s) if dark_s is not None else 1.0

    collected_share = optics.collection_efficiency * optics.brightness_correction
    detected_share = collected_share * model.camera.quantum_efficiency
    emitted = dye.quantum_yield * k10 * excited * timing.frame_length_s
    detected = emitted * detected_share
    back_rate = 1 / dark_s if dark_s is not None else None
    # Blinking and STORM start in the triplet, PALM before activation; without either molecules are bright at once.
    first_light = light.activation_rate_per_s if model.protocol == "PALM" else back_rate
    bleach_s = None
    if bleach_rate > 0 and returns and first_light != 0:
        bleach_s = (0.0 if first_light is None else 1 / first_light) + 1 / (bleach_rate * duty)
    leaving = off_rate + bleach_rate
    movie_s = timing.n_frames * timing.interval_s
    bleached, bright, bright_var = _shares(bleach_rate, off_rate, back_rate or 0.0, first_light, movie_s)
    # Detection adds its own Poisson noise to that of the emission (docs/camera.md), of which the optics say the share.
    emission_share = optics.emission_noise * detected_share
    pixels = _spot(model, detected, emission_share * detected)
    on_s = 1 / leaving if leaving > 0 else None

    def lit(seconds: float) -> float:
        """Mean share of a time that a molecule is bright which is so at its beginning."""
        return _shares(bleach_rate, off_rate, back_rate or 0.0, None, seconds)[1]

    visit_e = detected * lit(timing.frame_length_s)
    visit = _spot(model, visit_e, emission_share * visit_e)
    means = {n: lit(n * timing.interval_s) for n in averaged_frames(timing.n_frames)[:-1]} if bright > 0 else {}
    means |= {timing.n_frames: bright}
    most_e = detected * max(share * np.sqrt(n) for n, share in means.items())
    floor = _w1_floor_e(model, detected, bright, bright_var, pixels.spot_noise_e, pixels.empty_noise_e)
    return Prediction(
        k01_per_s=k01,
        emitted_photons_per_frame=emitted,
        collected_photons_per_frame=emitted * collected_share,
        detected_e_per_frame=detected,
        peak_pixel_e=pixels.peak_e,
        peak_pixel_adu=pixels.peak_adu,
        headroom_sd=pixels.headroom_sd,
        snr_peak_pixel=_over_noise(pixels.peak_e, pixels.peak_noise_e),
        snr_spot=_over_noise(detected, pixels.spot_noise_e),
        on_time_s=on_s,
        detected_e_per_visit=detected * on_s / timing.frame_length_s if on_s is not None else None,
        snr_visit=_over_noise(visit_e, visit.spot_noise_e),
        detection_sd=_over_noise(most_e, pixels.empty_noise_e),
        dark_time_s=dark_s,
        duty_cycle=duty,
        bleaching_time_s=bleach_s,
        detected_e_before_bleaching=detected / (bleach_rate * timing.interval_s) if bleach_rate else None,
        frames_before_bleaching=1 / (bleach_rate * timing.interval_s) if bleach_rate else None,
        localisation_nm=pixels.place_px * timing.pixel_size_nm if np.isfinite(pixels.place_px) else None,
        bleached_by_the_end=bleached if k1b else None,
        w1_floor_e=floor,
        smallest_change=floor / (detected * bright) if detected * bright > 0 else None,
        movie_s=movie_s,
    )


def _shares(
    bleaching: float, off: float, back: float, first: float | None, movie_s: float
) -> tuple[float, float, float]:
    """Share of molecules bleached when a movie ends, and mean and variance (over molecules) of the share of it that
    they are bright, by rates per s: bleaching and turning off while bright, coming back, and first light (None: bright
    from the start)."""
    from scipy.linalg import expm

    bright, dark, bleached, waiting = range(4)
    generator = np.zeros((4, 4))
    generator[bright, bleached], generator[bright, dark], generator[dark, bright] = bleaching, off, back
    generator[waiting, bright] = first or 0.0
    generator -= np.diag(generator.sum(axis=1))
    # Beside the exponential of the generator, those of these blocks have its mean over the movie, and the mean over all
    # pairs of times in order of being bright at both (Van Loan, IEEE Trans. Automat. Contr. 23, 395, 1978).
    is_bright = np.eye(4)[:, [bright]]
    blocks = np.zeros((9, 9))
    blocks[:4, :4] = blocks[4:8, 4:8] = generator * movie_s
    blocks[:4, 4:8], blocks[4:8, 8:] = is_bright @ is_bright.T, is_bright
    start = bright if first is None else waiting
    moved = expm(blocks)
    ended, mean = np.clip([moved[start, bleached], moved[4 + start, 8]], 0, 1)
    return float(ended), float(mean), float(max(2 * moved[start, 8] - mean**2, 0.0))


def _over_noise(signal: float, noise: float) -> float:
    return signal / noise if noise > 0 else float("inf") if signal > 0 else 0.0


def design(model: Model, vary: Mapping[str, Sequence[Any]] | None = None) -> pd.DataFrame:
    """Predictions for every combination of the values given by dotted path, one row each.

    ``design(model, {"excitation.power_density_w_per_cm2": [1, 10, 100]})``. Raises `MufasaError` for a path or
    a value the model does not allow, or more than `MAX_POINTS` combinations.
    """
    import pandas as pd

    from napari_mufasa.model.model import Model

    checks.need(model, Model, "model", "give preset(NAME) or Model.from_json(PATH)")
    vary = {name: checks.several(values, name) for name, values in (vary or {}).items()}
    n_points = int(np.prod([len(values) for values in vary.values()]))
    if not 1 <= n_points <= MAX_POINTS:
        raise MufasaError(f"the values given make {n_points} combinations: give between 1 and {MAX_POINTS}")
    rows = []
    for values in itertools.product(*vary.values()):
        point = dict(zip(vary, values, strict=True))
        rows.append(point | asdict(predict(model.with_values(point) if point else model)))
    return pd.DataFrame(rows)


def numbers() -> dict[str, type]:
    """Dotted path of every number of a set-up, which can be varied, and whether it is an int or a float."""
    found: dict[str, type] = {}
    for part in ("excitation", "fluorophore", "optics", "camera", "acquisition", "sample"):
        owner: Any = Model.model_fields[part].annotation
        for name, field in owner.model_fields.items():
            kinds = {int: int, float: float, int | None: int, float | None: float}
            if field.annotation in kinds:
                found[f"{part}.{name}"] = kinds[field.annotation]
    return found


@dataclass(frozen=True)
class _Spot:
    """Signal and noise of a spot centred on a pixel, in photoelectrons (peak_adu: in counts); headroom_sd: of its
    brightest pixel; place_px: the least sd of its place."""

    peak_e: float
    peak_adu: float
    headroom_sd: float
    peak_noise_e: float
    spot_noise_e: float
    empty_noise_e: float
    place_px: float


def _spot(model: Model, detected_e: float, emission_e2: float) -> _Spot:
    """``emission_e2``: variance of the whole spot's light, by the emission alone."""
    from scipy.special import erf

    camera = model.camera
    offsets_px = np.arange(-50, 51)
    edge = erf(np.stack([offsets_px - 0.5, offsets_px + 0.5]) / (np.sqrt(2) * model.sigma_px))
    line = (edge[1] - edge[0]) / 2
    centre = float(line[50] ** 2)
    n_pixels = 1 / float(np.sum(line**2) ** 2)  # noise-equivalent number of pixels of the PSF fitted by least squares
    # The spot's own shot noise is largest at its centre, where the weights are.
    own_share = n_pixels**2 * float(np.sum(line**3) ** 2)
    read_e2 = camera.read_noise_e**2
    if camera.variance_map_e2 is not None:
        read_e2 = float(np.mean(camera.variance_map_e2))
    read_e2 += camera.electrons_per_adu**2 / 12  # rounding to whole counts
    alpha = multiplication_noise(camera)
    dark_e = camera.quantum_efficiency * model.optics.background_photons_per_px + camera.clock_induced_charge_e
    shape = np.outer(line, line)
    peak = detected_e * centre
    light_e = detected_e * shape + dark_e
    out_e, steep = _response(model, light_e, alpha * light_e + emission_e2 * shape**2)
    read_pixels_e2 = read_e2 * steep
    read_dark_e2 = read_e2 * float(_response(model, np.array(dark_e), np.array(alpha * dark_e))[1])
    # Fisher information on its place: Σ (∂μ/∂x)² / variance over the pixels. The noise of the emission moves all pixels
    # together, along μ, which is even where ∂μ/∂x is odd: it does not blur the place.
    rise = np.diff(np.exp(-(np.append(offsets_px - 0.5, 50.5) ** 2) / (2 * model.sigma_px**2)))
    slopes_e = detected_e * np.outer(line, rise / (np.sqrt(2 * np.pi) * model.sigma_px))
    variance_e2 = alpha * light_e + read_pixels_e2
    known = float(np.sum(np.divide(slopes_e**2, variance_e2, out=np.zeros_like(slopes_e), where=variance_e2 > 0)))
    peak_adu = float(out_e[50, 50]) / camera.electrons_per_adu + camera.baseline_adu
    peak_noise_e = float(np.sqrt(alpha * (peak + dark_e) + emission_e2 * centre**2 + read_pixels_e2[50, 50]))
    room_e = (camera.adc_max - peak_adu) * camera.electrons_per_adu * float(np.sqrt(steep[50, 50]))
    return _Spot(
        peak_e=peak,
        peak_adu=peak_adu,
        headroom_sd=room_e / peak_noise_e if peak_noise_e > 0 else float(np.copysign(np.inf, room_e)),
        peak_noise_e=peak_noise_e,
        spot_noise_e=float(
            np.sqrt(
                alpha * (own_share * detected_e + n_pixels * dark_e)
                + emission_e2
                + n_pixels**2 * np.sum(shape**2 * read_pixels_e2)
            )
        ),
        empty_noise_e=float(np.sqrt(n_pixels * (alpha * dark_e + read_dark_e2))),
        place_px=float(1 / np.sqrt(known)) if known > 0 else float("inf"),
    )


def _response(model: Model, mean_e: Floats, variance_e2: Floats) -> tuple[Floats, Floats]:
    """Mean output electrons of pixels whose photoelectrons have this mean and variance, and by how much the inverse of
    the camera's response makes the square of a noise of the output larger: the mean of 1/slope², for shot noise spreads
    over several pieces of a CMOS's curve."""
    from scipy.special import ndtr

    camera = model.camera
    if camera.type != "CMOS":
        gain = float(camera.em_gain or 1.0)
        return gain * mean_e, np.full_like(mean_e, gain**-2)
    knots_e, out_e = np.asarray(camera.cmos_gain_curve, dtype=float).T
    slopes = np.diff(out_e) / np.diff(knots_e)
    spread_e = np.sqrt(np.maximum(variance_e2, 1e-12))
    steep, response_e = np.full_like(mean_e, slopes[0] ** -2), out_e[0] + slopes[0] * (mean_e - knots_e[0])
    for knot_e, (slope, after) in zip(knots_e[1:-1], pairwise(slopes), strict=True):
        above = (mean_e - knot_e) / spread_e
        share = ndtr(above)
        steep = steep + (after**-2 - slope**-2) * share
        bell = np.exp(-(above**2) / 2) / np.sqrt(2 * np.pi)
        response_e = response_e + (after - slope) * spread_e * (above * share + bell)
    return response_e, steep


def _w1_floor_e(
    model: Model, on_e: float, bright: float, bright_var: float, on_noise_e: float, off_noise_e: float
) -> float:
    """E|F₁ − F₂| integrated, of two halves of N molecules and T frames: √(2/π)·∫√(4·(noise/(N·T) + light/N)), where the
    noise of every frame is its own, and the share of it that a molecule is bright (`bright`, variance `bright_var`) is
    a draw for each molecule."""
    from scipy.special import ndtr

    n, n_frames = max(2, model.sample.n_molecules), model.acquisition.n_frames
    width = max(on_noise_e, off_noise_e)
    if width <= 0:
        return 0.0
    e = np.linspace(min(0.0, on_e) - 8 * width, on_e + 8 * width, 4001)
    on, off = ndtr((e - on_e) / max(on_noise_e, 1e-9)), ndtr(e / max(off_noise_e, 1e-9))
    noise = bright * on * (1 - on) + (1 - bright) * off * (1 - off)
    light = max(bright_var, bright * (1 - bright) / n_frames) * (off - on) ** 2
    spread = np.trapezoid(np.sqrt(noise / (n * n_frames) + light / n), e)
    return float(np.sqrt(2 / np.pi) * 2 * spread)
