"""The recipes that are files or need an optional package, run as a user would."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tipforce_tools.cli.main import main

DOCS = Path(__file__).parents[2] / "docs"
LOG = """\
(1700000000.000000) can0 080#
(1700000000.000120) can0 285#2E1129239A110303
(1700000000.000240) can0 286#D0072823E8030303
(1700000000.001000) can0 080#
(1700000000.001120) can0 285#3011282394110304
(1700000000.001240) can0 286#0500008000801204
"""
PAGE = (DOCS / "python.md").read_text()
DATA_FRAMES = {
    re.search(r"import (\w+)", block)[1]: block  # type: ignore[index]
    for block in re.findall(r"```python\n(import (?:pandas|polars)\n.*?)```", PAGE, re.DOTALL)
}


def test_a_recipe_for_each_package() -> None:
    assert list(DATA_FRAMES) == ["pandas", "polars"]
    for name, code in DATA_FRAMES.items():
        compile(code, f"python.md, {name}", "exec")


@pytest.mark.parametrize("name", DATA_FRAMES)
def test_decoded_with(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec(name) is None:
        pytest.skip(f"{name} is not installed: its three lines were compiled, not run")
    monkeypatch.chdir(tmp_path)
    Path("run.log").write_text(LOG)
    assert main(["decode", "run.log", "-q", "-o", "run.parquet"]) == 0
    space: dict[str, Any] = {}
    exec(DATA_FRAMES[name], space)
    assert space["result"] == [{"node": 5, "P_N": 4.4, "known": 2}, {"node": 6, "P_N": 2.0, "known": 1}]


@pytest.mark.parametrize("name", ["test_hand.py", "test_master.py"])
def test_an_example_test_runs_where_a_user_copies_it(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text((DOCS / "examples" / name).read_text())
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "CAN_"))}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", name],
        cwd=tmp_path, env=plain, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout
