"""Movies with a hidden effect, from physics written down a second time.

Nothing here comes from the package: another way to follow the molecules (event lists on a dose axis), another
way to draw spots (photons one by one), another camera. What the diagnosis may see is ``movie``, ``dark`` and
``believed``; ``truth`` is sealed.

    python -m tests.blind.generator --effect stage_drift --strength 0.5 --seed 3 --out DIR
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import photophysics, rendering
from .bases import BASE_NAMES, Believed, base_model
from .camera import record
from .effects_camera import CAMERA
from .effects_light import LIGHT
from .effects_sample import SAMPLE
from .off_catalogue import OFF_CATALOGUE
from .world import World, build

__all__ = [
    "BASE_NAMES",
    "EFFECTS",
    "OFF_CATALOGUE",
    "BlindMovie",
    "base_model",
    "forms",
    "make",
    "off_catalogue",
    "suitable_base",
]

EFFECTS = {**SAMPLE, **LIGHT, **CAMERA}
N_DARK = 100


@dataclass
class BlindMovie:
    """One hidden case.

    movie : uint16 (frame, y, x); dark : uint16 (100, y, x), recorded just before, without light;
    believed : the model.json of the user; truth : what was hidden, JSON-serialisable.
    """

    movie: np.ndarray
    dark: np.ndarray
    believed: Believed
    truth: dict[str, Any]


def forms(effect: str) -> tuple[str, ...]:
    """Names of the functional forms of an effect."""
    return EFFECTS[effect][1]


def suitable_base(effect: str) -> str:
    """The base in which this effect leaves a trace of its own (several emitters: only with bleaching)."""
    if effect not in EFFECTS and effect not in OFF_CATALOGUE:
        raise ValueError(f"effect {effect!r} unknown; choose one of {', '.join([*EFFECTS, *OFF_CATALOGUE])}")
    return "emccd_bleach" if effect == "multiple_emitters" else "emccd"


def _stream(seed: int, name: str) -> np.random.Generator:
    """A random stream of its own for every stage, so that one stage never moves another."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def _plain(parameters: dict[str, Any]) -> dict[str, Any]:
    """NumPy scalars as Python numbers, so that the truth can be written as JSON."""
    return {k: v.item() if isinstance(v, np.generic) else v for k, v in parameters.items()}


def _mislead(world: World, nuisance: float, rng: np.random.Generator) -> dict[str, float]:
    """Make the world differ from the belief in the values that every experiment gets slightly wrong."""
    brightness, background, width = 1.0 + nuisance * rng.uniform(-1, 1, 3)
    baseline_adu = 4.0 * nuisance / 0.12 * rng.uniform(-1, 1)
    world.photons_per_s *= brightness
    world.background_photons *= background
    world.sigma_px *= width
    world.camera.baseline_adu += baseline_adu
    return {
        "brightness_factor": float(brightness),
        "background_factor": float(background),
        "psf_width_factor": float(width),
        "baseline_shift_adu": float(baseline_adu),
    }


def _run(world: World, seed: int) -> tuple[np.ndarray, np.ndarray]:
    mean_photons = photophysics.expected_photons(world, _stream(seed, "fates"))
    spots_e = rendering.spot_electrons(world, mean_photons, _stream(seed, "photons"))
    drift = world.camera.drift_adu
    stacks = []
    for name, mean_e, spots, n, course in (
        ("movie", rendering.background_mean_e(world), spots_e, world.n_frames, slice(world.n_dark, None)),
        ("dark", None, None, world.n_dark, slice(0, world.n_dark)),
    ):
        shape = (n, *world.shape_px)
        part = None if drift is None else drift[course]
        stack = record(mean_e, spots, shape, world.camera, _stream(seed, name), part)
        for change in world.after:
            stack = change(stack, _stream(seed, name + " after"))
        stacks.append(stack)
    return stacks[0], stacks[1]


def _start(believed: Believed, seed: int, nuisance: float, n_molecules: int) -> tuple[World, dict[str, Any]]:
    if believed.get("effects"):
        raise ValueError("the believed model must come without effects; hidden ones are given to make()")
    world = build(believed, n_molecules, N_DARK, _stream(seed, "positions"))
    truth: dict[str, Any] = {
        "seed": seed,
        "nuisance": _mislead(world, nuisance, _stream(seed, "nuisance")),
        "n_molecules": n_molecules,
        "positions_px": world.positions_px.tolist(),
        "effects": [],
        "off_catalogue": [],
    }
    return world, truth


def _finish(world: World, truth: dict[str, Any], believed: Believed, seed: int) -> BlindMovie:
    truth["true_values"] = {
        "photons_per_s_per_molecule": world.photons_per_s,
        "background_photons_per_px": world.background_photons,
        "psf_sigma_px": world.sigma_px,
        "baseline_adu": world.camera.baseline_adu,
    }
    movie, dark = _run(world, seed)
    return BlindMovie(movie, dark, copy.deepcopy(believed), truth)


def make(
    believed: Believed,
    *,
    effects: Sequence[tuple[str, float]] = (),
    seed: int,
    nuisance: float = 0.12,
    n_molecules: int = 50,
    form: int | None = None,
    beside: Sequence[tuple[str, float]] = (),
) -> BlindMovie:
    """Record a movie in a world that has, beyond the believed model, the given effects.

    ``effects`` are (identifier, strength in [0, 1]); 0.15 is barely visible, 0.5 clearly. ``form`` chooses
    the functional form (index into ``forms(effect)``, same for all effects); None draws it from the seed.
    ``nuisance`` is the largest relative error of brightness, background and PSF width in the belief
    (0.12 also lets the baseline be 4 ADU off). ``beside``: disturbances off the catalogue, as for
    ``off_catalogue``, and their strengths.
    """
    world, truth = _start(believed, seed, nuisance, n_molecules)
    for kind, strength in effects:
        if kind not in EFFECTS:
            raise ValueError(f"effect {kind!r} unknown; choose one of {', '.join(EFFECTS)}")
        if not 0.0 <= strength <= 1.0:
            raise ValueError(f"strength of {kind} is {strength}; it must lie in [0, 1]")
        apply, names = EFFECTS[kind]
        rng = _stream(seed, kind)
        drawn = int(rng.integers(len(names)))
        chosen = drawn if form is None else form
        if not 0 <= chosen < len(names):
            raise ValueError(f"form {chosen} of {kind} unknown; it has {len(names)}: {', '.join(names)}")
        parameters = _plain(apply(world, float(strength), chosen, rng))
        truth["effects"].append(
            {
                "kind": kind,
                "strength": float(strength),
                "form": names[chosen],
                "form_index": chosen,
                "parameters": parameters,
            }
        )
    for kind, strength in beside:
        _disturb(world, truth, kind, strength, seed)
    return _finish(world, truth, believed, seed)


def _disturb(world: World, truth: dict[str, Any], kind: str, strength: float, seed: int) -> None:
    if kind not in OFF_CATALOGUE:
        raise ValueError(f"disturbance {kind!r} unknown; choose one of {', '.join(OFF_CATALOGUE)}")
    if not 0.0 <= strength <= 1.0:
        raise ValueError(f"strength of {kind} is {strength}; it must lie in [0, 1]")
    parameters = _plain(OFF_CATALOGUE[kind](world, strength, _stream(seed, kind)))
    truth["off_catalogue"].append({"kind": kind, "strength": strength, "parameters": parameters})


def off_catalogue(
    believed: Believed,
    kind: str,
    seed: int,
    *,
    strength: float = 0.5,
    nuisance: float = 0.12,
    n_molecules: int = 50,
) -> BlindMovie:
    """Record a movie with a disturbance that no catalogue effect describes."""
    return make(believed, beside=[(kind, strength)], seed=seed, nuisance=nuisance, n_molecules=n_molecules)


def main(argv: Sequence[str] | None = None) -> int:
    import tifffile

    parser = argparse.ArgumentParser(description="Record a movie with a hidden effect.")
    parser.add_argument("--effect", action="append", default=[], help="identifier; may be repeated; none: null case")
    parser.add_argument("--strength", action="append", type=float, default=[], help="one per effect (default 0.5)")
    parser.add_argument("--form", type=int, help="index of the functional form; default: drawn from the seed")
    parser.add_argument("--base", choices=BASE_NAMES, help="believed model; default: the one that suits the effect")
    parser.add_argument("--model", type=Path, help="believed model.json instead of --base")
    parser.add_argument("--nuisance", type=float, default=0.12)
    parser.add_argument("--n-molecules", type=int, default=50)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True, help="movie.tif, dark.tif, model.json go here")
    parser.add_argument("--truth", type=Path, help="sealed file; default: OUT-truth/truth.json, outside OUT")
    args = parser.parse_args(argv)
    strengths = [*args.strength, *[0.5] * (len(args.effect) - len(args.strength))]
    try:
        if args.model is not None:
            believed = json.loads(args.model.read_text())
        else:
            bases = {suitable_base(kind) for kind in args.effect} or {"emccd"}
            # where one effect needs bleaching, bleaching is in the base for all
            believed = base_model(args.base or ("emccd_bleach" if "emccd_bleach" in bases else "emccd"))
        common = {"seed": args.seed, "nuisance": args.nuisance, "n_molecules": args.n_molecules}
        if len(args.effect) == 1 and args.effect[0] in OFF_CATALOGUE:
            case = off_catalogue(believed, args.effect[0], strength=strengths[0], **common)
        else:
            pairs = list(zip(args.effect, strengths, strict=False))
            case = make(believed, effects=pairs, form=args.form, **common)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    truth_path = args.truth or args.out.with_name(args.out.name + "-truth") / "truth.json"
    args.out.mkdir(parents=True, exist_ok=True)
    truth_path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(args.out / "movie.tif", case.movie, photometric="minisblack")
    tifffile.imwrite(args.out / "dark.tif", case.dark, photometric="minisblack")
    (args.out / "model.json").write_text(json.dumps(case.believed, indent=1) + "\n")
    truth_path.write_text(json.dumps(case.truth, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
