"""Single-molecule traces from a movie: `extract_traces` (docs/traces.md)."""

from napari_mufasa.camera.frames import with_dark_baseline
from napari_mufasa.traces.extract import TraceSet, extract_traces
from napari_mufasa.traces.options import Options
from napari_mufasa.traces.steps import Steps, find_steps

__all__ = ["Options", "Steps", "TraceSet", "extract_traces", "find_steps", "with_dark_baseline"]
