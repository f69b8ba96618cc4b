"""What `propose` makes of the real movies beside the project: `python -m benchmarks.real_proposals [--movie NAME]`.

Beside the proposed PSF width stands a fit of its own: Gaussians fitted by least squares to isolated spots of short
averages of frames (photoelectrons, the read-out's kernel undone), one by one, and the median of their widths. In the
yeast cells, which shine themselves, spots are looked for in what a frame has more than the frames before and after it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from scipy import ndimage, optimize

import napari_mufasa as nm
from benchmarks.real_cameras import told
from napari_mufasa.camera.detector import photoelectrons
from napari_mufasa.files.instrument import Instrument

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
HALF_PX = 5
MOST_SPOTS = 300
STARTS = 12  # averages that spots are looked for in
AROUND = range(2, 11)  # frames before and after one that are taken off it
#: file, its dark frames, frames averaged for the fit of the width (None: one, less those around it), what the recording
#: says
MOVIES: dict[str, tuple[str, str | None, int | None, dict[str, Any]]] = {
    "smFRET": ("smfret_ixon_emccd.tif", None, 5, {"em_gain": 300.0, "exposure_s": 0.15, "interval_s": 0.1855}),
    "polymerase": (
        "polymerase_ixon888_emccd.tif", "polymerase_ixon888_dark.tif", 1, {"em_gain": 400.0, "exposure_s": 0.2}
    ),
    "yeast": ("yeast_slimfield_emccd.tif", None, None, {}),
}  # fmt: skip


def images(movie: Any, frames: int | None, camera: Any) -> Iterator[tuple[Any, Any]]:
    """Images to look for spots in, and how much noise each pixel has in relation to others."""
    if frames is not None:
        for start in np.linspace(len(movie) // 3, len(movie) - frames, STARTS).astype(int):
            yield photoelectrons(movie[start : start + frames], camera, int(start)).mean(axis=0, dtype=np.float64), 1.0
        return
    light = photoelectrons(movie, camera).astype(np.float64)
    lit = int(np.argmax(np.diff(light.mean(axis=(1, 2))))) + 1  # the first frames are dark
    for t in range(lit + AROUND.stop, len(light) - AROUND.stop):
        around = light[[t + sign * far for far in AROUND for sign in (-1, 1)]].mean(axis=0)
        noise = np.sqrt(np.maximum(ndimage.gaussian_filter(around, 1.5), 1.0))
        yield light[t] - around * light[t].mean() / around.mean(), noise


def fitted_sigma_px(movie: Any, frames: int | None, camera: Any) -> tuple[float, float, int]:
    """Median width of Gaussians fitted to isolated spots, its standard error, and how many there were."""
    y, x = np.mgrid[-HALF_PX : HALF_PX + 1, -HALF_PX : HALF_PX + 1]

    def shape(_: Any, height: float, cy: float, cx: float, sigma: float, level: float) -> Any:
        return (height * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * sigma**2)) + level).ravel()

    widths: list[float] = []
    for image, relative_noise in images(movie, frames, camera):
        smooth = (ndimage.gaussian_filter(image, 1.0) - ndimage.gaussian_filter(image, 4.0)) / relative_noise
        noise = 1.4826 * np.median(np.abs(smooth - np.median(smooth)))
        peaks = np.argwhere((smooth == ndimage.maximum_filter(smooth, 2 * HALF_PX + 1)) & (smooth > 6 * noise))
        others = np.argwhere((smooth == ndimage.maximum_filter(smooth, 3)) & (smooth > 3 * noise))
        heights = smooth[tuple(others.T)]
        for peak in peaks[: MOST_SPOTS // STARTS]:
            near = (np.abs(others - peak).max(axis=1) <= HALF_PX) & (heights > 0.5 * smooth[tuple(peak)])
            box = tuple(slice(c - HALF_PX, c + HALF_PX + 1) for c in peak)
            cut = image[box]
            if near.sum() > 1 or cut.shape != y.shape:
                continue
            try:
                point, _ = optimize.curve_fit(shape, None, cut.ravel(), (np.ptp(cut), 0, 0, 1.3, np.median(cut)))
            except RuntimeError:
                continue
            if point[0] > 0 and 0.5 < abs(point[3]) < HALF_PX and np.abs(point[1:3]).max() < 1.5:
                widths.append(abs(float(point[3])))
    if not widths:
        return float("nan"), float("nan"), 0
    middle = float(np.median(widths))
    error = 1.2533 * 1.4826 * float(np.median(np.abs(np.array(widths) - middle))) / np.sqrt(len(widths))
    # Pixels add 1/12 to the variance of a recorded spot.
    return float(np.sqrt(middle**2 - 1 / 12)), error, len(widths)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--movie", choices=tuple(MOVIES))
    parser.add_argument("--out", type=Path, help="a folder for the models")
    given = parser.parse_args()
    for name in (given.movie,) if given.movie else MOVIES:
        file, dark_file, frames, written = MOVIES[name]
        movie = tifffile.imread(DATA / file)
        dark = None if dark_file is None else tifffile.imread(DATA / dark_file)
        begun = time.process_time()
        found = nm.propose_model(movie, dark, instrument=Instrument(**written))
        spent = time.process_time() - begun
        print(f"\n{name} ({spent:.0f} s of processor time)")
        for value, measured in found.values.items():
            print(f"  {value:36s} {told(measured)}")
        own, error, spots = fitted_sigma_px(movie, frames, found.model.camera)
        print(f"  {'PSF width by a fit of its own (px)':36s} {own:.4g} ± {error:.2g}, {spots} spots")
        for value, words in found.unknown.items():
            print(f"  unknown: {value}: {words}")
        for note in found.notes:
            print(f"  note: {note}", flush=True)
        if given.out is not None:
            found.model.to_json(given.out / f"{name}.json")


if __name__ == "__main__":
    main()
