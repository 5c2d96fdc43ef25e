"""LSS identification of a device that has a node-id (CiA 305, 6.6)."""

from __future__ import annotations

from canopen_conformance.case import NotApplicableError, Service, check
from canopen_conformance.cases.lss import IDENTITY, SLAVE, identity, say
from canopen_conformance.dut import Dut

case = Service("lss_identify")


def identify(dut: Dut, numbers: list[int]) -> None:
    """Identify remote slave: vendor, product, revision from, to, serial from, to."""
    for part, number in enumerate(numbers):
        say(dut, 0x46 + part, number=number)


def ranges(own: list[int]) -> list[int]:
    """The six numbers that this device alone fits."""
    return [own[0], own[1], own[2], own[2], own[3], own[3]]


@case("CiA 305 6.6.1", "identify remote slave: a device in the ranges answers 4Fh", needs=IDENTITY)
def identified(dut: Dut) -> None:
    identify(dut, ranges(identity(dut)))
    answer = dut.heard(SLAVE)
    if answer is None:
        raise NotApplicableError("no LSS slave")
    check(answer.data == b"\x4f" + bytes(7), "4F and zeros", answer.data.hex(" "))


@case("CiA 305 6.6.1", "identify remote slave: the ends of the ranges may lie apart", needs=IDENTITY)
def identified_in_range(dut: Dut) -> None:
    own = identity(dut)
    identify(dut, [own[0], own[1], 0, 0xFFFFFFFF, 0, 0xFFFFFFFF])
    if dut.heard(SLAVE) is None:
        raise NotApplicableError("no LSS slave")


@case(
    "CiA 305 6.6.1",
    "identify remote slave: {2} is not this device's: silence",
    needs=IDENTITY,
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


@case("CiA 305 6.6.1", "identify remote slave in another order: silence", needs=IDENTITY)
def identify_order(dut: Dut) -> None:
    for part, number in reversed(list(enumerate(ranges(identity(dut))))):
        say(dut, 0x46 + part, number=number)
    dut.silence(SLAVE)


@case("CiA 305 6.6.3", "identify non-configured remote slave: a device with a node-id is silent")
def configured(dut: Dut) -> None:
    say(dut, 0x4C)
    dut.silence(SLAVE)


@case("CiA 305 6.6.4", "fastscan: a device with a node-id is silent")
def configured_fastscan(dut: Dut) -> None:
    say(dut, 0x51, 0, 0, 0, 0, 0x80)
    dut.silence(SLAVE)
