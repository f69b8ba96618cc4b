"""Simulations as rows of observables: the only door through which a diagnosis sees a measurement and a model.

Every row comes from the simulator that users run, through the observation that the measurement went through.
Rows of one seed share all chance that the models share (see `variates`), so that differences are precise. There is
one bench for movies (`movie_bench`) and one for tables of traces (`trace_bench`); nothing else of a diagnosis knows
which of them it works with.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.cluster import in_order
from napari_mufasa.discover.metric import spread_floor
from napari_mufasa.discover.nuisance import Nuisance
from napari_mufasa.discover.result import Curve
from napari_mufasa.model.model import Model
from napari_mufasa.observe.table import Meaning

if TYPE_CHECKING:
    from distributed import Client

Array = NDArray[np.float64]
WORKERS = max(1, min(4, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1))


class Observed(Protocol):
    """Observables of one measurement or simulation: (part, observable) values in a fixed order."""

    @property
    def values(self) -> Array: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def meanings(self) -> dict[str, Meaning]: ...


Seen = TypeVar("Seen", bound=Observed)
Done = TypeVar("Done")
Job = tuple[Model, int]  # a model and the seed of its simulation


class Bench(ABC, Generic[Seen]):
    """Has models simulated and observed in the measurement's form, on all cores or on a cluster; counts, reports
    progress, can be cancelled.

    start : the model believed, in the measurement's form · measured : what the measurement shows
    x (part, observable) : its numbers, 0 where it shows none · notes : choices made, for the reader
    matching_simulations : how many simulations `matched` makes · is_cheap : whether simulations and matching take so
    little time that every effect tried has the values of the model matched beside it
    shows_camera : whether pixels of the background are seen, which tell what the camera makes of light
    read_last : kinds of effects that are begun after others, for what is read off of them is what others leave
    gaps : observables that some simulation beside the base model did not show (see `Library.simulated`)
    """

    matching_simulations: int
    is_cheap = False
    shows_camera = False
    read_last: frozenset[str] = frozenset()

    def __init__(
        self,
        start: Model,
        measured: Seen,
        seed: int,
        notes: Sequence[str] = (),
        progress: Callable[[int, int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
        client: Client | None = None,
    ) -> None:
        self.start, self.measured, self.seed, self.notes = start, measured, seed, tuple(notes)
        self.x: Array = np.where(np.isfinite(measured.values), measured.values, 0.0)
        self.gaps: set[str] = set()
        self.done = 0
        self.planned = 1
        self._progress, self._cancel, self._client = progress, cancel, client

    # What depends on the kind of measurement ----------------------------------------------------------------

    @property
    @abstractmethod
    def simulated(self) -> Callable[[Job], Seen]:
        """What a simulation of a model shows, through the same eyes as the measurement. It holds no more than it needs,
        because workers elsewhere get it, too."""

    @abstractmethod
    def free_values(self, model: Model) -> list[Nuisance]:
        """The values of the model that are fitted beside every effect."""

    @abstractmethod
    def matched(self, model: Model) -> Model:
        """The model with its free values brought near the measurement by a few of its numbers."""

    @abstractmethod
    def read_off(self, kind: str, beside: Model | None = None, part: str = "all") -> dict[str, Any]:
        """Parameters of an effect that a part of the measurement shows directly, by name; some of them are what it
        shows beyond the model that the effect is `beside` (None: beyond the one believed)."""

    @abstractmethod
    def curves(self, before: Sequence[Seen], after: Sequence[Seen]) -> list[Curve]:
        """What to draw: the measurement, a few simulations of the base and of the completed model."""

    @abstractmethod
    def w1(self, before: Sequence[Seen], after: Sequence[Seen]) -> dict[str, Any]:
        """W1 of traces, as `Report.w1` has it; nothing for movies, which `compare` compares."""

    @abstractmethod
    def restored(self, model: Model, believed: Model) -> Model:
        """The model in the form of the one believed, ready for its user."""

    # What does not ------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        return self.measured.names

    @property
    def size(self) -> int:
        """Pixels times frames of a simulation."""
        timing = self.start.acquisition
        return timing.n_frames * int(np.prod(timing.shape_px))

    def least_spread(self) -> Array:
        """(observable,) the least standard deviation that each is credited with."""
        return spread_floor(self.names)

    def plan(self, more: int) -> None:
        """Announce simulations to come, for the progress bar."""
        self.planned = self.done + more

    def rows(self, jobs: Sequence[tuple[Model, int]]) -> Array:
        """(job, part, observable) for (model, seed number) jobs, in order; NaN where a simulation does not show an
        observable."""
        values = list(self._each(Values(self.simulated), jobs))
        return np.array(values).reshape(len(jobs), *self.measured.values.shape)

    def observations(self, jobs: Sequence[tuple[Model, int]]) -> list[Seen]:
        return list(self._each(self.simulated, jobs))

    def _each(self, work: Callable[[Job], Done], jobs: Sequence[tuple[Model, int]]) -> Iterator[Done]:
        seeded = [(model, self.seed * 100_003 + number) for model, number in jobs]
        for found in in_order(work, seeded, client=self._client, workers=WORKERS, cancel=self._cancel):
            self.done += 1
            if self._progress is not None:
                self._progress(min(self.done, self.planned), max(self.planned, self.done))
            yield found


@dataclass(frozen=True)
class Values:
    """The numbers alone of what simulations show: much less to send."""

    simulated: Callable[[Job], Observed]

    def __call__(self, job: Job) -> Array:
        return self.simulated(job).values


def as_table(names: Sequence[str], values: Array) -> dict[str, float]:
    return dict(zip(names, (float(v) for v in values), strict=True))
