"""Simulated devices on a bus, run by one thread: for tests of masters."""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from canopen_device.errors import InputError
from canopen_device.machine.device import DeviceApplication, Key, SimulatedDevice
from canopen_device.machine.make import device_from_file
from canopen_device.running import loop
from canopen_device.running.ports import PythonCanPort

if TYPE_CHECKING:
    import can

    from canopen_device.machine.signals import Signal
    from canopen_device.types import Value

_numbers = itertools.count()
_BOOT_S = 5.0


@contextmanager
def simulated_device(
    path: str | os.PathLike[str],
    node_id: int | None = None,
    bus: Any = None,
    *,
    application: DeviceApplication | None = None,
    values: Mapping[Key, Value] | None = None,
    signals: Mapping[Key, Signal] | None = None,
) -> Iterator[SimulatedDevice]:
    """Run the device of an EDS or DCF on a bus while the block lasts; yield it after its boot-up message is sent.

    ``path`` is a file, or "cia402" for the shipped drive. ``bus`` is that of the master: a ``can.BusABC``, or an object
    that has one as ``bus`` or ``network.bus``, such as a ``canopen.Network``. The device opens its own connection to a
    virtual, SocketCAN or multicast bus, and uses any other bus itself. A text names a
    SocketCAN interface, a dict holds keywords of ``can.Bus``; without ``bus``, ``device.bus_options`` holds the
    keywords by which this process reaches the device. Parameters are stored in memory. ``values`` are set once,
    ``signals`` all the time.

    Raises InputError for the file, the node-id, a key or a value; EnvironmentLackError for a bus that cannot be
    opened; at the end of the block, the error that ended the device.
    """
    with simulated_devices([device_from_file(path, node_id, application, values, signals)], bus) as devices:
        yield devices[0]


@contextmanager
def simulated_devices(devices: Sequence[SimulatedDevice], bus: Any = None) -> Iterator[Sequence[SimulatedDevice]]:
    """Run several devices on one bus, as ``simulated_device`` does one."""
    options, connection, owned = _connection(bus)
    stopped, booted = threading.Event(), threading.Event()
    failures: list[BaseException] = []
    for device in devices:
        device.shared, device.bus_options = True, options

    def ended() -> bool:
        if all(device.now_s > 0.0 for device in devices):
            booted.set()
        return stopped.is_set()

    def run() -> None:
        try:
            loop.run(devices, PythonCanPort(connection), ended)
        except BaseException as error:
            failures.append(error)
        finally:
            booted.set()

    thread = threading.Thread(target=run, name="simulated devices", daemon=True)
    thread.start()
    try:
        booted.wait(_BOOT_S)
        yield devices
    finally:
        stopped.set()
        thread.join()
        if owned:
            connection.shutdown()
    if failures:
        raise failures[0]


def _connection(bus: Any) -> tuple[dict[str, Any], can.BusABC, bool]:
    """Return the keywords of a bus, a connection for the devices, and whether to close it."""
    from canopen_device.running.open_bus import open_bus

    connected, options = None, {}
    if bus is None:
        options = {"interface": "virtual", "channel": f"simulated-device-{os.getpid()}-{next(_numbers)}"}
    elif isinstance(bus, str):
        options = {"interface": "socketcan", "channel": bus}
    elif isinstance(bus, dict):
        return dict(bus), open_bus(bus), True
    else:
        network = getattr(bus, "network", bus)  # of a host's object that holds the network
        connected = getattr(network, "bus", network)  # of canopen.Network
        if not hasattr(connected, "recv"):
            allowed = "a can.Bus, a connected canopen.Network, an object with one as `network`, a name"
            raise InputError(f"bus {bus!r}: allowed are {allowed}")
        options = _options_of(connected)
    if connected is not None and not options:
        return {}, connected, False
    return options, open_bus(options), True


def _options_of(bus: Any) -> dict[str, Any]:
    """Return keywords for a second connection to the channel of ``bus``; empty where only it can reach it."""
    from can.interfaces.virtual import VirtualBus

    if isinstance(bus, VirtualBus):
        return {"interface": "virtual", "channel": bus.channel_id}
    channel = getattr(bus, "channel", None)
    for interface in ("socketcan", "udp_multicast"):
        if channel is not None and interface in type(bus).__module__:
            return {"interface": interface, "channel": channel}
    return {}
