"""The cases of the blind trial: what is hidden in which movie, of which base. All of it follows from the trial's seed.

Groups are interleaved, so that a trial cut short has the same share of each.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from . import generator
from .bases import MOLECULES
from .forms import CAUGHT_UP

Case = dict[str, Any]

PLAN = {
    "single": 130, "faint": 52, "strong": 52, "null": 200, "several": 30, "several_off": 30, "off": 14, "pair": 10,
}  # fmt: skip
SEEDS = 1_000_000  # movies' seeds of one seed of the trial
STRENGTHS = (0.4, 0.6, 0.8)  # "visible": 0.5 is clearly visible by the generator's own scale …
FACTOR = {"single": 1.0, "faint": 0.35, "strong": 2.2}  # … which ends at 1: what would be stronger is 1
CLEAR = 0.5  # each of several at once
BASES = (
    "emccd", "ccd", "cmos", "emccd_dim", "cmos_bright", "emccd_small", "ccd_wide", "cmos_dim", "emccd_wide",
)  # fmt: skip
BLEACHING = ("emccd_bleach", "ccd_bleach", "cmos_bleach")
NEEDS_REGISTER = {"em_excess_noise", "clock_induced_charge"}  # charge of 0.1 e⁻ is lost in the read noise of others
NEEDS_BLEACHING = {"multiple_emitters"}  # else they are a spread of brightness
APART = ({"em_excess_noise", "detector_saturation"}, {"multiple_emitters", "photobleaching"})
OFF = tuple(kind for kind in generator.OFF_CATALOGUE if kind not in CAUGHT_UP)
PAIRS = (
    ("photobleaching", "stage_drift"), ("triplet_blinking", "background_decay"), ("laser_drift", "row_noise"),
    ("illumination_profile", "hot_pixels"), ("focus_drift", "column_offset"), ("molecule_diffusion", "laser_flicker"),
    ("delayed_activation", "image_lag"), ("brightness_heterogeneity", "baseline_drift"),
    ("long_dark_state", "background_gradient"), ("astigmatism", "periodic_modulation"),
)  # fmt: skip


def planned(counts: Mapping[str, int], seed: int = 0, base: str | None = None) -> list[Case]:
    """So many cases of each group, interleaved in proportion; `base`: one for all."""
    placed = [
        ((number + 0.5) / n, i, case(group, number, seed, base))
        for i, (group, n) in enumerate(counts.items())
        for number in range(n)
    ]
    return [one for _, _, one in sorted(placed, key=lambda each: each[:2])]


def case(group: str, number: int, seed: int, base: str | None = None) -> Case:
    """Case `number` of a group, the same whatever else is planned."""
    rng = np.random.default_rng([seed, zlib.crc32(group.encode()), number])
    effects: list[list[Any]] = []
    form, off = None, None
    if group in FACTOR:
        kind, form = _single(group, number, seed)
        effects = [[kind, min(1.0, round(FACTOR[group] * float(rng.choice(STRENGTHS)), 4))]]
    elif group == "pair":
        effects = [[kind, CLEAR] for kind in PAIRS[number % len(PAIRS)]]
    elif group in ("several", "several_off"):
        effects = [[kind, CLEAR] for kind in _several(3 + (number + number // len(BASES)) % 3, rng)]
    if group in ("off", "several_off"):
        off = OFF[number % len(OFF)]
    name = base or _base({kind for kind, _ in effects}, number)
    return {
        "group": group, "number": number, "seed": SEEDS * seed + 100_000 * list(PLAN).index(group) + number,
        "effects": effects, "form": form, "off": off, "base": name, "molecules": MOLECULES[name],
    }  # fmt: skip


def key(one: Mapping[str, Any]) -> str:
    """What makes two cases the same movie; rows are known by it."""
    return json.dumps([one[k] for k in ("group", "seed", "effects", "form", "off", "base", "molecules")])


def trial_seed(one: Mapping[str, Any]) -> int:
    """The seed of the trial that a case is of."""
    return int(one["seed"] // SEEDS)


def _single(group: str, number: int, seed: int) -> tuple[str, int]:
    """Every effect once in each round, in an order of its own; from round to round another of its forms."""
    kinds = list(generator.EFFECTS)
    turn, place = divmod(number, len(kinds))
    kind = kinds[np.random.default_rng([seed, zlib.crc32(group.encode()), turn, 1]).permutation(len(kinds))[place]]
    order = np.random.default_rng([seed, zlib.crc32(f"{group} {kind}".encode())]).permutation(
        len(generator.forms(kind))
    )
    return kind, int(order[turn % len(order)])


def _several(n: int, rng: np.random.Generator) -> Iterable[str]:
    """Effects that are not alike by definition; nor several emitters with a bleaching that their base has already."""
    while True:
        kinds = [str(kind) for kind in rng.choice(list(generator.EFFECTS), n, replace=False)]
        if not any(pair <= set(kinds) for pair in APART):
            return kinds


def _base(kinds: set[str], number: int) -> str:
    """The next base of the round in which these effects leave a trace of their own."""
    bases = BLEACHING if kinds & NEEDS_BLEACHING else BASES
    if kinds & NEEDS_REGISTER:
        bases = tuple(name for name in bases if name.startswith("emccd"))
    return bases[number % len(bases)]
