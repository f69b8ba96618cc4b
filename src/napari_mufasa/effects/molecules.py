"""Molecules that differ from the believed ones: dim ones, ones whose brightness wanders or switches
(docs/effects.md).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Literal

import numpy as np

from napari_mufasa.model.effect import Effect, parameter
from napari_mufasa.model.setup import Setup
from napari_mufasa.photophysics.chain import Chain, Transition
from napari_mufasa.simulate.scene import Scene

STAGE = "photophysics"


class LevelSwitching(Effect):
    kind = "level_switching"
    stage = STAGE
    strength = "to_low_per_s"
    common = False
    title = "Switching between two levels"
    what_it_is = (
        "The molecule changes to and fro between its full brightness and a lower one (quenching, another form)."
    )
    what_it_does = "Traces jump between two levels, neither of them dark, and never in unison."
    how_to_check = (
        "Look at the histogram of levels within single traces; change buffer or temperature: dwell times change."
    )
    observables = ("autocorrelation", "count", "steps", "level_spread")
    rivals = ("triplet_blinking", "brightness_wander", "multiple_emitters")
    separated_by = "two levels within one trace, of the same ratio in all; the lower one is not dark"

    to_low_per_s: float = parameter(
        1.0, ge=0, plausible=(0.1, 10), follows="/movie_s", unit="1/s", log=True, description="rate to the lower level"
    )
    to_full_per_s: float = parameter(
        1.0,
        gt=0,
        plausible=(0.1, 10),
        follows="/movie_s",
        unit="1/s",
        log=True,
        description="rate back to the full one",
    )
    level: float = parameter(
        0.5, gt=0, le=1, plausible=(0.2, 0.9), unit="", description="lower level over the full one"
    )

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.to_low_per_s > 0:
            scene.chain = with_lower_level(scene.chain, self.level, self.to_low_per_s, self.to_full_per_s)


def with_lower_level(chain: Chain, level: float, to_low_per_s: float, to_full_per_s: float) -> Chain:
    """Every state that a bright molecule goes to and fro between gets a second one that is left alike, but emits
    `level` of the photons: what goes dark comes back as it was. Molecules change in the ground state, and those that
    are not still to come start in equilibrium between the two."""
    grounds = [ground for ground, _ in chain.emitting_pairs()]
    low: dict[str, str] = {}
    for state in (state for ground in grounds for state in chain.returning(ground)):
        low[state] = chain.free_name(f"{state}_low")
    copies = [
        replace(
            t,
            source=low[t.source],
            target=low.get(t.target, t.target),
            photon_probability=level * t.photon_probability,
        )
        for t in chain.transitions
        if t.source in low
    ]
    switching = [
        change
        for ground in grounds
        for change in (Transition(ground, low[ground], to_low_per_s), Transition(low[ground], ground, to_full_per_s))
    ]
    share = to_low_per_s / (to_low_per_s + to_full_per_s)
    start = dict(chain.start)
    for full, copy in low.items():
        start |= {full: start.get(full, 0.0) * (1 - share), copy: start.get(full, 0.0) * share}
    chain = replace(chain, states=(*chain.states, *low.values()))
    return chain.with_transitions(*copies, *switching).starting(start)


class DimPopulation(Effect):
    kind = "dim_population"
    stage = STAGE
    strength = "number_ratio"
    common = False
    hides_molecules = True
    order = 2  # further molecules, to which nothing else happens
    title = "A second, dim population"
    what_it_is = "Many molecules shine at a fraction of the others' brightness: impurities, free dye, out of focus."
    what_it_does = "Faint spots that overlap make the background grainy; most are below what a finder of spots sees."
    how_to_check = "Image a sample without label, or average many frames: faint spots stand out of the background."
    observables = ("spots", "level", "background_variance", "pixel_pattern")
    rivals = ("brightness_heterogeneity", "background_gradient", "pixel_gain_variation")
    separated_by = "the graininess of the background in the mean of many frames, of the PSF's width, in light only"

    number_ratio: float = parameter(
        4.0,
        ge=0,
        le=1000,
        plausible=(0.3, 15),
        unit="",
        log=True,
        description="dim molecules per molecule of the first kind",
    )
    brightness: float = parameter(
        0.12,
        gt=0,
        le=1,
        plausible=(0.04, 0.4),
        unit="",
        log=True,
        description="their brightness over that of the others",
    )
    slower: float = parameter(
        3.0, ge=1, le=1e6, plausible=(1, 20), unit="", log=True, description="how many times more slowly they bleach"
    )

    @classmethod
    def same_as(cls, setup: Setup, beside: Collection[str]) -> tuple[str, ...]:
        # Where nothing bleaches, faster or slower, bright and dim molecules are one law of a spread of brightness.
        bleaches = setup.fluorophore.cycles_before_bleaching is not None or "photobleaching" in beside
        return () if bleaches else ("brightness_heterogeneity",)

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        n = round(self.number_ratio * scene.present * len(scene.positions_px))
        if n > 0:
            places = rng.random((n, 2)) * scene.shape_px - 0.5
            scene.add_molecules(places, (self.kind, dimmed(scene.chain, self.brightness, self.slower)))


class DimCompanions(Effect):
    kind = "dim_companions"
    stage = STAGE
    strength = "brightness"
    common = False
    order = 3  # after the dim population, whose molecules have none
    title = "Dim companions"
    what_it_is = "A dim emitter beside each molecule: a donor whose light leaks through, a second dye, a bleached form."
    what_it_does = "Where a molecule has bleached, a share of its light stays, and goes much later."
    how_to_check = "Look at single spots after their step: they are still there in the mean of many frames."
    observables = ("left_after", "steps_between", "ensemble_5")
    rivals = ("dim_population", "multiple_emitters", "photobleaching")
    separated_by = "the light of spots after their last step; none of it lies elsewhere"

    brightness: float = parameter(
        0.2, ge=0, le=1, plausible=(0.02, 0.3), unit="", description="their brightness over that of their molecules"
    )
    slower: float = parameter(
        10.0, ge=1, le=1e6, plausible=(2, 50), unit="", log=True, description="how many times more slowly they bleach"
    )

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.brightness > 0:
            scene.add_companions((self.kind, dimmed(scene.chain, self.brightness, self.slower)))


def dimmed(chain: Chain, brightness: float, slower: float) -> Chain:
    """The chain with `brightness` of the photons, whose bright states end for good at 1/`slower` of the rate."""
    leaving = {t.source for t in chain.transitions if t.rate_per_s > 0}
    excited = {source for _, source in chain.emitting_pairs()}
    transitions = (
        replace(
            t, photon_probability=brightness * t.photon_probability,
            rate_per_s=t.rate_per_s / (slower if t.source in excited and t.target not in leaving else 1.0),
        )
        for t in chain.transitions
    )  # fmt: skip
    return replace(chain, transitions=tuple(transitions))


class BrightnessWander(Effect):
    """The course scales the light that a molecule absorbs: photons are Poisson given the course, as in steady light,
    and what the light drives (bleaching) follows it."""

    kind = "brightness_wander"
    stage = STAGE
    strength = "rms"
    common = False
    order = 4  # every molecule wanders on its own, those of one spot and dim ones, too
    title = "Brightness that wanders"
    what_it_is = "Each molecule's brightness changes slowly on its own, as its orientation or surroundings do."
    what_it_does = "Levels of single traces wander over many frames, up and down, and not in unison."
    how_to_check = "Compare neighbours: they wander independently; rotate the polarisation or fix the molecules."
    observables = ("autocorrelation", "level_trend", "level_spread", "count")
    rivals = ("brightness_heterogeneity", "multiple_emitters", "level_switching", "molecule_diffusion", "laser_drift")
    separated_by = "the covariance of single traces at long lags, without gaps and not shared by molecules"

    rms: float = parameter(
        0.25,
        ge=0,
        le=3,
        plausible=(0.03, 0.6),
        unit="",
        log=True,
        description="relative rms of the brightness over time",
    )
    correlation_frames: float = parameter(
        100.0, gt=0, le=1e6, plausible=(5, 300), follows="frames", unit="frames", log=True,
        description="time over which it forgets to 1/e",
    )  # fmt: skip
    form: Literal["wandering", "jumps"] = "wandering"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        shape = len(scene.positions_px), scene.n_frames
        if self.rms == 0 or shape[0] == 0:
            return
        kept = np.exp(-1 / self.correlation_frames)
        noise = rng.standard_normal(shape, dtype=np.float32)
        if self.form == "jumps":  # a new level now and then
            last = np.where(rng.random(shape, dtype=np.float32) < 1 - kept, np.arange(shape[1]), 0)
            path = np.take_along_axis(noise, np.maximum.accumulate(last, axis=1), axis=1)
        else:
            from scipy.signal import lfilter

            fresh = np.sqrt(1 - kept**2)
            noise[:, 0] /= fresh  # stationary from the first frame on
            path = lfilter(np.array([fresh], np.float32), np.array([1, -kept], np.float32), noise, axis=1)
        width = np.sqrt(np.log1p(self.rms**2))
        scene.light_each(np.exp(width * path - width**2 / 2).astype(np.float32))


EFFECTS = (LevelSwitching, DimPopulation, DimCompanions, BrightnessWander)
