"""What compiled loops call is built into them (`napari_mufasa.compiled` says why)."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import napari_mufasa

ROOT = Path(napari_mufasa.__file__).parent
KINDS = ("jit", "vectorised", "inlined", "compiled")


def compiled(root: Path) -> Iterator[tuple[str, ast.FunctionDef, str]]:
    """(module, function, how it is compiled) of every function with one of the decorators."""
    for path in sorted(root.rglob("*.py")):
        module = ".".join(path.relative_to(root).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for kind in ast_names(node.decorator_list) if isinstance(node, ast.FunctionDef) else ():
                if kind in KINDS:
                    yield module, node, kind


def ast_names(nodes: list[ast.expr]) -> list[str]:
    return [node.id for node in nodes if isinstance(node, ast.Name)]


def built_apart(root: Path) -> list[str]:
    """Calls from one compiled loop to another that may reorder sums and is not built into its caller."""
    found = list(compiled(root))
    apart = {(module, node.name) for module, node, kind in found if kind == "vectorised"}
    names = {name for _, name in apart}
    return sorted(
        f"{module}.{node.name} calls {call.func.id}"
        for module, node, _ in found
        for call in ast.walk(node)
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Name)
        and call.func.id in names
        # A name of another file counts where this file has none of its own.
        and ((module, call.func.id) in apart or not any(m == module and n.name == call.func.id for m, n, _ in found))
    )


def test_loops_are_found():
    kinds = [kind for _, _, kind in compiled(ROOT)]
    assert kinds.count("vectorised") > 20 and kinds.count("inlined") > 30


def test_what_loops_call_is_built_into_them():
    assert built_apart(ROOT) == []


def test_loops_are_compiled_in_one_way():
    """No module asks numba itself for arithmetic that may be reordered."""
    own = [path.name for path in ROOT.rglob("*.py") if "fastmath" in path.read_text() and path.name != "compiled.py"]
    assert own == []


def test_a_call_is_seen(tmp_path):
    (tmp_path / "a.py").write_text("@vectorised\ndef sums(x): ...\n\n@jit\ndef other(x):\n    return sums(x)\n")
    (tmp_path / "b.py").write_text("from a import sums\n\n@vectorised\ndef caller(x):\n    return sums(x)\n")
    assert built_apart(tmp_path) == ["a.other calls sums", "b.caller calls sums"]
    (tmp_path / "a.py").write_text("@inlined\ndef sums(x): ...\n\n@jit\ndef other(x):\n    return sums(x)\n")
    assert built_apart(tmp_path) == []
