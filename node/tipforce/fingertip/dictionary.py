"""The table of ``tipforce.dictionary`` as the object dictionary of a running device."""

from tipforce.device import communication
from tipforce.device import object_dictionary as od_flags
from tipforce.device.object_dictionary import ObjectDictionary
from tipforce.dictionary import table

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.device.object_dictionary import Entry, Value
    from tipforce.dictionary.table import Converter


def build(
    n: int,
    node_id: int,
    simulated: bool,
    serial: int = 0,
    eds: bytes = b"",
    converter: "Converter" = table.CONVERTER_16,
    programs: bool = False,
) -> ObjectDictionary:
    """The dictionary of a node with ``n`` gauges at its defaults. ``eds`` is what 1021h gives; empty leaves it out.

    ``programs`` adds the objects of program slots.
    """
    od = ObjectDictionary(node_id)
    shared: "dict[Entry, Entry]" = {}  # equal entries are one tuple: a microcontroller has no room for all of them
    for index, _code, _name, _slug, entries in table.declared(n, simulated, converter, programs):
        if index in (communication.STORED_EDS, communication.EDS_FORMAT) and not eds:
            continue
        for first, count, _label, _part, kind, access, flags, default, low, high, _unit in entries:
            core_flags = _flags(flags)
            for k in range(count):
                value: "Value" = default[k] if isinstance(default, tuple) else default
                if kind == "D":
                    value = b""
                entry = (kind, access, core_flags, value, low, high)
                shared[entry] = od.add(index, first + k, shared.get(entry, entry))
    if eds:
        od.readers[communication.STORED_EDS] = lambda _sub: eds
    first = communication.IDENTITY << 8
    od.readers[communication.IDENTITY] = lambda sub: serial if sub == 4 else od.values[first | sub]
    return od


def _flags(flags: int) -> int:
    """The table's flags in the words of the device core."""
    if not flags:
        return 0  # most entries
    found = 0
    for ours, theirs in (
        (table.TPDO, od_flags.TPDO),
        (table.RPDO, od_flags.RPDO),
        (table.ADD_NODE_ID, od_flags.ADD_NODE_ID),
        (table.STAGED, od_flags.ANY_FLOAT | od_flags.NOT_STORED),
        (table.VIEW, od_flags.VIEW | od_flags.NOT_STORED),
        (table.NOT_STORED, od_flags.NOT_STORED),
        (table.COUNTED, od_flags.COUNTED),
    ):
        if flags & ours:
            found |= theirs
    return found
