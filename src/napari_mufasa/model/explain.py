"""What pydantic found wrong with a model, in one line: field, value, what is allowed, remedy."""

from __future__ import annotations

import difflib
from typing import Any

from pydantic import BaseModel, ValidationError


def explain(error: ValidationError, root: type[BaseModel], prefix: str = "") -> str:
    """One line for the first problem: field, value, what is allowed, remedy. `prefix` is where `root` sits."""
    first = error.errors()[0]
    loc = first["loc"]
    path = ".".join([prefix, *(str(part) for part in loc)] if prefix else [str(part) for part in loc])
    if not loc and not prefix and first["type"] != "value_error":
        path = f"the {root.__name__.lower()}"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    if first["type"] == "extra_forbidden":
        names = _known_keys(root, loc[:-1])
        near = difflib.get_close_matches(str(loc[-1]), names, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]}? " if near else ""
        return f"unknown key {path}: {hint}known keys here are {', '.join(names)}{more}"
    if first["type"] == "missing":
        names = _known_keys(root, loc)
        needs = f"give an object with {', '.join(names)}" if names else f"give the {_describe(root, loc) or 'value'}"
        return f"{path} is missing: {needs}{more}"
    if first["type"] == "value_error":
        message = str(first["ctx"]["error"])
        return f"{message if not path or path in message else f'{path}: {message}'}{more}"
    description = _describe(root, loc)
    message = first["msg"][:1].lower() + first["msg"][1:]
    return f"{path} = {_short(first.get('input'))}: {message}{f'; {description}' if description else ''}{more}"


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else text[:77] + "…"


def _field(root: type[BaseModel], loc: tuple[int | str, ...]) -> Any:
    current: Any = root
    field = None
    for part in loc:
        if not (isinstance(current, type) and issubclass(current, BaseModel)) or part not in current.model_fields:
            return field
        field = current.model_fields[str(part)]
        current = field.annotation
    return field


def _describe(root: type[BaseModel], loc: tuple[int | str, ...]) -> str:
    """What a field is, and what is allowed: "PSF width in nm (allowed: > 0, ≤ 100000)"."""
    field = _field(root, loc)
    if field is None:
        return ""
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    limits = [
        f"{sign} {getattr(m, name):g}" for m in field.metadata for name, sign in signs.items() if hasattr(m, name)
    ]
    extra = field.json_schema_extra
    unit = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
    allowed = f"allowed: {', '.join(limits)}" if limits else ""
    inside = " ".join(part for part in (allowed, unit) if part)
    return f"{field.description or ''}{f' ({inside})' if inside else ''}".strip()


def _known_keys(root: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    field = _field(root, loc)
    owner = field.annotation if field is not None else root
    return sorted(getattr(owner, "model_fields", {}))
