"""List the modules that an import loads, read from the sources, so that no list needs manual updates."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

_OWN = "tipforce"


def loaded_by(*names: str) -> tuple[str, ...]:
    """Return the modules of tipforce and the third-party packages that importing ``names`` loads, sorted.

    Imports inside functions and under ``if TYPE_CHECKING`` are excluded: they load on demand. Third-party packages
    are listed by their top-level name; the standard library only if ``names`` contains it.
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
    """Yield the imports of one module of tipforce, its parent package included."""
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
    """Return whether a name is a module of tipforce, not an attribute of one."""
    folder = Path(__file__).parents[2].joinpath(*name.split("."))
    return name.startswith(f"{_OWN}.") and (folder.with_suffix(".py").exists() or (folder / "__init__.py").exists())
