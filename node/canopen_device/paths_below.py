"""Paths that a file names: below its folder, so that a file from elsewhere makes the program reach nothing else."""

import os
from pathlib import Path

from canopen_device.errors import InputError

_MOST_BYTES = 255
"""Of a name in a folder, with every file system in use."""


def below(folder: str | Path, name: str, place: str = "", links: bool = True) -> Path:
    """Return the path of ``name``, as a file has it at ``place``, in ``folder``. Raises InputError for an empty or
    absolute name, for one with ``..``, ``\\``, ``~`` in front, a control character or a part of over 255 bytes, and
    where a link leads out of the folder; with ``links`` False for every link."""
    root = os.path.realpath(folder)
    shown = f"{place} = {name if len(name) <= 60 else name[:57] + '...'!r}: " if place else ""
    if not is_below(name):
        raise InputError(f"{shown}allowed is a path below {root}, with / and without ..")
    path = Path(folder, name)
    real = os.path.realpath(path)
    if not Path(real).is_relative_to(root):
        raise InputError(f"{shown}a link leads out of {root}: put the file itself there")
    if not links and real != os.path.join(root, os.path.normpath(name)):
        raise InputError(f"{shown}allowed is a file of {root} itself, not a link")
    return path


def is_below(name: str) -> bool:
    """Return whether a path stays in its folder by its text alone."""
    parts = name.split("/")
    return (
        bool(name.strip("./"))
        and name[0] not in "/~"
        and name[1:2] != ":"
        and ".." not in parts
        and not any(mark < " " or mark in "\\\x7f" for mark in name)
        and all(len(part.encode(errors="replace")) <= _MOST_BYTES for part in parts)
        and len(name) <= 4 * _MOST_BYTES
    )
