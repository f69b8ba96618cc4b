"""What spots and their traces say of optics, density, brightness and dynamics, each with a 95 % interval."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.calibrate.value import NORMAL, UNKNOWN, Value
from napari_mufasa.propose.fluctuations import fluctuation_width
from napari_mufasa.spots.find import LEAST_PROMINENCE

if TYPE_CHECKING:
    from collections.abc import Callable

    from napari_mufasa.model.setup import Camera
    from napari_mufasa.traces.extract import TraceSet

LEAST_SPOTS = 5
SHORT_RUN = 4  # frames in which a molecule that moves stays about where it is
SHORT_RUNS = 10
SHORT_SPOTS = 20  # for a width by them
WIDTH_DOUBT = 0.03  # of a width by moments, whatever the number of spots
LEVEL_DOUBT = 0.04  # of a mean on level, by choice of molecules and width
DENSITY_DOUBT = 0.15  # dim molecules that are missed, and noise that is not
RESOLVED = 3.0  # distance in PSF widths from which on two spots are two
SEEN_SD = 6.0  # noise sd that a molecule's light must reach to be found (`spots.find`)
SAFELY = 1.25  # times the frames that a molecule of middling brightness needs: dim ones need more
LEAST_BLINKS = 0.5  # dark times per molecule from which on blinking is believed


@dataclass(frozen=True)
class Seen:
    """psf_sigma_px · background_e (photoelectrons per pixel and frame) · n_molecules · on_level_e (photoelectrons of a
    bright molecule per frame) · bleaching_per_frame, off_per_frame (rates) · dark_frames (mean dark time in frames) ·
    width_from: "spots", in the mean of the movie; "short runs" of frames, where molecules move; "fluctuations", where
    too few stand alone."""

    psf_sigma_px: Value
    background_e: Value
    n_molecules: Value
    on_level_e: Value
    bleaching_per_frame: Value
    off_per_frame: Value
    dark_frames: Value
    traces: TraceSet
    width_from: str


def seen_in(
    movie: Any, camera: Camera, dark: Any, gain_doubt: float, baseline_doubt_e: float, progress: Any = None,
    cancel: Callable[[], bool] | None = None,
) -> Seen:  # fmt: skip
    """Look at a movie (frame, y, x) with the camera measured; `gain_doubt`: relative, `baseline_doubt_e`: both sd."""
    from napari_mufasa.traces import extract_traces

    def extracted(sigma_px: float | None) -> TraceSet:
        how: dict[str, Any] = {"width": None} if sigma_px is None else {"psf_sigma_px": sigma_px}
        return extract_traces(movie, camera, dark, progress=progress, cancel=cancel, **how)

    found = first = extracted(None)
    width, width_from = _width(first), "spots"
    if np.isfinite(width.value):
        found = extracted(width.value)
        width = _width(found)
        still = _width_of_short_runs(movie, camera, dark, found.sigma_px)
        if still.value + 2 * float(np.hypot(still.sd, width.sd)) < width.value:
            width, width_from = still, "short runs"
    if not np.isfinite(width.value):
        width, width_from = fluctuation_width(movie, camera), "fluctuations"
        found = extracted(width.value if np.isfinite(width.value) else first.sigma_px)
    spread = float(np.std(np.median(found.background, axis=1))) if len(found.background) > 1 else 0.0
    background = found.background_e
    share = float(np.hypot(baseline_doubt_e, abs(background) * np.hypot(gain_doubt, 0.02)))
    share = float(np.hypot(share, spread / np.sqrt(max(len(found.background), 1))))
    bleaching, off, dark_frames = _dynamics(found)
    return Seen(
        width, Value(background, share), _number(found, movie.shape[1:], bleaching), _level(found, gain_doubt),
        bleaching, off, dark_frames, found, width_from,
    )  # fmt: skip


def _width_of_short_runs(movie: Any, camera: Camera, dark: Any, sigma_px: float) -> Value:
    """PSF width in averages of so few frames that molecules hardly move in them; unknown where too few are seen."""
    from napari_mufasa.traces import extract_traces

    starts = np.unique(np.linspace(0, movie.shape[0] - SHORT_RUN, SHORT_RUNS).astype(int))
    width = Value(sigma_px, float("nan"))
    for _ in range(2):  # moments are read under a window of the width believed
        seen: list[Any] = []
        for start in starts[starts >= 0]:
            run = np.asarray(movie[start : start + SHORT_RUN])
            spots = _isolated(extract_traces(run, camera, dark, psf_sigma_px=width.value))
            seen.append(spots[["sigma_minor_px", "sigma_major_px", "neighbour_px"]].to_numpy())
        minor, major, apart = np.concatenate(seen).T if seen else np.empty((3, 0))
        if len(minor) < SHORT_SPOTS:
            return UNKNOWN
        width = _middle_width(np.sqrt(minor * major)[apart >= np.median(apart)])  # neighbours widen
    return width


def _isolated(found: TraceSet) -> Any:
    table = found.molecules
    clear = table["kept"] & (table["significance"] > np.percentile(table["significance"], 30) if len(table) > 20 else 1)
    return table[clear]


def _width(found: TraceSet) -> Value:
    spots = _isolated(found)
    widths = np.sqrt(spots["sigma_minor_px"].to_numpy() * spots["sigma_major_px"].to_numpy())
    return _middle_width(widths)


def _middle_width(widths: Any) -> Value:
    widths = widths[np.isfinite(widths)]
    if len(widths) < LEAST_SPOTS:
        return UNKNOWN
    middle = float(np.median(widths))
    spread = 1.4826 * float(np.median(np.abs(widths - middle)))
    return Value(middle, float(np.hypot(1.2533 * spread / np.sqrt(len(widths)), WIDTH_DOUBT * middle)))


def _number(found: TraceSet, shape: tuple[int, ...], bleaching_per_frame: Value) -> Value:
    table = found.molecules
    n = int(np.sum((table["prominence"] >= LEAST_PROMINENCE) & (table["lit_frames"] >= 3)))
    if n == 0:
        return UNKNOWN
    # Of molecules closer than what is resolved one is seen: n seen = A/a · (1 − exp(−n a/A)).
    crowded = min(n * np.pi * (RESOLVED * found.sigma_px) ** 2 / float(np.prod(shape)), 0.9)
    number = n * -np.log1p(-crowded) / crowded
    # Those that bleach before their light adds up to what is found are not seen either.
    rate = bleaching_per_frame.value if np.isfinite(bleaching_per_frame.value) else 0.0
    number *= np.exp(min(rate * _frames_to_be_seen(found), 1.0))
    doubt = float(np.hypot(np.hypot(np.sqrt(n), DENSITY_DOUBT * n), 0.5 * (number - n)))
    return Value(float(number), doubt, max(float(number) - NORMAL * doubt, 1.0))


def _frames_to_be_seen(found: TraceSet) -> float:
    """How long a molecule must shine for its light to be found.

    Most are found in the mean of all n frames: light in L of them stands L/√n single-frame SNRs above its noise.
    """
    snr = found.molecules["snr"].to_numpy()[found.kept]
    return SEEN_SD * float(np.sqrt(found.lit.shape[1])) / max(float(np.median(snr)), 0.1) if len(snr) else 0.0


def _level(found: TraceSet, gain_doubt: float) -> Value:
    levels = found.molecules["brightness"].to_numpy()[found.kept]
    if len(levels) < LEAST_SPOTS:
        return UNKNOWN
    middle = float(np.median(levels))
    own = 1.2533 * 1.4826 * float(np.median(np.abs(levels - middle))) / np.sqrt(len(levels))
    return Value(middle, float(np.sqrt(own**2 + middle**2 * (gain_doubt**2 + LEVEL_DOUBT**2))))


def _dynamics(found: TraceSet) -> tuple[Value, Value, Value]:
    """Bleaching and turning off per lit frame, and the mean dark time in frames, of the kept molecules.

    Events over the time at risk: what the movie's end cuts off counts as time without an event. Molecules that bleach
    before they are found are missing, so that bleaching is counted from there on.
    """
    table, lit = found.molecules[found.kept], found.lit[found.kept]
    shone = lit.sum(axis=1)
    at_risk = float(shone.sum())
    if len(table) < LEAST_SPOTS or at_risk == 0:
        return UNKNOWN, UNKNOWN, UNKNOWN
    least = min(SAFELY * _frames_to_be_seen(found), float(np.median(shone)))
    bleached = int(np.sum((table["bleaching_frame"].to_numpy() >= 0) & (shone > least)))
    beyond = float(np.maximum(shone - least, 0.0).sum())
    blinks = int(table["n_blinks"].sum())
    off = dark = UNKNOWN
    if blinks >= LEAST_BLINKS * len(table):
        between = np.maximum.accumulate(lit, axis=1) & np.maximum.accumulate(lit[:, ::-1], axis=1)[:, ::-1] & ~lit
        off, times = _rate(blinks, at_risk), _rate(blinks, float(between.sum()))
        low, high = times.interval
        dark = Value(1 / times.value, times.sd / times.value**2, 1 / high, 1 / max(low, 1e-12))
    return _rate(bleached, beyond) if beyond > 0 else UNKNOWN, off, dark


def _rate(events: int, time: float) -> Value:
    """Events per time, with the interval that a Poisson number has, a tenth wider for events missed or made up."""
    from scipy import stats

    low = stats.chi2.ppf(0.025, 2 * events) / 2 if events else 0.0
    high = stats.chi2.ppf(0.975, 2 * events + 2) / 2
    sd = np.sqrt(max(events, 1)) / time
    return Value(events / time, float(sd), float(0.9 * low / time), float(1.1 * high / time))
