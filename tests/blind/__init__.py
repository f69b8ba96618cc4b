"""Blind tests: movies with a hidden effect from a generator that shares no code with the package."""
