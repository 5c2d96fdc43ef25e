"""Conformance cases: small functions, each with the clause that it checks and its requirements on the device."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from canopen_conformance.dut import Dut

Step: TypeAlias = "Callable[[Dut], object]"
Needs: TypeAlias = Sequence[tuple[int, int]]
"""The (index, sub-index) that must exist."""


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


def need(fits: object, lack: str) -> None:
    """Raise NotApplicableError with the text ``lack`` unless the case ``fits`` the device."""
    if not fits:
        raise NotApplicableError(lack)


class Product(NamedTuple):
    """The devices that a caller's own cases are for: those whose 1018h:2 has this code under the mask.
    ``write_only_index``: an object of these devices, sub-index 0, that can only be written."""

    name: str
    code: int
    mask: int
    write_only_index: int | None = None


@dataclass(frozen=True)
class Case:
    """One check. ``needs``: (index, sub-index) that must exist; ``persistent``: stores parameters or changes the
    node-id; ``own``: for the caller's Product; ``error_frames``: needs those of a controller."""

    name: str
    clause: str
    title: str
    body: Step
    needs: tuple[tuple[int, int], ...]
    persistent: bool
    own: bool
    error_frames: bool


_HEADER = re.compile(r"(?:(?!tipforce )([a-z]\w*) )?((?:CiA \S+ |tipforce )?\S+): (.*)")


class Service:
    """The cases of a service of the standard, in the module that declares them; ``own`` as in Case. The header of a
    case is "name clause: title"; a clause that is a number is of ``standard``. Cases of one name are numbered."""

    def __init__(self, name: str, own: bool = False, standard: str = "CiA 301") -> None:
        self.name = name
        self._own = own
        self._standard = standard
        self._cases: dict[str, list[Case]] = {}

    @property
    def cases(self) -> Iterator[Case]:
        """The cases in the order of their declaration."""
        for same in self._cases.values():
            for number, case in enumerate(same, 1):
                yield replace(case, name=f"{case.name}.{number}") if len(same) > 1 else case

    def __call__(
        self,
        header: str,
        needs: Needs = (),
        *steps: Step,
        each: Sequence[tuple[Any, ...]] = ((),),
        persistent: bool = False,
        error_frames: bool = False,
    ) -> Callable[[Callable[..., object]], Callable[..., object]]:
        """Declare a case by its steps, called with the Dut in order, or by the decorated function, after which a header
        without a name is named. ``each``: a case per row, of arguments after the Dut, clause and title."""
        match = _HEADER.fullmatch(header)
        if match is None:
            raise ValueError(f"{header!r}: the form of a case is 'name clause: title'")
        clause = match[2] if " " in match[2] else f"{self._standard} {match[2]}"

        def declare(function: Callable[..., object]) -> Callable[..., object]:
            name = f"{self.name}.{match[1] or function.__name__.removeprefix(f'{self.name}_')}"
            for row in each:
                body = partial(lambda row, dut: function(dut, *row), row)
                at, title = (text.format(*row) if row else text for text in (clause, match[3]))
                case = Case(name, at, title, body, tuple(needs), persistent, self._own, error_frames)
                self._cases.setdefault(name, []).append(case)
            return function

        if steps:
            declare(lambda dut: [step(dut) for step in steps])
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
