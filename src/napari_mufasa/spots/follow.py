"""What spots do in time: light, displacement and shape of each in each frame.

Apertures follow the common motion, so that drift does not look like molecules going dark. A spot's light is
the least-squares amplitude of the PSF on a local constant, with its derivatives as further terms: their
amplitudes are displacements and changes of width, linear in the data and therefore unbiased.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.frames import Frames
from napari_mufasa.spots.drift import SEEN_PX, between, common_path
from napari_mufasa.spots.evidence import block_means
from napari_mufasa.spots.filters import spot_filter
from napari_mufasa.spots.find import Found, find_spots, isolation_px, neighbour_px
from napari_mufasa.spots.quantiles import quantiles

if TYPE_CHECKING:
    from napari_mufasa.model.setup import Camera

Array = NDArray[np.float64]
MOST_BESIDE = 1.5  # px: farther from its aperture a displacement is not linear in its light
BLOCKS = 10  # time blocks: motion and shape are followed from block to block


@dataclass(frozen=True)
class Spots:
    """What is seen of each spot (molecule) in time.

    positions_px (molecule, 2) at the first block · path_px (block, 2) common motion, zero at the first block
    light (molecule, frame) photoelectrons · isolated, inside (molecule,) no near neighbour; aperture in the field
    displacement_px (molecule, block, 2) own motion relative to the path; nan where the spot is dark
    amplitude (molecule, block) photoelectrons · shape (molecule, block, 3) light times change of width² along y,
    along x, and shear, px² · shape_weight (molecule, block) that light, 0 where the spot is dark
    """

    positions_px: Array
    path_px: Array
    light: Array
    isolated: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    displacement_px: Array
    amplitude: Array
    shape: Array
    shape_weight: Array
    frame_shift: Array  # (frame, molecule, 2) light times displacement, photoelectrons px
    frame_widening: Array  # (molecule, frame) light times change of width², mean of both axes, photoelectrons px²

    def of(self, these: NDArray[np.bool_]) -> Spots:
        """Some of the spots; the common path is that of all."""
        kept = {f.name: getattr(self, f.name) for f in fields(self)} | {"frame_shift": self.frame_shift[:, these]}
        other = {name: v[these] for name, v in kept.items() if name not in ("path_px", "frame_shift")}
        return Spots(**kept | other)

    def common_motion(self) -> Array:
        """Where all spots are in every frame (frame, 2), px: the path of their apertures, and how far beside it."""
        n_frames = self.light.shape[1]
        block_of = block_of_frame(n_frames, len(self.path_px))
        if not self.inside.any():
            return self.path_px[block_of]
        beside = self.frame_shift[:, self.inside].sum(axis=1) / self._together(self.inside)[:, None]
        found: Array = self.path_px[block_of] + np.clip(beside, -MOST_BESIDE, MOST_BESIDE)
        return found

    def common_path(self) -> Array:
        """Where all spots are in every block (block, 2), px, zero at the first: by their own light, so that of some
        spots it is theirs."""
        motion, light = self.common_motion(), self._together(self.inside)
        starts = np.flatnonzero(np.diff(block_of_frame(len(motion), len(self.path_px)), prepend=-1))
        path = np.add.reduceat(motion * light[:, None], starts) / np.add.reduceat(light, starts)[:, None]
        return np.asarray(path - path[0])

    def common_widening(self, these: NDArray[Any]) -> Array:
        """Change of width² that these spots have in common in every frame (frame,), px²."""
        found: Array = self.frame_widening[these].sum(axis=0) / self._together(these)
        return found

    def _together(self, these: NDArray[Any]) -> Array:
        """Light of these spots in every frame, never next to none: few lit must not make jumps from noise."""
        light = self.light[these].sum(axis=0)
        found: Array = np.maximum(light, max(0.25 * float(light.mean()), 1e-6))
        return found


def block_of_frame(n_frames: int, n_blocks: int) -> NDArray[np.int64]:
    """The time block of every frame (frame,)."""
    return np.minimum(np.arange(n_frames) * n_blocks // n_frames, n_blocks - 1)


def find_and_follow(movie: NDArray[np.uint16], camera: Camera, scale: float, sigma_px: float) -> Spots:
    """The spots of a movie (frame, y, x) ADU, found as for traces and followed; `scale` is photoelectrons per ADU.

    The field's motion is undone where it is more than noise: in a field at rest the positions are those that
    `extract_traces` starts from.
    """
    n_frames = len(movie)
    frames = Frames(movie, camera)
    edges = np.linspace(0, n_frames, min(BLOCKS, n_frames) + 1).round().astype(int)
    blocks = block_means(movie, edges)
    path = common_path(spot_filter(frames.flat(blocks), sigma_px))
    moves = np.hypot(*path.T).max() > SEEN_PX
    motion = between(path, (edges[1:] + edges[:-1] - 1) / 2, n_frames) if moves else None
    found = find_spots(frames, sigma_px, drift_px=motion)
    return follow(movie, blocks, camera.baseline_adu, scale, sigma_px, path, found)


def follow(
    movie: NDArray[np.uint16], blocks: NDArray[np.float32], baseline_adu: float, scale: float, sigma_px: float,
    path: Array, found: Found,
) -> Spots:  # fmt: skip
    """Measure every spot found in every frame of a movie; `scale` turns ADU into photoelectrons.

    blocks (block, y, x) : means of the movie's time blocks; path (block, 2) : common motion, zero at the first
    """
    from napari_mufasa.spots.kernels import amplitudes, fit_weights

    n_frames, *shape = movie.shape
    positions = found.positions_px
    if len(positions) == 0:
        return _nothing(path, n_frames, len(blocks))
    half = max(3, int(np.ceil(3 * sigma_px)))
    at = positions[:, None] + path[None]  # (molecule, block, 2)
    corner = np.rint(at).astype(np.int64) - half
    size = 2 * half + 1
    inside = np.all((corner >= 0) & (corner + size <= shape), axis=(1, 2))
    corner = np.clip(corner, 0, [max(n - size, 0) for n in shape])
    # A spot that the path takes out of the field is not `inside`; its weights need only be numbers.
    width = float(np.sqrt(sigma_px**2 + 1 / 12))  # with a pixel's own
    weights = fit_weights(np.clip(at - corner, 0, size - 1), size, width)  # (molecule, block, 6, size, size)
    block_of = block_of_frame(n_frames, len(blocks))
    in_frames = np.concatenate([weights[:, :, :3], weights[:, :, 3:5].mean(axis=2, keepdims=True)], axis=2)
    values = amplitudes(movie, float(baseline_adu), corner, in_frames, block_of) * scale
    patches = _patches((blocks - baseline_adu) * scale, corner, size)
    terms = np.einsum("mbkij,mbij->mbk", weights, patches)
    amplitude = terms[:, :, 0]
    bright = amplitude > 0.4 * quantiles(amplitude, [0.9])[0, :, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = np.where(bright[..., None], terms[:, :, 1:3] / amplitude[..., None], np.nan)
    return Spots(
        positions_px=positions,
        path_px=path,
        light=values[:, :, 0],
        isolated=neighbour_px(positions, found.is_spot) >= isolation_px(sigma_px),
        inside=inside,
        displacement_px=np.clip(moved, -3, 3),
        amplitude=amplitude,
        shape=np.where(bright[..., None], terms[:, :, 3:], 0.0),
        shape_weight=amplitude * bright,
        frame_shift=values[:, :, 1:3].transpose(1, 0, 2),
        frame_widening=values[:, :, 3],
    )


def _nothing(path: Array, n_frames: int, n_blocks: int) -> Spots:
    none = np.zeros(0, dtype=bool)
    return Spots(
        np.zeros((0, 2)), path, np.zeros((0, n_frames)), none, none, np.zeros((0, n_blocks, 2)),
        np.zeros((0, n_blocks)), np.zeros((0, n_blocks, 3)), np.zeros((0, n_blocks)), np.zeros((n_frames, 0, 2)),
        np.zeros((0, n_frames)),
    )  # fmt: skip


def _patches(images: NDArray[np.floating[Any]], corner: NDArray[np.int64], size: int) -> Array:
    offsets = np.arange(size)
    blocks = np.arange(images.shape[0])[None, :, None, None]
    y = corner[..., 0, None, None] + offsets[:, None]
    x = corner[..., 1, None, None] + offsets[None, :]
    return np.asarray(images[blocks, y, x], dtype=np.float64)
