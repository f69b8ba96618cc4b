"""The apparent efficiency of transfer, E = A/(γ D + A), of the light in two channels (docs/two_channels.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks

Traces = NDArray[np.floating]


@dataclass(frozen=True)
class Corrections:
    """What the acceptor's channel sees that was not transferred, and how it is weighed against the donor's.

    leakage : light of the donor in the acceptor's channel, as a share of what its own channel sees
    direct_excitation_e : photoelectrons per frame of an acceptor that the laser excites directly
    gamma : how much better the acceptor's light is detected than the donor's, quantum yields included
    """

    leakage: float = 0.0
    direct_excitation_e: float = 0.0
    gamma: float = 1.0

    def __post_init__(self) -> None:
        checks.number(self.leakage, "leakage", 0, 1)
        checks.number(self.direct_excitation_e, "direct_excitation_e", 0)
        checks.number(self.gamma, "gamma", 0.01, 100)

    @property
    def none(self) -> bool:
        """Whether nothing is corrected: E is the apparent one."""
        return self == Corrections()

    def __call__(self, donor: Traces, acceptor: Traces) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Donor and acceptor, photoelectrons per frame, as E counts them."""
        own = np.asarray(donor, dtype=float)
        return self.gamma * own, np.asarray(acceptor, dtype=float) - self.leakage * own - self.direct_excitation_e


def frame_by_frame(
    donor: Traces, acceptor: Traces, lit: NDArray[np.bool_], corrections: Corrections
) -> NDArray[np.float64]:
    """E of each frame, (molecule, frame); nan where the molecule is dark or the light sums to none."""
    d, a = corrections(donor, acceptor)
    total = d + a
    return np.asarray(np.divide(a, total, out=np.full(total.shape, np.nan), where=lit & (total > 0)))


def of_molecules(
    donor: Traces, acceptor: Traces, lit: NDArray[np.bool_], corrections: Corrections, lost_share: float = 0.0
) -> dict[str, NDArray[np.float64]]:
    """Mean levels while on (as read, nothing corrected), E and its sd of each molecule, (molecule,); nan without light.

    E is the ratio of sums over the frames in which the molecule is on: the mean of single frames' ratios is biased. Its
    sd is that of a ratio estimator, from the scatter of A − E (D + A) about 0, and, as a systematic part,
    E (1 − E) · `lost_share`: the share of the acceptor's light that is missed where it is looked for beside its place.
    """
    d, a = corrections(donor, acceptor)
    n = lit.sum(axis=1)
    levels = [np.divide((v * lit).sum(axis=1), n, out=np.full(len(n), np.nan), where=n > 0) for v in (donor, acceptor)]
    light, transferred = ((d + a) * lit).sum(axis=1), (a * lit).sum(axis=1)
    good = (n > 1) & (light > 0)
    efficiency = np.divide(transferred, light, out=np.full(len(n), np.nan), where=good)
    beside = np.where(lit, a - efficiency[:, None] * (d + a), 0.0)
    scatter = np.sqrt(np.square(beside).sum(axis=1) * n / np.maximum(n - 1, 1))
    sd = np.divide(scatter, light, out=np.full(len(n), np.nan), where=good)
    return {
        "donor_e": levels[0], "acceptor_e": levels[1], "efficiency": efficiency,
        "efficiency_sd": np.hypot(sd, efficiency * (1 - efficiency) * lost_share),
    }  # fmt: skip
