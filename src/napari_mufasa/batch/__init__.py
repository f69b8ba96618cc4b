"""Many movies at once: what is done to each, and what tells them apart (docs/batches.md)."""

from napari_mufasa.batch.movies import Entry, read_entries
from napari_mufasa.batch.run import Result, run
from napari_mufasa.batch.settings import Settings
from napari_mufasa.batch.steps import STEPS

__all__ = ["STEPS", "Entry", "Result", "Settings", "read_entries", "run"]
