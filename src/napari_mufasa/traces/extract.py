"""Single-molecule traces from an acquisition: detect, extract, judge (docs/traces.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.frames import Frames, Progress, Unit
from napari_mufasa.checks import counted
from napari_mufasa.errors import MufasaError
from napari_mufasa.optics.gaussian import mean_disc_share, mean_peak_share
from napari_mufasa.spots import aperture, drift, find
from napari_mufasa.traces import select
from napari_mufasa.traces.candidates import Candidates, followed, standing
from napari_mufasa.traces.dynamics import dynamics
from napari_mufasa.traces.options import Options, chosen_options, roi_mask

if TYPE_CHECKING:
    import pandas as pd
    from distributed import Client

    from napari_mufasa.model.setup import Camera


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
    drift_px : (frame, 2) motion of the field followed, or None; options : how it was made
    path_px : (candidate, frame, 2) where each trace was read, (y, x), of molecules that were followed, or None
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
    path_px: NDArray[np.float64] | None = None
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
        return replace(self, molecules=table, traces=kept_traces(self.all_traces, table, self.options.window))


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
    client: Client | None = None,
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
    client : of a cluster whose workers are sent the blocks (docs/clusters.md)

    Returns
    -------
    TraceSet : `.traces` of the kept molecules, `.molecules` with all candidates and reasons, …

    Raises
    ------
    MufasaError : a movie, dark frames or option that cannot be used.
    """
    options = chosen_options(options, changes)
    frames = Frames(movie, camera, dark, unit, client)
    if options.roi is not None:
        roi_mask(options.roi, frames.shape[1:])
    if options.window is not None and not 1 <= options.window <= frames.n_frames:
        raise MufasaError(f"window = {options.window} frames; the movie has {frames.n_frames}: give 1 … that")
    frames.check_light()
    if options.follow_molecules and positions_px is not None:
        raise MufasaError("positions are given and molecules to be followed: drop positions_px, or follow_molecules")
    passes = (2 if positions_px is None else 1) + (1 if options.follow_drift else 0)
    report = _counter(progress, passes * frames.n_frames)
    sigma = options.psf_sigma_px or (find.estimate_sigma_px(frames) or 1.3)
    motion = drift.common_motion(frames, sigma, report, cancel) if options.follow_drift else None

    if options.follow_molecules:
        seen = followed(frames, sigma, options, motion, report, cancel)
    else:
        seen = standing(frames, sigma, options, motion, positions_px, report, cancel)
    table, lit = _describe(seen, options, frames)
    select.judge(table, options.rules(sigma), frames.shape, sigma, seen.edge_px)
    measured = seen.measured
    return TraceSet(
        traces=kept_traces(measured.traces, table, options.window),
        molecules=table,
        all_traces=measured.traces,
        background=measured.background,
        lit=lit,
        background_e=float(np.median(measured.background)) if measured.background.size else measured.mean_e,
        noise_e=measured.noise_e,
        sigma_px=sigma,
        pixel_share=held_share(options.profile, sigma),
        options=options,
        drift_px=motion,
        path_px=seen.path_px,
        notes=seen.notes + _saturation(measured.saturated, table, frames.n_frames),
    )


def _saturation(frames: NDArray[np.int64], table: pd.DataFrame, n_frames: int) -> tuple[str, ...]:
    """A note on candidates (candidate,) that saturate the camera in some of the frames: those that are kept, and those
    too wide, as a spot without its top is; a hot pixel is none."""
    some = frames[(frames > 0) & (table["kept"] | (table["reason"] == "wider than the PSF")).to_numpy(dtype=bool)]
    if not len(some):
        return ()
    return (
        f"pixels of {counted(len(some), 'molecule')} are saturated, in {100 * some.mean() / n_frames:.3g} % of their "
        "frames: there the light is read too low, and the spot looks wider; record with less light or gain",
    )


def _describe(seen: Candidates, options: Options, frames: Frames) -> tuple[pd.DataFrame, NDArray[np.bool_]]:
    """The table of candidates, without the verdict, and where their traces are on."""
    import pandas as pd

    measured, positions = seen.measured, seen.positions_px
    traces = measured.traces
    if not options.subtract_background:  # levels are above the background; steps do not care about it
        held = measured.weight[:, None].astype(np.float32)
        traces = traces - held * np.median(measured.background, axis=1, keepdims=True)
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
            "neighbour_px": seen.neighbour_px,
            "sigma_minor_px": measured.shapes.sigma_px[:, 0],
            "sigma_major_px": measured.shapes.sigma_px[:, 1],
            "significance": seen.strength,
            "prominence": seen.prominence,
            "background_e": measured.background.mean(axis=1) if measured.background.size else 0.0,
            "in_roi": _inside(positions, options.roi, frames.shape[1:]),
            **seen.more,
        }
    )
    return table, dyn.lit


def kept_traces(traces: NDArray[np.float32], table: pd.DataFrame, window: int | None) -> NDArray[np.float32]:
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


def held_share(kind: aperture.Profile, sigma: float) -> float:
    """Share of a molecule's light that a trace holds, averaged over places within a pixel."""
    if kind == "psf":
        return 1.0
    return mean_peak_share(sigma) if kind == "brightest_pixel" else mean_disc_share(sigma, aperture.DISC_SIGMA * sigma)


def _counter(progress: Progress | None, total: int) -> Callable[[int], None]:
    done = 0

    def report(n: int) -> None:
        nonlocal done
        done += n
        if progress is not None:
            progress(min(done, total), total)

    return report
