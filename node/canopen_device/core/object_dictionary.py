"""Object dictionary at run time: entries, their values, and hooks for the services that own objects."""

import struct

from . import codes, communication

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from .sdo_server import Sink

    Value = int | float | str | bytes
    Entry = tuple[str, str, int, Value, "int | float | None", "int | float | None"]

# Flags of an entry.
TPDO, RPDO, ADD_NODE_ID, ANY_FLOAT, VIEW, NOT_STORED, COUNTED = 1, 2, 4, 8, 16, 32, 64

SIZES = {"B": 1, "b": 1, "H": 2, "h": 2, "I": 4, "i": 4, "f": 4}  # module ``wide_types`` adds to these tables
RANGES = {
    "B": (0, 0xFF), "H": (0, 0xFFFF), "I": (0, 0xFFFFFFFF),
    "b": (-0x80, 0x7F), "h": (-0x8000, 0x7FFF), "i": (-0x80000000, 0x7FFFFFFF),
}  # fmt: skip
FORMATS = {"B": "<B", "b": "<b", "H": "<H", "h": "<h", "I": "<I", "i": "<i", "f": "<f"}  # of struct
DUMMIES = {2: "b", 3: "h", 4: "i", 5: "B", 6: "H", 7: "I"}
REAL32_MAX, REAL32_END = 3.4028234663852886e38, 3.40282356e38  # up to which 3.4028235e38, as files write it, is rounded


def encode(kind: str, value: "Value") -> bytes:
    """Return ``value`` as little-endian bytes; ``kind``: struct's letter, "s", "D" bytes, "u3" to "u7", "i3" to "i7".
    Integers are limited to their range, as MicroPython's struct wraps; a float beyond REAL32 is infinite."""
    if kind == "D":
        return value  # type: ignore[return-value]
    if kind == "s":
        return value.encode()  # type: ignore[union-attr]
    if kind == "f":
        if value > REAL32_END:  # type: ignore[operator]
            value = float("inf")
        elif value < -REAL32_END:  # type: ignore[operator]
            value = float("-inf")
    elif kind != "d":
        low, high = RANGES[kind]
        value = min(max(value, low), high)
    packing = FORMATS.get(kind)
    if packing is None:
        return (value & (1 << 8 * SIZES[kind]) - 1).to_bytes(SIZES[kind], "little")  # type: ignore[operator]
    return struct.pack(packing, value)


def decode(kind: str, data: bytes) -> "Value":
    """Return the value of ``data``, whose length the caller has checked."""
    packing = FORMATS.get(kind)
    if packing is not None:
        value: "Value" = struct.unpack(packing, data)[0]
        return value
    if kind == "D":
        return bytes(data)
    if kind == "s":
        return bytes(data).decode()
    number = int.from_bytes(data, "little")
    return number - (1 << 8 * len(data)) if number > RANGES[kind][1] else number


def real32(value: float) -> float:
    """Return what a REAL32 keeps of a value."""
    return decode("f", encode("f", value))  # type: ignore[return-value]


class ObjectDictionary:
    """Entries by index and sub-index, with their values, and hooks of the services that own objects.

    ``readers[index](sub)``: the value; ``writers[index](sub, value)``: an abort code, or 0 to store; ``sizes[index]``:
    the only length of a DOMAIN or string; ``sinks[index](sub, size)``: an abort code or a ``sdo_server.Sink``.
    ``views`` read and write entries with the flag VIEW, which hold no value. ``dummies``: types that an RPDO may map
    (7.4.7.1); ``changed()``: after a write to a COUNTED entry; ``edited``: a setting but 1020h changed;
    ``packer(keys)``: a faster TPDO packer or None."""

    def __init__(self, node_id: int) -> None:
        self.node_id = node_id
        self._entries: "dict[int, dict[int, Entry]]" = {}
        self.values: "dict[int, Value]" = {}
        self.readers: "dict[int, Callable[[int], Value]]" = {}
        self.writers: "dict[int, Callable[[int, Value], int]]" = {}
        self.sizes: "dict[int, int]" = {}
        self.dummies = DUMMIES
        self.sinks: "dict[int, Callable[[int, int | None], Sink | int]]" = {}
        self.changed: "Callable[[], None] | None" = None
        self.edited = False
        self.views: "tuple[Callable[[int, int], Value], Callable[[int, int, Value], int]] | None" = None
        self.packer: "Callable[[list[tuple[int, int]]], Callable[[], bytes] | None]" = lambda _keys: None

    def add(self, index: int, sub: int, entry: "Entry") -> "Entry":
        """Declare an entry, (type, access, flags, default, low, high); return it as kept, with numbers of REAL32."""
        kind, access, flags, default, low, high = entry
        if kind == "f":
            numbers = tuple([None if v is None else real32(v) for v in (default, low, high)])  # type: ignore[arg-type]
            if numbers != (default, low, high):
                entry = (kind, access, flags) + numbers  # type: ignore[assignment]
        self._entries.setdefault(index, {})[sub] = entry
        self.values[index << 8 | sub] = self.default(index, sub)
        return entry

    def find(self, index: int, sub: int) -> "Entry | int":
        """Return the entry, or the abort code if it does not exist."""
        subs = self._entries.get(index)
        if subs is None:
            return codes.NO_OBJECT
        return subs.get(sub, codes.NO_SUB)

    def subs(self, index: int) -> "list[int]":
        """Return the sub-indices of an object in order; empty if the object does not exist."""
        return sorted(self._entries.get(index, ()))

    def indices(self, first: int, last: int) -> "list[int]":
        """Return the existing indices from ``first`` to ``last`` inclusive, in order."""
        return sorted(i for i in self._entries if first <= i <= last)

    def default(self, index: int, sub: int) -> "Value":
        """Return the default, plus the node-id if the entry has that flag."""
        entry = self._entries[index][sub]
        if entry[2] & ADD_NODE_ID:
            return entry[3] + self.node_id  # type: ignore[operator]
        return entry[3]

    def restore_defaults(self, first: int, last: int) -> None:
        """Reset every value of the objects ``first`` to ``last`` to its default."""
        for index in self.indices(first, last):
            for sub in self._entries[index]:
                self.values[index << 8 | sub] = self.default(index, sub)

    def get(self, index: int, sub: int = 0) -> "Value":
        """Return the present value of an existing entry."""
        reader = self.readers.get(index)
        if reader is not None and (sub or self._entries[index][0][1] != "const"):
            return reader(sub)
        if self.views is not None and self._entries[index][sub][2] & VIEW:
            return self.views[0](index, sub)
        return self.values[index << 8 | sub]

    def integer(self, index: int, sub: int = 0) -> int:
        """Return the stored value of an integer entry; 0, which disables most services, if the entry does not exist."""
        return self.values.get(index << 8 | sub, 0)  # type: ignore[return-value]

    def upload(self, index: int, sub: int) -> "bytes | int":
        """Return the bytes for an SDO upload, or an abort code."""
        entry = self.find(index, sub)
        if isinstance(entry, int):
            return entry
        if entry[1] == "wo":
            return codes.WRITE_ONLY
        return encode(entry[0], self.get(index, sub))

    def writable(self, index: int, sub: int, size: "int | None") -> int:
        """Return the abort code for a write of ``size`` bytes (None: unknown) that is about to start; 0 if allowed."""
        entry = self.find(index, sub)
        if isinstance(entry, int):
            return entry
        if entry[1] in ("ro", "const"):
            return codes.READ_ONLY
        expected = self.expected_size(index, sub)
        if size is None or expected is None or size == expected:
            return 0
        return codes.TOO_LONG if size > expected else codes.TOO_SHORT

    def expected_size(self, index: int, sub: int) -> "int | None":
        """Return the only length that a write may have, None if any is allowed. The entry must exist."""
        size = SIZES.get(self._entries[index][sub][0])
        return self.sizes.get(index) if size is None else size

    def download(self, index: int, sub: int, data: bytes) -> int:
        """Write a value from an SDO download or an RPDO: 0, or the abort code of a rejected write."""
        abort = self.writable(index, sub, len(data))
        if abort:
            return abort
        entry = self._entries[index][sub]
        try:
            value = decode(entry[0], data)
        except UnicodeError:
            return codes.INVALID_VALUE
        abort = check(entry, value)
        if abort:
            return abort
        if entry[2] & VIEW and self.views is not None:
            return self.views[1](index, sub, value)
        setting = index != communication.VERIFY_CONFIGURATION and is_setting(entry)
        before = encode(entry[0], self.values[index << 8 | sub]) if setting else data
        writer = self.writers.get(index)
        if writer is not None:
            abort = writer(sub, value)
            if abort:
                return abort
        self.values[index << 8 | sub] = value
        if before != data:
            self.edited = True
            if entry[2] & COUNTED and self.changed is not None:
                self.changed()
        return 0


def is_setting(entry: "Entry") -> bool:
    """Return whether the value of an entry is stored."""
    return entry[1] == "rw" and not entry[2] & NOT_STORED


def check(entry: "Entry", value: "Value") -> int:
    """Return the abort code of a value outside the entry's limits, 0 if it is inside."""
    kind, _access, flags, _default, low, high = entry
    # inf - inf and nan - nan are both nan: one test for every non-finite value.
    if kind == "f" and not flags & ANY_FLOAT and value - value != 0.0:  # type: ignore[operator]
        return codes.INVALID_VALUE
    if high is not None and not value <= high:  # type: ignore[operator]
        return codes.TOO_HIGH if value > high else codes.INVALID_VALUE  # type: ignore[operator]  # NaN
    if low is not None and not value >= low:  # type: ignore[operator]
        return codes.TOO_LOW if value < low else codes.INVALID_VALUE  # type: ignore[operator]
    return 0
