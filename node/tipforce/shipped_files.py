"""Find the files that ship with tipforce by name: scenes, EDS and DBC; and the folder of the ROS 2 packages."""

from pathlib import Path

from tipforce.errors import InputError

SUFFIXES = {"scenes": ".toml", "eds": ".eds", "dbc": ".dbc"}
_IN_CLONE = {"ros2": "docs/examples/ros2"}


def shipped_folder(kind: str) -> Path:
    """Return the folder of a kind of SUFFIXES, or "ros2": in the installed package, or in a clone of the source."""
    installed = Path(__file__).parent / "shipped" / kind
    return installed if installed.is_dir() else Path(__file__).parents[2] / _IN_CLONE.get(kind, kind)


def file_or_shipped(text: str, kind: str) -> Path:
    """Return the path ``text``, or the file of that name that ships with tipforce. A file of the user has priority.
    Raises InputError for a bare name that is neither."""
    path, suffix = Path(text), SUFFIXES[kind]
    if text == "-" or path.exists() or path.name != text or path.suffix not in ("", suffix):
        return path
    shipped = shipped_folder(kind) / f"{path.stem}{suffix}"
    if shipped.is_file():
        return shipped
    names = sorted(path.stem for path in shipped.parent.glob(f"*{suffix}"))
    raise InputError(f"{text}: no such file; by name ship {', '.join(names)}")
