"""Everything public has a docstring."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

NODE = Path(__file__).parents[2] / "node"
FILES = sorted(path for name in ("canopen_device", "tipforce") for path in (NODE / name).rglob("*.py"))
Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def undocumented(tree: ast.Module) -> Iterator[str]:
    """Names of public definitions without a docstring. A setter has the one of its property."""
    if not ast.get_docstring(tree):
        yield "the module itself"
    waiting: list[tuple[str, ast.Module | ast.ClassDef]] = [("", tree)]
    while waiting:
        prefix, place = waiting.pop()
        for node in place.body:
            if not isinstance(node, Definition) or node.name.startswith("_"):
                continue
            setter = any(isinstance(d, ast.Attribute) and d.attr == "setter" for d in node.decorator_list)
            if not setter and not ast.get_docstring(node):
                yield prefix + node.name
            if isinstance(node, ast.ClassDef):
                waiting.append((f"{prefix}{node.name}.", node))


def test_everything_public_has_a_docstring() -> None:
    assert len(FILES) > 150
    missing = [
        f"{path.relative_to(NODE)}: {name}" for path in FILES for name in undocumented(ast.parse(path.read_text()))
    ]
    assert missing == []


def test_the_check_finds_missing_docstrings() -> None:
    source = "class A:\n def f(self): pass\n def _g(self): pass\n @f.setter\n def h(self, x): pass\ndef b(): pass"
    assert sorted(undocumented(ast.parse(source))) == ["A", "A.f", "b", "the module itself"]
