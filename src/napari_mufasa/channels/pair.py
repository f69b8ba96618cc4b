"""Donor and acceptor of the same molecules side by side: `extract_pair` (docs/two_channels.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.camera.frames import Frames, Progress, Unit
from napari_mufasa.channels.efficiency import Corrections, frame_by_frame, of_molecules
from napari_mufasa.channels.registration import Channels
from napari_mufasa.channels.together import Together
from napari_mufasa.errors import MufasaError
from napari_mufasa.traces.candidates import least_edge_px
from napari_mufasa.traces.dynamics import dynamics
from napari_mufasa.traces.extract import TraceSet, extract_traces, kept_traces
from napari_mufasa.traces.measure import Measured, measure
from napari_mufasa.traces.options import Options, chosen_options
from napari_mufasa.traces.select import judge, windows

if TYPE_CHECKING:
    import pandas as pd

    from napari_mufasa.model.setup import Camera

FindIn = Literal["sum", "donor"]


@dataclass(frozen=True)
class PairedTraces:
    """What `extract_pair` gives.

    Attributes
    ----------
    donor, acceptor : traces of the same candidates in the two channels (`TraceSet`); places are those of the channel
    efficiency : (candidate, frame) apparent E, nan where the molecule is dark
    molecules : one row per candidate: the columns of `extract_traces`, places in the donor's channel, and
        y_acceptor_px, x_acceptor_px, donor_e, acceptor_e (mean levels while on), efficiency, efficiency_sd
    channels : how they were registered; corrections : what was taken off
    """

    donor: TraceSet
    acceptor: TraceSet
    efficiency: NDArray[np.float64]
    molecules: pd.DataFrame
    channels: Channels
    corrections: Corrections

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(candidate,) which of them are kept."""
        return np.asarray(self.molecules["kept"], dtype=bool)

    @property
    def lit(self) -> NDArray[np.bool_]:
        """(candidate, frame) whether the light of both channels together is on."""
        return self.donor.lit

    @property
    def together(self) -> TraceSet:
        """The light of both channels, of the same candidates."""
        both = self.donor.all_traces + self.acceptor.all_traces
        return replace(
            self.donor, all_traces=both, traces=kept_traces(both, self.molecules, self.donor.options.window),
            background=self.donor.background + self.acceptor.background,
            background_e=self.donor.background_e + self.acceptor.background_e,
            noise_e=float(np.hypot(self.donor.noise_e, self.acceptor.noise_e)),
        )  # fmt: skip

    def with_kept(self, molecules: Sequence[int], kept: bool = True, reason: str = "rejected by hand") -> PairedTraces:
        """A copy in which these molecules (ids) are kept, or rejected for `reason`: the choice by hand."""
        donor, acceptor = (side.with_kept(molecules, kept, reason) for side in (self.donor, self.acceptor))
        table = self.molecules.assign(kept=donor.molecules["kept"], reason=donor.molecules["reason"])
        return replace(self, donor=donor, acceptor=acceptor, molecules=table)


def extract_pair(
    movie: Any,
    camera: Camera,
    channels: Channels,
    dark: Any = None,
    *,
    find_in: FindIn = "sum",
    leakage: float = 0.0,
    direct_excitation_e: float = 0.0,
    gamma: float = 1.0,
    acceptor_sigma_px: float | None = None,
    options: Options | None = None,
    unit: Unit = "adu",
    progress: Progress | None = None,
    cancel: Callable[[], bool] | None = None,
    **changes: Any,
) -> PairedTraces:
    """Find single molecules in two registered channels and read donor and acceptor of each (docs/two_channels.md).

    Parameters
    ----------
    movie : (frame, y, x) whole frames, as they were registered; NumPy, dask or zarr; read in blocks
    camera : the detector of the whole frames; dark : dark frames of them, or of both channels alike
    channels : what `register` gave
    find_in : "sum" looks for molecules in the light of both channels, however it is divided; "donor" in the donor's
    leakage : light of the donor in the acceptor's channel, as a share of what its own channel sees
    direct_excitation_e : photoelectrons per frame of an acceptor that the laser excites directly
    gamma : how much better the acceptor's light is detected than the donor's, quantum yields included
    acceptor_sigma_px : width of the PSF there; None: as in the donor's channel
    options, **changes : see `Options`; places and regions are those of the donor's channel
    unit, progress, cancel : as of `extract_traces`

    Returns
    -------
    PairedTraces : `.donor.traces`, `.acceptor.traces` of the kept molecules, `.molecules` with E and its sd, …

    Raises
    ------
    MufasaError : a movie, channels or options that cannot be used.
    """
    checks.need(channels, Channels, "channels", "give what register gave, or Channels.from_json(PATH)")
    checks.choice(find_in, "find_in", get_args(FindIn))
    corrections = Corrections(leakage, direct_excitation_e, gamma)
    chosen = chosen_options(options, changes)
    if acceptor_sigma_px is not None:
        checks.number(acceptor_sigma_px, "acceptor_sigma_px", 0.3, 50)
    if chosen.follow_molecules:
        raise MufasaError("molecules of two channels are read in their places: drop follow_molecules")
    if not chosen.subtract_background:
        raise MufasaError("an efficiency needs the light without background: drop subtract_background=False")
    channels.check_fits(movie)
    donor, acceptor = (_frames(side, movie, camera, dark, unit) for side in (channels.donor, channels.acceptor))

    n_frames = donor.n_frames
    passes = (3 if chosen.follow_drift else 2) + 2
    done = (passes - 2) * n_frames

    def finding(read: int, _in_all: int) -> None:
        if progress is not None:
            progress(read, passes * n_frames)

    def reading(n: int) -> None:
        nonlocal done
        done += n
        finding(done, 0)

    light: Any = Together(donor, acceptor, channels.transform) if find_in == "sum" else None
    found = extract_traces(
        donor.movie if light is None else light, donor.camera, options=chosen,
        unit=unit if light is None else "photoelectrons", progress=finding, cancel=cancel,
    )  # fmt: skip
    there = channels.transform(found.positions_px)
    inside = np.clip(there, 0, np.array(acceptor.shape[1:]) - 1)
    motion = None if found.drift_px is None else found.drift_px @ channels.transform.linear().T
    width = acceptor_sigma_px or found.sigma_px
    of_donor = measure(donor, found.positions_px, found.sigma_px, chosen, found.drift_px, reading, cancel)
    of_acceptor = measure(acceptor, inside, width, chosen, motion, reading, cancel)

    seen = dynamics(of_donor.traces + of_acceptor.traces, chosen.step_false_alarm)
    lost_share = channels.residual_px.value**2 / (4 * width**2)  # of light that a misplaced PSF misses
    told = of_molecules(of_donor.traces, of_acceptor.traces, seen.lit, corrections, lost_share)
    table = found.molecules.assign(
        brightness=seen.on_level, snr=seen.snr, bleaching_frame=seen.bleaching_frame, n_steps=seen.n_steps,
        n_blinks=seen.n_blinks, lit_frames=seen.lit.sum(axis=1), y_acceptor_px=there[:, 0], x_acceptor_px=there[:, 1],
        window_start=-1 if chosen.window is None else windows(seen, chosen.window), **told,
    )  # fmt: skip
    # Judged anew by the light of both channels: it was that of the donor, or of a sum between pixels.
    lost = least_edge_px(there, motion, acceptor.shape[1:]) < chosen.rules(width).border_px
    edge = least_edge_px(found.positions_px, found.drift_px, donor.shape[1:])
    judge(table, chosen.rules(found.sigma_px), donor.shape, found.sigma_px, edge, lost)
    places = table.assign(y_px=table["y_acceptor_px"], x_px=table["x_acceptor_px"])
    base = replace(found, lit=seen.lit, notes=(*channels.notes, *found.notes))
    return PairedTraces(
        donor=_side(base, of_donor, table, found.sigma_px),
        acceptor=replace(_side(base, of_acceptor, places, width), drift_px=motion),
        efficiency=frame_by_frame(of_donor.traces, of_acceptor.traces, seen.lit, corrections),
        molecules=table,
        channels=channels,
        corrections=corrections,
    )


def _frames(side: Any, movie: Any, camera: Camera, dark: Any, unit: Unit) -> Frames:
    """One channel's pixels of movie, camera and dark frames; the latter may be of the whole frames or of a channel."""
    whole = checks.stack(movie)
    frame_px = (int(whole.shape[1]), int(whole.shape[2]))
    if dark is not None:
        dark = checks.stack(dark, "dark", single=True)
        dark = side.crop(dark) if tuple(dark.shape[1:]) == frame_px else dark
    return Frames(side.crop(whole), side.camera(camera, frame_px), dark, unit)


def _side(found: TraceSet, measured: Measured, table: pd.DataFrame, sigma_px: float) -> TraceSet:
    """What was read in one channel, as a set of traces."""
    table = table.assign(background_e=measured.background.mean(axis=1) if measured.background.size else 0.0)
    return replace(
        found, traces=kept_traces(measured.traces, table, found.options.window), molecules=table,
        all_traces=measured.traces, background=measured.background, noise_e=measured.noise_e, sigma_px=sigma_px,
        background_e=float(np.median(measured.background)) if measured.background.size else measured.mean_e,
    )  # fmt: skip
