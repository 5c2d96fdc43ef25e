"""A fingertip node, put together: dictionary (from the table), CANopen device, application, gauge source."""

from canopen_device.core import communication
from canopen_device.core.codes import LSS_UNCONFIGURED
from canopen_device.core.node import Device
from canopen_device.core.object_dictionary import ObjectDictionary
from tipforce.dictionary import table, table_objects

from .application import Fingertip

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from canopen_device.core.object_dictionary import Entry, Value
    from canopen_device.core.program import Programs
    from tipforce.dictionary.table import Converter

    from .source import Source


def build(
    n: int, node_id: int, simulated: bool, serial: int = 0, eds: bytes = b"",
    converter: "Converter" = table.CONVERTER_16, programs: bool = False,
) -> ObjectDictionary:  # fmt: skip
    """The dictionary of ``n`` gauges at its defaults; ``eds``: of 1021h, or empty; ``programs``: with slots."""
    od = ObjectDictionary(node_id)
    shared: "dict[Entry, Entry]" = {}  # equal entries are one tuple: a microcontroller has no room for all of them
    for index, _code, _name, _slug, entries in table_objects.declared(n, simulated, converter, programs):
        if index in (communication.STORED_EDS, communication.EDS_FORMAT) and not eds:
            continue
        for first, count, _label, _part, kind, access, flags, default, low, high, _unit in entries:
            stored_elsewhere = table.NOT_STORED if flags & (table.STAGED | table.VIEW) else 0
            for k in range(count):
                value: "Value" = default[k] if isinstance(default, tuple) else default
                if kind == "D":
                    value = b""
                entry = (kind, access, flags | stored_elsewhere, value, low, high)
                shared[entry] = od.add(index, first + k, shared.get(entry, entry))
    if eds:
        od.readers[communication.STORED_EDS] = lambda _sub: eds
    first = communication.IDENTITY << 8
    od.readers[communication.IDENTITY] = lambda sub: serial if sub == 4 else od.values[first | sub]
    return od


def fingertip_node(
    node_id: int, source: "Source", n: int = 3, serial: int = 0, save: "Callable[[str, bytes], bool] | None" = None,
    load: "Callable[[str], bytes | None] | None" = None, eds: bytes = b"", programs: "Programs | None" = None,
) -> Device:  # fmt: skip
    """A device that measures with ``source`` (n gauges).

    Step it, or hand it to a bus loop. ``node_id`` is 1..127, or 255 for a node that waits for LSS. ``source.simulated``
    adds 2200h and 2201h. ``save`` and ``load`` keep parameter groups; without them 1010h and 1011h refuse. ``programs``
    are the program slots of firmware that has them. Raises ValueError for a node-id or a number of gauges that is not
    allowed.
    """
    if not (1 <= node_id <= 127 or node_id == LSS_UNCONFIGURED):
        raise ValueError("node-id: %r, allowed 1 to 127, and 255 for none yet" % node_id)
    od = build(n, node_id, source.simulated, serial, eds, source.converter, programs is not None)
    device = Device(od, save, load)
    if programs is not None:
        from canopen_device.core.program import ProgramDownload

        ProgramDownload(device, programs)
    Fingertip(device, n, source)
    source.attach(device)
    return device
