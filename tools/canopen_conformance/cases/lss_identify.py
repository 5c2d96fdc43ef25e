"""LSS identification (CiA 305, 6.6): of a device with a node-id, and of one without."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from canopen_conformance import steps as do
from canopen_conformance.case import CheckError, NotApplicableError, Service, check
from canopen_conformance.cases.lss import (
    IDENTITY,
    MASTER,
    SLAVE,
    UNCONFIGURED,
    configuring,
    identity,
    in_configuration,
    restore_node_id,
    say,
    slave_answer,
    waiting,
)
from canopen_conformance.dut import Dut
from canopen_conformance.wire import RESET_COMMUNICATION, RESET_NODE

numbered = Service("lss_identify", standard="CiA 305")
unnumbered = Service("lss_unconfigured", standard="CiA 305")


def identify(dut: Dut, numbers: list[int]) -> None:
    """Identify remote slave: vendor, product, revision from, to, serial from, to."""
    for part, number in enumerate(numbers):
        say(dut, 0x46 + part, number=number)


def ranges(own: list[int]) -> list[int]:
    """The six numbers that this device alone fits."""
    return [own[0], own[1], own[2], own[2], own[3], own[3]]


@numbered("6.6.1: identify remote slave: a device in the ranges answers 4Fh", IDENTITY)
def identified(dut: Dut) -> None:
    identify(dut, ranges(identity(dut)))
    data = slave_answer(dut)
    check(data == b"\x4f" + bytes(7), "4F and zeros", data.hex(" "))


@numbered("6.6.1: identify remote slave: the ends of the ranges may lie apart", IDENTITY)
def identified_in_range(dut: Dut) -> None:
    own = identity(dut)
    identify(dut, [own[0], own[1], 0, 0xFFFFFFFF, 0, 0xFFFFFFFF])
    slave_answer(dut)


@numbered(
    "6.6.1: identify remote slave: {2} is not this device's: silence",
    IDENTITY,
    each=[
        (0, 1, "the vendor-ID"),
        (1, 1, "the product code"),
        (2, 1, "a revision from above"),
        (3, -1, "a revision to below"),
        (4, 1, "a serial number from above"),
        (5, -1, "a serial number to below"),
    ],
)
def not_identified(dut: Dut, part: int, step: int, _name: str) -> None:
    numbers = ranges(identity(dut))
    numbers[part] += step
    if not 0 <= numbers[part] <= 0xFFFFFFFF:
        raise NotApplicableError("the identity lies at the end of the range")
    identify(dut, numbers)
    dut.silence(SLAVE)


@numbered("6.6.1: identify remote slave in another order: silence", IDENTITY)
def identify_order(dut: Dut) -> None:
    for part, number in reversed(list(enumerate(ranges(identity(dut))))):
        say(dut, 0x46 + part, number=number)
    dut.silence(SLAVE)


numbered("configured 6.6.3: identify non-configured remote slave: a device with a node-id is silent")(
    do.run(say, 0x4C), do.silence(SLAVE)
)
numbered("configured_fastscan 6.6.4: fastscan: a device with a node-id is silent")(
    do.run(say, 0x51, 0, 0, 0, 0, 0x80), do.silence(SLAVE)
)


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


@unnumbered("6.3.2: without a node-id: no boot-up, no answer to NMT and SDO", IDENTITY, persistent=True)
def silent(dut: Dut) -> None:
    old = dut.node_id
    with unconfigured(dut):
        for command in (1, RESET_NODE):
            dut.send(0x000, bytes((command, 0)))
        dut.send(0x600 + old, "40 00 10 00 00 00 00 00")
        dut.silence(0x580 + old, 0x700 + old, 0x80 + old, 0x700 + UNCONFIGURED)


@unnumbered("6.6.3: identify non-configured remote slave: answer 50h", IDENTITY, persistent=True)
def lss_unconfigured_identify(dut: Dut) -> None:
    with unconfigured(dut):
        say(dut, 0x4C)
        dut.expect(SLAVE, "50 00 00 00 00 00 00 00")


@unnumbered("6.5: inquire node-id: 255", IDENTITY, persistent=True)
def inquire(dut: Dut) -> None:
    with unconfigured(dut) as own, configuring(dut, own):
        say(dut, 0x5E)
        dut.expect(SLAVE, "5E FF *")


@unnumbered("6.4.1: a node-id is given: boot-up as soon as configuration is left", IDENTITY, persistent=True)
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


@unnumbered("6.6.4: fastscan finds all 128 bits and leads to configuration", IDENTITY, persistent=True)
def fastscan(dut: Dut) -> None:
    with unconfigured(dut) as own:
        if not scan(dut, 0, _START, 0, 0):
            raise NotApplicableError("no fastscan")
        numbers = []
        for part in range(4):
            number = 0
            for bit in range(31, -1, -1):
                if not scan(dut, number, bit, part, part):
                    number |= 1 << bit
            # The number is complete: confirm it, and go on to the next one, after the last to the first.
            check(scan(dut, number, 0, part, (part + 1) % 4), f"an answer to {number:08X}h in part {part}", "silence")
            numbers.append(number)
        check(numbers == own, str(own), str(numbers))
        check(in_configuration(dut), "the configuration state", "no answer to an inquiry")


@unnumbered("6.6.4: fastscan with another {1}: silence", IDENTITY, persistent=True, each=[
    (0, "vendor-ID"), (1, "product code"),
])  # fmt: skip
def fastscan_other(dut: Dut, part: int, _name: str) -> None:
    with unconfigured(dut) as own:
        if not scan(dut, 0, _START, 0, 0):
            raise NotApplicableError("no fastscan")
        check(not part or scan(dut, own[0], 0, 0, 1), "an answer to the vendor-ID", "silence")
        if scan(dut, own[part] ^ 0x100, 0, part, part):
            raise CheckError("silence", "an answer to a number that is not the device's")


@unnumbered("6.6.4: fastscan of a part that is not its turn: silence", IDENTITY, persistent=True)
def fastscan_order(dut: Dut) -> None:
    with unconfigured(dut) as own:
        if not scan(dut, 0, _START, 0, 0):
            raise NotApplicableError("no fastscan")
        check(not scan(dut, own[2], 0, 2, 3), "silence", "an answer to the third number before the first")


@unnumbered("6.6.4: fastscan in the configuration state: silence", IDENTITY, persistent=True)
def fastscan_configuring(dut: Dut) -> None:
    with unconfigured(dut) as own, configuring(dut, own):
        check(not scan(dut, 0, _START, 0, 0), "silence", "an answer")
    waiting(dut)
