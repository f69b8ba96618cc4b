"""Parts of a movie: which frames, rows and columns of the whole."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

from pydantic import Field, model_validator

from napari_mufasa.model.setup import Acquisition, Values

EXACT = 9  # digits of a share


class Extent(Values):
    """Frames, rows and columns as shares (start, stop) of a movie; beyond 0 and 1 they lie outside of it."""

    frames: tuple[float, float] = Field((0.0, 1.0), description="first and last of its frames")
    rows: tuple[float, float] = Field((0.0, 1.0), description="first and last of its rows")
    columns: tuple[float, float] = Field((0.0, 1.0), description="first and last of its columns")

    @model_validator(mode="after")
    def _starts_before_it_stops(self) -> Self:
        if any(stop <= start for start, stop in self.axes):
            raise ValueError("needs (start, stop) with start < stop along each axis")
        return self

    @classmethod
    def of(cls, slices: Sequence[slice], shape: Sequence[int]) -> Extent:
        """Slices (frames, rows, columns) of a movie of that shape."""
        bounds = [part.indices(n)[:2] for part, n in zip(slices, shape, strict=True)]
        return cls._from([(start / n, stop / n) for (start, stop), n in zip(bounds, shape, strict=True)])

    @classmethod
    def _from(cls, axes: Sequence[tuple[float, float]]) -> Extent:
        frames, rows, columns = ((round(start, EXACT), round(stop, EXACT)) for start, stop in axes)
        return cls(frames=frames, rows=rows, columns=columns)

    @property
    def axes(self) -> tuple[tuple[float, float], ...]:
        return self.frames, self.rows, self.columns

    @property
    def is_whole(self) -> bool:
        return all(axis == (0.0, 1.0) for axis in self.axes)

    def seen_from(self, part: Extent) -> Extent:
        """The same extent as shares of a part of the movie."""
        return self._from(
            [((a - p) / (q - p), (b - p) / (q - p)) for (a, b), (p, q) in zip(self.axes, part.axes, strict=True)]
        )

    def placed_in(self, part: Extent) -> Extent:
        """An extent of a part of the movie as shares of the whole."""
        return self._from(
            [(p + a * (q - p), p + b * (q - p)) for (a, b), (p, q) in zip(self.axes, part.axes, strict=True)]
        )

    def within(self, timing: Acquisition) -> tuple[tuple[float, float], ...]:
        """(start, stop) along frames, rows and columns of a movie, in frames and pixels."""
        shape = (timing.n_frames, *timing.shape_px)
        return tuple((start * n, stop * n) for (start, stop), n in zip(self.axes, shape, strict=True))
