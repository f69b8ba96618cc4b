"""napari-mufasa: simulate, denoise, extract, compare, and find the physics a model lacks."""
