"""What several tests of the viewer do."""

from __future__ import annotations


def add_movie(viewer, *args, **options):
    """A movie as a step would make it, in the viewer."""
    from napari_mufasa.widgets.parts.layers import movie_layer

    return viewer.add_layer(movie_layer(*args, **options))
