"""Spots: common motion, detection, light and displacement of each in each frame.

Apertures follow the common motion, so that drift does not look like molecules going dark. A spot's light is
the least-squares amplitude of the PSF on a local constant, with its derivatives as further terms: their
amplitudes are displacements and changes of width, linear in the data and therefore unbiased.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Array = NDArray[np.float64]
THRESHOLD = 6.0  # standard deviations of the matched-filter image
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
    significance: Array
    path_px: Array
    light: Array
    isolated: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    displacement_px: Array
    amplitude: Array
    shape: Array
    shape_weight: Array
    frame_shift: Array  # (frame, molecule, 2) light times displacement, photoelectrons px

    def common_motion(self) -> Array:
        """Where all spots are in every frame (frame, 2), px: the path of their apertures, and how far beside it."""
        n_frames = self.light.shape[1]
        block_of = block_of_frame(n_frames, len(self.path_px))
        if not self.inside.any():
            return self.path_px[block_of]
        light = self.light[self.inside].sum(axis=0)
        light = np.maximum(light, max(0.25 * float(light.mean()), 1e-6))  # few lit: no jumps from noise
        beside = self.frame_shift[:, self.inside].sum(axis=1) / light[:, None]
        found: Array = self.path_px[block_of] + np.clip(beside, -MOST_BESIDE, MOST_BESIDE)
        return found


def block_of_frame(n_frames: int, n_blocks: int) -> NDArray[np.int64]:
    """The time block of every frame (frame,)."""
    return np.minimum(np.arange(n_frames) * n_blocks // n_frames, n_blocks - 1)


def find_spots(blocks: NDArray[np.float32], sigma_px: float) -> tuple[Array, Array, Array]:
    """Common path (block, 2), positions (molecule, 2) and their significance, from block means (block, y, x)."""
    filtered = _matched(blocks, sigma_px)
    path = common_path(filtered)
    aligned = np.stack([ndimage.shift(f, -s, order=1, mode="nearest") for f, s in zip(filtered, path, strict=True)])
    noise = np.median(np.abs(np.diff(aligned, axis=0))) / 0.6745 / np.sqrt(2) + 1e-9
    # Bright for the whole movie, for a half, or for one block: whichever shows the spot best.
    n = len(aligned)
    half = n // 2
    scales = [aligned.mean(0) * np.sqrt(n), aligned[:half].mean(0) * np.sqrt(half)]
    scales += [aligned[half:].mean(0) * np.sqrt(n - half), aligned.max(0)]
    evidence = np.max(scales, axis=0) / noise
    top = ndimage.maximum_filter(evidence, size=2 * int(np.ceil(1.5 * sigma_px)) + 1)
    y, x = np.nonzero((evidence == top) & (evidence > THRESHOLD))
    positions = _refine(evidence, y, x)
    return path, positions, evidence[y, x]


def common_path(images: NDArray[np.float32], reach_px: float = 12.0) -> Array:
    """(block, 2) motion of the whole field by cross-correlation of each block with the mean of the ones before."""
    shape = images.shape[1:]
    padded = [fft.next_fast_len(n + int(reach_px)) for n in shape]
    path = np.zeros((len(images), 2))
    reference = fft.rfft2(images[0] - images[0].mean(), padded)
    for b in range(1, len(images)):
        image = fft.rfft2(images[b] - images[b].mean(), padded)
        correlation = np.fft.fftshift(fft.irfft2(image * np.conj(reference), padded))
        cy, cx = (n // 2 for n in padded)
        r = int(reach_px)
        window = correlation[cy - r : cy + r + 1, cx - r : cx + r + 1]
        peak = np.unravel_index(np.argmax(window), window.shape)
        if min(peak) < 1 or max(peak) > 2 * r - 1:
            path[b] = path[b - 1]
            continue
        path[b] = _parabola(window, int(peak[0]), int(peak[1])) - r
        undo = _phase(path[b], padded)
        reference = reference * (b / (b + 1)) + image * undo / (b + 1)
    path -= path[0]
    return path


def follow(
    movie: NDArray[np.uint16], blocks: NDArray[np.float32], baseline_adu: float, scale: float, sigma_px: float,
    path: Array, positions: Array, significance: Array,
) -> Spots:  # fmt: skip
    """Measure every spot in every frame; `scale` turns ADU into photoelectrons."""
    n_frames, height, width = movie.shape
    from napari_mufasa.observe.kernels import amplitudes

    n = len(positions)
    if n == 0:
        return _nothing(path, n_frames, len(blocks))
    half = max(3, int(np.ceil(3 * sigma_px)))
    at = positions[:, None] + path[None]  # (molecule, block, 2)
    corner = np.rint(at).astype(np.int64) - half
    size = 2 * half + 1
    inside = np.all((corner >= 0) & (corner + size <= [height, width]), axis=(1, 2))
    corner = np.clip(corner, 0, [max(height - size, 0), max(width - size, 0)])
    # A spot that the path takes out of the field is not `inside`; its weights need only be numbers.
    weights = _weights(np.clip(at - corner, 0, size - 1), size, sigma_px)  # (molecule, block, 6, size, size)
    block_of = block_of_frame(n_frames, len(blocks))
    values = amplitudes(movie, float(baseline_adu), corner, weights[:, :, :3].copy(), block_of) * scale
    patches = _patches((blocks - baseline_adu) * scale, corner, size)
    terms = np.einsum("mbkij,mbij->mbk", weights, patches)
    amplitude = terms[:, :, 0]
    bright = amplitude > 0.4 * np.quantile(amplitude, 0.9, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = np.where(bright[..., None], terms[:, :, 1:3] / amplitude[..., None], np.nan)
    return Spots(
        positions_px=positions,
        significance=significance,
        path_px=path,
        light=values[:, :, 0],
        isolated=_isolated(positions, 5 * sigma_px),
        inside=inside,
        displacement_px=np.clip(moved, -3, 3),
        amplitude=amplitude,
        shape=np.where(bright[..., None], terms[:, :, 3:], 0.0),
        shape_weight=amplitude * bright,
        frame_shift=values[:, :, 1:3].transpose(1, 0, 2),
    )


def _nothing(path: Array, n_frames: int, n_blocks: int) -> Spots:
    none = np.zeros(0, dtype=bool)
    return Spots(
        np.zeros((0, 2)), np.zeros(0), path, np.zeros((0, n_frames)), none, none, np.zeros((0, n_blocks, 2)),
        np.zeros((0, n_blocks)), np.zeros((0, n_blocks, 3)), np.zeros((0, n_blocks)), np.zeros((n_frames, 0, 2)),
    )  # fmt: skip


def _matched(images: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    narrow = ndimage.gaussian_filter(images, (0, sigma_px, sigma_px), truncate=3)
    wide = ndimage.gaussian_filter(images, (0, 2.5 * sigma_px, 2.5 * sigma_px), truncate=2)
    result: NDArray[np.float32] = narrow - wide
    return result


def _refine(image: NDArray[np.floating[Any]], y: NDArray[np.int64], x: NDArray[np.int64]) -> Array:
    padded = np.pad(image, 1, mode="edge")
    result = np.empty((len(y), 2))
    for i, (r, c) in enumerate(zip(y, x, strict=True)):
        result[i] = _parabola(padded, int(r) + 1, int(c) + 1) - 1
    return result


def _parabola(image: NDArray[np.floating[Any]], r: int, c: int) -> Array:
    """Sub-pixel peak by a parabola along each axis."""

    def vertex(low: float, mid: float, high: float) -> float:
        bend = low - 2 * mid + high
        return 0.0 if bend >= 0 else float(np.clip(0.5 * (low - high) / bend, -0.5, 0.5))

    dy = vertex(image[r - 1, c], image[r, c], image[r + 1, c])
    dx = vertex(image[r, c - 1], image[r, c], image[r, c + 1])
    return np.array([r + dy, c + dx])


def _phase(shift: Array, shape: list[int]) -> NDArray[np.complex128]:
    ky, kx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    result: NDArray[np.complex128] = np.exp(2j * np.pi * (ky * shift[0] + kx * shift[1]))
    return result


def _isolated(positions: Array, distance: float) -> NDArray[np.bool_]:
    from scipy.spatial import KDTree

    if len(positions) < 2:
        return np.ones(len(positions), dtype=bool)
    nearest = KDTree(positions).query(positions, k=2)[0][:, 1]
    result: NDArray[np.bool_] = nearest > distance
    return result


def _weights(centre: Array, size: int, sigma_px: float) -> Array:
    """Rows of the pseudo-inverse for light, its shift (y, x) and its change of σ²/2 (yy, xx) and shear (yx).

    Terms of the Taylor series of a Gaussian spot: G, −∂G, ½∂²G …, plus a constant. The derivatives beyond
    the shift are orthogonalised after the first four, so that light and shift keep their small variance.
    """
    sigma_px = float(np.sqrt(sigma_px**2 + 1 / 12))  # a pixel's own width
    grid = np.arange(size)
    dy: Array = grid - centre[..., 0, None]  # (molecule, block, size)
    dx: Array = grid - centre[..., 1, None]
    gy: Array = np.exp(-(dy**2) / (2 * sigma_px**2)) / (np.sqrt(2 * np.pi) * sigma_px)
    gx: Array = np.exp(-(dx**2) / (2 * sigma_px**2)) / (np.sqrt(2 * np.pi) * sigma_px)
    ty, tx = dy / sigma_px**2, dx / sigma_px**2
    cy, cx = (dy**2 - sigma_px**2) / sigma_px**4, (dx**2 - sigma_px**2) / sigma_px**4

    def outer(a: Array, b: Array) -> Array:
        return a[..., :, None] * b[..., None, :]

    one = np.ones_like(dy)
    few = [outer(gy, gx), outer(gy * ty, gx), outer(gy, gx * tx), outer(one, one)]
    more = [0.5 * outer(gy * cy, gx), 0.5 * outer(gy, gx * cx), outer(gy * ty, gx * tx)]
    design: Array = np.stack([t.reshape(*t.shape[:-2], -1) for t in few + more], axis=-2)  # (…, term, pixel)
    gram = design @ np.swapaxes(design, -1, -2)
    n = len(few)
    small = np.linalg.inv(gram[..., :n, :n])[..., :3, :] @ design[..., :n, :]
    large = np.linalg.inv(gram)[..., n:, :] @ design
    both: Array = np.concatenate([small, large], axis=-2)
    return both.reshape(*both.shape[:-1], size, size)


def _patches(images: NDArray[np.floating[Any]], corner: NDArray[np.int64], size: int) -> Array:
    offsets = np.arange(size)
    blocks = np.arange(images.shape[0])[None, :, None, None]
    y = corner[..., 0, None, None] + offsets[:, None]
    x = corner[..., 1, None, None] + offsets[None, :]
    return np.asarray(images[blocks, y, x], dtype=np.float64)
