"""Emission, blurred, observed: the four protocols (figures 5 to 8 of the source note).

    python docs/gallery/protocols.py [--out DIR] [--quick] [--as-printed]

100 molecules on a grid in 96 × 96 pixels, seed 1, the frames that the source shows. The presets with the light and
the PSF of the sample movies, so that the eye finds molecules in what the camera says; `--as-printed` takes the
source's tables as they are, whose 20 background photons, read noise and PSF of 1200 nm hide them. Colours go from
the least to the largest value of a column, of counts from the 0.1 % least to the 0.1 % largest.
"""

from __future__ import annotations

import numpy as np
from drawing import arguments, save

import napari_mufasa as nm
from napari_mufasa.report.plots.themes import figure, style

FRAMES = (0, 10, 50, 71, 92)
VISIBLE = {
    "FF": {"excitation.power_density_w_per_cm2": 10, "fluorophore.cycles_before_bleaching": 5e4},
    "STORM": {
        "optics.psf_fwhm_nm": 308, "excitation.power_density_w_per_cm2": 100, "fluorophore.isc_ratio": 1e-4,
        "fluorophore.cycles_before_bleaching": None,
    },
    "PALM": {"optics.psf_fwhm_nm": 308, "excitation.power_density_w_per_cm2": 100},
    "Blinking": {
        "excitation.power_density_w_per_cm2": 10, "fluorophore.isc_ratio": 1e-4,
        "fluorophore.cycles_before_bleaching": 5e4,
    },
}  # fmt: skip


def emission_map(result: nm.Simulation, frame: int) -> np.ndarray:
    """(y, x) photons emitted in a frame, each molecule in its pixel."""
    height, width = result.model.acquisition.shape_px
    made = np.zeros((height, width))
    y, x = np.clip(np.rint(result.positions_px).astype(int), 0, (height - 1, width - 1)).T
    np.add.at(made, (y, x), result.emission[: len(y), frame])
    return made


def main() -> None:
    given = arguments(__doc__, more=["--as-printed"])
    n, size = (16, 40) if given.quick else (100, 96)
    values = {"sample.layout": "grid", "sample.n_molecules": n, "acquisition.shape_px": (size, size)}
    for name, changes in VISIBLE.items():
        model = nm.preset(name).with_values(
            {**values, "acquisition.n_frames": 93} | ({} if given.as_printed else changes)
        )
        result = nm.simulate(model, seed=1)
        columns = {
            "Emission, photons per frame": [emission_map(result, frame) for frame in FRAMES],
            "Blurred, photons per pixel": [result.optical[frame] for frame in FRAMES],
            "Observed by the camera, ADU": [result.movie[frame] for frame in FRAMES],
        }
        with style("light"):
            made = figure(6.6, 9.6)
            axes = made.subplots(len(FRAMES), len(columns))
            for column, (title, images) in enumerate(columns.items()):
                low, high = np.min(images), np.max(images)
                if column == 2:  # single counts far off would take all colours
                    low, high = np.percentile(images, (0.1, 99.9))
                for row, image in enumerate(images):
                    drawn = axes[row, column].imshow(image, vmin=low, vmax=high, interpolation="nearest")
                    axes[row, column].set(xticks=[], yticks=[])
                    if column == 0:
                        axes[row, 0].set_ylabel(f"frame {FRAMES[row]}")
                axes[0, column].set_title(title, fontsize=7)
                made.colorbar(drawn, ax=axes[:, column], location="bottom", shrink=0.9, aspect=30, pad=0.01)
            made.suptitle(f"{name}, {model.camera.type}", fontweight="bold")
            save(made, given.out / f"protocol-{name.lower()}.png", dpi=90)


if __name__ == "__main__":
    main()
