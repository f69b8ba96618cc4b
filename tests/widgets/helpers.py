"""What several tests of the viewer do."""

from __future__ import annotations


class Answers:
    """What a user says when a folder is asked for, and whether files there may be replaced; `asked` holds the
    questions."""

    def __init__(self, monkeypatch, folder):
        from qtpy.QtWidgets import QFileDialog, QMessageBox

        self.asked, self.replace = [], False
        monkeypatch.setattr(QFileDialog, "getExistingDirectory", lambda *_: str(folder))
        monkeypatch.setattr(QMessageBox, "question", self._question)

    def _question(self, parent, title, text, buttons, default):
        from qtpy.QtWidgets import QMessageBox

        self.asked.append(text)
        assert default == QMessageBox.StandardButton.No
        return QMessageBox.StandardButton.Yes if self.replace else default


def add_movie(viewer, *args, **options):
    """A movie as a step would make it, in the viewer."""
    from napari_mufasa.widgets.parts.layers import movie_layer

    return viewer.add_layer(movie_layer(*args, **options))
