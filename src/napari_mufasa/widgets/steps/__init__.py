"""The steps, each a widget over a typed function."""
