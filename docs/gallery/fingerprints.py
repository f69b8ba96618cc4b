"""The fingerprint of each effect: what it changes in a movie, and by how many standard deviations.

    python docs/gallery/fingerprints.py [--out DIR] [--quick] (pictures of docs/effects.md)

Every effect in its plain form and at its default strength, in a movie of 40 molecules (EMCCD, 64 × 64 pixels, 150
frames) that has none, beside the same movie without it: the same seed, so that all other chance is the same. Bars:
the mean change of an observable over six pairs, in standard deviations of one movie (over 24 movies without any
effect).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from drawing import arguments, save

import napari_mufasa as nm
from napari_mufasa import samples
from napari_mufasa.observe import Observation, observe
from napari_mufasa.report.plots.themes import figure, style

SHOWN = 7
#: Effects that are what was read off a movie show nothing until they are given something.
GIVEN = {
    "background_as_measured": {
        "map": [0.7, 1.0, 1.3, 0.9, 1.5, 0.8, 0.8, 1.1, 0.9], "map_columns": 3, "course": [1.2, 0.8, 0.9, 1.1],
    },
}  # fmt: skip
LONGEST = 36  # letters of a label
SLIGHT = 2.0  # sd of one movie: a bar below is chance for most movies


@dataclass
class Pair:
    """A movie without an effect and with it: their mean images, light courses and observables."""

    image: tuple[np.ndarray, np.ndarray]
    course: tuple[np.ndarray, np.ndarray]
    change: np.ndarray


def main() -> None:
    given = arguments(__doc__, "effects")
    size, frames, pairs, spread = ((40, 40), 40, 1, 4) if given.quick else ((64, 64), 150, 6, 24)
    values = {"acquisition.shape_px": size, "acquisition.n_frames": frames, "sample.n_molecules": 40 * size[0] // 96}
    base = nm.Model.from_dict(samples.BELIEVED).with_values(values)
    plain = [recorded(base, seed) for seed in range(spread)]
    sd = np.nanstd([seen.part("all") for _, seen in plain], axis=0, ddof=1)
    sd = np.where(sd > 1e-9, sd, np.inf)
    ours = {k: e for k, e in nm.catalogue().items() if e.__module__.startswith("napari_mufasa.effects.")}
    for kind, effect in ours.items():
        if not effect.suits(base):
            raise SystemExit(f"{kind} does not suit the movie that the pictures are made of")
        model = base.with_values({"effects": [{"kind": kind, **GIVEN.get(kind, {})}]})
        made = [pair(plain[seed], recorded(model, seed)) for seed in range(pairs)]
        z = np.nanmean([p.change for p in made], axis=0) / sd
        draw(given.out / f"{kind}.png", effect.title, made[0], z, plain[0][1])


def recorded(model: nm.Model, seed: int) -> tuple[np.ndarray, Observation]:
    movie = nm.simulate(model, seed=seed).movie
    return movie, observe(movie, model, nm.simulate_dark(model, 20, seed=seed))


def pair(without: tuple[np.ndarray, Observation], effect: tuple[np.ndarray, Observation]) -> Pair:
    (movie, seen), (changed, now) = without, effect
    return Pair(
        (movie.mean(axis=0), changed.mean(axis=0)),
        (movie.mean(axis=(1, 2)), changed.mean(axis=(1, 2))),
        now.part("all") - seen.part("all"),
    )


def label(seen: Observation, at: int) -> str:
    """The title of an observable; dark frames have some of the same names."""
    name = seen.names[at]
    title = seen.meanings[name].title
    title = f"dark: {title}" if name.startswith("dark") and "dark" not in title else title
    return title if len(title) <= LONGEST else f"{title[: LONGEST - 1]}…"


def draw(path, title: str, first: Pair, z: np.ndarray, seen: Observation) -> None:
    order = [i for i in np.argsort(-np.abs(np.nan_to_num(z))) if abs(np.nan_to_num(z[i])) > SLIGHT][:SHOWN][::-1]
    with style("light") as colours:
        made = figure(8.4, 2.1)
        bars, light, image = made.subplots(1, 3, width_ratios=(1.5, 1.3, 1))
        bars.barh(range(len(order)), z[order], color=[colours.after if z[i] > 0 else colours.before for i in order])
        bars.set_yticks(range(len(order)), [label(seen, i) for i in order])
        bars.axvline(0, color=colours.muted, linewidth=0.8)
        bars.set_xscale("symlog", linthresh=3)
        largest = max([10.0, *(abs(float(z[i])) for i in order)]) * 1.2
        bars.set_xlim(-largest, largest)
        powers = [10**n for n in range(1, int(np.log10(largest)) + 1)]
        powers = [n for n in powers if n in (powers[0], powers[-1])]
        bars.set_xticks(
            [-n for n in powers[::-1]] + [0] + powers,
            [f"−{n}" for n in powers[::-1]] + ["0"] + [str(n) for n in powers],
        )
        bars.minorticks_off()
        bars.set(xlabel="change (sd of one movie)")
        if not order:
            bars.text(0.5, 0.5, f"nothing beyond {SLIGHT:g} sd", ha="center", transform=bars.transAxes)
        light.plot(first.course[0], color=colours.muted, linewidth=0.9, label="without")
        light.plot(first.course[1], color=colours.after, linewidth=0.9, label="with")
        light.set(xlabel="frame", ylabel="mean count (ADU)")
        light.legend(loc="best", fontsize=6.5)
        difference = first.image[1] - first.image[0]
        reach, most = float(np.percentile(np.abs(difference), 99.5)), float(np.abs(difference).max())
        reach = reach if reach > most / 100 else max(most, 1e-6)  # single pixels are all there is to see
        drawn = image.imshow(difference, cmap="PiYG", vmin=-reach, vmax=reach, interpolation="nearest")
        image.set(xticks=[], yticks=[])
        image.set_title("change (ADU)", fontsize=7)
        made.colorbar(drawn, ax=image, shrink=0.85)
        made.suptitle(title, fontsize=9, fontweight="bold", x=0.01, ha="left")
        save(made, path, dpi=80)


if __name__ == "__main__":
    main()
