"""Power: how likely a diagnosis sees an effect, before the movie is taken; in step Design."""

from typing import Annotated, Any

import pandas as pd
from magicgui import magic_factory

from napari_mufasa.effects import catalogue
from napari_mufasa.widgets.parts.edits import TypedEdit
from napari_mufasa.widgets.parts.forms import begin
from napari_mufasa.widgets.parts.parameters import AnyMovie, Believed, Seed
from napari_mufasa.widgets.turns.session import believed
from napari_mufasa.widgets.turns.steering import steering

EFFECTS = [(effect.title or kind, kind) for kind, effect in catalogue().items()]
STRENGTHS: dict[str, Any] = {"widget_type": TypedEdit, "of": tuple[float, ...], "empty": "as in the catalogue"}


def power(
    movie: AnyMovie = None,
    model: Believed = None,
    effect: Annotated[str, {"widget_type": "ComboBox", "label": "Effect", "choices": EFFECTS}] = "stage_drift",
    strengths: Annotated[tuple[float, ...], STRENGTHS | {"label": "Strengths"}] = (),
    movies: Annotated[int, {"label": "Movies of each", "min": 2, "max": 10_000}] = 40,
    recorded_dark: Annotated[int, {"label": "Dark frames", "min": 0, "max": 10_000}] = 50,
    seed: Seed = 1,
) -> pd.DataFrame:
    """Simulate movies with an effect, and count in how many of them a diagnosis would see it.

    Without a model: the one in the movie's metadata.

    Parameters:
        effect: What may be hidden in the movie, in its plain form
        strengths: Of the effect, e.g. 0.2, 0.5, 1
        movies: Simulated with each strength
        recorded_dark: Dark frames, recorded beside the movie

    Returns:
        The table, a row for each strength: power with its 95 % interval, and how often it promises most of all.
    """
    from napari_mufasa.discover.detection import power as asked

    progress, cancel = steering()
    found = asked(
        believed(model, movie), catalogue()[effect](), strengths or None, movies=movies, dark_frames=recorded_dark,
        seed=seed, progress=progress, cancel=cancel,
    )  # fmt: skip
    return pd.DataFrame([one.row() for one in found])


power_widget = magic_factory(power, call_button="How often is it seen?", widget_init=begin)
