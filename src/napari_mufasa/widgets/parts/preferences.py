"""What the user prefers: napari's Preferences, or the defaults of the manifest where napari has none for plugins."""

from __future__ import annotations

from functools import cache
from typing import Any

PLUGIN = "napari-mufasa"


def preference(name: str) -> Any:
    """A setting by "group.name", as declared in napari.yaml, for example ``preference("steps.seed")``."""
    group, key = name.split(".")
    try:
        from napari.settings import get_plugin_settings

        return getattr(getattr(get_plugin_settings(PLUGIN), group), key)
    except (ImportError, KeyError, AttributeError):  # older napari, or the plugin is used without its manifest
        return _defaults()[group][key]


@cache
def _defaults() -> dict[str, dict[str, Any]]:
    from importlib.resources import files

    import yaml

    manifest = yaml.safe_load((files("napari_mufasa") / "napari.yaml").read_text(encoding="utf-8"))
    groups = manifest["contributions"]["configurations"]
    return {name: {key: item["default"] for key, item in group["properties"].items()} for name, group in groups.items()}
