"""From emitted photons to the optical image."""

from napari_mufasa.optics.psf import add_pattern, elongated, image_on_grid, spot_images

__all__ = ["add_pattern", "elongated", "image_on_grid", "spot_images"]
