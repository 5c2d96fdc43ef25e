"""Checks of the installation: this program, its dependencies, the extras, and related tools."""

from __future__ import annotations

import importlib.metadata
import platform
import shutil
from collections.abc import Iterator

from tipforce_tools.doctor.check import Check

BASE = ("canopen", "cantools", "msgspec", "numpy", "python-can", "rich")
EXTRAS = {
    "science": ("scipy",),
    "plot": ("matplotlib",),
    "fem": ("scikit-fem",),
    "parquet": ("pyarrow",),
    "zstd": ("zstandard",),
    "mcap": ("mcap",),
    "ros2": ("cyclonedds",),
    "multicast": ("msgpack",),
    "dask": ("distributed",),
}
PEERS = ("candump", "canplayer", "tshark")


def software_checks() -> Iterator[Check]:
    """Yield checks of versions, extras and related tools."""
    base = ", ".join(f"{name} {_version(name)}" for name in BASE)
    yield Check("software", "ok", f"tipforce {_version('tipforce')}, Python {platform.python_version()}, {base}")
    missing = [extra for extra, names in EXTRAS.items() if any(_version(name) == "missing" for name in names)]
    if missing:
        step = f'pip install "tipforce[{",".join(missing)}]"'
        yield Check("extras", "note", f"not installed: {', '.join(missing)}", step)
    else:
        yield Check("extras", "ok", "all installed")
    absent = [name for name in PEERS if shutil.which(name) is None]
    if absent:
        yield Check("peers", "note", f"not found: {', '.join(absent)}", "sudo apt-get install can-utils tshark")
    else:
        yield Check("peers", "ok", ", ".join(PEERS))


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
