"""The steps of a case as values: ``do.put("H", 0x1017, 0, 20)`` calls ``Dut.put`` so when the case runs.

A step is any function of the Dut: a case is a sequence of them, or one function of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Concatenate, ParamSpec, TypeVar

from canopen_conformance.case import Step, check
from canopen_conformance.dut import Dut
from canopen_conformance.wire import Frame

P = ParamSpec("P")
T = TypeVar("T")


def run(function: Callable[Concatenate[Dut, P], object], *arguments: P.args, **named: P.kwargs) -> Step:
    """Return the step that calls ``function`` with the Dut and these arguments."""
    return lambda dut: function(dut, *arguments, **named)


def _step(method: Callable[Concatenate[Dut, P], T]) -> Callable[P, Callable[[Dut], T]]:
    return lambda *arguments, **named: lambda dut: method(dut, *arguments, **named)


def all_of(*steps: Step) -> Step:
    """Take the steps in their order."""

    def take(dut: Dut) -> None:
        for step in steps:
            step(dut)

    return take


def repeat(times: int, *steps: Step) -> Step:
    """Take the steps so many times."""
    return all_of(*times * steps)


def within(context: Callable[[Dut], AbstractContextManager[object]], *steps: Step) -> Step:
    """Take the steps inside a context."""

    def take(dut: Dut) -> None:
        with context(dut):
            all_of(*steps)(dut)

    return take


def after(ms: float, what: str, frame: Callable[[Dut], Frame]) -> Step:
    """Check that the frame of a step arrives so many milliseconds from now; ``what`` is this time."""

    def take(dut: Dut) -> None:
        start_us = dut.now_us
        dut.check_ms(what, frame(dut).at_us - start_us, ms)

    return take


def each_ms(ms: float, times: int, what: str, frame: Callable[[Dut], Frame]) -> Step:
    """Check that the frame of a step comes again so many times, ``ms`` apart; ``what`` is the whole time."""

    def take(dut: Dut) -> None:
        first_us = frame(dut).at_us
        last_us = [frame(dut).at_us for _ in range(times)][-1]
        dut.check_ms(what, last_us - first_us, times * ms)

    return take


def matches(kind: str, index: int, sub: int, mask: int, bits: int, expected: str) -> Step:
    """Check an integer under a mask; ``expected`` says what it is to be."""

    def take(dut: Dut) -> None:
        value = dut.integer(kind, index, sub)
        check(value & mask == bits, expected, f"{value:08X}h")

    return take


def unchanged(kind: str, index: int, sub: int, *steps: Step) -> Step:
    """Take the steps, and check that they left the value of an object as it was."""

    def take(dut: Dut) -> None:
        before = dut.number(kind, index, sub)
        all_of(*steps)(dut)
        dut.holds(kind, index, sub, before)

    return take


nmt = _step(Dut.nmt)
reset = _step(Dut.reset)
boot_up = _step(Dut.boot_up)
waits_for_start = _step(Dut.waits_for_start)
enter = _step(Dut.enter)
state = _step(Dut.state)
beat = _step(Dut.beat)
heartbeat = _step(Dut.heartbeat)
no_heartbeat = _step(Dut.no_heartbeat)
request = _step(Dut.request)
answer = _step(Dut.answer)
ask = _step(Dut.ask)
aborted = _step(Dut.aborted)
no_sdo = _step(Dut.no_sdo)
read = _step(Dut.read)
put = _step(Dut.put)
accepts = _step(Dut.accepts)
holds = _step(Dut.holds)
refuses = _step(Dut.refuses)
refuses_bytes = _step(Dut.refuses_bytes)
read_segments = _step(Dut.read_segments)
integer = _step(Dut.integer)
send = _step(Dut.send)
expect = _step(Dut.expect)
silence = _step(Dut.silence)
sleep = _step(Dut.sleep)
forget = _step(Dut.forget)
emcy = _step(Dut.emcy)
no_emcy = _step(Dut.no_emcy)
pdo = _step(Dut.pdo)
no_pdo = _step(Dut.no_pdo)
send_pdo = _step(Dut.send_pdo)
forget_pdo = _step(Dut.forget_pdo)
