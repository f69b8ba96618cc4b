"""Traces that a model would give in the same acquisition, through the same camera and extraction
(docs/comparison.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import camera as detector
from napari_mufasa.chance.streams import Streams
from napari_mufasa.compare.baselines import (
    largest_of_a_trace,
    poisson_image,
    sofi_emission,
    tool_defaults,
    two_state_of,
)
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.optics.gaussian import pixel_shares
from napari_mufasa.simulate.movie import SimulatedAcquisition
from napari_mufasa.spots.aperture import aperture
from napari_mufasa.traces import Options, TraceSet, extract_traces

Cancel = Callable[[], bool]
SofiTimes = Literal["model", "tool"]
IN_MEMORY_BYTES = 2**29  # larger movies are simulated anew for every block that extraction asks for


PLACES = 50  # places within a pixel at which weights are worked out; further molecules share them


class SimulatedMovie:
    """An acquisition that is recorded when a block of it is read: a movie (frame, y, x) that needs no memory."""

    def __init__(self, acquisition: SimulatedAcquisition) -> None:
        self.acquisition = acquisition
        self.shape = (acquisition.n_frames, *acquisition.scene.shape_px)
        self.dtype = np.dtype(np.uint16)

    def __getitem__(self, key: slice) -> NDArray[np.uint16]:
        start, stop, _ = key.indices(self.shape[0])
        return self.acquisition.scene.record(self.acquisition.photons, start, stop).movie


def acquisitions(
    model: Model, positions_px: NDArray[np.float64], seed: int, sofi_times: SofiTimes = "model"
) -> dict[str, SimulatedAcquisition]:
    """The acquisition by the model ("mufasa") and by the two baselines, of molecules at the same places.

    The baselines know nothing of the model's effects. SOFI's I_on is the largest photon number of a frame in a
    trace of the MUFASA emission; its on, off and bleaching times are those of the model's chain ("model") or
    those SOFI Simulation Tools starts with ("tool").
    """
    if sofi_times not in ("model", "tool"):
        raise MufasaError(f"sofi_times {sofi_times!r} is unknown: choose 'model' or 'tool'")
    mufasa = SimulatedAcquisition(model, positions_px, seed)
    plain = model.model_copy(update={"effects": ()})
    poisson = SimulatedAcquisition(plain, positions_px, seed + 1)
    sofi = SimulatedAcquisition(plain, positions_px, seed + 2)
    n = len(positions_px)
    poisson.record_instead(poisson_image(model, n, Streams(seed + 1).of("poisson baseline")))
    timing = model.acquisition
    largest = largest_of_a_trace(mufasa.emission)
    tool = sofi_times == "tool"
    two_state = tool_defaults(largest) if tool else two_state_of(model, largest, mufasa.scene.chain)
    stream = Streams(seed + 2).of("sofi baseline")
    sofi.record_instead(sofi_emission(two_state, n, timing.n_frames, timing.frame_length_s, timing.interval_s, stream))
    return {"mufasa": mufasa, "poisson": poisson, "sofi": sofi}


def recorded(acquisition: SimulatedAcquisition, cancel: Cancel | None = None) -> Any:
    """The movie of an acquisition: in memory when it fits, else recorded on reading."""
    height, width = acquisition.scene.shape_px
    if 2 * acquisition.n_frames * height * width > IN_MEMORY_BYTES:
        return SimulatedMovie(acquisition)
    return np.concatenate([block.movie for _, block in acquisition.blocks(cancel=cancel)])


def extract_simulated(
    acquisition: SimulatedAcquisition, options: Options, positions_px: NDArray[np.float64] | None = None,
    cancel: Cancel | None = None,
) -> TraceSet:  # fmt: skip
    """Traces of an acquisition, detected like a measurement, or at known positions."""
    movie = recorded(acquisition, cancel)
    camera = acquisition.model.camera
    return extract_traces(movie, camera, options=options, positions_px=positions_px, cancel=cancel)


class FarApart:
    """Molecules far from each other, each anywhere within its pixel: how traces without a movie are simulated.

    Traces of the brightest pixel with its background need no image: every molecule is one pixel that receives
    its share of the light. Others are recorded in a field with room for the background rings, or (`quick`)
    without images, as one pixel each with the noise that the weights of the profile give.

    Parameters
    ----------
    sigma_px : PSF width; n_molecules; seed : of the places within the pixels
    options : profile and background of the traces, as extraction has them
    pixel_share : share of a molecule's light in its brightest pixel (None: that of the PSF; 1: a detector that
        collects a molecule in one pixel); for brightest-pixel traces with background only
    """

    def __init__(
        self,
        sigma_px: float,
        n_molecules: int,
        options: Options,
        seed: int,
        pixel_share: float | None = None,
        *,
        quick: bool = False,
    ) -> None:
        self.options = options
        self.one_pixel = options.profile == "brightest_pixel" and not options.subtract_background
        self.weighing: Weighing | None = None
        if pixel_share is not None and not (self.one_pixel and 0 < pixel_share <= 1):
            raise MufasaError(
                f"pixel_share = {pixel_share}: give a share in 0 … 1, for brightest-pixel traces with their background"
            )
        index = np.arange(n_molecules, dtype=np.float64)
        self.positions_px: NDArray[np.float64]
        offset = Streams(seed).of("place in the pixel").uniform(-0.5, 0.5, (n_molecules, 2))
        if self.one_pixel or quick:
            shares = pixel_shares(offset[:, 0], offset[:, 1], sigma_px)
            self.shares = shares if pixel_share is None else np.full(n_molecules, float(pixel_share))
            self.shape_px = (1, n_molecules)
            self.positions_px = np.stack([np.zeros(n_molecules), index], axis=1)
            if not self.one_pixel:
                self.weighing = weigh(offset, sigma_px, options)
            return
        spacing = int(np.ceil(8 * sigma_px)) + 3
        if options.subtract_background:
            spacing += int(np.ceil(2 * max(3.0, 2 * sigma_px)))
        columns = int(np.ceil(np.sqrt(n_molecules)))
        rows = -(-n_molecules // columns)
        self.shape_px = (rows * spacing, columns * spacing)
        self.positions_px = np.stack(np.divmod(index, columns), axis=1) * spacing + spacing // 2 + offset

    def acquisition(self, model: Model, seed: int) -> SimulatedAcquisition:
        """The model in this field."""
        return SimulatedAcquisition(self._here(model), self.positions_px, seed)

    def acquisitions(self, model: Model, seed: int, sofi_times: SofiTimes = "model") -> dict[str, SimulatedAcquisition]:
        """The model and the baselines in this field."""
        return acquisitions(self._here(model), self.positions_px, seed, sofi_times)

    def _here(self, model: Model) -> Model:
        return model.in_shape(shape_px=self.shape_px, maps=None)

    def traces(self, acquisition: SimulatedAcquisition, cancel: Cancel | None = None) -> NDArray[np.float32]:
        """(molecule, frame) photoelectrons at the known positions."""
        if self.one_pixel:
            light = self._light(acquisition) * self.shares.astype(np.float32)[:, None]
            return _detected(acquisition, light + self._background(acquisition))
        if self.weighing is None:
            return extract_simulated(acquisition, self.options, self.positions_px, cancel).all_traces
        weighing, background = self.weighing, self._background(acquisition)
        light = self._light(acquisition) * (weighing.share / weighing.excess).astype(np.float32)[:, None]
        signal = _detected(acquisition, light, alone=True) * weighing.excess.astype(np.float32)[:, None]
        camera = acquisition.model.camera
        level_e = camera.quantum_efficiency * background + camera.clock_induced_charge_e
        variance = detector.multiplication_noise(camera) * level_e
        variance += detector.read_variance(level_e.mean(keepdims=True), camera)
        if not self.options.subtract_background:
            signal = signal + level_e * weighing.weight[:, None]
        noise = acquisition.scene.streams.of("noise of the weights").standard_normal(signal.shape)
        return np.asarray(signal + noise * np.sqrt(variance * weighing.squares[:, None]), dtype=np.float32)

    def _light(self, acquisition: SimulatedAcquisition) -> NDArray[np.float32]:
        """(molecule, frame) photons collected from each place."""
        scene, optics = acquisition.scene, acquisition.model.optics
        share = optics.collection_efficiency * optics.brightness_correction * scene.brightness
        photons = acquisition.photons.astype(np.float32) * share[:, None].astype(np.float32)
        place = np.rint(scene.positions_px[:, 1]).astype(int)
        if np.array_equal(place, np.arange(len(self.positions_px))):
            return photons
        light = np.zeros((len(self.positions_px), scene.n_frames), np.float32)
        np.add.at(light, place, photons)  # several emitters may share a pixel
        return light

    def _background(self, acquisition: SimulatedAcquisition) -> NDArray[np.float32]:
        """(molecule, frame) background photons per pixel."""
        scene = acquisition.scene
        return np.asarray(scene.background_map()[0][:, None] * (scene.light * scene.background), dtype=np.float32)


@dataclass(frozen=True)
class Weighing:
    """What the weights of a profile do to one molecule's light, each (molecule,).

    share : signal in the trace over light collected; excess : variance of the signal over its Poisson value;
    weight, squares : sums of the weights (molecule only) and of their squares (with the background's)
    """

    share: NDArray[np.float64]
    excess: NDArray[np.float64]
    weight: NDArray[np.float64]
    squares: NDArray[np.float64]


def weigh(offset_px: NDArray[np.float64], sigma_px: float, options: Options) -> Weighing:
    """The `Weighing` of molecules at these places within their pixel, (molecule, 2)."""
    reach = int(np.ceil(8 * sigma_px)) + 4
    shape = (2 * reach + 1, 2 * reach + 1)
    y, x = np.indices(shape).reshape(2, -1)
    alone = np.empty((0, 2))
    found = []
    for place in offset_px[:PLACES] + reach:
        opening = aperture(
            place[None], shape, sigma_px, options.profile, subtract_background=options.subtract_background,
            neighbours_px=alone,
        )  # fmt: skip
        row = np.asarray(opening.signal.todense(), dtype=np.float64)[0]
        shares = pixel_shares(y - place[0], x - place[1], sigma_px)
        share = float(row @ shares)
        found.append((share, float(row**2 @ shares) / share, float(row[row > 0].sum()), float(row @ row)))
    each = np.resize(np.arange(len(found)), len(offset_px))
    return Weighing(*np.array(found)[each].T)


def background_weight(sigma_px: float, options: Options) -> float:
    """How many pixels' worth of background a trace of this profile holds, averaged over places within a pixel."""
    at = (np.arange(7) + 0.5) / 7 - 0.5
    places = np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2)
    return float(weigh(places, sigma_px, options).weight.mean())


def _detected(
    acquisition: SimulatedAcquisition, light: NDArray[np.float32], *, alone: bool = False
) -> NDArray[np.float32]:
    """Photoelectrons (molecule, frame) that the camera makes of photons, one pixel per molecule. `alone`: of a pixel
    that stands for all of a trace, without spurious charge, read noise and converter: no real pixel has all the light,
    nor its end of the scale."""
    scene, camera, sensor = acquisition.scene, acquisition.model.camera, acquisition.scene.sensor
    output: list[detector.Stack] = []
    if alone:

        def keep(electrons: detector.Stack, frames: NDArray[np.int64]) -> detector.Stack:
            output.append(electrons.copy())
            return electrons

        camera = camera.model_copy(update={"read_noise_e": 0.0, "clock_induced_charge_e": 0.0})
        sensor = replace(sensor, output=[*sensor.output, keep])
    before = sensor.memory_frames  # in the light of the first
    image = np.pad(light.T[:, None], ((before, 0), (0, 0), (0, 0)), mode="edge").astype(np.float32)
    numbers = scene.numbers(np.arange(-before, scene.n_frames))
    adu: NDArray[Any] = detector.expose(image, camera, scene.streams, numbers, sensor)
    if alone:  # half a count less, as the floor takes it on average
        adu = output[0] / np.float32(camera.electrons_per_adu) + detector.baseline_map_adu(camera) - np.float32(0.5)
    return detector.photoelectrons(adu[before:], camera)[:, 0].T
