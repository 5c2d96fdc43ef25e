"""A device without a node-id: what it does, and how fastscan finds it (CiA 305, 6.6.3 and 6.6.4)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from canopen_conformance.case import CheckError, NotApplicableError, Service, check
from canopen_conformance.cases.lss import (
    IDENTITY,
    MASTER,
    SLAVE,
    UNCONFIGURED,
    configuring,
    in_configuration,
    restore_node_id,
    say,
    waiting,
)
from canopen_conformance.dut import RESET_COMMUNICATION, RESET_NODE, Dut

case = Service("lss_unconfigured")

_START = 0x80


@contextmanager
def unconfigured(dut: Dut) -> Iterator[list[int]]:
    """The device without a node-id within, with its own after; yields its identity."""
    old = dut.node_id
    with configuring(dut) as own:
        say(dut, 0x11, UNCONFIGURED)
        answer = dut.expect(SLAVE).data
    if answer[1]:
        raise NotApplicableError("node-id 255 is refused")
    dut.nmt(RESET_COMMUNICATION)
    dut.sleep(10)
    dut.forget()
    dut.node_id = UNCONFIGURED
    try:
        yield own
    finally:
        restore_node_id(dut, own, old)


def scan(dut: Dut, number: int, bit: int, part: int, following: int) -> bool:
    """One request of fastscan; whether a device says yes."""
    dut.send(MASTER, bytes((0x51,)) + number.to_bytes(4, "little") + bytes((bit, part, following)))
    return dut.heard(SLAVE, 20) is not None


@case("CiA 305 6.3.2", "without a node-id: no boot-up, no answer to NMT and SDO", needs=IDENTITY, persistent=True)
def silent(dut: Dut) -> None:
    old = dut.node_id
    with unconfigured(dut):
        for command in (1, RESET_NODE):
            dut.send(0x000, bytes((command, 0)))
        dut.send(0x600 + old, "40 00 10 00 00 00 00 00")
        dut.silence(0x580 + old, 0x700 + old, 0x80 + old, 0x700 + UNCONFIGURED)


@case("CiA 305 6.6.3", "identify non-configured remote slave: answer 50h", needs=IDENTITY, persistent=True)
def identify(dut: Dut) -> None:
    with unconfigured(dut):
        say(dut, 0x4C)
        dut.expect(SLAVE, "50 00 00 00 00 00 00 00")


@case("CiA 305 6.5", "inquire node-id: 255", needs=IDENTITY, persistent=True)
def inquire(dut: Dut) -> None:
    with unconfigured(dut) as own, configuring(dut, own):
        say(dut, 0x5E)
        dut.expect(SLAVE, "5E FF *")


@case("CiA 305 6.4.1", "a node-id is given: boot-up as soon as configuration is left", needs=IDENTITY, persistent=True)
def boots(dut: Dut) -> None:
    old = dut.node_id
    with unconfigured(dut) as own:
        with configuring(dut, own):
            say(dut, 0x11, old)
            dut.expect(SLAVE, "11 00 *")
            dut.silence(0x700 + old, ms=10)
        dut.expect(0x700 + old, "00", 5000)
        dut.node_id = old
        dut.ask("40 00 10 00", "43 00 10 00 *")


@case("CiA 305 6.6.4", "fastscan finds all 128 bits and leads to configuration", needs=IDENTITY, persistent=True)
def fastscan(dut: Dut) -> None:
    with unconfigured(dut) as own:
        if not scan(dut, 0, _START, 0, 0):
            raise NotApplicableError("no fastscan")
        found = []
        for part in range(4):
            number = 0
            for bit in range(31, -1, -1):
                if not scan(dut, number, bit, part, part):
                    number |= 1 << bit
            # The number is complete: confirm it, and go on to the next one, after the last to the first.
            check(scan(dut, number, 0, part, (part + 1) % 4), f"an answer to {number:08X}h in part {part}", "silence")
            found.append(number)
        check(found == own, str(own), str(found))
        check(in_configuration(dut), "the configuration state", "no answer to an inquiry")


@case("CiA 305 6.6.4", "fastscan with another {1}: silence", needs=IDENTITY, persistent=True, each=[
    (0, "vendor-ID"), (1, "product code"),
])  # fmt: skip
def fastscan_other(dut: Dut, part: int, _name: str) -> None:
    with unconfigured(dut) as own:
        if not scan(dut, 0, _START, 0, 0):
            raise NotApplicableError("no fastscan")
        check(not part or scan(dut, own[0], 0, 0, 1), "an answer to the vendor-ID", "silence")
        if scan(dut, own[part] ^ 0x100, 0, part, part):
            raise CheckError("silence", "an answer to a number that is not the device's")


@case("CiA 305 6.6.4", "fastscan of a part that is not its turn: silence", needs=IDENTITY, persistent=True)
def fastscan_order(dut: Dut) -> None:
    with unconfigured(dut) as own:
        if not scan(dut, 0, _START, 0, 0):
            raise NotApplicableError("no fastscan")
        check(not scan(dut, own[2], 0, 2, 3), "silence", "an answer to the third number before the first")


@case("CiA 305 6.6.4", "fastscan in the configuration state: silence", needs=IDENTITY, persistent=True)
def fastscan_configuring(dut: Dut) -> None:
    with unconfigured(dut) as own, configuring(dut, own):
        check(not scan(dut, 0, _START, 0, 0), "silence", "an answer")
    waiting(dut)
