"""A machine in TOML: several simulated devices with their values, signals, faults and applications."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from tipforce.dictionary import types
from tipforce.dictionary.types import Value
from tipforce.eds.description import Description
from tipforce.eds.reader import read_eds
from tipforce.errors import InputError
from tipforce.machine import signals
from tipforce.machine.application import DeviceApplication
from tipforce.machine.device import Key, SimulatedDevice, shipped_eds
from tipforce.machine.faults import EMCY, SILENT, SLOW, WRONG_TOGGLE, Planned
from tipforce.paths_below import below
from tipforce.toml_table import convert, read_table

CIA402 = "cia402"
_STRICT = {"forbid_unknown_fields": True, "tag_field": "kind"}


class RampPart(msgspec.Struct, tag="ramp", **_STRICT):
    """See ``signals.Ramp``."""

    object: str | int
    start: float
    end: float
    duration_s: float
    repeats: bool = False


class SinePart(msgspec.Struct, tag="sine", **_STRICT):
    """See ``signals.Sine``."""

    object: str | int
    amplitude: float
    cycle_s: float
    offset: float = 0.0
    phase_deg: float = 0.0


class RandomWalkPart(msgspec.Struct, tag="random_walk", **_STRICT):
    """See ``signals.RandomWalk``."""

    object: str | int
    step: float
    low: float
    high: float
    start: float = 0.0
    every_s: float = 0.1
    seed: int = 0


class CsvPart(msgspec.Struct, tag="csv", **_STRICT):
    """See ``signals.recorded``."""

    object: str | int
    file: str
    column: str
    time_column: str = "t_s"
    repeats: bool = False


class FollowsPart(msgspec.Struct, tag="follows", **_STRICT):
    """See ``signals.Follows``."""

    object: str | int
    source: str | int
    gain: float = 1.0
    offset: float = 0.0
    lag_s: float = 0.0


class SilentPart(msgspec.Struct, tag=SILENT, **_STRICT):
    """The device neither hears nor sends."""

    at_s: float = 0.0
    for_s: float | None = None


class SlowPart(msgspec.Struct, tag=SLOW, **_STRICT):
    """SDO responses come late."""

    delay_s: float
    at_s: float = 0.0
    for_s: float | None = None


class WrongTogglePart(msgspec.Struct, tag=WRONG_TOGGLE, **_STRICT):
    """SDO segments have the wrong toggle bit."""

    at_s: float = 0.0
    for_s: float | None = None


class EmcyPart(msgspec.Struct, tag=EMCY, **_STRICT):
    """An error is active: EMCY when it begins and when it ends."""

    code: int
    register: int = 1
    at_s: float = 0.0
    for_s: float | None = None


class DevicePart(msgspec.Struct, forbid_unknown_fields=True):
    """One device."""

    eds: str
    node_id: int | None = None
    application: str = ""
    store: str = ""
    values: dict[str, int | float | str] = {}
    signal: tuple[RampPart | SinePart | RandomWalkPart | CsvPart | FollowsPart, ...] = ()
    fault: tuple[SilentPart | SlowPart | WrongTogglePart | EmcyPart, ...] = ()


class MachinePart(msgspec.Struct, forbid_unknown_fields=True):
    """The whole file."""

    device: tuple[DevicePart, ...]


def read_machine(path: str | Path) -> list[SimulatedDevice]:
    """Return the devices of a TOML file; files that it names are below its folder. Raises InputError."""
    place = str(path)
    machine = convert(MachinePart, read_table(path, place), place)
    if not machine.device:
        raise InputError(f"{place}: no device; write [[device]] with eds and node_id")
    folder, made = Path(path).resolve().parent, []
    for number, part in enumerate(machine.device, 1):
        try:
            made.append(_device(part, folder))
        except InputError as error:
            raise InputError(f"{place}: device[{number}]: {error}") from None
    check_node_ids(made, f"{place}: ")
    return made


def check_node_ids(devices: Sequence[SimulatedDevice], place: str = "") -> None:
    """Raise InputError for a node-id that two devices have."""
    seen: set[int] = set()
    for device in devices:
        if device.core.node_id in seen:
            raise InputError(f"{place}node-id {device.core.node_id}: two devices have it")
        seen.add(device.core.node_id)


def make_device(
    eds: str,
    node_id: int | None,
    application: str = "",
    values: Mapping[str, int | float | str] | None = None,
    store: str = "",
    driven: Mapping[Key, signals.Signal] | None = None,
    folder: Path | None = None,
) -> SimulatedDevice:
    """Return a device of a file: "cia402" is the shipped drive. ``folder``: of the file that names the others.

    Raises InputError, with ``folder`` for a file that is not below it, too.
    """
    shipped = eds == CIA402 and not _path(folder, eds, "eds").exists()
    description = read_eds(shipped_eds(CIA402) if shipped else _path(folder, eds, "eds"), node_id)
    kept: dict[str, bytes] = {}

    def save(group: str, data: bytes) -> bool:
        kept[group] = data
        return True

    load = kept.get
    if store:
        from tipforce.running.store import FileStore

        for slot in (f"{store}.2", store):
            path = _path(folder, slot, "store")
        file = FileStore(path)
        save, load = file.save, file.load  # type: ignore[assignment]
    chosen = load_application(application or (CIA402 if shipped else ""), folder)
    device = SimulatedDevice(description, chosen, driven, save, load)
    for key, text in (values or {}).items():
        device.initial_values[key] = typed_value(description, key, text)
        device[key] = device.initial_values[key]
    return device


def _path(folder: Path | None, name: str, place: str) -> Path:
    """Return the path of a name: of a file in ``folder``, where it must be below that; None: of a user, anywhere."""
    return Path(name) if folder is None else below(folder, name, place)


def typed_value(description: Description, key: str, value: float | str) -> Value:
    """Return a value as the entry has it; a text is read as ``sdo write`` reads it. Raises InputError."""
    entry = description.find(key)
    try:
        return types.parse_value(entry.letter, value) if isinstance(value, str) else value
    except InputError as error:
        raise InputError(f"{entry.place} {entry.name!r}: {error}") from None


def load_application(name: str, folder: Path | None) -> DeviceApplication | None:
    """Return a new application: "cia402", or "file.py:Class". Raises InputError."""
    if not name:
        return None
    if name == CIA402:
        from tipforce.machine.cia402 import Drive

        return Drive()
    file, _, wanted = name.rpartition(":")
    path = _path(folder, file, "application") if file else Path()
    if not file.endswith(".py") or not path.is_file():
        raise InputError(f"application {name!r}: allowed are {CIA402}, and FILE:CLASS of a file that exists")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise InputError(f"application {name!r}: {path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        found: Any = getattr(module, wanted, None)
        made = found() if isinstance(found, type) and issubclass(found, DeviceApplication) else None
    except Exception as error:
        raise InputError(f"application {name!r}: {path}: {type(error).__name__}: {error}") from error
    if made is None:
        raise InputError(f"application {name!r}: {path} has no subclass of DeviceApplication called {wanted!r}")
    return made


def _device(part: DevicePart, folder: Path) -> SimulatedDevice:
    driven: dict[Key, signals.Signal] = {}
    for one in part.signal:
        if one.object in driven:
            raise InputError(f"{one.object!r}: two signals; an object has one")
        driven[one.object] = _signal(one, folder)
    device = make_device(part.eds, part.node_id, part.application, part.values, part.store, driven, folder)
    for fault in part.fault:
        given = {name: getattr(fault, name) for name in ("delay_s", "code", "register") if hasattr(fault, name)}
        device.faults.plan(Planned(str(fault.__struct_config__.tag), fault.at_s, fault.for_s, given))
    return device


def _signal(part: RampPart | SinePart | RandomWalkPart | CsvPart | FollowsPart, folder: Path) -> signals.Signal:
    """Return the signal of a table. Raises InputError for a time that is not above 0, and limits out of order."""
    for name in ("duration_s", "cycle_s", "every_s"):
        if hasattr(part, name) and not getattr(part, name) > 0.0:
            raise InputError(f"signal of {part.object!r}: {name} {getattr(part, name)}: allowed is above 0")
    if isinstance(part, RampPart):
        return signals.Ramp(part.start, part.end, part.duration_s, part.repeats)
    if isinstance(part, SinePart):
        return signals.Sine(part.amplitude, part.offset, part.cycle_s, part.phase_deg)
    if isinstance(part, CsvPart):
        path = below(folder, part.file, f"signal of {part.object!r}: file")
        return signals.recorded(path, part.column, part.time_column, part.repeats)
    if isinstance(part, FollowsPart):
        return signals.Follows(part.source, part.gain, part.offset, part.lag_s)
    if not part.low <= part.start <= part.high:
        raise InputError(f"signal of {part.object!r}: start {part.start}: allowed are {part.low} to {part.high}")
    return signals.RandomWalk(part.start, part.step, part.low, part.high, part.every_s, part.seed)
