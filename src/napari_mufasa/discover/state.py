"""Where a diagnosis stands: a model, what simulations of it show, and what effects would do to it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover.coordinates import changed, model_at, room
from napari_mufasa.discover.metric import Adjusted, adjust, at_the_end, soften, stretch
from napari_mufasa.discover.nuisance import Nuisance
from napari_mufasa.discover.rules import AT_FLOOR, FAR_OFF, FORM_ERROR, SCALES, SOFT, TAKEN_REACH
from napari_mufasa.effects import Effect
from napari_mufasa.model.model import Model
from napari_mufasa.observe import PARTS
from napari_mufasa.one_thread import one_thread

Array = NDArray[np.float64]
HALVES = ((PARTS.index("white"), PARTS.index("black")), (PARTS.index("black"), PARTS.index("white")))  # fit, held out


@dataclass(frozen=True)
class Ray:
    """One effect at one setting, and the shift of the observables it makes (part, observable)."""

    effect: Effect
    shift: Array
    none: float = 0.0  # strength at which there is none of it


@dataclass(frozen=True)
class Lead:
    """The best ray of an effect: the fall of chi² it promises, and how far along."""

    gain: float
    ray: Ray
    scale: float

    @property
    def may_be_stronger(self) -> bool:
        """Whether the ray ends there: a stronger effect may promise more."""
        return abs(self.scale) == max(SCALES)

    @property
    def rises(self) -> bool:
        """Whether the effect's strength is above that of none of it."""
        effect = self.ray.effect
        return self.scale * (float(getattr(effect, effect.strength)) - self.ray.none) > 0

    @property
    def shift(self) -> Array:
        """What it does to the observables (part, observable)."""
        return self.scale * self.ray.shift

    def start(self) -> Effect:
        """The ray's effect at the strength the lead stands at, within hard limits."""
        return scaled(self.ray.effect, self.scale, self.ray.none)


@dataclass(frozen=True)
class State:
    """A model with its effects, and what simulations of it show.

    mean, spread (part, observable) · slopes (part, observable, free value), free values with prior widths: the
    nuisance values (`values`) first, then effect parameters · whiten (part, observable, observable) · check
    (simulation, part, observable) simulations of fresh seeds · least_spread (observable,) · floor: the held-out error
    that noise alone gives (see `with_floor`) ·
    unread : of each effect of which something is read off the movie, by half: how the mean (part, observable) changes
    where it is read off that half alone

    An observable that cannot be measured has an infinite (least) spread: whatever it is, it is no residual, and it is
    left out of every score and error.
    """

    model: Model
    mean: Array
    spread: Array
    slopes: Array
    prior: Array
    whiten: Array
    check: Array
    free: tuple[str, ...]
    least_spread: Array
    values: tuple[Nuisance, ...] = ()
    floor: float = 1.0
    unread: Mapping[str, Mapping[int, Array]] = field(default_factory=dict)

    @property
    def measurable(self) -> NDArray[np.bool_]:
        """(observable,) which of them take part in scores and errors."""
        return np.isfinite(self.least_spread)

    def model_at(self, moves: Array) -> Model:
        """The model with its free values moved."""
        return model_at(self.model, self.values, self.free, moves)

    def adjusted(self, x: Array, part: int = 0) -> Adjusted:
        """The measurement x (part, observable) against this model, free values moved."""
        return adjust(
            x[part], self.mean[part], self.spread[part], self.slopes[part], self.prior, self.room, self.whiten[part]
        )

    @cached_property
    def room(self) -> Array:
        """How far the free values may move (2, value)."""
        return room(self.model, self.values, self.free)

    def held_out_error(self, x: Array) -> float:
        """rms whitened residual of each half of the field, free values fitted, and all else read off, on the other."""
        return self._rms(self._held_out(x, fit, held) for fit, held in HALVES)

    def with_floor(self) -> State:
        """The state that knows the held-out error of a right model: its own simulations are taken as measurements, none
        judged by a mean it helped to make. What is read off one half has the noise of that half, which the other does
        not share: √2 times as much as it is from what is read off both, on either side, so far as free values that are
        fitted there do not make up for it."""
        right = replace(self, unread={})

        def error(x: Array, by: float) -> float:
            return self._rms(right._held_out(x + by * self._misread(fit), fit, held) for fit, held in HALVES)

        sides = (np.sqrt(2), -np.sqrt(2)) if self.unread else (0.0,)
        return replace(self, floor=float(np.median([error(x, by) for x in self.check for by in sides])))

    def _rms(self, squares: Iterable[Array]) -> float:
        return float(np.sqrt(np.mean([found[self.measurable] for found in squares])))

    def _misread(self, fit: int) -> Array:
        """How the mean (part, observable) changes where all that is read off the movie is read off one half."""
        changes = (change[fit] for change in self.unread.values() if fit in change)
        return sum(changes, np.zeros_like(self.mean))

    def _held_out(self, x: Array, fit: int, held: int) -> Array:
        """Squares of the whitened residuals of one half, free values fitted on the other."""
        read = replace(self, mean=self.mean + self._misread(fit))
        moves = read.adjusted(x, fit).moves
        still = adjust(
            x[held], read.mean[held] + self.slopes[held] @ moves, self.spread[held],
            np.zeros((x.shape[1], 0)), np.zeros(0), np.zeros((2, 0)), self.whiten[held], steps=0,
        )  # fmt: skip
        return np.square(still.residual)

    def at_floor(self, x: Array) -> bool:
        return self.held_out_error(x) <= AT_FLOOR * self.floor

    def far_off(self, x: Array) -> bool:
        """Is so much wrong that several things must be missing?"""
        return self.held_out_error(x) > FAR_OFF * self.floor

    def without(self, kind: str) -> State:
        """The state whose model lacks one of its effects; its mean is still that of the model with it."""
        keep = np.array([not path.startswith(f"{kind}.") for path in self.free])
        effects = tuple(effect for effect in self.model.effects if effect.kind != kind)
        free = tuple(path for path, stays in zip(self.free, keep, strict=True) if stays)
        model = self.model.model_copy(update={"effects": effects})
        unread = {other: change for other, change in self.unread.items() if other != kind}
        slopes, prior = self.slopes[:, :, keep], self.prior[keep]
        return replace(self, model=model, free=free, slopes=slopes, prior=prior, unread=unread)

    def doubting(self, shifts: Iterable[Array]) -> State:
        """The state that knows what effects move (part, observable), by their laws, but to a share (`FORM_ERROR`): the
        law of one in the measurement need not be that of the catalogue."""
        doubt = sum((np.square(FORM_ERROR * shift) for shift in shifts), np.zeros_like(self.spread))
        return replace(self, spread=np.sqrt(self.spread**2 + doubt))

    def misfit(self, x: Array) -> float:
        return self.adjusted(x).chi2

    def score(self, x: Array) -> float:
        """−2 log likelihood, up to a constant all models share."""
        return self.misfit(x) + self._log_volume(0)

    def surprise(self, x: Array) -> float:
        """The score, and that of each half of the field as predicted from the other (their mean): two models that make
        the same of the whole may differ in what they make of its parts."""
        halves = [self._held_out(x, fit, held).sum() + self._log_volume(held) for fit, held in HALVES]
        return self.score(x) + float(np.mean(halves))

    @one_thread
    def _log_volume(self, part: int) -> float:
        spread = self.spread[part][self.measurable]
        return 2 * float(np.log(spread).sum() - np.linalg.slogdet(self.whiten[part])[1])

    @one_thread
    def screen(self, x: Array, rays: dict[str, list[Ray]], taken: Sequence[Lead] = ()) -> dict[str, list[Lead]]:
        """Per effect: the largest fall of chi² along any ray of each of its forms, best form first.

        `taken`: leads that are taken up already; the others are asked what they explain beside them.
        """
        w = self.whiten[0]
        spread = self.doubting(lead.shift for lead in taken).spread[0]
        mean, slopes, prior, room = self.mean[0], self.slopes[0], self.prior, self.room
        for lead in taken:
            mean = mean + lead.shift[0]
            slopes = np.column_stack([slopes, lead.shift[0]])
            prior, room = np.append(prior, TAKEN_REACH / 2), np.column_stack([room, [-TAKEN_REACH, TAKEN_REACH]])
        start = adjust(x[0], mean, spread, slopes, prior, room, w)
        # Locally linear: directions of free values are projected out of residual and rays alike.
        local = 1 / np.cosh(np.clip(start.soft / SOFT, -20, 20))
        slope = np.vstack([w @ (slopes / spread[:, None] * local[:, None]), np.diag(1 / prior)])
        full = np.concatenate([start.residual, -start.moves / prior])
        q, _ = np.linalg.qr(slope[:, ~at_the_end(start.moves, room, slope.T @ full)])
        raw = stretch(start.soft)
        found: dict[str, list[Lead]] = {}
        for kind, candidates in rays.items():
            best: dict[tuple[str, ...], Lead] = {}
            scales = (
                (*SCALES, *(-s for s in SCALES))
                if candidates and two_sided(candidates[0].effect, candidates[0].none)
                else SCALES
            )
            for ray in candidates:
                shifts = np.outer(scales, ray.shift[0] / spread)
                moved = start.soft - soften(raw - shifts)
                rest = full - np.pad(moved @ w.T, ((0, 0), (0, len(prior))))
                rest -= (rest @ q) @ q.T
                gains = start.chi2 - (rest**2).sum(axis=1)
                i = int(np.argmax(gains))
                form = tuple(ray.effect.chosen.values())
                if form not in best or gains[i] > best[form].gain:
                    best[form] = Lead(float(gains[i]), ray, scales[i])
            found[kind] = sorted(best.values(), key=lambda lead: -lead.gain)
        return found


def two_sided(effect: type[Effect] | Effect, none: float) -> bool:
    """Whether the effect's strength may lie on either side of `none`."""
    low, high, _ = effect.plausible()[effect.strength]
    return low < none < high


def scaled(effect: Effect, scale: float, none: float) -> Effect:
    """The effect with its strength moved to `scale` of the way from `none`."""
    return changed(effect, {effect.strength: none + (float(getattr(effect, effect.strength)) - none) * scale})
