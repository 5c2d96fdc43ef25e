"""EMCY: the message, the error register, the history, identifier and inhibit time (CiA 301, 7.2.7)."""

from __future__ import annotations

import struct

from canopen_conformance import steps as do
from canopen_conformance.case import CheckError, NotApplicableError, Service, check
from canopen_conformance.cases.pdo import INVALID
from canopen_conformance.dut import Dut
from canopen_conformance.wire import START, Abort

# fmt: off
# A table: a case is its header, and below it its steps.

case = Service("emcy")


break_sync = do.send(0x080, "01 02 03")  # a SYNC of wrong length: EMCY 8240h, if the device checks it


def make_error(dut: Dut) -> bytes:
    """Cause an error that ``cure_error`` clears and that each call can repeat; return its EMCY."""
    break_sync(dut)
    frame = dut.heard(0x80 + dut.node_id)
    if frame is None:
        raise NotApplicableError("no EMCY for a SYNC of wrong length")
    return frame.data


def cure_error(dut: Dut) -> bytes:
    """Clear the error of ``make_error``; return the EMCY that reports it."""
    dut.send(0x080)
    return dut.emcy("00 00 *").data


NEEDS = ((0x1014, 0), (0x1001, 0))
HISTORY = (*NEEDS, (0x1003, 0))
INHIBIT = (*NEEDS, (0x1015, 0))


@case("7.2.7.3: the message: 8 bytes, code, error register, the manufacturer's five", NEEDS)
def message(dut: Dut) -> None:
    data = make_error(dut)
    right = len(data) == 8 and data[:2] == b"\x40\x82" and data[2:3] == dut.read(0x1001)
    check(right, "40 82, 1001h and five bytes", data.hex(" "))


case("register_clear 7.5.2.2: 1001h is 0 without an error", NEEDS,
    do.holds("B", 0x1001, 0, 0))
case("register_bits 7.5.2.2: a communication error sets bits 0 and 4 of 1001h", NEEDS,
    make_error, do.holds("B", 0x1001, 0, 0x11))


@case("7.2.7.1: the end of an error: EMCY 0000h with the register as it is then", NEEDS)
def cured(dut: Dut) -> None:
    make_error(dut)
    data = cure_error(dut)
    check(data[2] == 0 and dut.integer("B", 0x1001) == 0, "error register 0", data.hex(" "))


case("cured_one 7.2.7.1: of two errors one ends: the register keeps the other's bits", (*NEEDS, (0x1016, 1)),
    do.put("I", 0x1016, 1, 0x700014), do.send(0x770, "05"), do.emcy("30 81 11 *"), make_error,
    lambda dut: check(cure_error(dut)[2] == 0x11, "error register 11h", "another one"))
for command, name in ((129, "reset node"), (130, "reset communication")):
    case(f"register_reset 7.2.8.2.1.5: {name} clears the register", NEEDS,
        make_error, do.reset(command), do.holds("B", 0x1001, 0, 0), do.no_emcy())


clear = do.put("B", 0x1003, 0, 0)  # empties the history
case("history 7.5.2.4: an error is entered with its code", HISTORY,
    clear, make_error, do.holds("B", 0x1003, 0, 1), do.matches("I", 0x1003, 1, 0xFFFF, 0x8240, "1003h:1 = ....8240h"))


@case("7.5.2.4: the newest error is sub-index 1, the others move up", (*HISTORY, (0x1016, 1)))
def history_order(dut: Dut) -> None:
    clear(dut)
    dut.put("I", 0x1016, 1, 0x700014)
    dut.send(0x770, "05")
    dut.emcy("30 81 *")
    make_error(dut)
    codes = [dut.integer("I", 0x1003, sub) & 0xFFFF for sub in (1, 2)]
    if codes != [0x8240, 0x8130] or dut.integer("B", 0x1003, 0) != 2:
        raise CheckError("8240h, 8130h", str([f"{code:04X}h" for code in codes]))


case("history_cure 7.5.2.4: the end of an error is no entry", HISTORY,
    clear, make_error, cure_error, do.holds("B", 0x1003, 0, 1))
case("history_cleared 7.5.2.4: 0 written to sub-index 0 empties the history", HISTORY,
    make_error, clear, do.holds("B", 0x1003, 0, 0))
for value in (1, 8, 255):
    case(f"history_value 7.5.2.4: {value} written to sub-index 0: 06090030h", HISTORY,
        do.refuses("B", 0x1003, 0, value, Abort.INVALID_VALUE))
for sub in (1, 2):
    case("history_empty 7.5.2.4: an entry that is empty: 08000024h", HISTORY,
        clear, do.request(struct.pack("<BHB", 0x40, 0x1003, sub)),
        do.aborted(0x1003, sub, Abort.NO_DATA, Abort.GENERAL_ERROR, *(() if sub == 1 else (Abort.NO_SUB,))))
case("history_read_only 7.5.2.4: entries cannot be written", (*HISTORY, (0x1003, 1)),
    do.refuses("I", 0x1003, 1, 0, Abort.READ_ONLY))


def check_on(dut: Dut) -> None:
    """End a case about a device that sends no EMCY by default."""
    if dut.integer("I", 0x1014) & INVALID:
        raise NotApplicableError("1014h: EMCY is switched off")


def switch_off(dut: Dut) -> None:
    """Make the EMCY object invalid."""
    dut.put("I", 0x1014, 0, INVALID | 0x80 + dut.node_id)


case("default 7.5.2.17: the default CAN-ID is 080h + node-id", NEEDS,
    check_on, lambda dut: dut.holds("I", 0x1014, 0, 0x80 + dut.node_id))
case("switched_off 7.5.2.17: with bit 31 set there is no EMCY, but register and history", HISTORY,
    make_error, cure_error, clear, switch_off, break_sync, do.holds("B", 0x1001, 0, 0x11), do.holds("B", 0x1003, 0, 1),
    do.no_emcy())
case("moved_while_valid 7.5.2.17: another CAN-ID while the object exists: 06090030h", NEEDS,
    check_on, do.refuses("I", 0x1014, 0, 0x390, Abort.INVALID_VALUE),
    lambda dut: dut.holds("I", 0x1014, 0, 0x80 + dut.node_id))
case("moved 7.5.2.17: switched off, moved, switched on", NEEDS,
    switch_off, do.put("I", 0x1014, 0, 0x390), break_sync, do.expect(0x390, "40 82 *"), do.no_emcy())
for value in (0x000, 0x07F, 0x101, 0x581, 0x601, 0x6E0, 0x701, 0x20000390, 0x40000390, 0x00001390):
    case(f"refused 7.5.2.17: 1014h = {value:08X}h: 06090030h", NEEDS,
        switch_off, do.refuses("I", 0x1014, 0, value, Abort.INVALID_VALUE))


@case("7.5.2.18: the inhibit time lies between two messages, and none is lost", INHIBIT)
def inhibit(dut: Dut) -> None:
    dut.put("H", 0x1015, 0, 500)
    make_error(dut)
    first_us = dut.now_us
    dut.send(0x080)
    break_sync(dut)
    dut.send(0x080)
    for number, wanted in enumerate(("00 00 *", "40 82 *", "00 00 *"), 1):
        frame = dut.emcy(wanted, 80)
        dut.check_ms("inhibit times of 50 ms", frame.at_us - first_us, 50 * number)
    dut.no_emcy(ms=70)


case("no_inhibit 7.5.2.18: inhibit time 0: every message at once", INHIBIT,
    do.put("H", 0x1015, 0, 0), do.repeat(3, make_error, cure_error))
case("operational 7.3.2.3: EMCY is sent in OPERATIONAL", NEEDS,
    do.nmt(START), make_error)
