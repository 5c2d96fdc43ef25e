"""EMCY (CiA 301, 7.2.7), SYNC (7.2.5), TIME and the high-resolution time stamp (7.2.6)."""

import struct
from collections.abc import Iterable

from canopen_conformance import steps as do
from canopen_conformance.case import NotApplicableError, Service, check, need
from canopen_conformance.cases import pdo
from canopen_conformance.dut import Dut
from canopen_conformance.wire import EMCY, PDO, REMOTE_FLAG, START, STATES, Abort

# fmt: off
# A table: a case is its header, and below it its steps.

emcy = Service("emcy")
sync = Service("sync")
time = Service("time")


break_sync = do.send(0x080, "01 02 03")  # a SYNC of wrong length: EMCY 8240h, if the device checks it


def make_error(dut: Dut) -> bytes:
    """Cause an error that ``cure_error`` clears and that each call can repeat; return its EMCY."""
    break_sync(dut)
    frame = dut.heard(EMCY)
    if frame is None:
        raise NotApplicableError("no EMCY for a SYNC of wrong length")
    return frame.data


def cure_error(dut: Dut, register: int = 0) -> None:
    """Clear the error of ``make_error``, and check the error register in the EMCY that reports it."""
    dut.send(0x080)
    data = dut.expect(EMCY, "00 00 *").data
    check(data[2] == register, f"error register {register:02X}h", data.hex(" "))


NEEDS = ((0x1014, 0), (0x1001, 0))
HISTORY = (*NEEDS, (0x1003, 0))
INHIBIT = (*NEEDS, (0x1015, 0))


@emcy("7.2.7.3: the message: 8 bytes, code, error register, the manufacturer's five", NEEDS)
def message(dut: Dut) -> None:
    data = make_error(dut)
    right = data[:2] == b"\x40\x82" and data[2:3] == dut.read(0x1001)
    check(right, "40 82, 1001h and five bytes", data.hex(" "))


emcy("register_clear 7.5.2.2: 1001h is 0 without an error", NEEDS,
    do.holds("B", 0x1001, 0, 0))
emcy("register_bits 7.5.2.2: a communication error sets bits 0 and 4 of 1001h", NEEDS,
    make_error, do.holds("B", 0x1001, 0, 0x11))


emcy("cured 7.2.7.1: the end of an error: EMCY 0000h with the register as it is then", NEEDS,
    make_error, cure_error, do.holds("B", 0x1001, 0, 0))
emcy("cured_one 7.2.7.1: of two errors one ends: the register keeps the other's bits", (*NEEDS, (0x1016, 1)),
    do.put("I", 0x1016, 1, 0x700014), do.send(0x770, "05"), do.expect(EMCY, "30 81 11 *"), make_error,
    do.run(cure_error, 0x11))
for command, name in ((129, "reset node"), (130, "reset communication")):
    emcy(f"register_reset 7.2.8.2.1.5: {name} clears the register", NEEDS,
        make_error, do.reset(command), do.holds("B", 0x1001, 0, 0), do.silence(EMCY))


clear = do.put("B", 0x1003, 0, 0)  # empties the history
emcy("history 7.5.2.4: an error is entered with its code", HISTORY,
    clear, make_error, do.holds("B", 0x1003, 0, 1), do.matches("I", 0x1003, 1, 0xFFFF, 0x8240, "1003h:1 = ....8240h"))
emcy("history_order 7.5.2.4: the newest error is sub-index 1, the others move up", (*HISTORY, (0x1003, 2), (0x1016, 1)),
    clear, do.put("I", 0x1016, 1, 0x700014), do.send(0x770, "05"), do.expect(EMCY, "30 81 *"), make_error,
    do.matches("I", 0x1003, 1, 0xFFFF, 0x8240, "1003h:1 = ....8240h"),
    do.matches("I", 0x1003, 2, 0xFFFF, 0x8130, "1003h:2 = ....8130h"), do.holds("B", 0x1003, 0, 2))
emcy("history_cure 7.5.2.4: the end of an error is no entry", HISTORY,
    clear, make_error, cure_error, do.holds("B", 0x1003, 0, 1))
emcy("history_cleared 7.5.2.4: 0 written to sub-index 0 empties the history", HISTORY,
    make_error, clear, do.holds("B", 0x1003, 0, 0))
for value in (1, 8, 255):
    emcy(f"history_value 7.5.2.4: {value} written to sub-index 0: 06090030h", HISTORY,
        do.refuses("B", 0x1003, 0, value, Abort.INVALID_VALUE))
for sub in (1, 2):
    emcy("history_empty 7.5.2.4: an entry that is empty: 08000024h", HISTORY,
        clear, do.request(struct.pack("<BHB", 0x40, 0x1003, sub)),
        do.aborted(0x1003, sub, Abort.NO_DATA, Abort.GENERAL_ERROR, *(() if sub == 1 else (Abort.NO_SUB,))))
emcy("history_read_only 7.5.2.4: entries cannot be written", (*HISTORY, (0x1003, 1)),
    do.refuses("I", 0x1003, 1, 0, Abort.READ_ONLY))


def check_on(dut: Dut) -> None:
    """End a case about a device that sends no EMCY by default."""
    need(not dut.integer("I", 0x1014) & pdo.INVALID, "1014h: EMCY is switched off")


own_id = do.late(lambda dut, flags=0: flags | 0x80 + dut.node_id)
switch_off = do.put("I", 0x1014, 0, own_id(pdo.INVALID))  # makes the EMCY object invalid
emcy("default 7.5.2.17: the default CAN-ID is 080h + node-id", NEEDS,
    check_on, do.holds("I", 0x1014, 0, own_id()))
emcy("switched_off 7.5.2.17: with bit 31 set there is no EMCY, but register and history", HISTORY,
    make_error, cure_error, clear, switch_off, break_sync, do.holds("B", 0x1001, 0, 0x11), do.holds("B", 0x1003, 0, 1),
    do.silence(EMCY))
emcy("moved_while_valid 7.5.2.17: another CAN-ID while the object exists: 06090030h", NEEDS,
    check_on, do.refuses("I", 0x1014, 0, 0x390, Abort.INVALID_VALUE), do.holds("I", 0x1014, 0, own_id()))
emcy("moved 7.5.2.17: switched off, moved, switched on", NEEDS,
    switch_off, do.put("I", 0x1014, 0, 0x390), break_sync, do.expect(0x390, "40 82 *"), do.silence(EMCY))
for value in (0x000, 0x07F, 0x101, 0x581, 0x601, 0x6E0, 0x701, 0x20000390, 0x40000390, 0x00001390):
    emcy(f"refused 7.5.2.17: 1014h = {value:08X}h: 06090030h", NEEDS,
        switch_off, do.refuses("I", 0x1014, 0, value, Abort.INVALID_VALUE))
emcy("inhibit 7.5.2.18: the inhibit time lies between two messages, and none is lost", INHIBIT,
    do.put("H", 0x1015, 0, 500), make_error, do.send(0x080), break_sync, do.send(0x080),
    *(do.after(50, "inhibit time", do.expect(EMCY, wanted, 80)) for wanted in ("00 00 *", "40 82 *", "00 00 *")),
    do.silence(EMCY, ms=70))
emcy("no_inhibit 7.5.2.18: inhibit time 0: every message at once", INHIBIT,
    do.put("H", 0x1015, 0, 0), do.repeat(3, make_error, cure_error))
emcy("operational 7.3.2.3: EMCY is sent in OPERATIONAL", NEEDS,
    do.nmt(START), make_error)


COUNTER = (*pdo.TPDO1, (0x1019, 0), (0x1800, 6))
LENGTH = (*pdo.TPDO1, (0x1019, 0), (0x1014, 0))


sync("default 7.3.3: the default CAN-ID of SYNC is 080h", ((0x1005, 0),),
    do.matches("I", 0x1005, 0, 0x3FFFFFFF, 0x80, "1005h = 080h"))
sync("moved 7.5.2.5: SYNC on another CAN-ID: that one alone acts", (*pdo.TPDO1, (0x1005, 0)),
    pdo.enable_tpdo1, do.put("I", 0x1005, 0, 0x90), do.nmt(START), do.send(0x080), do.silence(PDO),
    do.send(0x090), do.expect(PDO))
sync("bit_31 7.5.2.5: bit 31 of 1005h is not looked at", (*pdo.TPDO1, (0x1005, 0)),
    pdo.enable_tpdo1, do.put("I", 0x1005, 0, 0x80000090), do.nmt(START), do.send(0x090), do.expect(PDO))
for can_id in (0x000, 0x07F, 0x101, 0x580 | 5, 0x600 | 5, 0x6E0, 0x701):
    sync(f"restricted 7.3.5: 1005h with the restricted CAN-ID {can_id:03X}h: 06090030h", ((0x1005, 0),),
        do.refuses("I", 0x1005, 0, can_id, Abort.INVALID_VALUE))
sync("remote_frame 7.2.5: a remote frame is no SYNC", pdo.TPDO1,
    pdo.start_tpdo1, do.send(0x080 | REMOTE_FLAG), do.silence(PDO))
for value in (1, 241, 255):
    sync(f"overflow_refused 7.5.2.22: 1019h = {value} is refused", ((0x1019, 0),),
        do.refuses("B", 0x1019, 0, value, Abort.INVALID_VALUE, Abort.TOO_HIGH), do.holds("B", 0x1019, 0, 0))
for value in (0, 2, 240):
    sync(f"overflow_taken 7.5.2.22: 1019h = {value} is taken", ((0x1019, 0),),
        do.put("B", 0x1019, 0, value, required=True), do.holds("B", 0x1019, 0, value))
sync("counted 7.2.5.3.1: with 1019h a SYNC with its counter acts", COUNTER,
    pdo.enable_tpdo1, do.put("B", 0x1019, 0, 10), do.nmt(START),
    *(step for counter in (1, 2, 10, 1) for step in (do.send(0x080, bytes((counter,))), do.expect(PDO))))
for overflow, data, what in (
    (0, "01", "one byte without 1019h"), (0, "01 02 03 04 05 06 07 08", "eight bytes without 1019h"),
    (10, "", "no data with 1019h"), (10, "01 02", "two bytes with 1019h"),
):
    sync(f"wrong_length 7.2.5.3.1: SYNC of {what}: EMCY 8240h, and no TPDO", LENGTH,
        pdo.enable_tpdo1, do.put("B", 0x1019, 0, overflow), do.nmt(START), do.send(0x080, data),
        do.expect(EMCY, "40 82 *"), do.silence(PDO))


def answers(dut: Dut, counters: Iterable[int], wanted: list[int]) -> None:
    """The TPDO answers the SYNCs with these counters."""
    answered = pdo.on_syncs(dut, counters, counted=True)
    check(answered == wanted, f"TPDOs with the counters {wanted}", str(answered))


for transmission, start, counters, wanted in (
    (1, 3, (1, 2, 3, 4, 5), [3, 4, 5]), (2, 4, (1, 2, 3, 4, 5, 6, 7), [4, 6]), (1, 1, (2, 3, 10, 1, 2), [1, 2]),
):
    sync(f"start_value 7.5.2.37: SYNC start value {start}, type {transmission}: the first TPDO goes with that counter",
        COUNTER,
        do.run(pdo.enable_tpdo1, transmission, sync_start=start), do.put("B", 0x1019, 0, 10), do.nmt(START),
        do.run(answers, counters, wanted))
sync("start_without_counter 7.5.2.37: without a counter the start value has no meaning", COUNTER,
    do.run(pdo.start_tpdo1, sync_start=5), do.send(0x080), do.expect(PDO))


for wait_ms, when, fate in ((10, "within", "taken"), (150, "after", "discarded")):
    sync(f"window 7.5.2.7: a synchronous RPDO {when} the window of 1007h is {fate}",
        ((0x1007, 0), (0x1013, 0), (0x1400, 1), (0x1600, 0)),
        do.run(pdo.mapped_rpdo1, transmission=1), do.put("I", 0x1007, 0, 80000), do.nmt(START), pdo.set_time,
        do.send(0x080), do.sleep(wait_ms), pdo.sends_6, do.send(0x080), do.run(pdo.rpdo_was, fate, 0x60000000))


TIME = ((0x1012, 0),)
HIGH_RESOLUTION = ((0x1013, 0),)
CONSUME = 0x80000000
NOON = struct.pack("<IH", 12 * 3600 * 1000, 14000)


time("default 7.3.3: the default CAN-ID of TIME is 100h", TIME,
    do.matches("I", 0x1012, 0, 0x7FF, 0x100, "CAN-ID 100h"))
for value in (0x100, 0x80000390, 0x80000100):
    time(f"taken 7.5.2.15: 1012h = {value:08X}h is taken", TIME,
        do.put("I", 0x1012, 0, value, required=True), do.holds("I", 0x1012, 0, value))
for can_id in (0x001, 0x07F, 0x101, 0x581, 0x601, 0x6E0, 0x701):
    time(f"restricted 7.3.5: 1012h with the restricted CAN-ID {can_id:03X}h: 06090030h", TIME,
        do.refuses("I", 0x1012, 0, CONSUME | can_id, Abort.INVALID_VALUE))
for state, name in STATES:
    time(f"message 7.2.6.3: a TIME message in {name} is not answered and no error", (*TIME, (0x1001, 0)),
        do.put("I", 0x1012, 0, CONSUME | 0x100), do.enter(state), do.sleep(20), do.forget(), do.send(0x100, NOON),
        do.silence())
for size in (0, 5, 8):
    time(f"wrong_length 7.2.6.3: a TIME message of {size} bytes is passed over", TIME,
        do.put("I", 0x1012, 0, CONSUME | 0x100), do.send(0x100, (NOON + NOON)[:size]), do.silence(),
        do.ask("40 00 10 00", "43 00 10 00 *"))


def runs_on(dut: Dut, first: int) -> None:
    """1013h runs on in microseconds from this value, which it has now."""
    start_us = dut.now_us
    dut.sleep(100)
    last = dut.integer("I", 0x1013)
    dut.check_ms(f"from {first:08X}h on", (last - first) & 0xFFFFFFFF, (dut.now_us - start_us) / 1000)


time("runs 7.5.2.16: 1013h counts microseconds", HIGH_RESOLUTION,
    do.run(runs_on, do.late(Dut.integer)("I", 0x1013)))
time("written 7.5.2.16: 1013h runs on from what is written, and wraps", HIGH_RESOLUTION,
    do.put("I", 0x1013, 0, 0xFFFFFFF0), do.run(runs_on, 0xFFFFFFF0))
