"""Continuous-time Markov chains as data: states, transitions, where they start (docs/photophysics.md).

This module knows nothing of microscopes except that some transitions are driven by the excitation light
and some release a photon.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from napari_mufasa.errors import MufasaError


@dataclass(frozen=True)
class Transition:
    """A jump: its rate at full light, whether light drives it, and the chance that it releases a photon."""

    source: str
    target: str
    rate_per_s: float
    driven: bool = False
    photon_probability: float = 0.0


@dataclass(frozen=True)
class Chain:
    """A chain of named states. `start` gives the probabilities of the first state."""

    states: tuple[str, ...]
    transitions: tuple[Transition, ...]
    start: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(set(self.states)) != len(self.states):
            raise MufasaError(f"states {self.states} name one state twice")
        for t in self.transitions:
            if t.source not in self.states or t.target not in self.states or t.source == t.target:
                raise MufasaError(f"transition {t.source}→{t.target} does not join two states of {self.states}")
            if not (np.isfinite(t.rate_per_s) and t.rate_per_s >= 0):
                raise MufasaError(f"rate of {t.source}→{t.target} is {t.rate_per_s}; it must be finite and ≥ 0")
        unknown = set(self.start) - set(self.states)
        if unknown or not np.isclose(sum(self.start.values()), 1):
            raise MufasaError(f"start {dict(self.start)} must be probabilities over {self.states}")

    def matrix(self, *, driven: bool) -> NDArray[np.float64]:
        """Rates (from, to) of the driven or the undriven transitions; zero diagonal."""
        rates = np.zeros((len(self.states), len(self.states)))
        for t in self.transitions:
            if t.driven == driven:
                rates[self.states.index(t.source), self.states.index(t.target)] += t.rate_per_s
        return rates

    def generator(self, light: float = 1.0) -> NDArray[np.float64]:
        """The generator G at a relative light: rows sum to zero."""
        rates = self.matrix(driven=False) + light * self.matrix(driven=True)
        return rates - np.diag(rates.sum(axis=1))

    def photon_matrix(self) -> NDArray[np.float64]:
        """Photon probability of every jump (from, to); of parallel transitions, the largest."""
        photons = np.zeros((len(self.states), len(self.states)))
        for t in self.transitions:
            at = self.states.index(t.source), self.states.index(t.target)
            photons[at] = max(photons[at], t.photon_probability)
        return photons

    def start_vector(self) -> NDArray[np.float64]:
        return np.array([self.start.get(state, 0.0) for state in self.states])

    def with_transitions(self, *transitions: Transition) -> Chain:
        """The chain with transitions added; rates between the same two states add up."""
        return replace(self, transitions=self.transitions + transitions)

    def starting(self, start: Mapping[str, float]) -> Chain:
        return replace(self, start=dict(start))

    def free_name(self, name: str) -> str:
        """`name`, or `name` with a number, such that no state has it yet."""
        names = [name, *(f"{name}_{i}" for i in range(2, len(self.states) + 3))]
        return next(n for n in names if n not in self.states)

    def returning(self, state: str) -> list[str]:
        """The states that a molecule goes to and fro between, among them `state`."""
        moves = (self.matrix(driven=False) + self.matrix(driven=True)) > 0
        _, part = connected_components(moves, connection="strong")
        return [s for s, k in zip(self.states, part, strict=True) if k == part[self.states.index(state)]]

    def emitting_pairs(self) -> list[tuple[str, str]]:
        """(ground, excited) of every transition that releases photons."""
        return [(t.target, t.source) for t in self.transitions if t.photon_probability > 0]
