"""What is done to every movie of a batch."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from napari_mufasa.denoise.pipeline import Method


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is done to every movie: `steps` in order (see `steps.STEPS`), and their options."""

    steps: tuple[str, ...]
    seed: int = 1
    effects: tuple[str, ...] | None = None
    budget: int | None = None
    follow_drift: bool = False
    follow_molecules: bool = False
    method: Method = "pure-let-movie"

    def of(self, step: str) -> dict[str, Any]:
        """The options that this step depends on."""
        names = {
            "denoise": ("method",), "traces": ("follow_drift", "follow_molecules"), "compare": ("follow_drift", "seed"),
            "diagnose": ("seed", "effects", "budget"),
        }[step]  # fmt: skip
        return {name: value for name, value in asdict(self).items() if name in names}

    @property
    def without_use(self) -> list[str]:
        """Options that were changed though no step depends on them; a seed says nothing of what is wanted."""
        used = {"steps", "seed"}.union(*(self.of(step) for step in self.steps))
        return [f.name for f in fields(self) if f.name not in used and getattr(self, f.name) != f.default]
