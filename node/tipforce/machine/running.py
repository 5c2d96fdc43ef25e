"""Simulated devices on a bus, run by one thread: for tests of masters."""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tipforce.eds.reader import read_eds
from tipforce.errors import InputError
from tipforce.machine.device import Key, SimulatedDevice, shipped_eds
from tipforce.running import loop
from tipforce.running.ports import PythonCanPort

if TYPE_CHECKING:
    import can
    import canopen

    from tipforce.dictionary.types import Value
    from tipforce.host.network.bus import Bus
    from tipforce.machine.application import DeviceApplication
    from tipforce.machine.signals import Signal

_numbers = itertools.count()
_BOOT_S = 5.0


@contextmanager
def simulated_device(
    path: str | os.PathLike[str],
    node_id: int | None = None,
    bus: can.BusABC | canopen.Network | Bus | dict[str, Any] | str | None = None,
    *,
    application: DeviceApplication | None = None,
    values: Mapping[Key, Value] | None = None,
    signals: Mapping[Key, Signal] | None = None,
) -> Iterator[SimulatedDevice]:
    """Run the device of an EDS or DCF on a bus while the block lasts; yield it after its boot-up message is sent.

    ``path`` is a file, or "cia402" for the drive that tipforce ships. ``bus`` is that of the master: the device opens
    its own connection to a virtual, SocketCAN or multicast bus, and uses any other bus itself. A text names a
    SocketCAN interface, a dict holds keywords of ``can.Bus``; without ``bus``, ``device.bus_options`` holds the
    keywords by which this process reaches the device. Parameters are stored in memory. ``values`` are set once,
    ``signals`` all the time.

    Raises InputError for the file, the node-id, a key or a value; EnvironmentLackError for a bus that cannot be
    opened; at the end of the block, the error that ended the device.
    """
    with simulated_devices([device_from_file(path, node_id, application, values, signals)], bus) as devices:
        yield devices[0]


@contextmanager
def simulated_devices(
    devices: Sequence[SimulatedDevice], bus: can.BusABC | canopen.Network | Bus | dict[str, Any] | str | None = None
) -> Iterator[Sequence[SimulatedDevice]]:
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


def device_from_file(
    path: str | os.PathLike[str],
    node_id: int | None = None,
    application: DeviceApplication | None = None,
    values: Mapping[Key, Value] | None = None,
    signals: Mapping[Key, Signal] | None = None,
) -> SimulatedDevice:
    """Return the simulated device of a file, its parameters stored in memory. Raises InputError."""
    import warnings

    from tipforce.eds.load import EdsWarning
    from tipforce.machine.file import CIA402, load_application

    shipped = os.fspath(path) == CIA402 and not Path(path).exists()
    description = read_eds(shipped_eds(CIA402) if shipped else os.fspath(path), node_id)
    for text in description.warnings:
        warnings.warn(text, EdsWarning, stacklevel=4)
    store: dict[str, bytes] = {}

    def save(group: str, data: bytes) -> bool:
        store[group] = data
        return True

    if shipped and application is None:
        application = load_application(CIA402, None)
    device = SimulatedDevice(description, application, signals, save, store.get)
    for key, value in (values or {}).items():
        device.initial_values[key] = value
        device[key] = value
    return device


def _connection(bus: Any) -> tuple[dict[str, Any], can.BusABC, bool]:
    """Return the keywords of a bus, a connection for the devices, and whether to close it."""
    from tipforce.host.network.open_bus import open_bus

    if bus is None:
        options: dict[str, Any] = {"interface": "virtual", "channel": f"tipforce-device-{os.getpid()}-{next(_numbers)}"}
        return options, open_bus(**options), True
    if isinstance(bus, str):
        options = {"interface": "socketcan", "channel": bus}
        return options, open_bus(**options), True
    if isinstance(bus, dict):
        return dict(bus), open_bus(**bus), True
    network = getattr(bus, "network", bus)  # of tipforce.Bus
    connected = getattr(network, "bus", network)  # of canopen.Network
    if not hasattr(connected, "recv"):
        raise InputError(f"bus {bus!r}: allowed are a can.Bus, a connected canopen.Network, tipforce.Bus, or a channel")
    options = _options_of(connected)
    if options:
        return options, open_bus(**options), True
    return {}, connected, False


def _options_of(bus: Any) -> dict[str, Any]:
    """Return keywords for a second connection to the channel of ``bus``; empty where only it can reach it."""
    with suppress(ImportError):
        from can.interfaces.virtual import VirtualBus

        if isinstance(bus, VirtualBus):
            return {"interface": "virtual", "channel": bus.channel_id}
    name = type(bus).__module__
    channel = getattr(bus, "channel", None)
    if channel is not None and "socketcan" in name:
        return {"interface": "socketcan", "channel": channel}
    if channel is not None and "udp_multicast" in name:
        return {"interface": "udp_multicast", "channel": channel}
    return {}
