"""One movie, one pair of dark frames and one model for all steps of a viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QObject

from napari_mufasa.widgets.turns.session import session_of, unwrapped

if TYPE_CHECKING:
    from napari.viewer import Viewer


class Shared(QObject):
    """Keeps movie, dark frames and model of a form those of the viewer's session, both ways; lives with the form."""

    def __init__(self, form: Any, viewer: Viewer) -> None:
        super().__init__(form.native)
        self.form = form
        session = self.session = session_of(viewer)
        self._showing = False  # what the session says, not the user
        names = form.asdict()
        self._layers = [form[name] for name in ("movie", "dark", "molecules") if name in names]
        for widget in self._layers:
            widget.viewer = unwrapped(viewer)
            widget.reset_choices()
        events = unwrapped(viewer).layers.events
        for event in (events.inserted, events.removed, events.reordered, events.renamed):
            event.connect(self.reset_choices)
        setters = {"movie": session.set_movie, "dark": session.set_dark, "dark_frames": session.set_dark_frames}
        self._values = {name: form[name] for name in setters if name in names}
        movie = self._values.get("movie")
        if movie is not None and session.movie_layer is None and movie.value is not None:
            session.set_movie(movie.value)
        for name, widget in self._values.items():
            widget.changed.connect(lambda value, setter=setters[name]: None if self._showing else setter(value))
        session.movie_changed.connect(self.refresh)
        self.refresh()
        if "model" in names:
            form["model"].follow(session)

    def refresh(self) -> None:
        session = self.session
        now = {"movie": session.movie_layer, "dark": session.dark_layer, "dark_frames": session.dark_frames}
        self._showing = True
        for name, widget in self._values.items():
            if name != "movie" or now["movie"] is not None:
                widget.value = now[name]
        self._showing = False

    def reset_choices(self, _event: Any = None) -> None:
        try:
            for widget in self._layers:
                widget.reset_choices()
        except RuntimeError:  # the form is gone, the layer list is not
            self._layers = []
