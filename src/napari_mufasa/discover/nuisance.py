"""Nuisance values: what is re-fitted before anything is called missing (docs/discovery.md).

Each is a coordinate with a natural step; 0 is where the model stands. Brightness, background, PSF width,
baseline and density are free; gain and read noise may move only as far as data sheets are wrong (those that are
farther off are found first, `camera`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from scipy.stats import poisson

from napari_mufasa.discover.rules import VALUE_REACH
from napari_mufasa.model.model import Model
from napari_mufasa.observe import photoelectrons_per_adu

PAIRS_MISSED = 4.0  # pairs that a random layout would show nearer than the nearest: none of them is a chance of e⁻⁴
EXCEPTIONS = 0.15  # of these pairs may be nearer all the same; at random a finder misses half where spots merge


@dataclass(frozen=True)
class Nuisance:
    """A value of the model, its scale ("log" or units of its own), step for derivatives, prior width, the value that
    it started from, the largest that it takes, and the value believed (None: the one it started from)."""

    path: str
    log: bool
    step: float
    prior: float
    origin: float = 0.0
    most: float = np.inf
    believed: float | None = None

    def changes(self, model: Model, by: float) -> dict[str, Any]:
        """The changed value, as `Model.with_values` takes it; within its room."""
        value, by = _get(model, self.path), float(np.clip(by, *self.room(model)))
        new = value * np.exp(by) if self.log else value + by
        if self.path == "sample.n_molecules":
            return {self.path: _that_fit(model, new)}
        return {self.path: float(new)}

    def room(self, model: Model) -> tuple[float, float]:
        """How far the value may move down and up, to stay within `VALUE_REACH` of where it started and of what is
        believed, and not below zero."""
        value, reach = float(_get(model, self.path)), VALUE_REACH * self.prior
        low, high = sorted((self.origin, self.origin if self.believed is None else self.believed))
        if self.log:
            return -reach - float(np.log(max(value, 1e-9) / low)), reach - float(np.log(max(value, 1e-9) / high))
        return max(low - reach, 0.0) - value, min(high + reach, self.most) - value

    def inward(self, model: Model, step: float) -> float:
        """A step of that size that the room does not cut short."""
        low, high = self.room(model)
        there, back = abs(np.clip(step, low, high)), abs(np.clip(-step, low, high))
        return step if there >= 0.99 * back else -step


def nuisances(model: Model, believed: Model | None = None) -> list[Nuisance]:
    """The nuisance values of a model, which is their origin: rates that it has, and what every movie has. What is
    `believed` of them stays in reach: matched beside hidden effects they may start far from where they belong."""
    adu = 0.3 / photoelectrons_per_adu(model)  # 0.3 photoelectrons
    found = [
        Nuisance("optics.brightness_correction", True, 0.08, 0.5),
        Nuisance("optics.background_photons_per_px", True, 0.08, 0.5),
        Nuisance("optics.psf_fwhm_nm", True, 0.05, 0.2),
        Nuisance("camera.baseline_adu", False, adu, 8 * adu),
        Nuisance("sample.n_molecules", True, 0.15, 0.4),
        Nuisance("camera.electrons_per_adu", True, 0.05, 0.03),
        Nuisance("camera.read_noise_e", True, 0.1, 0.08),
        Nuisance("optics.emission_noise", False, 0.5, 2.0, most=1.0),
        Nuisance("fluorophore.cycles_before_bleaching", True, 0.4, 0.15),
        Nuisance("fluorophore.isc_ratio", True, 0.3, 0.12),
        Nuisance("fluorophore.triplet_decay_rate_per_s", True, 0.3, 0.12),
    ]
    known = believed or model
    return [
        replace(
            n, origin=float(_get(model, n.path)), believed=float(_get(known, n.path)) if _present(known, n) else None
        )
        for n in found
        if _present(model, n)
    ]


def apply(model: Model, values: Sequence[Nuisance], by: Iterable[float]) -> Model:
    """The model with nuisance coordinates moved by `by` (one per value), within their room."""
    changes: dict[str, Any] = {}
    for value, step in zip(values, by, strict=True):
        changes |= value.changes(model, step)
    return model.with_values(changes)


def kept(model: Model, values: Sequence[Nuisance]) -> Model:
    """The model with every nuisance value in its room."""
    return apply(model, values, np.zeros(len(values)))


def with_molecules(model: Model, n: float) -> Model:
    """The model with about n molecules, as many as fit."""
    return model.with_values({"sample.n_molecules": _that_fit(model, n)})


def spaced(model: Model, positions_px: NDArray[np.float64], area_px2: float) -> Model:
    """The model with the smallest distance between molecules that spots at `positions_px` (spot, 2) within an area
    show: where nothing is believed of it, and molecules at random would have neighbours that are nearer.

    n spots at random have c r² pairs nearer than r on average, c = n(n−1)π/2A; two spots less than 2√2 σ apart are
    seen as one. The nearest pair is farther apart than any two must be, in r² by 1/c on average. Where many pairs are
    missed a few that are nearer are exceptions: as many as leave the rest least likely by chance, and by e⁻⁴
    less likely than without any, for there are many to choose from.
    """
    n, sample = len(positions_px), model.sample
    if n < 2 or sample.layout != "random" or sample.min_distance_px > 0:
        return model
    pairs_per_px2 = n * (n - 1) * np.pi / (2 * area_px2)
    exceptions = np.arange(n // 5 + 1)
    nearest = np.sort(pdist(positions_px))[exceptions] ** 2
    missed = np.maximum(pairs_per_px2 * (nearest - 8 * model.sigma_px**2), 0.0)
    by_chance = poisson.logcdf(exceptions, missed) + PAIRS_MISSED * (exceptions > 0)
    by_chance[exceptions > EXCEPTIONS * missed] = 0.0
    fewest = int(np.argmin(by_chance))
    if by_chance[fewest] > -PAIRS_MISSED:
        return model
    return model.with_values({"sample.min_distance_px": float(np.sqrt(nearest[fewest] - 1 / pairs_per_px2))})


def told(believed: Model, fitted: Model) -> str:
    """What became of the values believed, as a reader finds them in model.json: "optics.psf_fwhm_nm 280 → 307"."""
    paths = [nuisance.path for nuisance in nuisances(believed)] + ["sample.min_distance_px"]
    values = [(path, f"{_get(believed, path):.3g}", f"{_get(fitted, path):.3g}") for path in paths]
    return ", ".join(f"{path} {before} → {after}" for path, before, after in values if before != after)


def moment_step(model: Model, eyes: Model, measured: Mapping[str, float], simulated: Mapping[str, float]) -> Model:
    """One round of matching by moments: brightness, width, density, baseline and background. Observables are in the
    units of the model believed (`eyes`), from whose gain that of the model may differ."""
    seen, scale = photoelectrons_per_adu(eyes), photoelectrons_per_adu(model)
    factor = float(np.exp(np.clip(measured["level"] - simulated["level"], -1.5, 1.5)))
    width = model.sigma_px**2 + measured["spot_width_early"] - simulated["spot_width_early"]
    width_factor = np.sqrt(np.clip(width / model.sigma_px**2, 0.5, 2.0))
    spots = (measured["spots"] / max(simulated["spots"], 0.5)) ** 2
    surplus = measured["background"] - simulated["background"]  # photoelectrons, offset and light together
    if "dark_mean" in measured:
        offset_adu = measured["dark_mean"] - simulated["dark_mean"]
    else:  # light brings variance, an offset does not
        more_variance = np.exp(measured["background_variance"]) - np.exp(simulated["background_variance"])
        alpha = (2.0 if model.camera.type == "EMCCD" else 1.0) * seen / scale
        offset_adu = (surplus - more_variance / alpha) / seen
    light = (surplus - offset_adu * seen) * scale / seen / model.camera.quantum_efficiency
    return model.with_values(
        {
            "optics.brightness_correction": model.optics.brightness_correction * factor,
            "optics.psf_fwhm_nm": model.optics.psf_fwhm_nm * float(width_factor),
            "optics.background_photons_per_px": max(model.optics.background_photons_per_px + light, 0.0),
            "camera.baseline_adu": max(model.camera.baseline_adu + offset_adu, 0.0),
            "sample.n_molecules": _that_fit(model, model.sample.n_molecules * np.clip(spots, 0.2, 5)),
        }
    )


def _that_fit(model: Model, n: float) -> int:
    """A number of molecules that the field can hold at their smallest distance (random packing jams at 0.547)."""
    height, width = model.acquisition.shape_px
    distance = model.sample.min_distance_px
    room = 0.4 * height * width / (np.pi * distance**2 / 4) if distance > 0 else np.inf
    return int(np.clip(round(n), 1, max(1.0, min(room, 20_000))))


def _get(model: Model, path: str) -> Any:
    value: Any = model
    for part in path.split("."):
        value = getattr(value, part)
    return value


def _present(model: Model, nuisance: Nuisance) -> bool:
    value = _get(model, nuisance.path)
    return value is not None and (value > 0 or not nuisance.log)
