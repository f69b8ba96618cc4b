"""Places of one channel as places of the other: an affine map, or a polynomial of second order, and how well it is
known (docs/two_channels.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.errors import MufasaError

Array = NDArray[np.float64]
Kind = Literal["affine", "polynomial"]
TERMS: dict[Kind, int] = {"affine": 3, "polynomial": 6}


@dataclass(frozen=True)
class Estimate:
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} … {self.high:.3g})"


@dataclass(frozen=True)
class Transform:
    """A map of places (y, x), px, fitted to pairs.

    kind : "affine", or "polynomial" of second order
    centre_px, scale_px : places count from here, in these units: u = (place − centre)/scale
    coefficients : (term, 2) of 1, u_y, u_x, and of second order u_y², u_y u_x, u_x²
    spread : (term, term) covariance of the coefficients of an axis, over the variance of a residual
    sd_px : of a residual along an axis; freedom : degrees of freedom that it was estimated from
    """

    kind: Kind
    centre_px: Array
    scale_px: float
    coefficients: Array
    spread: Array
    sd_px: float
    freedom: int

    def __call__(self, positions_px: NDArray[np.floating]) -> Array:
        """Places (…, 2), (y, x), in the other channel."""
        return np.asarray(self._terms(positions_px) @ self.coefficients)

    def sd_at(self, positions_px: NDArray[np.floating]) -> Array:
        """(…,) sd of the mapped places along an axis, from the uncertainty of the transform."""
        terms = self._terms(positions_px)
        return np.asarray(self.sd_px * np.sqrt(np.einsum("...i,ij,...j->...", terms, self.spread, terms)))

    def linear(self) -> Array:
        """(2, 2) derivative at the centre: what a small step (y, x) becomes."""
        return np.asarray(self.coefficients[1:3].T / self.scale_px)

    @property
    def shift_px(self) -> tuple[Estimate, Estimate]:
        """How far the centre is moved, along y and x."""
        at = self.coefficients[0] - self.centre_px
        sd = self.sd_px * float(np.sqrt(self.spread[0, 0]))
        return self._estimate(float(at[0]), sd), self._estimate(float(at[1]), sd)

    @property
    def rotation_deg(self) -> Estimate:
        """By how much it turns at the centre; counter-clockwise in the image, where y points down."""
        return self._of_linear(lambda a: float(np.degrees(np.arctan2(a[1, 0] - a[0, 1], a[0, 0] + a[1, 1]))))

    @property
    def scale(self) -> Estimate:
        """How much larger the other channel shows the same at the centre."""
        return self._of_linear(lambda a: float(np.sqrt(abs(np.linalg.det(a)))))

    def _terms(self, positions_px: NDArray[np.floating]) -> Array:
        u = (np.asarray(positions_px, dtype=float) - self.centre_px) / self.scale_px
        return _design(u, self.kind)

    def _of_linear(self, number: Callable[[Array], float]) -> Estimate:
        """A number of the linear part, its sd by the derivative in each of its four values."""
        linear, step = self.linear(), 1e-6
        slope = np.zeros((2, 2))
        for at in np.ndindex(2, 2):
            moved = linear.copy()
            moved[at] += step
            slope[at] = (number(moved) - number(linear)) / step
        of_axis = self.spread[1:3, 1:3] * (self.sd_px / self.scale_px) ** 2
        return self._estimate(number(linear), float(np.sqrt(np.einsum("ai,ij,aj->", slope, of_axis, slope))))

    def _estimate(self, value: float, sd: float) -> Estimate:
        from scipy.stats import t

        reach = float(t.ppf(0.975, self.freedom)) * sd
        return Estimate(value, value - reach, value + reach)

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in vars(self).items()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Transform:
        """Of plain data; raises `MufasaError` where it is none."""
        try:
            kind: Kind = checks.choice(data["kind"], "kind", get_args(Kind))  # type: ignore[assignment]
            centre = np.array(data["centre_px"], dtype=float).reshape(2)
            coefficients = np.array(data["coefficients"], dtype=float).reshape(TERMS[kind], 2)
            spread = np.array(data["spread"], dtype=float).reshape(TERMS[kind], TERMS[kind])
            scale, sd, freedom = float(data["scale_px"]), float(data["sd_px"]), int(data["freedom"])
        except MufasaError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise MufasaError(f"transform is not one ({error!r}): make it anew with register") from None
        finite = all(np.isfinite(each).all() for each in (centre, coefficients, spread, scale, sd))
        if not finite or scale <= 0 or freedom < 1:
            raise MufasaError("transform has values that cannot be: make it anew with register")
        return cls(kind, centre, scale, coefficients, spread, sd, freedom)


def fit(donor_px: Array, acceptor_px: Array, kind: Kind) -> tuple[Transform, Array]:
    """The transform of least squares of pairs (pair, 2), and how far off (pair, 2) each is when it is left out.

    Needs more pairs than the transform has terms.
    """
    centre = donor_px.mean(axis=0)
    scale = float(max(np.abs(donor_px - centre).max(), 1.0))
    design = _design((donor_px - centre) / scale, kind)
    spread: Array = np.asarray(np.linalg.pinv(design.T @ design), dtype=np.float64)
    coefficients = spread @ design.T @ acceptor_px
    residual = acceptor_px - design @ coefficients
    weight = np.einsum("ni,ij,nj->n", design, spread, design)  # of each pair in its own mapped place
    freedom = 2 * (len(donor_px) - TERMS[kind])
    sd = float(np.sqrt(np.square(residual).sum() / freedom))
    left_out = residual / np.maximum(1 - weight, 1e-9)[:, None]
    return Transform(kind, centre, scale, coefficients, spread, sd, freedom), np.asarray(left_out)


def bends(donor_px: Array, acceptor_px: Array, false_alarm: float) -> bool:
    """Whether pairs show that the map is no affine one: the F test of the three terms of second order on each axis."""
    from scipy.stats import f

    (straight, _), (bent, _) = fit(donor_px, acceptor_px, "affine"), fit(donor_px, acceptor_px, "polynomial")
    left, more = bent.sd_px**2 * bent.freedom, straight.freedom - bent.freedom
    gained = straight.sd_px**2 * straight.freedom - left
    return bool(f.sf(gained / more / max(left / bent.freedom, 1e-30), more, bent.freedom) < false_alarm)


def rms_px(left_out: Array, freedom: int) -> Estimate:
    """Root mean square distance of pairs from where the others say they are, with its 95 % interval.

    The mean square of distances is a scaled χ² whose degrees of freedom follow from their own spread (Satterthwaite),
    no more than the fit has: a few bad pairs widen the interval.
    """
    from scipy.stats import chi2

    square = np.square(left_out).sum(axis=1)
    mean, spread = float(square.mean()), float(square.var(ddof=1) / len(square))
    degrees = min(2 * mean**2 / spread if spread > 0 else freedom, freedom)
    low, high = (mean * degrees / float(chi2.ppf(p, degrees)) for p in (0.975, 0.025))
    return Estimate(float(np.sqrt(mean)), float(np.sqrt(low)), float(np.sqrt(high)))


def _design(u: Array, kind: Kind) -> Array:
    y, x = u[..., 0], u[..., 1]
    columns = [np.ones_like(y), y, x]
    if kind == "polynomial":
        columns += [y * y, y * x, x * x]
    return np.stack(columns, axis=-1)
