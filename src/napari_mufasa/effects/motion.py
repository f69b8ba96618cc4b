"""Motion effects: the stage, the focus, the molecules (docs/effects.md)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from napari_mufasa.effects.courses import course, seen_path, settling, step_time, told
from napari_mufasa.model.effect import Effect, parameter
from napari_mufasa.simulate.scene import Scene

STAGE = "sample motion"
SHAPE = 4  # of the speeds' gamma distribution


class StageDrift(Effect):
    kind = "stage_drift"
    stage = STAGE
    strength = "distance_px"
    title = "Stage drift"
    what_it_is = "The sample moves sideways against the objective: slowly, or at once when something is bumped."
    what_it_does = "All spots move together."
    how_to_check = "Follow fiducial beads; wait for the temperature to settle."
    observables = ("common_shift", "spot_elongation", "ensemble", "first_seen")
    rivals = ("molecule_diffusion", "delayed_activation")
    separated_by = "common against individual displacement; fiducials"

    distance_px: float = parameter(
        1.5, ge=0, plausible=(0.15, 5), unit="px", log=True, description="distance moved over the movie"
    )
    direction_deg: float = parameter(
        45.0, plausible=(0, 360), unit="deg", description="direction; 0 along x, 90 along y"
    )
    path: tuple[tuple[float, float], ...] = Field(
        (),
        description="(y, x) at equal times, 0 first, 1 long at most; () at random",
        json_schema_extra={"forms": ["wandering"]},
    )
    step_at: float = step_time()
    settling_time: float = settling()
    form: Literal["linear", "saturating", "step", "wandering"] = "linear"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        angle = np.deg2rad(self.direction_deg)
        if self.form == "wandering" and self.path:
            path = np.stack([told(values, scene.elapsed) for values in zip(*self.path, strict=True)], axis=1)
        elif self.form == "wandering":
            steps = rng.standard_normal((scene.n_frames, 2))
            path = np.cumsum(steps, axis=0) - steps[0]
            path *= 1 / max(float(np.hypot(*path.T).max()), 1e-12)
        else:
            along = course(self.form, scene, rng, self.step_at, settling_time=self.settling_time)
            path = along[:, None] * np.array([np.sin(angle), np.cos(angle)])
        scene.shift_px = scene.shift_px + self.distance_px * path


class FocusDrift(Effect):
    kind = "focus_drift"
    stage = STAGE
    strength = "widening"
    title = "Focus drift"
    what_it_is = "The sample leaves the focal plane slowly."
    what_it_does = "Spots widen and their peaks fall while their total light stays."
    how_to_check = "Refocus in the middle of the movie; use a focus lock."
    observables = ("spot_width", "level_trend")
    rivals = ("laser_drift",)
    separated_by = "spot width against time at constant flux"

    widening: float = parameter(
        0.3,
        ge=0,
        le=5,
        plausible=(0.05, 0.8),
        unit="",
        log=True,
        description="relative growth of the PSF width",
    )
    course: tuple[float, ...] = seen_path()
    form: Literal["linear", "accelerating", "step", "wandering"] = "linear"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        path = course(self.form, scene, rng, seen=self.course)
        # Out of focus is wider on either side of it.
        growth = np.maximum(1 + self.widening * (path if self.course else np.abs(path)), 0.2)
        scene.sigma_px = scene.sigma_px * growth[:, None]


class MoleculeDiffusion(Effect):
    kind = "molecule_diffusion"
    stage = STAGE
    strength = "diffusion_px2_per_frame"
    title = "Diffusing molecules"
    what_it_is = "Molecules move on their own: free, confined, or only some of them."
    what_it_does = "Each spot wanders in its own direction and leaves its place."
    how_to_check = "Track single spots; fix the sample as control."
    observables = ("individual_shift", "spot_width", "ensemble", "first_seen")
    rivals = ("stage_drift", "directed_motion", "delayed_activation", "triplet_blinking", "long_dark_state")
    separated_by = "the mean square displacement that molecules do not share"

    diffusion_px2_per_frame: float = parameter(
        0.003,
        ge=0,
        plausible=(0.0003, 0.05),
        follows="/frames",
        unit="px²/frame",
        log=True,
        description="D; MSD = 4 D t",
    )
    form: Literal["free", "confined", "half_mobile"] = "free"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        n = len(scene.positions_px)
        step = np.sqrt(2 * self.diffusion_px2_per_frame)
        steps = rng.standard_normal((scene.n_frames, n, 2), dtype=np.float32) * np.float32(step)
        steps[0] = 0
        if self.form == "half_mobile":
            steps *= (rng.random(n) < 0.5)[None, :, None]
        if self.form == "confined":  # pulled back to its place within about thirty frames
            walk = np.zeros_like(steps)
            for f in range(1, scene.n_frames):
                walk[f] = walk[f - 1] * np.float32(1 - 1 / 30) + steps[f]
        else:
            walk = np.cumsum(steps, axis=0, dtype=np.float32)
        scene.walk_px = walk if scene.walk_px is None else scene.walk_px + walk


class Binding(Effect):
    """Molecules are there from arrival to departure, in continuous time: of the light of a frame each gets the share
    of the exposure that it is bound."""

    kind = "binding"
    stage = STAGE
    strength = "unbinding_rate_per_s"
    common = False
    order = -1  # what becomes of molecules happens to those that come later, too
    title = "Molecules that bind and leave"
    what_it_is = "Molecules leave the surface after some time, and others from the solution bind at other places."
    what_it_does = "Spots vanish in one step as others appear elsewhere; their number stays, or rises from nothing."
    how_to_check = "Wash with buffer: nothing comes any more; lower the laser power: spots do not last longer."
    observables = ("first_seen", "survival", "ensemble", "spots")
    rivals = ("photobleaching", "delayed_activation", "long_dark_state")
    separated_by = "the life time at another laser power; whether new spots come at new places"

    unbinding_rate_per_s: float = parameter(
        0.3, ge=0, plausible=(0.03, 3), follows="/movie_s", unit="1/s", log=True,
        description="1 / mean time that a molecule stays; as many come as leave",
    )  # fmt: skip
    form: Literal["exchange", "landing"] = "exchange"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        rate, n = self.unbinding_rate_per_s, len(scene.positions_px)
        if rate == 0 or n == 0:
            return
        timing = scene.setup.acquisition
        duration_s = scene.n_frames * timing.interval_s
        landings = np.sort(rng.random(rng.poisson(n * rate * duration_s))) * duration_s
        if self.form == "exchange":  # those of the model are there at the start
            arrival_s = np.concatenate([np.zeros(n), landings])
        else:  # nobody is: the first to land do so at the model's places
            arrival_s = np.pad(landings, (0, max(0, n - len(landings))), constant_values=np.inf)
        departure_s = arrival_s + rng.exponential(1 / rate, len(arrival_s))
        scene.add_molecules(rng.random((len(arrival_s) - n, 2)) * scene.shape_px - 0.5)
        frame = np.searchsorted(scene.time_s + timing.interval_s, arrival_s, side="right")
        scene.arrival = frame.clip(max=scene.n_frames - 1)
        scene.present = n / len(arrival_s)
        begin_s = scene.time_s
        end_s = begin_s + timing.frame_length_s
        bound_s = np.minimum(departure_s[:, None], end_s) - np.maximum(arrival_s[:, None], begin_s)
        scene.light_each((np.maximum(bound_s, 0.0) / timing.frame_length_s).astype(np.float32))


class DirectedMotion(Effect):
    """Each molecule at a speed of its own, gamma distributed with half its mean as spread: motors and polymerases on
    tracks that lie alike (one or both ways), or on tracks of all directions."""

    kind = "directed_motion"
    stage = STAGE
    strength = "speed_px_per_frame"
    common = False
    title = "Molecules that glide"
    what_it_is = "Molecules are carried along tracks: motors on filaments, polymerases on stretched DNA, flow."
    what_it_does = "Spots leave their places in straight lines, each at its own speed; some stay."
    how_to_check = "Follow single molecules: displacements grow in proportion to time; take away the fuel."
    observables = ("individual_shift", "spot_elongation", "first_seen", "survival", "ensemble")
    rivals = ("molecule_diffusion", "stage_drift", "delayed_activation", "binding")
    separated_by = "squared displacements that grow with the square of time, along one axis, unlike from spot to spot"

    speed_px_per_frame: float = parameter(
        0.05, ge=0, plausible=(0.002, 0.8), follows="/frames", unit="px/frame", log=True,
        description="mean speed of those that move",
    )  # fmt: skip
    moving: float = parameter(0.8, ge=0, le=1, plausible=(0.2, 1), unit="", description="share of molecules that move")
    axis_deg: float = parameter(
        90.0, plausible=(0, 180), unit="deg", description="direction; 0 along x, 90 along y",
        forms=("one_way", "both_ways"),
    )  # fmt: skip
    form: Literal["one_way", "both_ways", "any_direction"] = "one_way"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        n = len(scene.positions_px)
        if self.speed_px_per_frame == 0 or n == 0:
            return
        speed = self.speed_px_per_frame * rng.gamma(SHAPE, 1 / SHAPE, n) * (rng.random(n) < self.moving)
        turn = rng.random(n)
        angle = np.full(n, np.deg2rad(self.axis_deg))
        if self.form == "both_ways":
            angle += np.pi * (turn < 0.5)
        elif self.form == "any_direction":
            angle = 2 * np.pi * turn
        velocity = speed[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)
        walk = (np.arange(scene.n_frames)[:, None, None] * velocity).astype(np.float32)
        scene.walk_px = walk if scene.walk_px is None else scene.walk_px + walk


EFFECTS = (StageDrift, FocusDrift, MoleculeDiffusion, Binding, DirectedMotion)
