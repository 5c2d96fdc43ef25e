"""The modules that an import loads, read from the sources, so that no list of them is kept by hand."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

_OWN = "tipforce"


def loaded_by(*names: str) -> tuple[str, ...]:
    """The modules of tipforce and the packages of others that importing ``names`` loads, sorted.

    Imports inside functions and under ``if TYPE_CHECKING`` are left out: they are loaded when something needs them.
    Packages of others are named by their first part; the standard library only where ``names`` has it.
    """
    found: set[str] = set()
    pending = list(names)
    while pending:
        name = pending.pop()
        if name in found:
            continue
        found.add(name)
        if name.partition(".")[0] == _OWN:
            pending += _imports(name)
    return tuple(sorted(found))


@cache
def _imports(name: str) -> tuple[str, ...]:
    """What one module of tipforce imports when it is loaded, its parent package included."""
    spec = find_spec(name)
    assert spec is not None, name
    assert spec.origin is not None, name
    parent = name.rpartition(".")[0]
    package = name if spec.submodule_search_locations is not None else parent
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    found = {module for node in _statements(tree) for module in _targets(node, package)}
    return tuple(found | ({parent} if parent else set()))


def _statements(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            continue
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from _statements(node)


def _targets(node: ast.Import | ast.ImportFrom, package: str) -> Iterator[str]:
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    else:
        base = package.rsplit(".", node.level - 1)[0] if node.level else ""
        module = ".".join(filter(None, (base, node.module)))
        names = [f"{module}.{alias.name}" if _is_module(f"{module}.{alias.name}") else module for alias in node.names]
    for name in names:
        first = name.partition(".")[0]
        if first == _OWN:
            yield name
        elif first not in sys.stdlib_module_names:
            yield first


def _is_module(name: str) -> bool:
    """Whether a name is a module of tipforce, not something in one."""
    folder = Path(__file__).parents[2].joinpath(*name.split("."))
    return name.startswith(f"{_OWN}.") and (folder.with_suffix(".py").exists() or (folder / "__init__.py").exists())
