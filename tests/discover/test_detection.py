"""The power to see an effect: what it says comes true in movies that it has not seen."""

import numpy as np
import pytest
from scipy import stats
from tests.report_example import power

import napari_mufasa as nm
from napari_mufasa.discover import Investigation
from napari_mufasa.discover.detection import LOOKS, Power, strength_seen
from napari_mufasa.discover.measurement import FRAMES, VOXELS, cropped

KINDS = ["row_noise", "stage_drift", "laser_flicker"]
ROWS = nm.catalogue()["row_noise"]


def small():
    values = {"acquisition.n_frames": 40, "acquisition.shape_px": [48, 48], "sample.n_molecules": 30}
    return nm.preset("FF").with_values(values)


@pytest.fixture(scope="module")
def found():
    return nm.power(small(), ROWS(), [0.0, 6.0, 40.0], movies=40, dark_frames=20, effects=KINDS, seed=3)


def test_nothing_is_seen_by_chance_and_what_is_strong_always(found):
    nothing, _, strong = found
    # 2 % by chance, the law of it fitted to 72 simulations: 7 of 40 or more by chance of 5 % movies is p = 0.003.
    assert nothing.seen < 7
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
        seen += stand.leads["row_noise"][0].gain > stand.needed("row_noise")
    assert 0.1 < middle.share < 0.95  # neither always nor never: what the test is about
    low, high = middle.interval  # four standard errors wide
    error = np.hypot((high - low) / 4, np.sqrt(middle.share * (1 - middle.share) / n))
    assert abs(seen / n - middle.share) < 3 * error  # 0.3 % by chance; `benchmarks.power` does it with more movies


def test_an_effect_is_seen_whichever_way_it_points():
    """A diagnosis reads its direction off the movie, so that the power does not depend on it."""
    gradient, kinds = nm.catalogue()["background_gradient"], ["background_gradient", "row_noise"]
    evidence = []
    for direction in (0.0, 90.0, 225.0):
        added = gradient(relative_height=0.3, direction_deg=direction)
        (found,) = nm.power(small(), added, movies=12, dark_frames=20, effects=kinds, seed=3)
        assert found.seen >= 9  # of 12 with a chance of 0.95 or more: fewer by chance in 0.2 % of all
        evidence.append(found.evidence)
    assert max(evidence) < 2 * min(evidence)


def test_one_look_has_the_interval_of_clopper_and_pearson():
    for seen in (0, 7, 40):
        low, high = power(ROWS(), 40, seen).interval
        assert low <= seen / 40 <= high
        assert stats.binom.sf(seen - 1, 40, low) == pytest.approx(0.025) or seen == 0
        assert stats.binom.cdf(seen, 40, high) == pytest.approx(0.025) or seen == 40


def test_the_interval_knows_that_looks_differ():
    """Where the shares of looks follow a beta law, the interval holds its mean in 95 %."""
    rng = np.random.default_rng(1)
    n, per_look, holds, believed_apart = 1000, 6, 0, 0
    p, correlation = 0.6, 0.3
    shape = (1 - correlation) / correlation
    for _ in range(n):
        seen = rng.binomial(per_look, rng.beta(p * shape, (1 - p) * shape, LOOKS))
        low, high = power(ROWS(), per_look, *seen).interval
        holds += low <= p <= high
        apart = power(ROWS(), per_look * LOOKS, seen.sum()).interval
        believed_apart += apart[0] <= p <= apart[1]
    assert holds > 0.93 * n  # of 95 %, with an sd of .7 %: fewer by chance in 0.2 %
    assert believed_apart < 0.9 * n


def test_looks_that_agree_cost_nothing():
    assert power(ROWS(), 4, *[2] * LOOKS).interval == power(ROWS(), 4 * LOOKS, 2 * LOOKS).interval


def test_what_is_told_of_looks_is_told_of_all_their_movies():
    found = power(ROWS(rms_adu=4.0), 5, 5, 2, 0)
    assert (found.movies, found.seen, found.first) == (15, 7, 7) and found.share == pytest.approx(7 / 15)
    assert (found.evidence, found.needed) == (3.0, 12.0)
    assert found.row()["rms_adu"] == 4.0 and found.row()["first"] == found.share


def test_the_strength_that_is_seen_lies_between_those_tried():
    def at(strength, seen) -> Power:
        return power(ROWS(rms_adu=strength), 10, seen)

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
        ({"strengths": []}, "strengths is empty"),
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
