"""The front doors: what is public, that it is there, lazy and typed, and that documents use nothing else."""

from __future__ import annotations

import ast
import compileall
import importlib
import pkgutil
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PARTS = ["host", "sensor", "fingertip", "sources", "scene"]
DEVICE = ["canopen_device", *(f"canopen_device.{part}" for part in ("eds", "machine", "running"))]
ROBOTS = ["tipforce_robots.mujoco", "tipforce_robots.learning"]
PACKAGES = ["tipforce", *(f"tipforce.{part}" for part in PARTS), *DEVICE, *ROBOTS]
OWN = ("tipforce", "canopen_device")
TOOLS = ["tipforce_lab", "tipforce_lab.fem"]  # an extra of its own


def python(code: str, *flags: str) -> str:
    done = subprocess.run([sys.executable, *flags, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("package", [*PACKAGES, *TOOLS])
def test_every_public_name_is_there_and_has_a_docstring(package: str) -> None:
    module = importlib.import_module(package)
    assert len(set(module.__all__)) == len(module.__all__)
    assert not {info.name for info in pkgutil.iter_modules(module.__path__)} & set(module.__all__)
    for name in module.__all__:
        found = getattr(module, name)
        if callable(found):
            assert found.__doc__, f"{package}.{name}"
    with pytest.raises(AttributeError):
        _ = module.nothing_of_this_name


def test_a_bare_environment_is_enough_to_import_it() -> None:
    """No site-packages: neither numpy nor python-can is there."""
    code = f"import sys; sys.path.insert(0, {str(ROOT / 'node')!r}); import tipforce; "
    code += "print(tipforce.__version__, len(tipforce.__all__), sorted(dir(tipforce)) == sorted(tipforce.__all__))"
    version, count, same = python(code, "-S", "-I").split()
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    assert int(count) == 32
    assert same == "True"


def test_importing_it_loads_nothing_of_others() -> None:
    code = "import sys, tipforce, tipforce.host, tipforce.sensor, canopen_device, canopen_device.core, tipforce.scene, "
    code += "tipforce_robots.mujoco, tipforce_robots.learning; "
    code += "print({'numpy', 'can', 'canopen', 'msgspec', 'scipy', 'mujoco', 'gymnasium'} & sys.modules.keys())"
    assert python(code).strip() == "set()"


def test_a_program_without_sources_has_the_same_names(tmp_path: Path) -> None:
    folder = Path(importlib.import_module("canopen_device").__file__ or "").parent
    shutil.copytree(folder, tmp_path / "canopen_device", ignore=shutil.ignore_patterns("__pycache__"))
    assert compileall.compile_dir(tmp_path, quiet=1, legacy=True)
    for source in tmp_path.rglob("*.py"):
        source.unlink()
    names = "import canopen_device as c; print(*c.__all__, c.Device.__name__, c.__file__)"
    shown = subprocess.run([sys.executable, "-c", names], capture_output=True, text=True, check=True, cwd=tmp_path)
    front_door = importlib.import_module("canopen_device").__all__
    assert shown.stdout.split() == [*front_door, "Device", str(tmp_path / "canopen_device/__init__.pyc")]


def test_a_checker_sees_the_type_of_every_name(tmp_path: Path) -> None:
    lines = [f"import {package}" for package in PACKAGES]
    for package in PACKAGES:
        lines += [f"reveal_type({package}.{name})" for name in importlib.import_module(package).__all__]
    (tmp_path / "application.py").write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", str(tmp_path / "application.py")],
        capture_output=True, text=True, check=False, timeout=800, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("Revealed type is") == len(lines) - len(PACKAGES)
    assert not re.findall(r'Revealed type is "Any"', done.stdout)


def imports(tree: ast.AST) -> set[str]:
    """What a program imports of the project's packages, as ``module.name`` or ``module``."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.startswith(OWN)}
        elif isinstance(node, ast.ImportFrom) and str(node.module).startswith(OWN):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def is_public(name: str) -> bool:
    package, _, last = name.rpartition(".")
    return name in PACKAGES or (package in [*PACKAGES, *TOOLS] and last in importlib.import_module(package).__all__)


DOCUMENTS = sorted([ROOT / "README.md", *ROOT.glob("docs/*.md")])


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_documents_import_public_names_only(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    lines = [
        m[1]
        for m in re.finditer(r"^\s*(?:>>> |\.\.\. )?((?:from|import) (?:tipforce|canopen_device)\S*.*)$", text, re.M)
    ]
    private = {name for line in lines for name in imports(ast.parse(line.split("#")[0])) if not is_public(name)}
    assert not private


@pytest.mark.parametrize("path", sorted(ROOT.glob("docs/examples/*.py")), ids=lambda path: path.stem)
def test_examples_import_public_names_only(path: Path) -> None:
    found = imports(ast.parse(path.read_text(encoding="utf-8")))
    assert not {name for name in found if not is_public(name)}
