"""What a batch says: one row per movie, its effects, and what tells the conditions apart (docs/batches.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.batch.run import Result

if TYPE_CHECKING:
    import pandas as pd

ROW = (
    "movie", "condition", "verdict", "effects", "strengths", "error_before", "error_after", "error_floor",
    "error_over_floor", "w1", "w1_fitted", "w1_floor", "w1_over_floor", "molecules", "candidates", "brightness_e",
    "snr", "bleached_share", "diffusion_px2_per_frame", "frames", "height", "width", "folder", "problem", "doubts",
)  # fmt: skip
COMPARED = (
    "error_before", "error_after", "w1", "w1_fitted", "molecules", "brightness_e", "snr", "bleached_share",
    "diffusion_px2_per_frame",
)  # fmt: skip
SURE = 0.05  # chance, over all rows of the table together, that one of them is told to differ where none does
INTERVAL_SD = 1.96  # 95 %
TOLD = ("p_value", "p_adjusted", "differs")  # of each row of `difference_table`, beside its conditions
MOST_WAYS = 20_000  # of dealing movies to conditions, that are looked at


def movie_table(results: Sequence[Result]) -> pd.DataFrame:
    """One row per movie: columns `ROW`, empty ones left out."""
    import pandas as pd

    rows = []
    for result in results:
        told = dict(result.told)
        effects = told.get("effects")
        told["movie"], told["condition"] = result.entry.movie.name, result.entry.condition
        told["folder"], told["problem"] = result.entry.name, result.error
        told["doubts"] = "; ".join(told.get("doubts") or []) or None
        for over, value, floor in (("error", "error_before", "error_floor"), ("w1", "w1", "w1_floor")):
            if told.get(value) is not None and told.get(floor):
                told[f"{over}_over_floor"] = told[value] / told[floor]
        if effects is not None:
            told["effects"] = ", ".join(one["effect"] for one in effects)
            told["strengths"] = "; ".join(filter(None, map(strength_text, effects)))
        rows.append({name: told.get(name) for name in ROW})
    table = pd.DataFrame(rows, columns=list(ROW))
    return table.loc[:, [name for name in ROW if not table[name].isna().all()]]


def strength_text(effect: dict[str, Any]) -> str:
    """Kind and strength of an effect that was found, with its 95 % interval."""
    found = strength_of(effect)
    if found is None:
        return ""
    name, value, low, high = found
    return f"{effect['effect']}: {name} {value:.3g} [{low:.3g}, {high:.3g}]"


def strength_of(effect: dict[str, Any]) -> tuple[str, float, float, float] | None:
    """(parameter, value, 95 % interval) of what says how strong an effect is; None where it was not fitted."""
    from napari_mufasa.effects import effect_class

    name = effect_class(effect["effect"]).strength
    value, sd = effect["parameters"].get(name), effect["sd"].get(name)
    if not isinstance(value, (int, float)) or not isinstance(sd, (int, float)):
        return None
    return name, float(value), float(value - INTERVAL_SD * sd), float(value + INTERVAL_SD * sd)


def effect_table(results: Sequence[Result]) -> pd.DataFrame:
    """One row per movie, effect and number that was fitted: value, sd, 95 % interval, evidence, p value."""
    import pandas as pd

    head = ["movie", "condition", "effect", "parameter", "value", "sd", "low_95", "high_95", "evidence", "p_value"]
    rows = [
        (result.entry.movie.name, result.entry.condition, effect["effect"], name, value, sd,
         value - INTERVAL_SD * sd, value + INTERVAL_SD * sd, effect["evidence"], effect["p_value"])
        for result in results
        for effect in result.told.get("effects") or []
        for name, sd in effect["sd"].items()
        if isinstance(value := effect["parameters"].get(name), (int, float)) and isinstance(sd, (int, float))
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=head)


def condition_table(results: Sequence[Result]) -> pd.DataFrame:
    """One row per condition and effect that was found in any movie: in how many, and its strength over them all.

    The strength is the mean of a random-effects model: movies differ by more than their own uncertainty (DerSimonian
    and Laird, Control. Clin. Trials 7, 177 (1986)); `between_sd` says by how much.
    """
    import pandas as pd

    done = [r for r in results if not r.error and "verdict" in r.told]
    kinds = sorted({one["effect"] for r in done for one in r.told["effects"]})
    rows = []
    for condition in sorted({r.entry.condition for r in done}):
        of = [r for r in done if r.entry.condition == condition]
        for kind in kinds:
            there = [one for r in of for one in r.told["effects"] if one["effect"] == kind]
            fitted = [found for one in there if (found := strength_of(one)) is not None]
            name = fitted[0][0] if fitted else ""
            value, reach, between = pooled(
                [v for _, v, _, _ in fitted], [(high - low) / (2 * INTERVAL_SD) for _, _, low, high in fitted]
            )
            rows.append((condition, kind, len(there), len(of), name, value, value - reach, value + reach, between))
    head = ["condition", "effect", "found_in", "movies", "parameter", "value", "low_95", "high_95", "between_sd"]
    return pd.DataFrame(rows, columns=head)


def pooled(values: Sequence[float], sds: Sequence[float]) -> tuple[float, float, float]:
    """Mean of values with uncertainties, half its 95 % interval, and the sd of what they are of between movies.

    Mean and sd by DerSimonian and Laird. A few movies tell little of how they differ: the interval is that of Student's
    law for how they scatter about the mean (IntHout, Ioannidis and Borm, BMC Med. Res. Methodol. 14, 25 (2014)), and no
    narrower than their own uncertainties make it. Beside values without any (sd 0) only the scatter counts.
    """
    from scipy import stats

    x, variance = np.array(values, dtype=float), np.array(sds, dtype=float) ** 2
    if len(x) == 0:
        return float("nan"), float("nan"), float("nan")
    if not np.all(variance > 0):
        between = float(np.std(x, ddof=1)) if len(x) > 1 else 0.0
        reach = stats.t.ppf(0.975, len(x) - 1) * between / np.sqrt(len(x)) if len(x) > 1 else 0.0
        return float(np.mean(x)), float(reach), between
    w = 1 / variance
    spread = float(np.sum(w * (x - np.sum(w * x) / w.sum()) ** 2))
    between = 0.0
    if len(x) > 1:
        between = max(0.0, (spread - (len(x) - 1)) / (w.sum() - np.sum(w**2) / w.sum()))
    w = 1 / (variance + between)
    mean, reach = float(np.sum(w * x) / w.sum()), INTERVAL_SD * float(w.sum() ** -0.5)
    if len(x) > 1:
        scatter = float(np.sqrt(np.sum(w * (x - mean) ** 2) / (len(x) - 1) / w.sum()))
        reach = max(reach, float(stats.t.ppf(0.975, len(x) - 1)) * scatter)
    return mean, reach, float(np.sqrt(between))


def difference_table(results: Sequence[Result]) -> pd.DataFrame:
    """What tells the conditions apart: one row per number and effect, the surest first; empty with one condition.

    Both by the test of Kruskal and Wallis (of an effect the ranks are those of found and not found), its p value
    counted over the ways to deal the movies to the conditions. Of rows whose movies are too few to differ however they
    were dealt (Tarone, Biometrics 46, 515 (1990)) `p_adjusted` is empty; the p values of all others are multiplied for
    how many they are (Holm), so that all rows together raise a false alarm in 5 % (`SURE`) at most.
    """
    import pandas as pd

    groups: dict[str, list[Result]] = {}
    for result in results:
        if not result.error:
            groups.setdefault(result.entry.condition, []).append(result)
    names = sorted(groups)
    rows: list[tuple[Any, ...]] = []
    if len(names) > 1:
        for name in COMPARED:
            samples = [[r.told[name] for r in groups[c] if r.told.get(name) is not None] for c in names]
            if min(map(len, samples)) < 2 or len({v for sample in samples for v in sample}) < 2:
                continue
            rows.append((name, *(f"{np.median(sample):.4g}" for sample in samples), *rank_p(samples)))
        kinds = sorted({e["effect"] for group in groups.values() for r in group for e in r.told.get("effects") or []})
        for kind in kinds:
            found = [
                [float(kind in [e["effect"] for e in r.told.get("effects") or []]) for r in groups[c]] for c in names
            ]
            rows.append((kind, *(f"in {sum(one):.0f} of {len(one)}" for one in found), *rank_p(found)))
    columns = [f"condition {name}" if name in ("what", *TOLD) else name for name in names]
    table = pd.DataFrame(rows, columns=["what", *columns, "p_value", "least_p"]).sort_values("p_value", kind="stable")
    tested = able_to_tell(table.pop("least_p").to_numpy(dtype=float))
    table["p_adjusted"] = np.nan
    table.loc[tested, "p_adjusted"] = holm(table["p_value"].to_numpy(dtype=float)[tested])
    table["differs"] = table["p_adjusted"] < SURE
    return table.reset_index(drop=True)


def rank_p(samples: Sequence[Sequence[float]]) -> tuple[float, float]:
    """The p value of the test of Kruskal and Wallis, and the least that such samples can have, however they are dealt.

    Counted, as its law of chi2 is that of many: with three in each of two samples it gives 10 % of false alarms as 5 %.
    """
    from scipy.stats import rankdata

    sizes = tuple(map(len, samples))
    ranks = rankdata(np.concatenate([np.asarray(sample, dtype=float) for sample in samples]))
    ranks -= ranks.mean()
    spread = sum(((_dealt(sizes) == i) @ ranks) ** 2 / n for i, n in enumerate(sizes) if n)
    beyond = spread + 1e-9 * max(float(spread.max()), 1.0)
    return float(np.mean(beyond >= spread[0])), float(np.mean(beyond >= spread.max()))


@lru_cache(maxsize=8)
def _dealt(sizes: tuple[int, ...]) -> NDArray[np.int8]:
    """Ways (way, movie) to deal movies to conditions of these sizes, each with the condition's number; the first is
    theirs. All there are, of more than `MOST_WAYS` so many at random, the same each time."""
    own = np.repeat(np.arange(len(sizes), dtype=np.int8), sizes)
    if multinomial(sizes) > MOST_WAYS:
        drawn = np.random.default_rng(0).permuted(np.tile(own, (MOST_WAYS - 1, 1)), axis=1)
        return np.concatenate([own[None], drawn])
    ways = np.zeros((1, len(own)), np.int8)
    for i, n in enumerate(sizes[1:], start=1):
        ways = np.concatenate([_given(way, n, i) for way in ways])
    return ways[np.argsort(np.any(ways != own, axis=1), kind="stable")]


def _given(way: NDArray[np.int8], n: int, number: int) -> NDArray[np.int8]:
    """All ways to give `n` of the zeros of a way this number."""
    chosen = np.array(list(combinations(np.flatnonzero(way == 0), n)), dtype=int).reshape(-1, n)
    ways = np.tile(way, (len(chosen), 1))
    np.put_along_axis(ways, chosen, np.int8(number), axis=1)
    return ways


def multinomial(sizes: Sequence[int]) -> int:
    """In how many ways so many can be dealt to samples of these sizes."""
    return math.factorial(sum(sizes)) // math.prod(map(math.factorial, sizes))


def able_to_tell(least: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Of tests with these least p values, which could be sure beside as many others as there are (Tarone)."""
    for n in range(1, len(least) + 1):
        able = least < SURE / n
        if np.count_nonzero(able) <= n:
            return np.asarray(able)
    return np.zeros(len(least), dtype=bool)


def holm(p_values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sorted p values, each for as many tests as are not surer (Holm, Scand. J. Stat. 6, 65 (1979))."""
    steps = p_values * np.arange(len(p_values), 0, -1)
    return np.asarray(np.minimum(np.maximum.accumulate(steps), 1.0) if len(steps) else steps)


def write_tables(out: Path, results: Sequence[Result], title: str) -> None:
    """summary.csv, effects.csv, conditions.csv, differences.csv and summary.html."""
    from napari_mufasa import files
    from napari_mufasa.report.batch import render

    movies, conditions, apart = movie_table(results), condition_table(results), difference_table(results)
    out.mkdir(parents=True, exist_ok=True)  # it is not there yet where no movie came to its first result
    files.write_table(out / "summary.csv", movies)
    files.write_table(out / "effects.csv", effect_table(results))
    files.write_table(out / "conditions.csv", conditions)
    files.write_table(out / "differences.csv", apart)
    reports = {r.entry.name: f"{r.entry.name}/diagnose/report.html" for r in results if "verdict" in r.told}
    files.write_text(out / "summary.html", render(title, movies, conditions, apart, reports))
