"""From emitted photons to the optical image."""

from napari_mufasa.optics.psf import elongated, image_on_grid, spot_images

__all__ = ["elongated", "image_on_grid", "spot_images"]
