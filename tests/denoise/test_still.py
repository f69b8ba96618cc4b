"""What past and future show: averages as long as nothing changes, cut where something does, never the frame itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_mufasa.denoise import pure_let_movie, still, temporal
from napari_mufasa.denoise.expansion import apply
from napari_mufasa.denoise.noise import Noise
from napari_mufasa.denoise.risk import choose_weights

NOISE = Noise(1.0, np.float32(0.25))


def seen(data, noise=NOISE, most=24):
    sides = still.past_and_future(data, 0, len(data), noise, most)
    return {t: still.shown(data[t], past, future, noise, 1.0) for t, past, future in sides}


def recorded(truth, rng):
    return (rng.poisson(truth) + rng.normal(0, 0.5, truth.shape)).astype(np.float32)


def test_smoothing_keeps_constants_and_leaves_the_stated_share_of_noise():
    np.testing.assert_allclose(still.smooth(np.full((5, 3), 7.0, np.float32)), 7.0, rtol=1e-6)
    np.testing.assert_allclose(still.smooth(np.full((1, 9), 7.0, np.float32)), 7.0, rtol=1e-6)
    white = np.random.default_rng(0).normal(0, 1, (300, 300)).astype(np.float32)
    # Neighbouring values share pixels: about 90 000 / 15 independent ones, a standard error of 2 % in the variance.
    assert still.smooth(white)[3:-3, 3:-3].var() == pytest.approx(still.SHARE, rel=0.08)


def test_where_nothing_changes_the_noise_falls_with_the_number_of_frames():
    rng = np.random.default_rng(1)
    truth = np.full((60, 48, 48), 5.0)
    planes = seen(recorded(truth, rng))
    plane, relative = planes[30]
    error = np.mean((plane - 5.0) ** 2)
    # 24 frames on either side: the walk's weights make at least 30 of them; the stated variance is the true one
    # within 40 % (false resets, counted pixels are alike within a smoothing width).
    assert error < 5.25 / 30
    assert error == pytest.approx(relative * 5.25, rel=0.4)


def test_the_frame_itself_takes_no_part_where_nothing_changes():
    rng = np.random.default_rng(2)
    data = recorded(np.full((40, 32, 32), 20.0), rng)
    other = data.copy()
    other[20] = recorded(np.full((32, 32), 20.0), rng)
    shown = seen(other)[20][0] - seen(data)[20][0]
    changed = other[20] - data[20]
    # Where past and future differ by chance the frame may choose between them; its share is that of no frame: with
    # 1024 pixels of noise 1 and answers below 1/4 the standard error of the share is below 0.01.
    assert abs(np.sum(shown * changed) / np.sum(changed**2)) < 0.04


def test_a_step_is_kept_on_the_frame_it_happens():
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:40, :40]
    spot = 12.0 * np.exp(-((y - 20) ** 2 + (x - 20) ** 2) / (2 * 1.3**2))
    truth = np.full((50, 40, 40), 1.0) + spot
    truth[25:] = 1.0
    planes = [seen(recorded(truth, rng)) for _ in range(12)]
    level = {t: np.mean([p[t][0][20, 20] for p in planes]) for t in (10, 24, 25, 40)}
    # 13 before, 1 after. A plain mean of the neighbours would say 7 in the frames next to the step. Four standard
    # errors of 12 runs of single frames are 4 photoelectrons at most.
    assert level[10] == pytest.approx(13.0, abs=1.0)
    assert level[24] > 9.5
    assert level[25] < 4.5
    assert level[40] == pytest.approx(1.0, abs=0.4)


def test_a_bleaching_molecule_keeps_its_height():
    # Mean height of the denoised step against the truth; 36 molecules, 5 photoelectrons at the peak.
    rng = np.random.default_rng(4)
    side, frames = 84, 60
    y, x = np.mgrid[:side, :side]
    grid = np.arange(7, side, 14)
    bleach = rng.integers(15, frames - 15, grid.size**2)
    truth = np.full((frames, side, side), 0.5)
    centres = [(cy, cx) for cy in grid for cx in grid]
    for (cy, cx), stop in zip(centres, bleach, strict=True):
        truth[:stop] += 5.0 * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * 1.3**2))
    out = pure_let_movie(recorded(truth, rng), 1.0, 0.5)

    def height(stack):
        sums = [stack[:, cy - 2 : cy + 3, cx - 2 : cx + 3].sum(axis=(1, 2)) for cy, cx in centres]
        return np.mean([s[:stop].mean() - s[stop:].mean() for s, stop in zip(sums, bleach, strict=True)])

    # Noise of the mean height: 0.4 %.
    assert height(out) / height(truth) == pytest.approx(1.0, abs=0.04)


def test_short_movies_have_a_past_or_a_future():
    rng = np.random.default_rng(5)
    for n in (2, 3):
        planes = seen(recorded(np.full((n, 16, 16), 4.0), rng))
        assert sorted(planes) == list(range(n))
        assert all(np.isfinite(plane).all() and 0 < relative <= 1 for plane, relative in planes.values())


def moving(rng, frames, side=96, speed=3):
    """A texture that moves by several pixels per frame: neither past nor future shows the frame."""
    texture = gaussian_filter(rng.normal(size=(side, side)), 2.0, mode="wrap")
    texture = 30 * np.exp(0.6 * texture / texture.std())
    return np.stack([np.roll(texture, (speed * t, 2 * speed * t), (0, 1)) for t in range(frames)])


def test_where_everything_moves_the_movie_is_no_worse_than_its_single_frames():
    # The weights' own errors differ between the two by less than half a percent.
    rng = np.random.default_rng(3)
    truth = moving(rng, 16)
    y = rng.standard_gamma(rng.poisson(truth)) + rng.normal(0, 0.3, truth.shape)
    multi, single = (
        np.mean((pure_let_movie(y, 2.0, 0.3, multiplied=True, neighbours=n) - truth) ** 2) for n in (24, 0)
    )
    assert multi < 1.005 * single


def test_the_cost_of_the_choice_between_past_and_future_is_told_without_bias():
    # Blinking blobs, where the choice helps: estimated against true difference of the errors, within four standard
    # errors of 16 frames (6 false alarms in 100 000), and seen to help.
    rng = np.random.default_rng(8)
    y, x = np.mgrid[:72, :72]
    truth = np.full((40, 72, 72), 1.0)
    for k in range(60):
        on = np.cumsum(rng.random(40) < 0.15) % 2
        spot = np.exp(-((y - (17 * k) % 72) ** 2 + (x - (29 * k) % 72) ** 2) / (2 * 1.4**2))
        truth += 15.0 * on[:, None, None] * spot
    data = recorded(truth, rng)
    seen = [sight for t in range(4, 36, 2) for _, sight in temporal.sights(data, t, t + 1, NOISE, 24)]
    weights, *_ = choose_weights([sight.system(3, 1.0) for sight in seen])
    told, true = [], []
    for t, sight in zip(range(4, 36, 2), seen, strict=True):
        told.append(sight.cost_of_trust(weights, 3))
        asked, unasked = (
            np.mean((apply(sight.frame, NOISE, 3, False, weights, sight.guides(trust)) - truth[t]) ** 2)
            for trust in (1.0, 0.0)
        )
        true.append(asked - unasked)
    apart = np.array(told) - np.array(true)
    assert abs(apart.mean()) < 4 * apart.std() / np.sqrt(len(apart))
    assert np.mean(told) < -3 * np.std(told) / np.sqrt(len(told))


def test_a_few_dim_spots_that_stand_still_are_not_taken_for_noise():
    # Peak 5 photons on 20, under the noise of one pixel (sqrt 40); 4 spots in 96 x 96 pixels. Lost of their height: a
    # third, with a spread of 0.09 over draws; without what past and future show beyond their noise it was 0.58 +- 0.05.
    y, x = np.mgrid[:96, :96]
    spots = sum(np.exp(-((y - a) ** 2 + (x - b) ** 2) / 2 / 1.3**2) for a in (24, 72) for b in (24, 72))
    bright, lost = spots > 0.2, []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        photons = rng.poisson(5 * spots + 20, (60, 96, 96))
        electrons = np.where(photons > 0, rng.gamma(np.maximum(photons, 1)), 0) + rng.normal(0, 0.2, photons.shape)
        found = pure_let_movie(electrons, alpha=2.0, sigma=0.2, multiplied=True).mean(axis=0)
        above = found - np.median(found)
        lost.append(1 - (above * spots)[bright].sum() / (5 * spots**2)[bright].sum())
    assert np.mean(lost) < 0.46  # three standard errors of the mean of five beyond a third
