"""ROS 2 messages: definitions, tipforce_msgs from its .msg files, and bytes, little-endian plain CDR (XCDR1) with its
header of four bytes. ``encode`` writes one message; ``Layout`` many at once, if only their numbers differ."""

import struct
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError
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
    """Return the fields of a message, without its constants; of one without fields the one that rosidl adds."""
    fields = []
    for line in text_of(kind).splitlines():
        words = line.partition("#")[0].split()
        if len(words) == 2 and "=" not in words[1]:
            base, bracket, rest = words[0].partition("[")
            count = (int(rest[:-1]) if rest != "]" else None) if bracket else 1
            package, slash, name = base.partition("/")
            full_name = f"{package}/msg/{name}" if slash and "/" not in name else base
            fields.append(Field(words[1], full_name, count))
    return tuple(fields) or (_NEEDED,)


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


HEADER = b"\x00\x01\x00\x00"
_CODES = {
    "bool": "?", "byte": "B", "char": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I",
    "int32": "i", "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip
_NEEDED = Field("structure_needs_at_least_one_member", "uint8")  # rosidl's, of a message without fields

Rows = npt.NDArray[np.void]


def encode(kind: str, values: Mapping[str, Any]) -> bytes:
    """Serialise one message; ``values`` by field, nested messages as mappings. Raises KeyError for a missing field."""
    out = bytearray(HEADER)
    _put(out, kind, 1, values)
    return bytes(out)


def stamp(t_ns: int) -> dict[str, int]:
    """Return builtin_interfaces/Time."""
    return {"sec": t_ns // 1_000_000_000, "nanosec": t_ns % 1_000_000_000}


class Layout:
    """Messages of one kind of which only numbers differ. ``constants`` by path ("header.frame_id") holds every string
    and may hold numbers; ``counts`` the lengths of sequences; the rows all other numbers ("wrench.force.x")."""

    def __init__(self, kind: str, constants: Mapping[str, Any], counts: Mapping[str, int] | None = None) -> None:
        self._template = bytearray(HEADER)
        self._constants, self._counts = constants, counts or {}
        self._places: dict[str, tuple[str, int]] = {}
        self._walk(kind, "")
        self._dtype = np.dtype({
            "names": list(self._places), "formats": [code for code, _ in self._places.values()],
            "offsets": [offset for _, offset in self._places.values()], "itemsize": len(self._template),
        })  # fmt: skip

    def rows(self, count: int) -> Rows:
        """Return ``count`` messages with zeros."""
        return np.frombuffer(bytearray(bytes(self._template) * count), dtype=self._dtype)

    def _walk(self, kind: str, prefix: str) -> None:
        for field in fields_of(kind):
            path = prefix + field.name
            if path in self._constants or field.kind == "string":
                _put(self._template, field.kind, field.size, self._constants[path])
            elif "/" in field.kind:
                self._walk(field.kind, path + ".")
            else:
                count = self._counts[path] if field.size is None else field.size
                if field.size is None:
                    _primitive(self._template, "uint32", count)
                code = _CODES[field.kind]
                if count:
                    _align(self._template, struct.calcsize(code))
                form = f"<{code}" if count == 1 == field.size else f"({count},)<{code}"
                self._places[path] = form, len(self._template)
                self._template += bytes(count * struct.calcsize(code))


def split(rows: Rows) -> list[bytes]:
    """Return the bytes of each row."""
    size, data = rows.dtype.itemsize, rows.tobytes()
    return [data[at : at + size] for at in range(0, len(data), size)]


def set_stamps(rows: Rows, t_ns: npt.NDArray[np.int64]) -> None:
    """Set ``header.stamp`` of rows (k,) to times (k,) in nanoseconds of the epoch. Raises InputError beyond 2038."""
    outside = t_ns[(t_ns < 0) | (t_ns >= 1_000_000_000 << 31)]
    if len(outside):  # of builtin_interfaces/Time; MCAP has no times before 1970
        raise InputError(f"a time of {1e-9 * outside[0]:.6f} s: allowed in ROS 2 are 0 to {(1 << 31) - 1} s")
    rows["header.stamp.sec"], rows["header.stamp.nanosec"] = np.divmod(t_ns, 1_000_000_000)


def _put(out: bytearray, kind: str, size: int | None, value: Any) -> None:
    if size != 1:
        if size is None:
            _primitive(out, "uint32", len(value))
        for item in value:
            _put(out, kind, 1, item)
    elif "/" in kind:
        for field in fields_of(kind):
            _put(out, field.kind, field.size, 0 if field is _NEEDED else value[field.name])
    elif kind == "string":
        data = value.encode() + b"\0"
        _primitive(out, "uint32", len(data))
        out += data
    else:
        _primitive(out, kind, value)


def _primitive(out: bytearray, kind: str, value: Any) -> None:
    code = _CODES[kind]
    _align(out, struct.calcsize(code))
    out += struct.pack(f"<{code}", value)


def _align(out: bytearray, size: int) -> None:
    out += bytes(-(len(out) - len(HEADER)) % size)
