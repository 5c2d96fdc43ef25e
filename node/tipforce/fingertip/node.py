"""A fingertip node, put together: dictionary, CANopen device, application, gauge source."""

from tipforce.device.codes import LSS_UNCONFIGURED
from tipforce.device.node import Device

from .application import Fingertip
from .dictionary import build

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from tipforce.device.program import Programs

    from .source import Source


def fingertip_node(
    node_id: int,
    source: "Source",
    n: int = 3,
    serial: int = 0,
    save: "Callable[[str, bytes], bool] | None" = None,
    load: "Callable[[str], bytes | None] | None" = None,
    eds: bytes = b"",
    programs: "Programs | None" = None,
) -> Device:
    """A device that measures with ``source`` (n gauges). Step it, or hand it to a bus loop.

    ``node_id`` is 1..127, or 255 for a node that waits until LSS gives it one.

    Objects 2200h and 2201h exist when the source is a simulated one (``source.simulated``). ``save`` and ``load`` keep
    parameter groups; without them 1010h and 1011h refuse. ``programs`` are the program slots of firmware that has them.
    Raises ValueError for a node-id or a number of gauges that is not allowed.
    """
    if not (1 <= node_id <= 127 or node_id == LSS_UNCONFIGURED):
        raise ValueError("node-id: %r, allowed 1 to 127, and 255 for none yet" % node_id)
    device = Device(
        build(n, node_id, source.simulated, serial, eds, source.converter, programs is not None), save, load
    )
    if programs is not None:
        from tipforce.device.program import ProgramDownload

        ProgramDownload(device, programs)
    Fingertip(device, n, source)
    source.attach(device)
    return device
