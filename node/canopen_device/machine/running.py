"""Simulated devices made of files (an EDS, an application by its name, stored parameters), and run on a bus."""

from __future__ import annotations

import itertools
import os
import runpy
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canopen_device import types
from canopen_device.eds.description import Entry
from canopen_device.eds.load import EdsWarning
from canopen_device.eds.reader import read_eds
from canopen_device.errors import InputError, placed
from canopen_device.machine.cia402 import Drive
from canopen_device.machine.device import DeviceApplication, Key, SimulatedDevice
from canopen_device.machine.signals import Signal
from canopen_device.paths_below import below
from canopen_device.running import loop
from canopen_device.running.open_bus import PythonCanPort, open_bus
from canopen_device.running.store import FileStore
from canopen_device.types import Value

if TYPE_CHECKING:
    import can

CIA402 = "cia402"
_numbers = itertools.count()


def shipped_eds(name: str) -> Path:
    """The path of a shipped EDS: ``cia402`` for the drive."""
    return Path(__file__).with_name(f"{name}.eds")


def device_from_file(
    path: str | os.PathLike[str], node_id: int | None = None, application: DeviceApplication | None = None,
    values: Mapping[Key, Value] | None = None, signals: Mapping[Key, Signal] | None = None,
) -> SimulatedDevice:  # fmt: skip
    """Return the simulated device of a file, its parameters stored in memory. Raises InputError."""
    device = made_device(os.fspath(path), node_id, application, values, signals)
    for text in device.description.warnings:
        warnings.warn(text, EdsWarning, stacklevel=4)
    return device


def made_device(
    eds: str, node_id: int | None, application: DeviceApplication | str | None = None,
    values: Mapping[Any, Value] | None = None, signals: Mapping[Key, Signal] | None = None, store: str = "",
    folder: Path | None = None,
) -> SimulatedDevice:  # fmt: skip
    """Return a device: ``eds`` may be "cia402", ``application`` a name, ``store`` a file, a text in ``values`` is read
    as its type. Raises InputError, with ``folder`` also for a file that is not below it."""
    shipped = eds == CIA402 and not path_of(folder, eds, "eds").exists()
    description = read_eds(shipped_eds(CIA402) if shipped else path_of(folder, eds, "eds"), node_id)
    if isinstance(application, str | None):
        application = load_application(application or (CIA402 if shipped else ""), folder)
    for slot in (f"{store}.2", store) if store else ():
        path_of(folder, slot, "store")
    kept = FileStore(path_of(folder, store, "store")) if store else loop.MemoryStore()
    device = SimulatedDevice(description, application, signals, kept.save, kept.load)
    for key, given in (values or {}).items():
        device.initial_values[key] = device[key] = typed_value(description.find(key), given)
    return device


def typed_value(entry: Entry, value: Value) -> Value:
    """Return a value as the entry has it; a text is read as ``sdo write`` reads it. Raises InputError."""
    with placed(f"{entry.place} {entry.name!r}"):
        text = isinstance(value, str) and entry.type.python is not str
        return types.parse_value(entry.letter, str(value)) if text else value


def path_of(folder: Path | None, name: str, place: str) -> Path:
    """Return the path of a name: of a file in ``folder``, where it must be below that; None: of a user, anywhere."""
    return Path(name) if folder is None else below(folder, name, place)


def load_application(name: str, folder: Path | None) -> DeviceApplication | None:
    """Return a new application: "cia402", or "file.py:Class". Raises InputError."""
    if not name:
        return None
    if name == CIA402:
        return Drive()
    file, _, wanted = name.rpartition(":")
    path = path_of(folder, file, "application") if file else Path()
    if not file.endswith(".py") or not path.is_file():
        raise InputError(f"application {name!r}: allowed are {CIA402}, and FILE:CLASS of a file that exists")
    try:
        named: Any = runpy.run_path(str(path)).get(wanted)
        made = named() if isinstance(named, type) and issubclass(named, DeviceApplication) else None
    except Exception as error:
        raise InputError(f"application {name!r}: {path}: {type(error).__name__}: {error}") from error
    if made is None:
        raise InputError(f"application {name!r}: {path} has no subclass of DeviceApplication called {wanted!r}")
    return made


@contextmanager
def simulated_device(
    path: str | os.PathLike[str], node_id: int | None = None, bus: Any = None, *,
    application: DeviceApplication | None = None, values: Mapping[Key, Value] | None = None,
    signals: Mapping[Key, Signal] | None = None,
) -> Iterator[SimulatedDevice]:  # fmt: skip
    """Run the device of an EDS, a DCF or "cia402" (the shipped drive) while the block lasts, from its boot-up on.

    ``bus``: the master's ``can.BusABC``, or an object that has it as ``bus`` or ``network.bus`` (``canopen.Network``),
    to which the device opens a second connection where it can; a SocketCAN interface; keywords of ``can.Bus``; without
    it ``device.bus_options`` reach the device. ``values`` are set once, ``signals`` all the time. Raises InputError for
    an argument, EnvironmentLackError for a bus that cannot be opened, and at the end what ended the device."""
    with simulated_devices([device_from_file(path, node_id, application, values, signals)], bus) as devices:
        yield devices[0]


@contextmanager
def simulated_devices(devices: Sequence[SimulatedDevice], bus: Any = None) -> Iterator[Sequence[SimulatedDevice]]:
    """Run several devices on one bus, as ``simulated_device`` does one."""
    options, connection, owned = _connection(bus)
    for device in devices:
        device.shared, device.bus_options = True, options
    try:
        with loop.running(devices, PythonCanPort(connection)) as thread:
            # Time passes for a device from its second step on: then its boot-up message is sent.
            while thread.is_alive() and any(device.now_s <= 0.0 for device in devices):
                time.sleep(0.001)
            yield devices
    finally:
        if owned:
            connection.shutdown()


def _connection(bus: Any) -> tuple[dict[str, Any], can.BusABC, bool]:
    if bus is None:
        options = {"interface": "virtual", "channel": f"simulated-device-{os.getpid()}-{next(_numbers)}"}
    elif isinstance(bus, str):
        options = {"interface": "socketcan", "channel": bus}
    elif isinstance(bus, dict):
        options = dict(bus)
    else:
        network = getattr(bus, "network", bus)  # of a host's object that holds the network
        connected = getattr(network, "bus", network)  # of canopen.Network
        if not hasattr(connected, "recv"):
            allowed = "a can.Bus, a connected canopen.Network, an object with one as `network`, a name"
            raise InputError(f"bus {bus!r}: allowed are {allowed}")
        options = _options_of(connected)
        if not options:
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
