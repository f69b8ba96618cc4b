"""Where molecules are, how they move, and their light in each frame."""
