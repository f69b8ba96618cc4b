"""Whether the power to see an effect comes true: `python -m benchmarks.power [--movies N] [--only KIND]`.

Movies with an effect that is seen in half to three quarters of them are simulated, and each is matched and looked at
with a neighbourhood of its own, as a diagnosis does. Printed for each effect: the share that `nm.power` says, the share
in which the effect promises more than chance, with 95 % intervals, and their difference with its standard error.
"""

from __future__ import annotations

import argparse

from scipy import stats

import napari_mufasa as nm
from napari_mufasa.discover import Investigation, Power
from napari_mufasa.discover.detection import Look
from napari_mufasa.effects import Effect
from napari_mufasa.model.model import Model

SIZE = {"acquisition.n_frames": 40, "acquisition.shape_px": [48, 48], "sample.n_molecules": 30}
CASES = {"row_noise": 6.0, "laser_flicker": 0.015, "stage_drift": 1.2}  # that half to three quarters of them show
DARK_FRAMES = 20
AT_ONCE = 40  # movies of one run of `power`
FIRST_SEED = 5_000  # of the movies that are looked at one by one: `power` has others


def seen(movie_of: Model, believed: Model, kind: str, seed: int) -> bool:
    """Whether a diagnosis of one movie sees an effect at its first look."""
    movie, dark = nm.simulate(movie_of, seed=seed).movie, nm.simulate_dark(movie_of, DARK_FRAMES, seed)
    stand = Investigation(movie, believed, dark, seed=seed, effects=list(CASES)).stand
    return stand.leads[kind][0].gain > stand.needed(kind)


def predicted(believed: Model, effect: Effect, movies: int) -> Power:
    """The power, told by several runs of it."""
    looks: list[Look] = []
    for seed in range(1, max(movies // AT_ONCE, 1) + 1):
        (found,) = nm.power(
            believed, effect, movies=AT_ONCE, dark_frames=DARK_FRAMES, effects=list(CASES), seed=seed
        )  # fmt: skip
        looks += found.looks
    return Power(effect, tuple(looks))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--movies", type=int, default=200, help="looked at one by one, and by the power")
    parser.add_argument("--only", choices=tuple(CASES))
    given = parser.parse_args()
    believed = nm.preset("FF").with_values(SIZE)
    for kind in (given.only,) if given.only else CASES:
        cls = nm.catalogue()[kind]
        effect = cls(**{cls.strength: CASES[kind]})
        said = predicted(believed, effect, given.movies)
        truth = believed.with_effects(effect)
        n = sum(seen(truth, believed, kind, FIRST_SEED + k) for k in range(given.movies))
        met, limits = n / given.movies, stats.binomtest(n, given.movies).proportion_ci(0.95, "exact")
        low, high = said.interval
        error = ((high - low) ** 2 + (limits.high - limits.low) ** 2) ** 0.5 / (2 * stats.norm.isf(0.025))
        print(
            f"{kind} {CASES[kind]:g}: said {said.share:.3f} [{low:.3f}, {high:.3f}], "
            f"met {met:.3f} [{limits.low:.3f}, {limits.high:.3f}], difference {said.share - met:+.3f} ± {error:.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
