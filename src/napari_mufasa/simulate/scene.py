"""The scene: all a movie needs, as arrays and small functions, before a single photon is drawn.

`build_scene` turns a model into a scene and lets every effect change it once. `Scene.record` then plays any
block of frames through optics and camera. Nothing here knows which effects exist.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import camera, optics
from napari_mufasa.chance.streams import Streams
from napari_mufasa.model.extent import Extent
from napari_mufasa.model.model import Model
from napari_mufasa.model.setup import Setup
from napari_mufasa.photophysics.chain import Chain
from napari_mufasa.photophysics.protocols import protocol_chain

Array = NDArray[np.float64]
FieldMap = Callable[[Array, Array], Array]
"""Relative light or background at pixel coordinates (y, x)."""


@dataclass(frozen=True)
class Population:
    """Molecules of another kind, the last ones of the scene; `name` names their streams."""

    name: str
    chain: Chain
    n_molecules: int


@dataclass
class Scene:
    """What effects may change. Times are frame starts in s; shapes are given per attribute."""

    setup: Setup
    streams: Streams
    chain: Chain  # of the molecules that no other population has
    positions_px: Array  # (molecule, 2) at the first frame
    brightness: Array  # (molecule,) collected photons relative to the model's
    time_s: Array  # (frame,)
    light: Array  # (frame,) relative excitation
    sigma_px: Array  # (frame, 2) PSF standard deviations (y, x)
    shift_px: Array  # (frame, 2) motion common to all molecules
    background: Array  # (frame,) relative background, on top of the light's course
    reference: tuple[tuple[float, float], ...]  # (start, stop) frame, row and column that effects speak of
    light_field: list[FieldMap] = field(default_factory=list)  # excitation across the field: spots and background
    background_field: list[FieldMap] = field(default_factory=list)  # background only
    walk_px: NDArray[np.float32] | None = None  # (frame, molecule, 2) motion of each molecule
    light_of_each: NDArray[np.float32] | None = None  # (molecule, frame) what each molecule gets of the light
    arrival: NDArray[np.int64] | None = None  # (molecule,) frame from which each is there; None: the first
    present: float = 1.0  # of all molecules, the share that is there at a time
    populations: list[Population] = field(default_factory=list)  # in the order of their molecules
    halo: tuple[float, float] | None = None  # share of the light in a wider PSF, and how many times wider it is
    oblique: tuple[float, float] | None = None  # ln of the PSF's axes' ratio, and the direction of the long one (rad)
    sensor: camera.SensorHooks = field(default_factory=camera.SensorHooks)

    @property
    def shape_px(self) -> tuple[int, int]:
        return self.setup.acquisition.shape_px

    @property
    def n_frames(self) -> int:
        return len(self.time_s)

    @property
    def progress(self) -> Array:
        """(frame,) 0 at the first frame that effects speak of, usually of the movie, 1 at the last."""
        return _along(self.n_frames, self.reference[0])

    @property
    def down(self) -> Array:
        """(y,) 0 at the first row that effects speak of, usually of the movie, 1 at the last."""
        return _along(self.shape_px[0], self.reference[1])

    @property
    def elapsed(self) -> Array:
        """(frame,) the share of the movie that has passed by the middle of each frame."""
        start, stop = self.reference[0]
        middle = np.arange(self.n_frames, dtype=np.float64) + 0.5
        passed: Array = (middle - start) / (stop - start)
        return passed

    def pixel_coordinates(self) -> tuple[Array, Array]:
        y, x = np.indices(self.shape_px, dtype=float)
        return y, x

    @property
    def field_px(self) -> tuple[float, float]:
        """Height and width of the field that effects speak of, usually the movie's."""
        (top, bottom), (left, right) = self.reference[1:]
        return bottom - top, right - left

    def centred(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Coordinates relative to the field's centre, ±1 at the edges of the longer side."""
        (top, bottom), (left, right) = self.reference[1:]
        half = max(self.field_px) / 2
        return (y - (top + bottom - 1) / 2) / half, (x - (left + right - 1) / 2) / half

    def shares(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Coordinates as shares of the field's height and width, 0 at its first edges."""
        (top, _), (left, _) = self.reference[1:]
        height, width = self.field_px
        return (y + 0.5 - top) / height, (x + 0.5 - left) / width

    def over_time(self, course: Callable[[Array], Array]) -> Array:
        """What a course is in the frames that effects speak of, by the share that has passed."""
        start, stop = self.reference[0]
        n = max(1, round(stop - start))
        return course((np.arange(n) + 0.5) / n)

    def over_field(self, relative: FieldMap) -> Array:
        """What a map is at the pixels of the field that effects speak of."""
        edges = np.ceil(np.array(self.reference[1:]) - 0.5).astype(int)
        y, x = (np.arange(start, stop, dtype=float) for start, stop in edges)
        return relative(*np.broadcast_arrays(y[:, None], x[None, :]))

    def light_at(self, y: Array, x: Array) -> Array:
        """Relative excitation at pixel coordinates."""
        return _product(self.light_field, y, x)

    def drive(self) -> Array:
        """(molecule,) relative excitation at each molecule's first position."""
        return self.light_at(self.positions_px[:, 0], self.positions_px[:, 1])

    def add_molecules(self, positions_px: Array, population: tuple[str, Chain] | None = None) -> None:
        """Further molecules at positions (molecule, 2), as bright as the model has them, at rest; without a population
        of their own (name, chain) they are like the first ones, and must come before any that have one."""
        n = len(positions_px)
        self.positions_px = np.concatenate([self.positions_px, positions_px])
        self.brightness = np.concatenate([self.brightness, np.ones(n)])
        if self.walk_px is not None:
            self.walk_px = np.pad(self.walk_px, ((0, 0), (0, n), (0, 0)))
        if self.light_of_each is not None:
            self.light_of_each = np.pad(self.light_of_each, ((0, n), (0, 0)), constant_values=1)
        if self.arrival is not None:
            self.arrival = np.pad(self.arrival, (0, n))
        if population is not None:
            self.populations.append(Population(*population, n))

    def add_companions(self, population: tuple[str, Chain]) -> None:
        """Beside each of the first molecules one of a population of its own, which goes where that one goes and has its
        share of the light."""
        n = len(self.positions_px) - sum(other.n_molecules for other in self.populations)
        self.add_molecules(self.positions_px[:n], population)
        self.brightness[-n:] = self.brightness[:n]
        if self.light_of_each is not None:
            self.light_of_each[-n:] = self.light_of_each[:n]
        if self.walk_px is not None:
            self.walk_px[:, -n:] = self.walk_px[:, :n]
        if self.arrival is not None:
            self.arrival[-n:] = self.arrival[:n]

    def set_off(self) -> None:
        """Let molecules that come later walk from where they arrive."""
        if self.walk_px is not None and self.arrival is not None:
            self.walk_px = self.walk_px - self.walk_px[self.arrival, np.arange(len(self.arrival))]

    def follow_light(self) -> None:
        """Light each molecule that moves as the field is where it has come to."""
        if not self.light_field or (self.walk_px is None and not self.shift_px.any()):
            return
        drive = self.drive()
        first = np.where(drive > 0, drive, 1.0)  # what begins in the dark stays there
        course = np.empty((len(first), self.n_frames), np.float32)
        for frame in range(self.n_frames):
            at = self.positions_px + self.shift_px[frame]
            if self.walk_px is not None:
                at = at + self.walk_px[frame]
            course[:, frame] = self.light_at(at[:, 0], at[:, 1]) / first
        self.light_each(course)

    def show_sample_of(self, other: Scene) -> None:
        """Show the same sample as another scene of as many molecules: brightness, motion, stage, focus, and the courses
        of light and background."""
        for name in ("brightness", "walk_px", "shift_px", "sigma_px", "light", "background"):
            setattr(self, name, getattr(other, name))

    def light_each(self, course: NDArray[np.float32]) -> None:
        """Multiply the light of each molecule by its course (molecule, frame)."""
        self.light_of_each = course if self.light_of_each is None else self.light_of_each * course

    def background_map(self) -> Array:
        """(y, x) background photons per pixel at relative light and course 1."""
        y, x = self.pixel_coordinates()

        def everywhere(y: Array, x: Array) -> Array:
            return self.light_at(y, x) * _product(self.background_field, y, x)

        # The background believed is that of the field's mean.
        mean = float(self.over_field(everywhere).mean()) if self.light_field and self.background_field else 1.0
        return self.setup.optics.background_photons_per_px * everywhere(y, x) / max(mean, 1e-12)

    def optical(self, emission: NDArray[Any], frames: NDArray[np.int64]) -> NDArray[np.float32]:
        """(frame, y, x) expected photons on the detector for an emission (molecule, frame) in these frames."""
        optical = self.setup.optics
        share = optical.collection_efficiency * optical.brightness_correction * self.brightness
        photons = (emission * share[:, None]).T
        moves = np.any(self.shift_px[frames] != self.shift_px[frames[0]]) or self.walk_px is not None
        at = frames if moves else frames[:1]
        positions = self.positions_px[None] + self.shift_px[at, None]
        if self.walk_px is not None:
            positions = positions + self.walk_px[at]
        image = self._spots(photons, positions, self.sigma_px[frames])
        if self.halo is not None:
            within, wider = self.halo
            image *= np.float32(1 - within)
            image += np.float32(within) * self._spots(photons, positions, wider * self.sigma_px[frames])
        course = (self.light * self.background)[frames].astype(np.float32)
        optics.add_pattern(image, course, self.background_map().astype(np.float32))
        return image

    def _spots(self, photons: Array, positions: Array, sigma: Array) -> NDArray[np.float32]:
        """(frame, y, x) images of photons (frame, molecule) at positions (frame or 1, molecule, 2)."""
        factor = self.setup.optics.high_resolution_factor
        if self.oblique is not None and photons.size:
            photons, positions = optics.elongated(photons, positions, sigma, *self.oblique)
        if factor is None:
            return optics.spot_images(photons, positions, sigma, self.shape_px)
        last = len(positions) - 1
        fine = [
            optics.image_on_grid(photons[i], positions[min(i, last)], tuple(sigma[i]), self.shape_px, factor)
            for i in range(len(photons))
        ]
        return np.stack(fine).astype(np.float32)

    def record(self, emission: NDArray[Any], start: int, stop: int) -> Recording:
        """Frames start … stop−1 of the movie and their optical images; memory is that of the block."""
        return self.record_block(self.block(emission, slice(start, stop)))

    def block(self, emission: NDArray[Any], span: slice) -> Block:
        """What frames of the movie are made of: their part of an emission (molecule, frame), and that of as many frames
        before as the sensor remembers; those before the movie were in the light of its first."""
        begins = span.start - self.sensor.memory_frames
        emission = emission[:, max(0, begins) : span.stop]
        if begins < 0:
            emission = np.pad(emission, ((0, 0), (-begins, 0)), mode="edge")
        return Block(emission, begins, span.start)

    def numbers(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers of frames for the camera, which name their chance: those before the movie (below 0) come after it."""
        return np.where(frames < 0, self.n_frames - 1 - frames, frames)

    def of_frames(self, values: NDArray[Any], numbers: NDArray[np.int64]) -> NDArray[Any]:
        """Of values (frame, …) those of frames as the camera numbers them; before the movie they were those of its
        first."""
        picked: NDArray[Any] = values[np.where(numbers < self.n_frames, numbers, 0)]
        return picked

    def record_block(self, block: Block) -> Recording:
        frames = block.begins + np.arange(block.emission.shape[1])
        image = self.optical(block.emission, np.maximum(frames, 0))
        adu = camera.expose(image, self.setup.camera, self.streams, self.numbers(frames), self.sensor)
        kept = slice(block.start - block.begins, None)
        return Recording(image[kept], adu[kept])


@dataclass(frozen=True)
class Block:
    """Frames to record from `start` on: their emission (molecule, frame), which `begins` at a frame before (below 0:
    before the movie)."""

    emission: NDArray[Any]
    begins: int
    start: int


@dataclass(frozen=True)
class Recording:
    """A block of frames: expected photons (frame, y, x) float32 and ADU (frame, y, x) uint16."""

    optical: NDArray[np.float32]
    movie: NDArray[np.uint16]


def build_scene(model: Model, positions_px: NDArray[np.floating[Any]], streams: Streams) -> Scene:
    """The scene of a model with molecules at `positions_px` (molecule, 2), effects applied."""
    n = model.acquisition.n_frames
    scene = Scene(
        setup=model,
        streams=streams,
        chain=protocol_chain(model),
        positions_px=np.asarray(positions_px, dtype=np.float64).reshape(-1, 2),
        brightness=np.ones(len(positions_px)),
        time_s=np.arange(n, dtype=np.float64) * model.acquisition.interval_s,
        light=np.ones(n),
        sigma_px=np.full((n, 2), model.sigma_px),
        shift_px=np.zeros((n, 2)),
        background=np.ones(n),
        reference=(model.effects_refer_to or Extent()).within(model.acquisition),
    )
    for effect in sorted(model.effects, key=lambda e: (e.order, e.kind)):  # in whatever order they are listed
        effect.apply(scene, streams.of(f"effect {effect.kind}"))
    scene.set_off()
    scene.follow_light()
    return scene


def _along(n: int, bounds: tuple[float, float]) -> Array:
    """(n,) places from 0 at the first to 1 at the last one within bounds (start, stop); 0 where that is one place."""
    start, stop = bounds
    steps = stop - start - 1
    if steps < 0.5:
        return np.zeros(n)
    return np.linspace(-start / steps, (n - 1 - start) / steps, n)


def _product(fields: list[FieldMap], y: Array, x: Array) -> Array:
    result = np.ones(np.shape(y))
    for field_map in fields:
        result = result * field_map(y, x)
    return result
