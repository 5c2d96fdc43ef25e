"""Definitions of the messages: tipforce_msgs from its .msg files, and of the standard messages their fields."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from tipforce.shipped_files import shipped_folder

_STANDARD = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/msg/Empty": "",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
    "geometry_msgs/msg/WrenchStamped": "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
    "diagnostic_msgs/msg/KeyValue": "string key\nstring value",
    "diagnostic_msgs/msg/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\n"
        "string hardware_id\ndiagnostic_msgs/KeyValue[] values"
    ),
    "diagnostic_msgs/msg/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
    "can_msgs/msg/Frame": (
        "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\nuint8 dlc\nuint8[8] data"
    ),
}
WRENCH, CONTACT = "geometry_msgs/msg/WrenchStamped", "tipforce_msgs/msg/Contact"
FINGERTIP = "tipforce_msgs/msg/Fingertip"
DIAGNOSTICS, EMPTY, FRAME = "diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/Empty", "can_msgs/msg/Frame"


class Field(NamedTuple):
    """One field: ``kind`` is a primitive, "string", or the full name of a message."""

    name: str
    kind: str
    size: int | None = 1
    """1: one value; more: an array; None: a sequence of any length."""


@cache
def text_of(kind: str) -> str:
    """Return the definition of a message, ``package/msg/Name``, as in its .msg file. Raises KeyError."""
    package, _, name = kind.split("/")
    if package == "tipforce_msgs":
        return (shipped_folder("ros2") / "tipforce_msgs" / "msg" / f"{name}.msg").read_text(encoding="utf-8")
    return _STANDARD[kind]


@cache
def fields_of(kind: str) -> tuple[Field, ...]:
    """Return the fields of a message, without its constants."""
    found = []
    for line in text_of(kind).splitlines():
        words = line.partition("#")[0].split()
        if len(words) == 2 and "=" not in words[1]:
            base, bracket, rest = words[0].partition("[")
            count = (int(rest[:-1]) if rest != "]" else None) if bracket else 1
            found.append(Field(words[1], _full_name(base), count))
    return tuple(found)


def constants_of(kind: str) -> dict[str, int]:
    """Return the constants of a message."""
    lines = (line.partition("#")[0].split() for line in text_of(kind).splitlines())
    pairs = (words[1].split("=") for words in lines if len(words) == 2 and "=" in words[1])
    return {name: int(value) for name, value in pairs}


def with_dependencies(kind: str) -> str:
    """Return a definition followed by those that it uses: the "ros2msg" schema of MCAP."""
    parts, waiting, seen = [text_of(kind)], [kind], {kind}
    while waiting:
        for field in fields_of(waiting.pop(0)):
            if "/" in field.kind and field.kind not in seen:
                seen.add(field.kind)
                waiting.append(field.kind)
                parts.append(f"{'=' * 80}\nMSG: {field.kind.replace('/msg/', '/')}\n{text_of(field.kind)}")
    return "\n".join(parts)


def _full_name(base: str) -> str:
    package, slash, name = base.partition("/")
    return f"{package}/msg/{name}" if slash and "/" not in name else base
