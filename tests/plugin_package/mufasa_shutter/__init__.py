"""An effect from outside: a shutter that opens slowly, so that the first frames get less light."""

from typing import ClassVar

import numpy as np

from napari_mufasa.effects import Effect, parameter


class SlowShutter(Effect):
    """All that somebody else writes: parameters, what they do, and words."""

    kind: ClassVar[str] = "slow_shutter"
    stage: ClassVar[str] = "illumination"
    strength: ClassVar[str] = "missing"
    title: ClassVar[str] = "Slow shutter"
    what_it_is: ClassVar[str] = "The shutter opens while the camera records already."
    what_it_does: ClassVar[str] = "Molecules and background start dim and reach their level together."
    how_to_check: ClassVar[str] = "Open the shutter a second before the recording."
    observables: ClassVar[tuple[str, ...]] = ("ensemble",)

    missing: float = parameter(
        0.5, ge=0, le=1, plausible=(0.1, 0.9), unit="", description="share of the light missing in the first frame"
    )
    opening_s: float = parameter(
        0.5, gt=0, plausible=(0.1, 2), follows="movie_s", unit="s", log=True, description="time constant of opening"
    )

    def apply(self, scene, rng):
        scene.light = scene.light * (1 - self.missing * np.exp(-scene.time_s / self.opening_s))
