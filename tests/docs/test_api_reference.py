"""The Python reference: everything public has a docstring, and the pages are built from it without a warning."""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Iterator
from pathlib import Path

import pytest

from tipforce_tools import api_reference

NODE = Path(__file__).parents[2] / "node"
FILES = sorted((NODE / "tipforce").rglob("*.py"))
Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef

needs_pdoc = pytest.mark.skipif(
    importlib.util.find_spec("pdoc") is None, reason='pdoc is not installed: pip install "tipforce[docs]"'
)


def undocumented(tree: ast.Module) -> Iterator[str]:
    """Names of what is public and has no docstring. A setter has the one of its property."""
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


def test_the_check_sees_what_is_missing() -> None:
    source = "class A:\n def f(self): pass\n def _g(self): pass\n @f.setter\n def h(self, x): pass\ndef b(): pass"
    assert sorted(undocumented(ast.parse(source))) == ["A", "A.f", "b", "the module itself"]


def test_every_module_is_in_the_reference() -> None:
    names = {".".join(path.relative_to(NODE).with_suffix("").parts).removesuffix(".__init__") for path in FILES}
    assert set(api_reference.module_names()) == {name for name in names if "._" not in name}


@needs_pdoc
def test_every_signature_resolves() -> None:
    assert api_reference.check_annotations() == []


@needs_pdoc
def test_pages_are_built_without_warnings(tmp_path: Path) -> None:
    chosen = [
        "tipforce",
        "tipforce.host",
        "tipforce.host.network.faulty_bus",
        "tipforce.sensor",
        "tipforce.sensor.structure.strain",
    ]
    assert api_reference.build(tmp_path, chosen) == []
    pages = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.html")}
    assert pages == {"index.html", *(f"{name.replace('.', '/')}.html" for name in chosen)}
    page = (tmp_path / "tipforce" / "host" / "network" / "faulty_bus.html").read_text()
    assert "Corrupting flips one bit of the data" in page
    assert "FaultyBus" in (tmp_path / "search.js").read_text()


@needs_pdoc
def test_an_annotation_that_means_nothing_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "spoiled_for_pdoc.py").write_text('"""A."""\n\n\ndef f(x: "Nowhere") -> None:\n    """B."""\n')
    monkeypatch.syspath_prepend(tmp_path)
    assert any("Nowhere" in line for line in api_reference.check_annotations(["spoiled_for_pdoc"]))
