"""Single-molecule traces from an acquisition: detect, extract, judge (docs/traces.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.camera.frames import Frames, Progress, Unit
from napari_mufasa.errors import MufasaError
from napari_mufasa.optics.gaussian import mean_peak_share
from napari_mufasa.simulate.layout import check_positions
from napari_mufasa.spots import aperture, drift, find
from napari_mufasa.spots.shape import LitImages, Shapes
from napari_mufasa.traces import select
from napari_mufasa.traces.dynamics import dynamics

if TYPE_CHECKING:
    import pandas as pd

    from napari_mufasa.model.setup import Camera


MIN_SPOTS_FOR_DRIFT = 5
DRIFT_PX = 0.7  # motion over the movie from which on the user is told


@dataclass(frozen=True, kw_only=True)
class Options(select.Choice):
    """How molecules are found, measured and chosen. Every field is a keyword of `extract_traces`.

    psf_sigma_px : PSF standard deviation in px; None measures it on the brightest spots
    threshold, threshold_value : "sigma" (k noise sd, 6), "percentile" (98), "otsu", "triangle"
    time_block : frames of the shortest time scale detection looks at; None: at most 200 blocks
    profile : "psf" (photoelectrons of the whole spot), "sum" (disc of 2.5 σ), "brightest_pixel"
    subtract_background : subtract the local background ring frame by frame
    position : "fit" (moments of the lit image) or "brightest_pixel" (its centre)
    follow_drift : let positions follow the motion common to the field
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


@dataclass(frozen=True)
class TraceSet:
    """What `extract_traces` gives.

    Attributes
    ----------
    traces : (molecule, frame) float32 photoelectrons of the kept molecules; with `window`, those frames only
    molecules : one row per candidate: molecule, y_px, x_px, kept, reason, brightness, snr, bleaching_frame, …
    all_traces : (candidate, frame) float32 photoelectrons, whole movie, same order as `molecules`
    units : "photoelectrons"
    background_e, noise_e : median background level and temporal noise sd per pixel and frame, photoelectrons
    background : (candidate, frame) local background per pixel
    lit : (candidate, frame) whether the idealised trace is on
    sigma_px : PSF width used; pixel_share : share of a molecule's light that the trace holds
    drift_px : (frame, 2) motion followed, or None; options : how it was made
    notes : what the user should know, in sentences
    """

    traces: NDArray[np.float32]
    molecules: pd.DataFrame
    all_traces: NDArray[np.float32]
    background: NDArray[np.float32]
    lit: NDArray[np.bool_]
    background_e: float
    noise_e: float
    sigma_px: float
    pixel_share: float
    options: Options
    drift_px: NDArray[np.float64] | None = None
    units: str = "photoelectrons"
    notes: tuple[str, ...] = ()

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(candidate,) which of them are kept."""
        return np.asarray(self.molecules["kept"], dtype=bool)

    @property
    def positions_px(self) -> NDArray[np.float64]:
        """(candidate, 2) positions (y, x) of all candidates."""
        return np.asarray(self.molecules[["y_px", "x_px"]], dtype=np.float64)

    def with_kept(self, molecules: Sequence[int], kept: bool = True, reason: str = "rejected by hand") -> TraceSet:
        """A copy in which these molecules (ids) are kept, or rejected for `reason`: the choice by hand."""
        table = self.molecules.copy()
        chosen = table["molecule"].isin(list(molecules))
        table.loc[chosen, "kept"] = kept
        table.loc[chosen, "reason"] = "" if kept else reason
        return replace(self, molecules=table, traces=_kept_traces(self.all_traces, table, self.options.window))


def extract_traces(
    movie: Any,
    camera: Camera,
    dark: Any = None,
    *,
    options: Options | None = None,
    positions_px: NDArray[np.floating] | None = None,
    unit: Unit = "adu",
    progress: Progress | None = None,
    cancel: Callable[[], bool] | None = None,
    **changes: Any,
) -> TraceSet:
    """Find single molecules in a movie and give their traces in photoelectrons (docs/traces.md).

    Parameters
    ----------
    movie : (frame, y, x), NumPy, dask or zarr; read in blocks, twice
    camera : the detector; dark : dark frames of the same region, which replace its baseline
    options, **changes : see `Options` (``extract_traces(movie, camera, window=50, best=20)``)
    positions_px : (molecule, 2) known positions; nothing is detected then
    unit : what the movie's numbers are: "adu", "photoelectrons" or "photons"
    progress : called with (frames read, frames to read); cancel : True stops (raises `Cancelled`)

    Returns
    -------
    TraceSet : `.traces` of the kept molecules, `.molecules` with all candidates and reasons, …

    Raises
    ------
    MufasaError : a movie, dark frames or option that cannot be used.
    """
    options = chosen_options(options, changes)
    frames = Frames(movie, camera, dark, unit)
    if options.roi is not None:
        roi_mask(options.roi, frames.shape[1:])
    if options.window is not None and not 1 <= options.window <= frames.n_frames:
        raise MufasaError(f"window = {options.window} frames; the movie has {frames.n_frames}: give 1 … that")
    frames.check_light()
    passes = (2 if positions_px is None else 1) + (1 if options.follow_drift else 0)
    report = _counter(progress, passes * frames.n_frames)
    sigma = options.psf_sigma_px or (find.estimate_sigma_px(frames) or 1.3)
    motion = drift.common_motion(frames, sigma, report, cancel) if options.follow_drift else None

    notes: list[str] = []
    if positions_px is None:
        seen = find.find_spots(
            frames, sigma, threshold=options.threshold, value=options.threshold_value, block=options.time_block,
            drift_px=motion, report=report, cancel=cancel,
        )  # fmt: skip
        found, strength, outstanding = seen.positions_px, seen.significance, seen.prominence
        early, late = seen.evidence.early, seen.evidence.late
        moved = drift.moved_px(early, late) if motion is None and len(found) >= MIN_SPOTS_FOR_DRIFT else 0.0
        if moved > DRIFT_PX:
            notes.append(
                f"the field moves by about {moved:.1f} px, so a molecule may count twice or leave its place: "
                "follow the drift"
            )
    else:
        found = check_positions(positions_px)
        strength = outstanding = np.full(len(found), np.nan)
    if options.position == "brightest_pixel" and positions_px is None:
        found = np.rint(found)

    measured = _measure(frames, found, sigma, options, motion, report, cancel)
    refine = options.position == "fit" and positions_px is None
    positions = found + (measured.shapes.shift_px if refine else 0.0)
    table, lit = _describe(measured, positions, strength, outstanding, options, frames)
    select.judge(table, options.rules(sigma), frames.shape, sigma)
    return TraceSet(
        traces=_kept_traces(measured.traces, table, options.window),
        molecules=table,
        all_traces=measured.traces,
        background=measured.background,
        lit=lit,
        background_e=float(np.median(measured.background)) if measured.background.size else measured.mean_e,
        noise_e=measured.noise_e,
        sigma_px=sigma,
        pixel_share=_share(options.profile, sigma),
        options=options,
        drift_px=motion,
        notes=tuple(notes),
    )


@dataclass(frozen=True)
class _Measured:
    traces: NDArray[np.float32]
    background: NDArray[np.float32]
    shapes: Shapes
    noise_e: float
    mean_e: float


def _measure(
    frames: Frames, positions: NDArray[np.float64], sigma: float, options: Options,
    motion: NDArray[np.float64] | None, report: Callable[[int], None], cancel: Callable[[], bool] | None,
) -> _Measured:  # fmt: skip
    """The second pass: traces, local backgrounds, lit images, noise."""
    shape = frames.shape[1:]
    share = options.profile, options.subtract_background
    opening = aperture.aperture(positions, shape, sigma, share[0], subtract_background=share[1])
    lit_images = LitImages(opening.window.shape)
    traces = np.empty((len(positions), frames.n_frames), np.float32)
    background = np.empty_like(traces)
    variances, means = [], []
    for start, stack in frames.blocks(report=report, cancel=cancel):
        for first, last in drift.still_parts(motion, start, start + len(stack)):
            if motion is not None:
                moved = positions + motion[first:last].mean(axis=0)
                opening = aperture.aperture(moved, shape, sigma, share[0], subtract_background=share[1])
            span, part = slice(first, last), stack[first - start : last - start]
            traces[:, span], background[:, span] = opening.traces(part)
            lit_images.add(opening, part, traces[:, span], background[:, span])
        means.append(float(stack.mean(dtype=np.float64)))
        if len(stack) > 1:
            variances.append(float(np.median(np.mean(np.diff(stack, axis=0) ** 2, axis=0))) / 2)
    noise = float(np.sqrt(np.mean(variances))) if variances else float("nan")
    return _Measured(traces, background, lit_images.measure(sigma), noise, float(np.mean(means)))


def _describe(
    measured: _Measured, positions: NDArray[np.float64], strength: NDArray[np.float64],
    outstanding: NDArray[np.float64], options: Options,
    frames: Frames,
) -> tuple[pd.DataFrame, NDArray[np.bool_]]:  # fmt: skip
    """The table of candidates, without the verdict."""
    import pandas as pd

    traces = measured.traces
    if not options.subtract_background:  # levels are above the background; steps do not care about it
        traces = traces - np.median(measured.background, axis=1, keepdims=True)
    dyn = dynamics(traces, options.step_false_alarm)
    window_start = np.full(len(positions), -1)
    if options.window is not None:
        window_start = select.windows(dyn, options.window)
    table = pd.DataFrame(
        {
            "molecule": np.arange(len(positions)),
            "y_px": positions[:, 0],
            "x_px": positions[:, 1],
            "kept": False,
            "reason": "",
            "brightness": dyn.on_level,
            "snr": dyn.snr,
            "bleaching_frame": dyn.bleaching_frame,
            "n_steps": dyn.n_steps,
            "n_blinks": dyn.n_blinks,
            "lit_frames": dyn.lit.sum(axis=1),
            "window_start": window_start,
            "neighbour_px": find.neighbour_px(positions, ~(outstanding < find.LEAST_PROMINENCE)),
            "sigma_minor_px": measured.shapes.sigma_px[:, 0],
            "sigma_major_px": measured.shapes.sigma_px[:, 1],
            "significance": strength,
            "prominence": outstanding,
            "background_e": measured.background.mean(axis=1) if measured.background.size else 0.0,
            "in_roi": _inside(positions, options.roi, frames.shape[1:]),
        }
    )
    return table, dyn.lit


def _kept_traces(traces: NDArray[np.float32], table: pd.DataFrame, window: int | None) -> NDArray[np.float32]:
    kept = np.flatnonzero(table["kept"].to_numpy(dtype=bool))
    if window is None:
        return traces[kept]
    # A molecule kept by hand may have no window of its own: its last frames are shown then.
    start = table["window_start"].to_numpy(dtype=int)[kept]
    start = np.where(start < 0, traces.shape[1] - window, start)
    return (
        np.stack([traces[i, s : s + window] for i, s in zip(kept, start, strict=True)])
        if len(kept)
        else (np.empty((0, window), np.float32))
    )


def _inside(positions: NDArray[np.float64], roi: Any, shape_px: tuple[int, int]) -> NDArray[np.bool_]:
    if roi is None:
        return np.ones(len(positions), dtype=bool)
    mask = roi_mask(roi, shape_px)
    y, x = np.clip(np.rint(positions).astype(int), 0, np.array(shape_px) - 1).T
    return np.asarray(mask[y, x])


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


def _share(kind: aperture.Profile, sigma: float) -> float:
    """Share of a molecule's light that a trace holds, averaged over places within a pixel."""
    if kind == "psf":
        return 1.0
    return mean_peak_share(sigma) if kind == "brightest_pixel" else float(1 - np.exp(-(2.5**2) / 2))


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
    find.check_threshold(chosen.threshold, chosen.threshold_value)
    checks.number(chosen.step_false_alarm, "step_false_alarm", 1e-12, 1)
    checks.number(chosen.min_snr, "min_snr", 0)
    for name, least, most in _RANGES:
        if (value := getattr(chosen, name)) is not None:
            checks.number(value, name, least, most)
    for name, fewest in _COUNTS:
        if (value := getattr(chosen, name)) is not None:
            checks.whole(value, name, fewest)
    return chosen


# Options that may be None, and what they may be else.
_RANGES = (("psf_sigma_px", 0.3, 50), ("border_px", 0, np.inf), ("isolation_px", 0, np.inf), ("max_lit_share", 0, 1))
_COUNTS = (("window", 1), ("best", 1), ("time_block", 1), ("min_lit_frames", 0), ("min_steps", 0), ("max_steps", 0))


def _counter(progress: Progress | None, total: int) -> Callable[[int], None]:
    done = 0

    def report(n: int) -> None:
        nonlocal done
        done += n
        if progress is not None:
            progress(min(done, total), total)

    return report
