"""The compiled core (_core.c), if it was built where tipforce was installed; without it everything works, slower."""

import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

INTERFACE = 7
"""Of _core.c: one built from another version of it is not used."""


def _load() -> Any:
    try:
        found = None if os.environ.get("TIPFORCE_NO_CORE") else import_module("tipforce._core")
    except ImportError:
        return None
    return found if getattr(found, "INTERFACE", None) == INTERFACE else None


core: Any = _load()
"""The module, or None. The environment variable TIPFORCE_NO_CORE=1 leaves it out."""


def how_to_build() -> str:
    """Return the command that installs tipforce with its core."""
    folder = Path(__file__).resolve().parents[2]
    source = f"-e {folder}" if (folder / "pyproject.toml").is_file() else "--no-binary tipforce tipforce"
    return f"install gcc and python3-dev, then: {sys.executable} -m pip install --force-reinstall --no-deps {source}"
