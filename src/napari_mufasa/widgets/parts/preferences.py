"""What the user prefers, in napari's Preferences."""

from __future__ import annotations

from typing import Any


def preference(name: str, default: Any = True) -> Any:
    """A setting by "group.name", as declared in napari.yaml; the default where napari has no settings for plugins."""
    group, key = name.split(".")
    try:
        from napari.settings import get_plugin_settings

        return getattr(getattr(get_plugin_settings("napari-mufasa"), group), key)
    except (ImportError, KeyError, AttributeError):  # older napari, or the plugin is used without its manifest
        return default
