"""The arguments of a command as a typed request: parsed once, handed to the library, printed by the command.

A command declares its request as a frozen dataclass with a field for each flag that it needs. The classes below hold
the common flags: a request of a command that prints inherits ``OutputRequest``, one of a command that opens a bus
``BusRequest``, one of a command that transfers objects ``SdoRequest``. The functions of ``common`` take them in place
of the Namespace.
"""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

Request = TypeVar("Request")
_BUS_FLAGS = ("interface", "channel", "bitrate", "fd", "data_bitrate", "timing", "can_filters")


@dataclass(frozen=True, kw_only=True)
class OutputRequest:
    """The flags of ``common.add_output_arguments``."""

    json: bool
    quiet: bool
    verbose: bool
    color: str


@dataclass(frozen=True, kw_only=True)
class BusRequest(OutputRequest):
    """The flags of ``common.add_bus_arguments``."""

    bus: dict[str, Any]
    """The bus flags that the command line contains, as keywords of ``can.Bus``."""


@dataclass(frozen=True, kw_only=True)
class SdoRequest(BusRequest):
    """The flags of ``common.add_sdo_arguments``."""

    timeout: float
    retries: int


Output: TypeAlias = argparse.Namespace | OutputRequest
BusArguments: TypeAlias = argparse.Namespace | BusRequest
SdoArguments: TypeAlias = argparse.Namespace | SdoRequest


def request_of(kind: type[Request], args: argparse.Namespace) -> Request:
    """Return the dataclass ``kind`` with the argument of each of its fields; ``bus``: those of ``can.Bus``."""
    fields: tuple[dataclasses.Field[Any], ...] = dataclasses.fields(kind)  # type: ignore[arg-type]
    return kind(
        **{field.name: bus_options(args) if field.name == "bus" else getattr(args, field.name) for field in fields}
    )


def bus_options(args: BusArguments) -> dict[str, Any]:
    """Return the bus flags that the command line contains, as keywords of ``can.Bus``."""
    if isinstance(args, BusRequest):
        return dict(args.bus)
    options = {name: getattr(args, name) for name in _BUS_FLAGS if hasattr(args, name)}
    return options | getattr(args, "bus_kwargs", {})
