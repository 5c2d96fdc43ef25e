"""TIME consumer and the high-resolution time stamp (CiA 301, 7.2.6, 7.5.2.15 and 7.5.2.16)."""

from __future__ import annotations

import struct

from canopen_conformance.case import Service, check
from canopen_conformance.dut import OPERATIONAL, PRE_OPERATIONAL, STOPPED, Dut

case = Service("time")

NEEDS = ((0x1012, 0),)
HIGH = ((0x1013, 0),)
INVALID_VALUE = 0x06090030
CONSUME = 0x80000000
NOON = struct.pack("<IH", 12 * 3600 * 1000, 14000)


@case("CiA 301 7.3.3", "the default CAN-ID of TIME is 100h", needs=NEEDS)
def default(dut: Dut) -> None:
    found = dut.integer("I", 0x1012)
    check(found & 0x7FF == 0x100, "CAN-ID 100h", f"{found:08X}h")


@case("CiA 301 7.5.2.15", "1012h = {0:08X}h is taken", needs=NEEDS, each=[(0x100,), (0x80000390,), (0x80000100,)])
def taken(dut: Dut, value: int) -> None:
    dut.accepts("I", 0x1012, 0, value)
    dut.holds("I", 0x1012, 0, value)


@case("CiA 301 7.3.5", "1012h with the restricted CAN-ID {0:03X}h: 06090030h", needs=NEEDS, each=[
    (0x001,), (0x07F,), (0x101,), (0x581,), (0x601,), (0x6E0,), (0x701,),
])  # fmt: skip
def restricted(dut: Dut, can_id: int) -> None:
    dut.refuses("I", 0x1012, 0, CONSUME | can_id, INVALID_VALUE)


@case("CiA 301 7.2.6.3", "a TIME message in {1} is not answered and no error", needs=(*NEEDS, (0x1001, 0)), each=[
    (PRE_OPERATIONAL, "PRE-OPERATIONAL"), (OPERATIONAL, "OPERATIONAL"), (STOPPED, "STOPPED"),
])  # fmt: skip
def message(dut: Dut, state: int, _name: str) -> None:
    dut.put("I", 0x1012, 0, CONSUME | 0x100)
    dut.enter(state)
    dut.sleep(20)
    dut.forget()
    dut.send(0x100, NOON)
    dut.silence()


@case("CiA 301 7.2.6.3", "a TIME message of {0} bytes is passed over", needs=NEEDS, each=[(0,), (5,), (8,)])
def wrong_length(dut: Dut, size: int) -> None:
    dut.put("I", 0x1012, 0, CONSUME | 0x100)
    dut.send(0x100, (NOON + NOON)[:size])
    dut.silence()
    dut.ask("40 00 10 00", "43 00 10 00 *")


@case("CiA 301 7.5.2.16", "1013h counts microseconds", needs=HIGH)
def runs(dut: Dut) -> None:
    first, start_us = dut.integer("I", 0x1013), dut.now_us
    dut.sleep(100)
    second, end_us = dut.integer("I", 0x1013), dut.now_us
    dut.check_ms("between two readings", (second - first) & 0xFFFFFFFF, (end_us - start_us) / 1000)


@case("CiA 301 7.5.2.16", "1013h runs on from what is written, and wraps", needs=HIGH)
def written(dut: Dut) -> None:
    dut.put("I", 0x1013, 0, 0xFFFFFFF0)
    start_us = dut.now_us
    dut.sleep(50)
    found = dut.integer("I", 0x1013)
    dut.check_ms("since the write", (found + 0x10) & 0xFFFFFFFF, (dut.now_us - start_us) / 1000)
