"""How molecules are found, measured and chosen (docs/traces.md)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.errors import MufasaError
from napari_mufasa.spots import aperture, find
from napari_mufasa.spots.link import LEAST_FRAMES, MOST_GAP
from napari_mufasa.traces import select


@dataclass(frozen=True, kw_only=True)
class Options(select.Choice):
    """How molecules are found, measured and chosen. Every field is a keyword of `extract_traces`.

    psf_sigma_px : PSF standard deviation in px; None measures it on the brightest spots
    threshold, threshold_value : "sigma" (k noise sd, 6), "percentile" (98), "otsu", "triangle"
    time_block : frames of the shortest time scale detection looks at, or fewer, so that hardly any are left over at the
        end; None: at most 200 blocks
    profile : "psf" (photoelectrons of the whole spot), "sum" (disc of 2.5 σ), "brightest_pixel"
    subtract_background : subtract the local background ring frame by frame
    position : "fit" (moments of the lit image) or "brightest_pixel" (its centre)
    follow_drift : let positions follow the motion common to the field
    follow_molecules : follow each molecule from frame to frame, and read its trace along its path
    max_step_px : a molecule that is followed moves no farther from frame to frame; None: 2 σ, at least 2 px
    max_gap : frames that it may be missed for; min_found : frames that it must be found in to be a candidate
    roi : (y, x) mask, or polygons as (vertex, 2) arrays of (y, x), as a Shapes layer holds them
    step_false_alarm : probability that a trace without any step is split
    border_px, isolation_px : None: σ and 3.5 σ, at least 1 and 3 px
    min_snr … best : see `select.Choice`
    """

    psf_sigma_px: float | None = None
    threshold: find.Threshold = "sigma"
    threshold_value: float | None = None
    time_block: int | None = None
    profile: aperture.Profile = "psf"
    subtract_background: bool = True
    position: str = "fit"
    follow_drift: bool = False
    follow_molecules: bool = False
    max_step_px: float | None = None
    max_gap: int = MOST_GAP
    min_found: int = LEAST_FRAMES
    roi: Any = None
    step_false_alarm: float = 0.01
    border_px: float | None = None
    isolation_px: float | None = None

    def rules(self, sigma_px: float) -> select.Rules:
        shared = {f.name: getattr(self, f.name) for f in fields(select.Rules)}
        if self.border_px is None:
            shared["border_px"] = max(1.0, sigma_px)
        if self.isolation_px is None:
            shared["isolation_px"] = find.isolation_px(sigma_px)
        return select.Rules(**shared)


def chosen_options(options: Options | None, changes: dict[str, Any]) -> Options:
    """Options with changes, each within what it may be; raises `MufasaError`."""
    known = {f.name for f in fields(Options)}
    for name in changes:
        if name not in known:
            raise MufasaError(f"there is no option {name!r} for traces: choose of {', '.join(sorted(known))}")
    checks.need(options or Options(), Options, "options", "give napari_mufasa.traces.Options(…)")
    chosen = replace(options or Options(), **changes)
    checks.choice(chosen.profile, "profile", get_args(aperture.Profile))
    checks.choice(chosen.position, "position", ("fit", "brightest_pixel"))
    if chosen.follow_molecules:
        _check_following(chosen)
    find.check_threshold(chosen.threshold, chosen.threshold_value)
    checks.number(chosen.step_false_alarm, "step_false_alarm", 1e-12, 1)
    checks.number(chosen.min_snr, "min_snr", 0)
    for name, least, most in _RANGES:
        if (value := getattr(chosen, name)) is not None:
            checks.number(value, name, least, most)
    for name, fewest in _COUNTS:
        if (value := getattr(chosen, name)) is not None:
            checks.whole(value, name, fewest)
    if chosen.min_steps is not None and chosen.max_steps is not None and chosen.min_steps > chosen.max_steps:
        raise MufasaError(f"min_steps {chosen.min_steps} is above max_steps {chosen.max_steps}: lower it")
    return chosen


# Options that may be None, and what they may be else.
_RANGES = (
    ("psf_sigma_px", 0.3, 50),
    ("max_step_px", 0.01, 1000),
    ("border_px", 0, np.inf),
    ("isolation_px", 0, np.inf),
    ("max_lit_share", 0, 1),
)
_COUNTS = (
    ("window", 1),
    ("best", 1),
    ("time_block", 1),
    ("max_gap", 0),
    ("min_found", 2),
    ("min_lit_frames", 0),
    ("min_steps", 0),
    ("max_steps", 0),
)


def _check_following(chosen: Options) -> None:
    if chosen.threshold != "sigma":
        raise MufasaError(f"threshold {chosen.threshold!r}: molecules are followed above a number of noise sd: 'sigma'")
    if chosen.position != "fit":
        raise MufasaError(f"position {chosen.position!r}: molecules are followed to a part of a pixel: 'fit'")


def roi_mask(roi: Any, shape_px: tuple[int, int]) -> NDArray[np.bool_]:
    """A (y, x) mask from a mask or from polygons, each (vertex, 2 or more) with (y, x) last."""
    from skimage.draw import polygon2mask

    if isinstance(roi, np.ndarray) and roi.ndim == 2 and roi.shape == tuple(shape_px):
        return roi.astype(bool)
    try:
        polygons = [np.asarray(p, dtype=float) for p in roi]
    except (TypeError, ValueError):
        polygons = []
    if not polygons or any(p.ndim != 2 or p.shape[0] < 3 or p.shape[1] < 2 for p in polygons):
        raise MufasaError(
            f"roi {checks.told(roi)}: give a mask of shape {tuple(shape_px)} or a list of polygons (vertex, 2)"
        )
    masks = [polygon2mask(shape_px, p[:, -2:]) for p in polygons]  # type: ignore[no-untyped-call]
    return np.asarray(np.logical_or.reduce(masks), dtype=bool)
