"""The hidden world: everything that decides what the camera saw. Effects change its fields before it runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from . import bases
from .laws import Dwell, Rng, exponential

SUBSTEPS = 8  # positions are followed in this many steps per frame, so motion blurs inside a frame


@dataclass
class DarkState:
    """A dark excursion: entered by light at ``rate_per_s`` (at the nominal light), left after a time."""

    rate_per_s: float
    dwell: Dwell


@dataclass
class CameraTruth:
    """The true camera. Signals are electrons until ``electrons_per_adu``; offsets are ADU."""

    kind: str
    quantum_efficiency: float
    read_noise_e: float
    spurious_e: float
    electrons_per_adu: float
    baseline_adu: float
    adc_max: int
    em_gain: float
    # effects
    excess_factor: float = 2.0
    excess_form: int = 0
    serial_charge_e: float = 0.0
    spurious_map: np.ndarray | None = None  # multiplies spurious_e, (y, x)
    gain_map: np.ndarray | None = None  # (y, x)
    offset_map_adu: np.ndarray | None = None  # (y, x)
    row_offset_adu: Callable[[int, int, Rng], np.ndarray] | None = None  # -> (frame, y)
    hot_map_e: np.ndarray | None = None  # (y, x)
    hot_switching: tuple[float, float] | None = None  # probabilities per frame: off->on, on->off
    response: Callable[[np.ndarray], np.ndarray] | None = None  # electrons after gain -> electrons
    lag: tuple[float, float] | None = None  # share left behind per frame, share of the store kept per frame
    drift_adu: np.ndarray | None = None  # (dark + movie frames)
    cosmic_per_frame: float = 0.0
    cosmic_form: int = 0


@dataclass
class World:
    n_frames: int
    n_dark: int
    shape_px: tuple[int, int]
    frame_s: float
    pixel_nm: float
    positions_px: np.ndarray  # (molecule, 2) as (y, x); integers are pixel centres
    photons_per_s: float
    fatal_dose: Dwell | None  # seconds of nominal light in the bright state before bleaching
    start_delay: Dwell | None
    dark_states: list[DarkState]
    sigma_px: float
    background_photons: float
    camera: CameraTruth
    # set to neutral below
    emitters: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    brightness: np.ndarray = field(default_factory=lambda: np.empty(0))
    level: np.ndarray | None = None  # (molecule, frame)
    light_t: np.ndarray = field(default_factory=lambda: np.empty(0))
    light_map: np.ndarray = field(default_factory=lambda: np.empty(0))
    shift_px: np.ndarray | None = None  # (frame * SUBSTEPS, 2), common to all
    wander_px: np.ndarray | None = None  # (molecule, frame * SUBSTEPS, 2), own to each
    width_t: np.ndarray = field(default_factory=lambda: np.empty(0))
    shape_of_spot: Callable[[np.ndarray], np.ndarray] | None = None  # position -> 2x2 matrix
    halo: tuple[float, float] = (0.0, 1.0)  # share of photons, width factor
    background_t: np.ndarray = field(default_factory=lambda: np.empty(0))
    background_map: np.ndarray = field(default_factory=lambda: np.empty(0))
    after: list[Callable[[np.ndarray, Rng], np.ndarray]] = field(default_factory=list)  # recorded stack -> stack

    def __post_init__(self) -> None:
        n = len(self.positions_px)
        self.emitters = np.ones(n, dtype=int)
        self.brightness = np.ones(n)
        self.light_t = np.ones(self.n_frames)
        self.light_map = np.ones(self.shape_px)
        self.width_t = np.ones(self.n_frames)
        self.background_t = np.ones(self.n_frames)
        self.background_map = np.ones(self.shape_px)

    @property
    def movie_s(self) -> float:
        return self.n_frames * self.frame_s

    @property
    def peak_e(self) -> float:
        """Mean photoelectrons in the central pixel of a nominal spot, background included."""
        spot = self.photons_per_s * self.frame_s / (2 * np.pi * (self.sigma_px**2 + 1 / 12))
        return float(self.camera.quantum_efficiency * (spot + self.background_photons))

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (y, x) of the pixels, -1 to 1 across the field."""
        ny, nx = self.shape_px
        return np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")

    def light_at(self, positions_px: np.ndarray) -> np.ndarray:
        ny, nx = self.shape_px
        y = np.clip(np.rint(positions_px[:, 0]).astype(int), 0, ny - 1)
        x = np.clip(np.rint(positions_px[:, 1]).astype(int), 0, nx - 1)
        return self.light_map[y, x]


def scatter(n: int, shape_px: tuple[int, int], rng: Rng, min_distance_px: float = 5.0) -> np.ndarray:
    """Random positions, some on the very border; the minimum distance is kept where there is room for it."""
    ny, nx = shape_px
    placed = np.empty((n, 2))
    for i in range(n):
        for _attempt in range(30):
            trial = rng.uniform(-0.5, [ny - 0.5, nx - 0.5])
            if ((placed[:i] - trial) ** 2).sum(axis=1).min(initial=np.inf) >= min_distance_px**2:
                break
        placed[i] = trial  # after thirty tries it is put where it fell: crowding happens
    return placed


def build(model: bases.Believed, n_molecules: int, n_dark: int, rng: Rng) -> World:
    """The world in which the believed model is exactly true."""
    acq, dye, cam = model["acquisition"], model["fluorophore"], model["camera"]
    shape_px = (int(acq["shape_px"][0]), int(acq["shape_px"][1]))
    cycles_per_s = bases.cycle_rate_per_s(model)
    _, p_isc, p_bleach = bases.s1_branching(model)
    dark_states = []
    triplet_s = None
    if p_isc and dye.get("triplet_decay_rate_per_s"):
        triplet_s = 1.0 / dye["triplet_decay_rate_per_s"]
        dark_states.append(DarkState(cycles_per_s * p_isc, exponential(triplet_s)))
    delay = None
    if model["protocol"] == "PALM" and model["excitation"].get("activation_rate_per_s"):
        delay = exponential(1.0 / model["excitation"]["activation_rate_per_s"])
    elif model["protocol"] in ("STORM", "Blinking") and triplet_s:
        delay = exponential(triplet_s)
    return World(
        n_frames=int(acq["n_frames"]),
        n_dark=n_dark,
        shape_px=shape_px,
        frame_s=float(acq["frame_length_s"]),
        pixel_nm=float(acq["pixel_size_nm"]),
        positions_px=scatter(n_molecules, shape_px, rng),
        photons_per_s=bases.photons_per_s(model),
        fatal_dose=exponential(1.0 / (cycles_per_s * p_bleach)) if p_bleach else None,
        start_delay=delay,
        dark_states=dark_states,
        sigma_px=bases.sigma_px(model),
        background_photons=float(model["optics"]["background_photons_per_px"]),
        camera=CameraTruth(
            kind=cam["type"],
            quantum_efficiency=float(cam["quantum_efficiency"]),
            read_noise_e=float(cam["read_noise_e"]),
            spurious_e=float(cam["clock_induced_charge_e"]),
            electrons_per_adu=float(cam["electrons_per_adu"]),
            baseline_adu=float(cam["baseline_adu"]),
            adc_max=int(cam["adc_max"]),
            em_gain=float(cam.get("em_gain") or 1.0),
        ),
    )
