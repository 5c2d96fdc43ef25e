"""Conformance cases: small functions, each with the clause that it checks and its requirements on the device."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from canopen_conformance.dut import Dut

    Entry: TypeAlias = tuple[int, int]

_FOUND: list[Case] = []


class CheckError(Exception):
    """The device violated the clause."""

    def __init__(self, expected: str, got: str) -> None:
        super().__init__(f"expected {expected}; got {got}")
        self.expected = expected
        self.got = got


def check(right: object, expected: str, got: str) -> None:
    """Raise CheckError unless ``right``."""
    if not right:
        raise CheckError(expected, got)


class NotApplicableError(Exception):
    """The device lacks the feature of the case, which the text names."""


@dataclass(frozen=True)
class Case:
    """One check. ``needs`` are the (index, sub-index) that must exist.

    ``persistent``: stores parameters or temporarily changes the node-id. ``own``: guarantees of tipforce beyond the
    standard, or its own objects. ``error_frames``: needs the controller's error frames, which a bus does not carry.
    """

    name: str
    clause: str
    title: str
    body: Callable[[Dut], None]
    needs: tuple[Entry, ...]
    persistent: bool
    own: bool
    error_frames: bool


def case(
    clause: str,
    title: str,
    *,
    needs: Sequence[Entry] = (),
    each: Sequence[tuple[Any, ...]] = ((),),
    persistent: bool = False,
    own: bool = False,
    error_frames: bool = False,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Declare a case, or one per tuple of ``each``: arguments of the function after the Dut, and of the title."""

    def declare(body: Callable[..., None]) -> Callable[..., None]:
        service = body.__module__.rpartition(".")[2]
        for number, arguments in enumerate(each, 1):
            name = f"{service}.{body.__name__}" + (f".{number}" if len(each) > 1 else "")
            _FOUND.append(
                Case(
                    name,
                    clause.format(*arguments),
                    title.format(*arguments),
                    _bound(body, arguments),
                    tuple(needs),
                    persistent,
                    own,
                    error_frames,
                )
            )
        return body

    return declare


def _bound(body: Callable[..., None], arguments: tuple[Any, ...]) -> Callable[[Dut], None]:
    return lambda dut: body(dut, *arguments)


def all_cases() -> list[Case]:
    """Return every case, ordered by service file and position there."""
    for name in ("canopen_conformance.cases", "tipforce_tools.conformance.cases"):
        for module in sorted(info.name for info in pkgutil.iter_modules(importlib.import_module(name).__path__)):
            importlib.import_module(f"{name}.{module}")
    # Sorted, because another order of import (a test that imports one service) must not change the report.
    return sorted(_FOUND, key=lambda found: found.name.partition(".")[0])


def matching(pattern: str) -> list[Case]:
    """Return the cases whose name or clause matches a shell pattern: `nmt.*`, `*crc*`, `CiA 305*`."""
    return [found for found in all_cases() if fnmatchcase(found.name, pattern) or fnmatchcase(found.clause, pattern)]
