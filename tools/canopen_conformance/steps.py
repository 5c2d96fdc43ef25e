"""The steps of a case as values: ``do.put("H", 0x1017, 0, 20)`` calls ``Dut.put`` so when the case runs. A step is any
function of the Dut; arguments that only the running case knows are ``late``."""

import math
import struct
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar

from canopen_conformance.case import Needs, Step, check
from canopen_conformance.dut import Dut
from canopen_conformance.wire import Frame

P = ParamSpec("P")
T = TypeVar("T")


def step(function: Callable[Concatenate[Dut, P], T]) -> Callable[P, Callable[[Dut], T]]:
    """Make of a function of the Dut and further arguments one of these alone that returns the step."""

    def of(*arguments: Any, **named: Any) -> Callable[[Dut], T]:
        def taken(dut: Dut) -> T:
            values: Any = [given.read(dut) if isinstance(given, _Late) else given for given in arguments]
            return function(dut, *values, **named)

        return taken

    return of


class _Late(NamedTuple):
    """A positional argument that a step reads when it is taken."""

    read: Step


def late(function: Callable[Concatenate[Dut, P], T]) -> Callable[P, T]:
    """Make of a function of the Dut and further arguments one of these alone that stands for its value in a step."""

    def of(*arguments: Any, **named: Any) -> Any:
        return _Late(step(function)(*arguments, **named))

    return of


def run(function: Callable[Concatenate[Dut, P], object], *arguments: P.args, **named: P.kwargs) -> Step:
    """Return the step that calls ``function`` with the Dut and these arguments."""
    return step(function)(*arguments, **named)


@step
def repeat(dut: Dut, /, times: int, *steps: Step) -> None:
    """Take the steps so many times."""
    for taken in times * steps:
        taken(dut)


@step
def within(dut: Dut, /, context: Callable[[Dut], AbstractContextManager[object]], *steps: Step) -> None:
    """Take the steps inside a context."""
    with context(dut):
        for taken in steps:
            taken(dut)


def undone_by(*steps: Step) -> Callable[[Dut], AbstractContextManager[None]]:
    """Return the context that takes these steps at its end, also after a failure."""

    @contextmanager
    def undone(dut: Dut) -> Iterator[None]:
        try:
            yield
        finally:
            for taken in steps:
                taken(dut)

    return undone


@step
def after(dut: Dut, /, ms: float, what: str, frame: Callable[[Dut], Frame]) -> None:
    """Check that the frame of a step arrives so many milliseconds from now; ``what`` is this time."""
    start_us = dut.now_us
    dut.check_ms(what, frame(dut).at_us - start_us, ms)


@step
def each_ms(dut: Dut, /, ms: float, times: int, what: str, frame: Callable[[Dut], Frame]) -> None:
    """Check that the frame of a step comes again so many times, ``ms`` apart; ``what`` is the whole time."""
    first_us = frame(dut).at_us
    last_us = [frame(dut).at_us for _ in range(times)][-1]
    dut.check_ms(what, last_us - first_us, times * ms)


@step
def matches(dut: Dut, /, kind: str, index: int, sub: int, mask: int, bits: int, expected: str) -> None:
    """Check an integer under a mask; ``expected`` says what it is to be."""
    value = dut.integer(kind, index, sub)
    check(value & mask == bits, expected, f"{value:08X}h")


@step
def between(dut: Dut, /, kind: str, index: int, sub: int, low: int, high: int) -> None:
    """Check that an integer lies in a range."""
    value = dut.integer(kind, index, sub)
    check(low <= value <= high, f"{index:04X}h:{sub:02X} in {low:X}h..{high:X}h", f"{value:X}h")


@step
def unchanged(dut: Dut, /, entries: Needs, *steps: Step) -> None:
    """Take the steps, and check that they left the entries as they were."""
    before = [dut.read(*entry) for entry in entries]
    for taken in steps:
        taken(dut)
    for entry, data in zip(entries, before, strict=True):
        dut.reads(*entry, data)


@step
def rises(dut: Dut, /, kind: str, index: int, sub: int, more: int, *steps: Step) -> None:
    """Take the steps, and check that a counter went up so far; it may wrap."""
    before = dut.integer(kind, index, sub)
    for taken in steps:
        taken(dut)
    dut.holds(kind, index, sub, (before + more) % 256 ** struct.calcsize(kind))


@step
def near(dut: Dut, /, index: int, sub: int, value: float, within: float, kind: str = "f") -> None:
    """Check that a number reads as ``value`` within so much."""
    value_read = dut.number(kind, index, sub)
    check(abs(value_read - value) <= within, f"{index:04X}h:{sub:02X} = {value:g} (+-{within:g})", str(value_read))


@step
def known(dut: Dut, /, index: int, sub: int, is_known: bool) -> None:
    """Check whether a REAL32 is a number or unknown, as NaN."""
    value = dut.number("f", index, sub)
    check(math.isnan(value) != is_known, f"{index:04X}h:{sub:02X} {'known' if is_known else 'unknown'}", str(value))


def __getattr__(name: str) -> Callable[..., Callable[[Dut], Any]]:
    """Return the maker of the steps that call a method of the Dut."""
    return step(getattr(Dut, name))
