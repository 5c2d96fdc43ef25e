"""A machine in TOML: several simulated devices with their values, signals, faults and applications."""

import operator
import types
from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import msgspec

from canopen_device.errors import InputError, placed
from canopen_device.machine import signals
from canopen_device.machine.device import EMCY, SILENT, SLOW, WRONG_TOGGLE, Key, SimulatedDevice
from canopen_device.machine.running import made_device
from canopen_device.paths_below import below
from canopen_device.toml_table import convert, read_table


def _list_of(*structs: type[msgspec.Struct]) -> Any:
    return types.GenericAlias(tuple, (reduce(operator.or_, structs), ...))


def _tables(kinds: Mapping[str, Sequence[tuple[Any, ...]]]) -> Any:
    """Return the type of a list of tables: (key, type, default where there is one) by the value of ``kind``."""
    return _list_of(
        *(
            msgspec.defstruct(kind, keys, tag=kind, tag_field="kind", forbid_unknown_fields=True)
            for kind, keys in kinds.items()
        )
    )


_OBJECT = ("object", str | int)
_SIGNALS = _tables({
    "ramp": [_OBJECT, ("start", float), ("end", float), ("duration_s", float), ("repeats", bool, False)],
    "sine": [_OBJECT, ("amplitude", float), ("cycle_s", float), ("offset", float, 0.0), ("phase_deg", float, 0.0)],
    "random_walk": [
        _OBJECT, ("step", float), ("low", float), ("high", float), ("start", float, 0.0), ("every_s", float, 0.1),
        ("seed", int, 0),
    ],
    "csv": [_OBJECT, ("file", str), ("column", str), ("time_column", str, "t_s"), ("repeats", bool, False)],
    "follows": [_OBJECT, ("source", str | int), ("gain", float, 1.0), ("offset", float, 0.0), ("lag_s", float, 0.0)],
})  # fmt: skip
_WHEN = (("at_s", float, 0.0), ("for_s", float | None, None))
_FAULTS = _tables({
    SILENT: _WHEN, SLOW: [("delay_s", float), *_WHEN], WRONG_TOGGLE: _WHEN,
    EMCY: [("code", int), ("register", int, 1), *_WHEN],
})  # fmt: skip
_DEVICE = msgspec.defstruct(
    "Device",
    [
        ("eds", str), ("node_id", int | None, None), ("application", str, ""), ("store", str, ""),
        ("values", dict[str, int | float | str], {}), ("signal", _SIGNALS, ()), ("fault", _FAULTS, ()),
    ],
    forbid_unknown_fields=True,
)  # fmt: skip
_MACHINE = msgspec.defstruct("Machine", [("device", _list_of(_DEVICE))], forbid_unknown_fields=True)


def read_machine(path: str | Path) -> list[SimulatedDevice]:
    """Return the devices of a TOML file; files that it names are below its folder. Raises InputError."""
    place = str(path)
    machine: Any = convert(_MACHINE, read_table(path, place), place)
    if not machine.device:
        raise InputError(f"{place}: no device; write [[device]] with eds and node_id")
    folder, made = Path(path).resolve().parent, []
    for number, part in enumerate(machine.device, 1):
        with placed(f"{place}: device[{number}]"):
            made.append(_device(part, folder))
    check_node_ids(made, f"{place}: ")
    return made


def check_node_ids(devices: Sequence[SimulatedDevice], place: str = "") -> None:
    """Raise InputError for a node-id that two devices have."""
    seen: set[int] = set()
    for device in devices:
        if device.core.node_id in seen:
            raise InputError(f"{place}node-id {device.core.node_id}: two devices have it")
        seen.add(device.core.node_id)


def _device(part: Any, folder: Path) -> SimulatedDevice:
    driven: dict[Key, signals.Signal] = {}
    for table in part.signal:
        if table.object in driven:
            raise InputError(f"{table.object!r}: two signals; an object has one")
        driven[table.object] = _signal(folder, str(table.__struct_config__.tag), **msgspec.structs.asdict(table))
    device = made_device(part.eds, part.node_id, part.application, part.values, driven, part.store, folder)
    for table in part.fault:
        device.faults.plan(str(table.__struct_config__.tag), **msgspec.structs.asdict(table))
    return device


def _signal(folder: Path, kind: str, object: str | int, **given: Any) -> signals.Signal:
    """Return the signal of a table. Raises InputError for limits out of order."""
    if kind == "csv":
        path = below(folder, given["file"], f"signal of {object!r}: file")
        return signals.recorded(path, given["column"], given["time_column"], given["repeats"])
    if kind == "follows":
        return signals.Follows(given.pop("source"), **given)
    if kind == "random_walk" and not given["low"] <= given["start"] <= given["high"]:
        limits = f"{given['low']} to {given['high']}"
        raise InputError(f"signal of {object!r}: start {given['start']}: allowed are {limits}")
    return {"ramp": signals.Ramp, "sine": signals.Sine, "random_walk": signals.RandomWalk}[kind](**given)
