"""The whole chain in one place: sample → emission → optical image → movie (docs/words.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.chance.streams import Streams
from napari_mufasa.cluster import in_order
from napari_mufasa.model.extent import Extent
from napari_mufasa.model.model import Model
from napari_mufasa.photophysics.engines import Engine, Exposure, simulate_photons
from napari_mufasa.simulate import layout
from napari_mufasa.simulate.scene import Block, Population, Recording, Scene, build_scene

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[int, int], None]
BLOCK_BYTES = 2 * 2**20  # optical images of one block of frames: they stay close to the processor


@dataclass(frozen=True)
class Simulation:
    """What `simulate` gives.

    Attributes
    ----------
    emission : (molecule, frame) photons emitted
    optical : (frame, y, x) float32, expected photons per pixel, before detection
    movie : (frame, y, x) uint16, ADU
    positions_px : (molecule, 2), (y, x) at the first frame
    model, seed : what it was made from

    Effects that add molecules (several emitters in a spot, molecules that come, a dim population) add rows: those of
    molecules that come or are dim stand behind the positions given.
    """

    emission: NDArray[np.int64]
    optical: NDArray[np.float32]
    movie: NDArray[np.uint16]
    positions_px: NDArray[np.float64]
    model: Model
    seed: int


class SimulatedAcquisition:
    """A simulated acquisition whose frames are recorded on demand, block by block.

    Parameters as for `simulate`. Holds the emission, the photons that images are made of (both (molecule, frame), and
    the same unless `Optics.emission_noise` is below 1) and courses per frame, never the movie: use it to stream movies
    larger than memory.
    """

    def __init__(
        self,
        model: Model,
        positions_px: NDArray[np.floating] | None = None,
        seed: int = 0,
        engine: Engine = "fast",
        workers: int = 1,
    ) -> None:
        _check(model)
        checks.whole(workers, "workers", 1, 1024)
        checks.choice(engine, "engine", get_args(Engine))
        streams = Streams(seed)
        if positions_px is None:
            positions_px = layout.place(model, streams.of("positions"))
        positions = layout.check_positions(positions_px)
        self.model = model
        self.seed = seed
        self._positions_px = positions
        self.scene: Scene = build_scene(model, positions, streams)
        self.emission, expected = _emit(self.scene, engine, workers)
        self.photons = _imaged(self.emission, expected, model.optics.emission_noise)

    @property
    def n_frames(self) -> int:
        """Frames of the movie."""
        return self.scene.n_frames

    def record_instead(self, emission: NDArray[Any]) -> None:
        """Record another emission (molecule, frame) in the same scene, with all its noise."""
        self.emission = self.photons = emission

    def block_frames(self) -> int:
        """Frames per block: about `BLOCK_BYTES` of optical image."""
        height, width = self.scene.shape_px
        return max(1, min(self.n_frames, BLOCK_BYTES // (4 * height * width)))

    def movie(self) -> NDArray[np.uint16]:
        """The whole movie (frame, y, x) ADU, without its optical images."""
        size, last = self.block_frames(), self.n_frames
        blocks = (self.scene.record(self.photons, f, min(f + size, last)) for f in range(0, last, size))
        return np.concatenate([block.movie for block in blocks])

    def blocks(
        self,
        *,
        workers: int = 1,
        first: int = 0,
        progress: Progress | None = None,
        cancel: Callable[[], bool] | None = None,
        client: Client | None = None,
    ) -> Iterator[tuple[slice, Recording]]:
        """Record the movie from frame `first` on, block by block, in order; `workers` threads run ahead, or the workers
        of a cluster (`client`)."""
        checks.whole(workers, "workers", 1, 1024)
        size = self.block_frames()
        spans = [slice(f, min(f + size, self.n_frames)) for f in range(first, self.n_frames, size)]
        record = self.scene.record_block if client is None else Elsewhere(self.model, self._positions_px, self.seed)
        ahead = workers + 1 if client is None else None
        jobs = (self.scene.block(self.photons, span) for span in spans)
        blocks = in_order(record, jobs, client=client, workers=workers, ahead=ahead, cancel=cancel)
        for span, block in zip(spans, blocks, strict=True):
            yield span, block
            if progress is not None:
                progress(span.stop, self.n_frames)


@dataclass(frozen=True)
class Elsewhere:
    """Records blocks in another process: the scene is built there from what it is built from here."""

    model: Model
    positions_px: NDArray[np.float64]
    seed: int

    @cached_property
    def scene(self) -> Scene:
        return build_scene(self.model, self.positions_px, Streams(self.seed))

    def __call__(self, block: Block) -> Recording:
        return self.scene.record_block(block)


def simulate(
    model: Model,
    positions_px: NDArray[np.floating] | None = None,
    seed: int = 0,
    engine: Engine = "fast",
    *,
    workers: int = 1,
    progress: Progress | None = None,
    cancel: Callable[[], bool] | None = None,
    client: Client | None = None,
) -> Simulation:
    """Simulate a movie from molecules to digital counts.

    Parameters
    ----------
    model : what to simulate, effects included
    positions_px : (molecule, 2) positions (y, x) in detector pixels; None: the model's sample layout
    seed : the same seed gives the same movie, whatever `workers`
    engine : "fast" or "exact" (docs/photophysics.md)
    progress : called with (frames done, frames in all); cancel : returns True to stop (raises `Cancelled`)
    client : of a cluster whose workers record the frames, instead of threads (docs/clusters.md)

    Raises `MufasaError` for positions, a seed or an engine that cannot be used.
    Peak memory: the result (optical 4 bytes and movie 2 bytes per pixel and frame) and one block per worker.
    For movies larger than memory use `SimulatedAcquisition.blocks`.
    """
    _check(model)
    n_frames, (height, width) = model.acquisition.n_frames, model.acquisition.shape_px
    checks.affordable(
        6 * n_frames * height * width, f"a movie of {n_frames} × {height} × {width} px",
        "take fewer frames, or stream it: napari-mufasa simulate, or SimulatedAcquisition.blocks",
    )  # fmt: skip
    acquisition = SimulatedAcquisition(model, positions_px, seed, engine, workers)
    shape = (acquisition.n_frames, *acquisition.scene.shape_px)
    optical = np.empty(shape, dtype=np.float32)
    movie = np.empty(shape, dtype=np.uint16)
    for span, block in acquisition.blocks(workers=workers, progress=progress, cancel=cancel, client=client):
        optical[span], movie[span] = block.optical, block.movie
    return Simulation(acquisition.emission, optical, movie, acquisition.scene.positions_px, model, seed)


def simulate_emission(
    model: Model, n_molecules: int = 1000, seed: int = 0, engine: Engine = "fast"
) -> NDArray[np.int64]:
    """Photons emitted per molecule and frame, (molecule, frame) int64; no optics, no camera.

    Molecules are spread over the field, so that effects across the field act on them too. Effects that add molecules
    add rows (see `Simulation`).
    """
    checks.whole(n_molecules, "n_molecules")
    _check(model, n_molecules)
    checks.choice(engine, "engine", get_args(Engine))
    streams = Streams(seed)
    positions = layout.scatter(int(n_molecules), model.acquisition.shape_px, 0.0, streams.of("positions"))
    return _emit(build_scene(model, positions, streams), engine)[0]


def simulate_dark(model: Model, n_frames: int, seed: int = 0) -> NDArray[np.uint16]:
    """Dark frames of the model's camera just before the movie, (frame, y, x) uint16: no light, all camera effects.

    The sensor's patterns are those of the movie with the same seed, its noise is not, nor is a course that was seen in
    the movie (`Effect.in_the_dark`). Raises `MufasaError` for a number of frames or a seed that cannot be used.
    """
    checks.whole(n_frames, "n_frames", 1)
    _check(model, 0)
    height, width = model.acquisition.shape_px
    checks.affordable(10 * int(n_frames) * height * width, f"{n_frames} dark frames", "take fewer, or a smaller field")
    frames = int(n_frames) + model.acquisition.n_frames
    lit = Extent(frames=(int(n_frames) / frames, 1.0))  # slow courses come to the movie by way of the dark frames
    optics = model.optics.model_copy(update={"background_photons_per_px": 0.0})
    effects = tuple(effect.in_the_dark() for effect in model.effects)
    dark_model = model.in_shape(n_frames=frames).model_copy(update={"optics": optics, "effects": effects})
    dark_model = dark_model.referring_to((model.effects_refer_to or Extent()).placed_in(lit))
    # The sensor's patterns are the movie's (same seed); its noise is not.
    scene = build_scene(dark_model, np.empty((0, 2)), Streams(seed))
    scene.streams = Streams(seed + 2**32)
    return scene.record(np.empty((0, frames), dtype=np.int64), 0, int(n_frames)).movie


def _check(model: Model, n_molecules: int | None = None) -> None:
    """A model, and one whose courses of molecules (molecule, frame) this machine can hold."""
    checks.need(model, Model, "model", "give preset(NAME) or Model.from_json(PATH)")
    n = model.sample.n_molecules if n_molecules is None else n_molecules
    frames, (height, width) = model.acquisition.n_frames, model.acquisition.shape_px
    of_each_frame = 8 if model.optics.emission_noise == 1 else 32  # bytes of a molecule
    checks.affordable(
        of_each_frame * int(n) * frames + 100 * frames, f"the light of {n} molecules in {frames} frames",
        "take fewer molecules or frames",
    )  # fmt: skip
    checks.affordable(40 * height * width, f"a frame of {height} × {width} px", "take a smaller field")


def _emit(scene: Scene, engine: Engine, workers: int = 1) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Photons emitted (molecule, frame), one population of molecules after the other; and expected, where the images
    are made of them, too."""
    timing = scene.setup.acquisition
    dead_time_s = timing.interval_s - timing.frame_length_s
    drive, each = scene.drive(), scene.light_of_each
    first = len(drive) - sum(p.n_molecules for p in scene.populations)
    with_expected = scene.setup.optics.emission_noise != 1
    emitted, start = [], 0
    for kind in (Population("", scene.chain, first), *scene.populations):
        rows = slice(start, start + kind.n_molecules)
        start = rows.stop
        exposure = Exposure(timing.frame_length_s, dead_time_s, scene.light, None if each is None else each[rows])
        emitted.append(
            simulate_photons(
                kind.chain, drive[rows], exposure, scene.streams, engine, kind.name, workers, with_expected
            )
        )
    if len(emitted) == 1:
        return emitted[0]
    return np.concatenate([n for n, _ in emitted]), np.concatenate([expected for _, expected in emitted])


def _imaged(emission: NDArray[np.int64], expected: NDArray[np.float64], noise_kept: float) -> NDArray[Any]:
    """Photons (molecule, frame) that images are made of: the emission, with a share of the variance of its noise.

    N emitted photons of which each is detected with chance p make a count of variance p E[N] + p² (Var N − E[N]): light
    that is Poisson stays Poisson. A Poisson detection of the image of N (docs/camera.md) has p E[N] + p² Var N instead,
    which is right when none of the noise of Poisson light is kept in the image.
    """
    if noise_kept == 1:
        return emission
    return np.asarray(expected + np.sqrt(noise_kept) * (emission - expected))
