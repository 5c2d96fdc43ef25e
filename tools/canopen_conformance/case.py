"""Conformance cases: small functions, each with the clause that it checks and its requirements on the device."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from canopen_conformance.dut import Dut


class CheckError(Exception):
    """The device violated the clause."""

    def __init__(self, expected: str, got: str) -> None:
        super().__init__(f"expected {expected}; got {got}")
        self.expected = expected
        self.got = got


class NotApplicableError(Exception):
    """The device lacks the feature of the case, which the text names."""


class LostDeviceError(Exception):
    """The device no longer boots, or the bus accepts no frames: the run ends."""


def check(right: object, expected: str, got: str) -> None:
    """Raise CheckError unless ``right``."""
    if not right:
        raise CheckError(expected, got)


class Product(NamedTuple):
    """The devices that a caller's own cases are for: those whose 1018h:2 has this code under the mask.

    ``write_only_index``: an object of these devices, sub-index 0, that can only be written.
    """

    name: str
    code: int
    mask: int
    write_only_index: int | None = None


@dataclass(frozen=True)
class Case:
    """One check. ``needs`` are the (index, sub-index) that must exist.

    ``persistent``: stores parameters or temporarily changes the node-id. ``own``: for devices of the caller's Product
    alone. ``error_frames``: needs the controller's error frames, which a bus does not carry.
    """

    name: str
    clause: str
    title: str
    body: Callable[[Dut], None]
    needs: tuple[tuple[int, int], ...]
    persistent: bool
    own: bool
    error_frames: bool


class Service:
    """The cases of a service of the standard, in the module that declares them; ``own`` as in Case."""

    def __init__(self, name: str, own: bool = False) -> None:
        self.name = name
        self.cases: list[Case] = []
        self._own = own

    def __call__(
        self,
        clause: str,
        title: str,
        *,
        needs: Sequence[tuple[int, int]] = (),
        each: Sequence[tuple[Any, ...]] = ((),),
        persistent: bool = False,
        error_frames: bool = False,
    ) -> Callable[[Callable[..., None]], Callable[..., None]]:
        """Declare a case, or one per tuple of ``each``: arguments of the function after the Dut, and of the title.

        Its name is the service, the function's name without the service, and the number of the tuple.
        """

        def declare(body: Callable[..., None]) -> Callable[..., None]:
            name = f"{self.name}.{body.__name__.removeprefix(f'{self.name}_')}"
            for number, arguments in enumerate(each, 1):
                self.cases.append(
                    Case(
                        name + (f".{number}" if len(each) > 1 else ""),
                        clause.format(*arguments),
                        title.format(*arguments),
                        lambda dut, arguments=arguments: body(dut, *arguments),  # type: ignore[misc]
                        tuple(needs),
                        persistent,
                        self._own,
                        error_frames,
                    )
                )
            return body

        return declare


def all_cases(*packages: ModuleType) -> list[Case]:
    """Return the cases of the standards and those in the modules of a caller's packages, ordered by service."""
    from canopen_conformance import cases

    return sorted(
        (
            case
            for package in (cases, *packages)
            for info in sorted(pkgutil.iter_modules(package.__path__), key=lambda info: info.name)
            for service in vars(importlib.import_module(f"{package.__name__}.{info.name}")).values()
            if isinstance(service, Service)
            for case in service.cases
        ),
        key=lambda case: case.name.partition(".")[0],
    )


def matching(pattern: str, cases: Iterable[Case]) -> list[Case]:
    """Return the cases whose name or clause matches a shell pattern: `nmt.*`, `*crc*`, `CiA 305*`."""
    return [case for case in cases if fnmatchcase(case.name, pattern) or fnmatchcase(case.clause, pattern)]


def by_clause(cases: Iterable[Case]) -> list[Case]:
    """Sort cases by clause: CiA 301 before 302, 7.2.4.3.9 before 7.2.4.3.13."""
    return sorted(cases, key=lambda case: clause_key(case.clause))


def clause_key(clause: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that compares the numbers in a clause as numbers."""
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"[ .]", clause))
