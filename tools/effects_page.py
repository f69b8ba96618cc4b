"""docs/effects.md, printed from the catalogue's own words: what each effect is, its parameters, how to tell it apart.

    python tools/effects_page.py > docs/effects.md

`make docs` does that; a test holds the committed page to it.
"""

from __future__ import annotations

from itertools import groupby
from typing import Any

from napari_mufasa.model.effect import REFERENCE, Effect
from napari_mufasa.model.registry import catalogue

HEAD = """\
# Effects: what a model may lack

<!-- Printed by tools/effects_page.py (make docs): change the words in napari_mufasa/effects/, not here. -->

An effect is one physical mechanism. In a [model](model.md) it is data, `{{"kind": …}}` and parameters; on the command
line `--effect KIND:NAME=VALUE,…`. There are {number}; [discovery](discovery.md) searches
them for what a model lacks, but those marked *only when named*.

{contents}

## How to read this page

**Plausible** is the range that discovery searches, for movies of {frames:.0f} frames of {frame_ms:.0f} ms
({movie_s:.0f} s) and a read noise of {noise_adu:.0f} ADU. A note behind it says what the range follows in other movies:
*∝ movie* means that it grows with the length of the movie, *∝ 1/frame* that it shrinks with longer frames. Ranges
marked *log* are searched by the logarithm. The parameter called the **strength** switches the effect off at the value
in its row. Parameters marked with forms matter to those forms only.

**Forms** are functional forms of one mechanism; the first is the default. Some are shared:

| form | meaning |
|---|---|
| `linear`, `saturating`, `accelerating` | the change grows evenly, fast at first, or fast at the end |
| `step` | at once: at `step_at` (share of the movie), within `step_frames`; where it has neither, in the middle |
| `wandering` | by a course over time: read off the movie where one is given, else a random walk |
| `as_seen` | by a map or a course that was read off the movie |

**Shows in** names the first words of the [observables](discovery.md) that the effect moves most. **Rivals** are effects
that look alike in some movies; **told apart by** is the measurement that separates them.

**The pictures** (`python docs/gallery/fingerprints.py`) show what an effect changes in a movie at its default strength:
the observables it moves most, by how many standard deviations of one movie; the light over time; the mean image.

A further effect is one class in a package of its own, registered under the entry-point group `napari_mufasa.effects`
([how](your_effect.md)).
"""

FOLLOWS = {"movie_s": "movie", "frame_s": "frame", "frames": "number of frames", "noise_adu": "read noise"}


def page() -> str:
    """The whole page, of the effects that this package brings."""
    ours = [effect for effect in catalogue().values() if effect.__module__.startswith("napari_mufasa.")]
    stages = [(stage, list(effects)) for stage, effects in groupby(ours, key=lambda effect: effect.stage)]
    rows = ["| stage | effects |", "|---|---|"]
    rows += [f"| [{s}](#{anchor(s)}) | {', '.join(f'[{e.kind}](#{e.kind})' for e in found)} |" for s, found in stages]
    movie: dict[str, Any] = REFERENCE | {"frame_ms": 1000 * REFERENCE["frame_s"]}
    parts = [HEAD.format(number=len(ours), contents="\n".join(rows), **movie)]
    for stage, found in stages:
        parts.append(f"## {stage[0].upper()}{stage[1:]}\n")
        parts += [section(effect) for effect in found]
    return "\n".join(parts)


def section(effect: type[Effect]) -> str:
    """One effect: its words, its parameters, its forms."""
    lines = [
        f"### {effect.kind}\n",
        f"**{effect.title}.** {effect.what_it_is} {effect.what_it_does}\n",
        f"![What {effect.kind} changes](images/effects/{effect.kind}.png)\n",
        "| parameter | unit | default | allowed | plausible | meaning |",
        "|---|---|---|---|---|---|",
        *(parameter_row(effect, name) for name in effect.model_fields if name not in ("form", "start")),
        "",
    ]
    for name in ("form", "start"):
        if choices := choices_of(effect, name):
            lines.append(f"* {name.capitalize()}: {', '.join(f'`{c}`' for c in choices)}")
    lines += [
        f"* Shows in: {', '.join(f'`{prefix}`' for prefix in effect.observables)}",
        f"* Rivals: {', '.join(f'[{kind}](#{kind})' for kind in effect.rivals)}",
        f"* Told apart by: {effect.separated_by}",
        f"* To check: {effect.how_to_check}",
        *([] if effect.common else ["* A diagnosis considers it where the common ones leave a model off its floor"]),
        "",
    ]
    return "\n".join(lines)


def parameter_row(effect: type[Effect], name: str) -> str:
    """A parameter with unit, default, hard limits, plausible range and meaning, as a row of a table."""
    field: Any = effect.model_fields[name]
    extra: dict[str, Any] = field.json_schema_extra or {}
    meaning = field.description or ""
    if name == effect.strength:
        meaning = f"**strength**, off at {effect.null_value:g}: {meaning}"
    if forms := extra.get("forms"):
        meaning += f" ({', '.join(f'`{form}`' for form in forms)})"
    default = f"{field.default:g}" if isinstance(field.default, (int, float)) else "none"
    cells = (f"`{name}`", extra.get("unit", ""), default, allowed(field), plausible(extra), meaning)
    return f"| {' | '.join(cells)} |"


def allowed(field: Any) -> str:
    """The hard limits of a field: "> 0, ≤ 1"."""
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    return ", ".join(
        f"{sign} {getattr(m, at):g}" for m in field.metadata for at, sign in signs.items() if hasattr(m, at)
    )


def plausible(extra: dict[str, Any]) -> str:
    """The range that a search covers, and what it follows: "0.5 … 50, log, ∝ 1/frame"."""
    if "plausible" not in extra:
        return ""
    low, high = extra["plausible"]
    notes = [f"{low:g} … {high:g}"]
    if extra["log"]:
        notes.append("log")
    if follows := extra["follows"]:
        notes.append(f"∝ {'1/' if follows.startswith('/') else ''}{FOLLOWS[follows.removeprefix('/')]}")
    return ", ".join(notes)


def choices_of(effect: type[Effect], name: str) -> tuple[str, ...]:
    """The values of a field that is a choice, the default first; () without such a field."""
    field: Any = effect.model_fields.get(name)
    if field is None:
        return ()
    choices: tuple[str, ...] = field.annotation.__args__
    return (field.default, *(choice for choice in choices if choice != field.default))


def anchor(heading: str) -> str:
    """Where mkdocs puts a heading."""
    return heading.lower().replace(" ", "-")


if __name__ == "__main__":
    print(page(), end="")
