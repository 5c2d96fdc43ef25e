"""RPDOs at work: when they act, their length, their deadline (CiA 301, 7.2.2)."""

from __future__ import annotations

import struct

from canopen_conformance.case import Service, check
from canopen_conformance.dut import ENTER_PRE_OPERATIONAL, START, Dut
from canopen_conformance.setups import RPDO1, disable_pdo, mapped_rpdo1

case = Service("rpdo")

HIGH_RESOLUTION = (*RPDO1, (0x1013, 0))
TIME_U32 = 0x10130020  # 1013h, 32 bits
TIME = 0x1013


def high_resolution(dut: Dut, at_least: int, below: int) -> None:
    """1013h, which runs on, lies in this range."""
    found = dut.integer("I", TIME)
    check(at_least <= found < below, f"1013h in {at_least:08X}h..{below:08X}h", f"{found:08X}h")


def set_time(dut: Dut) -> None:
    """1013h to 0, so that what an RPDO brings shows."""
    dut.put("I", TIME, 0, 0)


@case("CiA 301 7.2.2.2", "an RPDO of type {0} acts at once", needs=HIGH_RESOLUTION, each=[(254,), (255,)])
def received(dut: Dut, transmission: int) -> None:
    can_id = mapped_rpdo1(dut, TIME_U32, transmission=transmission)
    dut.nmt(START)
    set_time(dut)
    dut.send(can_id, struct.pack("<I", 0x60000000))
    high_resolution(dut, 0x60000000, 0x61000000)


@case(
    "CiA 301 7.2.2.2",
    "a synchronous RPDO of type {0} acts with the next SYNC",
    needs=HIGH_RESOLUTION,
    each=[(0,), (1,), (240,)],
)
def received_on_sync(dut: Dut, transmission: int) -> None:
    can_id = mapped_rpdo1(dut, TIME_U32, transmission=transmission)
    dut.nmt(START)
    set_time(dut)
    dut.send(can_id, struct.pack("<I", 0x60000000))
    high_resolution(dut, 0, 0x60000000)
    dut.send(0x080)
    high_resolution(dut, 0x60000000, 0x61000000)


@case("CiA 301 7.2.2.2", "of two synchronous RPDOs before a SYNC the last one acts", needs=HIGH_RESOLUTION)
def last_before_sync(dut: Dut) -> None:
    can_id = mapped_rpdo1(dut, TIME_U32, transmission=1)
    dut.nmt(START)
    dut.send(can_id, struct.pack("<I", 0x60000000))
    dut.send(can_id, struct.pack("<I", 0x70000000))
    dut.send(0x080)
    high_resolution(dut, 0x70000000, 0x71000000)


@case("CiA 301 7.2.2.5.1", "a longer RPDO: the mapped bytes count", needs=HIGH_RESOLUTION)
def longer(dut: Dut) -> None:
    can_id = mapped_rpdo1(dut, TIME_U32)
    dut.nmt(START)
    dut.send(can_id, struct.pack("<II", 0x60000000, 0x99999999))
    high_resolution(dut, 0x60000000, 0x61000000)


@case("CiA 301 7.2.2.5.1", "a shorter RPDO: EMCY 8210h, nothing is taken", needs=(*HIGH_RESOLUTION, (0x1014, 0)))
def shorter(dut: Dut) -> None:
    can_id = mapped_rpdo1(dut, TIME_U32)
    dut.nmt(START)
    set_time(dut)
    dut.send(can_id, "00 00 60")
    dut.expect(0x80 + dut.node_id, "10 82 *")
    high_resolution(dut, 0, 0x600000)


@case("CiA 301 7.4.7.1", "dummy entries skip bytes of an RPDO", needs=HIGH_RESOLUTION)
def dummies(dut: Dut) -> None:
    can_id = mapped_rpdo1(dut, 0x00050008, TIME_U32, 0x00060010)
    dut.nmt(START)
    dut.send(can_id, "AA 00 00 00 60 BB CC")
    high_resolution(dut, 0x60000000, 0x61000000)


@case(
    "CiA 301 7.5.2.35",
    "an RPDO that stays away: EMCY 8250h after its event timer",
    needs=(*HIGH_RESOLUTION, (0x1400, 5)),
)
def deadline(dut: Dut) -> None:
    can_id = mapped_rpdo1(dut, TIME_U32, event_ms=50)
    dut.nmt(START)
    dut.send(can_id, bytes(4))
    start_us = dut.now_us
    frame = dut.expect(0x80 + dut.node_id, "50 82 *")
    dut.check_ms("event timer", frame.at_us - start_us, 50)
    dut.silence(0x80 + dut.node_id, ms=70)
    dut.send(can_id, bytes(4))
    dut.expect(0x80 + dut.node_id, "00 00 *")


@case("CiA 301 7.5.2.35", "an RPDO is not missed {1}", needs=(*HIGH_RESOLUTION, (0x1400, 5)), each=[
    (False, "before the first one"), (True, "after OPERATIONAL was left"),
])  # fmt: skip
def no_deadline(dut: Dut, came: bool, _when: str) -> None:
    can_id = mapped_rpdo1(dut, TIME_U32, event_ms=40)
    dut.nmt(START)
    if came:
        dut.send(can_id, bytes(4))
        dut.nmt(ENTER_PRE_OPERATIONAL)
    dut.silence(0x80 + dut.node_id, ms=100)


@case("CiA 301 7.5.2.35", "RPDOs in time: no EMCY", needs=(*HIGH_RESOLUTION, (0x1400, 5)))
def in_time(dut: Dut) -> None:
    can_id = mapped_rpdo1(dut, TIME_U32, event_ms=150)
    dut.nmt(START)
    for _ in range(4):
        dut.send(can_id, bytes(4))
        dut.silence(0x80 + dut.node_id, ms=70)


@case("CiA 301 7.5.2.35", "an RPDO with bit 31 set is not taken", needs=HIGH_RESOLUTION)
def invalid_rpdo(dut: Dut) -> None:
    can_id = mapped_rpdo1(dut, TIME_U32)
    disable_pdo(dut, 0x1400)
    dut.nmt(START)
    set_time(dut)
    dut.send(can_id, struct.pack("<I", 0x60000000))
    high_resolution(dut, 0, 0x60000000)
