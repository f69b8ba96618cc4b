"""Estimated over true risk of `pure_let`, with what is known to be chance taken off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from napari_mufasa.denoise import pure_let
from napari_mufasa.denoise.purelet import Method

Array = NDArray[np.float64]


def honest_ratio(x: Array, rng: np.random.Generator, draws: int, method: Method) -> tuple[float, float, float]:
    """Estimated over true risk of Poisson draws of ``x``: the ratio of means, its standard error, one draw's scatter.

    Most of a draw's difference is chance of the data alone. As ``x`` is known, so are averages over the image of e =
    y - x whose mean is exactly zero: e^2 - y; e x; e times the estimate's bias, as the other draws show it; and e times
    the sum of e over the pixels around, near and farther. They are taken off by regression before the mean is read.
    """
    estimates, error, true, data = [], [], [], []
    for _ in range(draws):
        y = rng.poisson(x).astype(float)
        estimate, risk = pure_let(y, method=method, return_risk=True)
        true.append(np.mean((estimate - x) ** 2))
        error.append(risk - true[-1])
        estimates.append(estimate)
        data.append(y)
    total = np.sum(estimates, axis=0, dtype=np.float64)
    chance = []
    for y, estimate in zip(data, estimates, strict=True):
        e, bias = y - x, x - (total - estimate) / (draws - 1)
        around = [np.mean(e * (uniform_filter(e, k, mode="constant") - e / k**2)) for k in (3, 7, 15)]
        chance.append([1.0, np.mean(e * e - y), np.mean(e * x), np.mean(e * bias), *around])
    design, relative = np.array(chance), np.array(error) / np.mean(true)
    fit, *_ = np.linalg.lstsq(design, relative, rcond=None)
    left = relative - design @ fit
    spread = np.sqrt(np.sum(left**2) / (draws - design.shape[1]) * np.linalg.inv(design.T @ design)[0, 0])
    return 1 + float(fit[0]), float(spread), float(relative.std(ddof=1))
