"""A machine in TOML: several simulated devices with their values, signals, faults and applications."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from canopen_device.errors import InputError
from canopen_device.machine import signals
from canopen_device.machine.device import Key, SimulatedDevice, made_device
from canopen_device.machine.faults import EMCY, SILENT, SLOW, WRONG_TOGGLE, Planned
from canopen_device.paths_below import below
from canopen_device.toml_table import convert, read_table

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


def _device(part: DevicePart, folder: Path) -> SimulatedDevice:
    driven: dict[Key, signals.Signal] = {}
    for signal in part.signal:
        if signal.object in driven:
            raise InputError(f"{signal.object!r}: two signals; an object has one")
        driven[signal.object] = _signal(signal, folder)
    device = made_device(part.eds, part.node_id, part.application, part.values, driven, part.store, folder)
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
