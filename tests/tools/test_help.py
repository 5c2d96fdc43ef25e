"""`--help` of every command: quick, because nothing heavy is imported, and with examples to paste."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tools import heavy
from tools.command_lines import LINES

HEAVY = (*heavy.OF_ALL, "matplotlib", "scipy", "pyarrow", "importlib.metadata")
PATHS = [tuple(path.split()[1:]) for path in LINES]
CODE = f"""\
import contextlib, io, sys
from tipforce_tools.cli.main import main
for path in {PATHS!r}:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([*path, "--help"])
    assert text.getvalue().startswith("usage: tipforce " + " ".join(path)), path
    heavy = [name for name in {HEAVY!r} if name in sys.modules]
    print(*path, "imports" if heavy else "", *heavy)
    for name in heavy:
        del sys.modules[name]
"""


@pytest.fixture(scope="module")
def told() -> list[str]:
    """A line for each command and action: what heavy its help imports."""
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return [line.strip() for line in done.stdout.splitlines()]


def test_no_help_imports_anything_heavy(told: list[str]) -> None:
    assert told == [" ".join(path) for path in PATHS]
