"""The transform's own laws: exact reconstruction, exact adjoint weights."""

from __future__ import annotations

import numpy as np
import pytest

from napari_mufasa.denoise import haar


def _round_trip(image, levels, flat):
    planes, a = [], image
    for level in range(levels):
        a, details = haar.analyse(a, 2**level, flat)
        planes.append(details)
    for level in reversed(range(levels)):
        a = haar.synthesise(a, planes[level], 2**level, flat)
    return a


@pytest.mark.parametrize(("shape", "flat"), [((11, 13), False), ((24, 47), False), ((64, 31), False), ((3, 57), True)])
def test_synthesis_inverts_analysis_for_any_shape(shape, flat):
    image = np.random.default_rng(0).normal(size=shape)
    levels = haar.levels_for(shape[1:] if flat else shape, 5)
    assert levels >= 1
    np.testing.assert_allclose(_round_trip(image, levels, flat), image, atol=1e-12)


def test_details_of_a_constant_are_zero_and_sums_count_pixels():
    s, details = haar.analyse(np.full((9, 12), 3.0), 1, False)
    np.testing.assert_array_equal(details, 0)
    np.testing.assert_array_equal(s, 12.0)


def test_neighbour_means_never_see_the_block_itself():
    # Changing all four pixels of one block must leave its own neighbour mean and energy unchanged, or the risk
    # estimate would be biased.
    rng = np.random.default_rng(1)
    image = rng.poisson(5.0, (20, 20)).astype(np.float64)
    changed = image.copy()
    r, c = 7, 9
    changed[r : r + 4, c : c + 4] += rng.normal(size=(4, 4)) * 10
    before, after = [], []
    for data, out in ((image, before), (changed, after)):
        s1, _ = haar.analyse(data, 1, False)
        s2, d2 = haar.analyse(s1, 2, False)
        out += [haar.mean_beside(s2, 4, False)[r, c], haar.energy_beside(d2, 4, False)[r, c]]
    np.testing.assert_allclose(before, after, rtol=1e-12)
