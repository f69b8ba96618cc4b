"""Simulated movies as rows of observables: the only door through which a diagnosis sees a model.

Every row comes from the simulator that users run, through the observation that the measurement went through.
Rows of one seed share all chance that the models share (see `variates`), so that differences are precise.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover.measurement import Measurement
from napari_mufasa.errors import Cancelled
from napari_mufasa.model.model import Model
from napari_mufasa.observe import DarkView, Observation, observe, view_dark
from napari_mufasa.simulate.movie import simulate, simulate_dark

Array = NDArray[np.float64]
WORKERS = max(1, min(4, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1))
CAMERA_STAGE = "camera"


class Bench:
    """Simulates and observes models in the measurement's form; counts, reports progress, can be cancelled."""

    def __init__(
        self,
        measurement: Measurement,
        seed: int,
        progress: Callable[[int, int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
    ) -> None:
        self.measurement = measurement
        self.seed = seed
        self.done = 0
        self.planned = 1
        self._progress, self._cancel = progress, cancel
        self._dark: dict[tuple[str, int], DarkView] = {}
        self._eyes = measurement.model  # the same eyes for all: units and PSF width believed
        self.measured = observe(measurement.movie, self._eyes, measurement.dark)

    @property
    def names(self) -> tuple[str, ...]:
        return self.measured.names

    def plan(self, more: int) -> None:
        """Announce simulations to come, for the progress bar."""
        self.planned = self.done + more

    def rows(self, jobs: Sequence[tuple[Model, int]]) -> Array:
        """(job, part, observable) for (model, seed number) jobs, in order, on all cores."""
        return np.array([o.values for o in self.observations(jobs)]).reshape(len(jobs), *self.measured.values.shape)

    def observations(self, jobs: Sequence[tuple[Model, int]]) -> list[Observation]:
        with ThreadPoolExecutor(WORKERS) as pool:
            pending = [pool.submit(self._one, model, number) for model, number in jobs]
            found = []
            try:
                for future in pending:
                    if self._cancel is not None and self._cancel():
                        raise Cancelled
                    found.append(future.result())
                    self.done += 1
                    if self._progress is not None:
                        self._progress(min(self.done, self.planned), max(self.planned, self.done))
            except BaseException:
                for future in pending:
                    future.cancel()
                raise
        return found

    def _one(self, model: Model, number: int) -> Observation:
        seed = self.seed * 100_003 + number
        movie = simulate(model, seed=seed).movie
        dark = None if self.measurement.dark is None else self._dark_view(model, seed)
        return observe(movie, self._eyes, dark)

    def _dark_view(self, model: Model, seed: int) -> DarkView:
        """Dark frames depend on the camera and its effects only: made once for each."""
        assert self.measurement.dark is not None
        camera_effects = tuple(e for e in model.effects if e.stage == CAMERA_STAGE)
        model = model.model_copy(update={"effects": camera_effects})
        key = (repr((model.camera, camera_effects)), seed)
        if key not in self._dark:
            self._dark[key] = view_dark(simulate_dark(model, len(self.measurement.dark), seed), self._eyes)
        return self._dark[key]


def as_table(names: Sequence[str], values: Array) -> dict[str, float]:
    return dict(zip(names, (float(v) for v in values), strict=True))
