"""Who imports whom: every import of the package as an arrow between files, those inside functions and for types too."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

PACKAGE = "napari_mufasa"
#: The folders and top files from the lowest up; those of one line do not know each other. What is at the top of the
#: package (`__init__`, which gives the public names, and `__main__`) stands above all.
FLOORS = (
    ("errors",),
    ("checks", "provenance", "compiled", "one_thread"),
    ("chance",),
    ("files",),
    ("model",),
    ("cluster",),
    ("photophysics", "optics"),
    ("camera",),
    ("simulate",),
    ("effects",),
    ("spots",),
    ("traces",),
    ("channels",),
    ("observe", "calibrate"),
    ("denoise", "compare", "propose"),
    ("design", "infer"),
    ("discover",),
    ("report",),
    ("batch",),
    ("samples",),
    ("widgets",),
    ("cli",),
    ("__init__", "__main__"),
)


def modules(root: Path) -> dict[str, Path]:
    """Dotted name within the package → file; a package's `__init__` has the package's name, the top one "__init__"."""
    found = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        inner = parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts
        found[".".join(inner)] = path
    return found


def arrows(root: Path) -> dict[str, set[str]]:
    """Module → the modules of the package that it imports, anywhere in the file."""
    known = modules(root)
    found = {}
    for name, path in known.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found[name] = {target for target in _targets(tree, name, path, known) if target != name}
    return found


def _targets(tree: ast.AST, name: str, path: Path, known: dict[str, Path]) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == PACKAGE:
                    yield _module(alias.name.split(".")[1:], known)
        elif isinstance(node, ast.ImportFrom):
            start = _start(node, name, path)
            if start is not None:
                # "from package import thing": the thing may be a module of its own.
                for alias in node.names:
                    yield _module([*start, alias.name], known)


def _start(node: ast.ImportFrom, name: str, path: Path) -> list[str] | None:
    """The parts of the module that names come from, within the package; None when it is someone else's."""
    given = node.module.split(".") if node.module else []
    if node.level == 0:
        return given[1:] if given[:1] == [PACKAGE] else None
    own = name.split(".") if path.stem == "__init__" else name.split(".")[:-1]
    return own[: len(own) - node.level + 1] + given


def _module(parts: list[str], known: dict[str, Path]) -> str:
    """The longest beginning of a dotted name that is a module; the package itself where none is."""
    for end in range(len(parts), 0, -1):
        if ".".join(parts[:end]) in known:
            return ".".join(parts[:end])
    return "__init__"


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of two and more nodes that reach each other (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for target in sorted(graph.get(node, ())):
            if target not in index:
                visit(target)
                low[node] = min(low[node], low[target])
            elif target in stack:
                low[node] = min(low[node], index[target])
        if low[node] == index[node]:
            group = [stack.pop()]
            while group[-1] != node:
                group.append(stack.pop())
            if len(group) > 1:
                found.append(sorted(group))

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return found


def room(module: str) -> str:
    """The folder, or the file at the top, that a module lies in."""
    return module.split(".")[0]


def between_rooms(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """The same arrows between folders."""
    found: dict[str, set[str]] = {}
    for name, targets in graph.items():
        found.setdefault(room(name), set()).update(room(t) for t in targets if room(t) != room(name))
    return found


def upward(graph: dict[str, set[str]], floors: Iterable[Iterable[str]] = FLOORS) -> list[str]:
    """Arrows that do not go down, as "from -> to"; and rooms that stand on no floor."""
    floor = {name: height for height, names in enumerate(floors) for name in names}
    lost = sorted({room(name) for name in graph} - set(floor))
    bad = [
        f"{name} -> {target}"
        for name, targets in sorted(graph.items())
        for target in sorted(targets)
        if room(name) != room(target) and floor.get(room(target), -1) >= floor.get(room(name), -1)
    ]
    return [*(f"{name} is on no floor" for name in lost), *bad]
