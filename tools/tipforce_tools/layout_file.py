"""A gauge layout as the command line names it: I, II, III (their mirrors I', II', III'), or a TOML file."""

from __future__ import annotations

from pathlib import Path

import msgspec

from tipforce.errors import InputError
from tipforce.sensor.geometry import FABRICATED, Geometry
from tipforce.sensor.layouts import LAYOUTS, layout


class _File(msgspec.Struct, forbid_unknown_fields=True):
    points: list[str]
    geometry: Geometry = FABRICATED


def read_layout(name_or_path: str) -> tuple[Geometry, tuple[str, ...]]:
    """(geometry, gauge points). A file has ``points = ["K_H", "S_H", "U"]`` and, if it is not the paper's, [geometry].

    Raises InputError naming the place and what is allowed.
    """
    if name_or_path in LAYOUTS:
        return FABRICATED, layout(name_or_path)
    path = Path(name_or_path)
    try:
        content = msgspec.toml.decode(path.read_bytes(), type=_File)
        return content.geometry, layout(content.points)
    except FileNotFoundError:
        raise InputError(
            f"layout {name_or_path!r}: neither one of {', '.join(LAYOUTS)} nor a file; "
            'a layout file has a line like points = ["K_H", "S_H", "U"]'
        ) from None
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, InputError) as error:
        raise InputError(f"layout {path}: {error}") from None
