"""The power to see an effect: what it says comes true in movies that it has not seen."""

import numpy as np
import pytest
from scipy import stats

import napari_mufasa as nm
from napari_mufasa.discover import Investigation
from napari_mufasa.discover.detection import Power, strength_seen
from napari_mufasa.discover.measurement import FRAMES, VOXELS, cropped

KINDS = ["row_noise", "stage_drift", "laser_flicker"]
ROWS = nm.catalogue()["row_noise"]


def small():
    values = {"acquisition.n_frames": 40, "acquisition.shape_px": [48, 48], "sample.n_molecules": 30}
    return nm.preset("FF").with_values(values)


@pytest.fixture(scope="module")
def found():
    return nm.power(small(), ROWS(), [0.0, 6.0, 40.0], movies=60, dark_frames=20, effects=KINDS, seed=3)


def test_nothing_is_seen_by_chance_and_what_is_strong_always(found):
    nothing, _, strong = found
    # 2 % by chance, the law of it fitted to 72 simulations: 8 of 60 or more by chance of 5 % movies is p = 0.01.
    assert nothing.seen < 8
    assert strong.share == 1 and strong.first == strong.movies
    assert nothing.evidence < found[1].evidence < strong.evidence


def test_the_power_comes_true_in_movies_looked_at_one_by_one(found):
    """Each of other movies with the effect is matched and looked at anew, as a diagnosis does."""
    _, middle, _ = found
    truth = small().with_effects(middle.effect)
    n = 20
    seen = 0
    for seed in range(n):
        movie, dark = nm.simulate(truth, seed=100 + seed).movie, nm.simulate_dark(truth, 20, 100 + seed)
        stand = Investigation(movie, small(), dark, seed=100 + seed, effects=KINDS).stand
        seen += stand.leads["row_noise"][0].gain > stand.needed
    assert 0.1 < middle.share < 0.95  # neither always nor never: what the test is about
    table = [[seen, n - seen], [middle.seen, middle.movies - middle.seen]]
    assert stats.fisher_exact(table).pvalue > 0.002


def test_an_effect_is_seen_whichever_way_it_points():
    """A diagnosis reads its direction off the movie, so that the power does not depend on it."""
    gradient, kinds = nm.catalogue()["background_gradient"], ["background_gradient", "row_noise"]
    evidence = []
    for direction in (0.0, 90.0, 180.0, 270.0):
        added = gradient(relative_height=0.3, direction_deg=direction)
        (found,) = nm.power(small(), added, movies=12, dark_frames=20, effects=kinds, seed=3)
        assert found.seen >= 9  # of 12 with a chance of 0.95 or more: fewer by chance in 0.2 % of all
        evidence.append(found.evidence)
    assert max(evidence) < 2 * min(evidence)


def test_the_interval_holds_the_share():
    for seen in (0, 7, 40):
        low, high = Power(ROWS(), 40, seen, 0, 1.0, 10.0).interval
        assert low <= seen / 40 <= high
        assert stats.binom.sf(seen - 1, 40, low) == pytest.approx(0.025) or seen == 0
        assert stats.binom.cdf(seen, 40, high) == pytest.approx(0.025) or seen == 40


def test_the_strength_that_is_seen_lies_between_those_tried():
    def at(strength, seen):
        return Power(ROWS(rms_adu=strength), 10, seen, seen, 1.0, 10.0)

    assert strength_seen([at(4.0, 10), at(1.0, 8)]) == pytest.approx(2.0)  # half of the way, in the logarithm
    assert strength_seen([at(0.0, 8), at(1.0, 10)]) == pytest.approx(0.5)
    assert strength_seen([at(1.0, 9), at(2.0, 10)]) == 1.0
    assert strength_seen([at(1.0, 2), at(2.0, 5)]) is None


def test_of_a_large_movie_the_part_that_a_diagnosis_looks_at_is_simulated():
    values = {"acquisition.n_frames": 2000, "acquisition.shape_px": [512, 512], "sample.n_molecules": 2000}
    part = cropped(nm.preset("FF").with_values(values))
    timing = part.acquisition
    assert timing.n_frames == FRAMES and timing.n_frames * np.prod(timing.shape_px) <= VOXELS
    assert part.sample.n_molecules / np.prod(timing.shape_px) == pytest.approx(2000 / 512**2, rel=0.01)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"effect": "row_noise"}, "effect is a str"),
        ({"strengths": [-1.0]}, "row_noise.rms_adu = -1"),
        ({"strengths": [np.nan]}, "row_noise.rms_adu"),
        ({"movies": 1}, "movies"),
        ({"dark_frames": -1}, "dark_frames"),
        ({"effects": ["stage_drift"]}, "not among the effects considered"),
        ({"model": small().with_effects(ROWS())}, "in the model already"),
        ({"model": None}, "model is a NoneType"),
    ],
)
def test_what_cannot_be_asked_is_said(changes, said):
    given = {"model": small(), "effect": ROWS()} | changes
    with pytest.raises(nm.MufasaError, match=said):
        nm.power(**given)
