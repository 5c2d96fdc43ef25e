"""SYNC (CiA 301, 7.2.5), TIME and the high-resolution time stamp (7.2.6)."""

from __future__ import annotations

import struct

from canopen_conformance import steps as do
from canopen_conformance.case import Service, check
from canopen_conformance.cases.pdo import (
    TIME_U32,
    TPDO1,
    enable_tpdo1,
    mapped_rpdo1,
    rpdo_was,
    sends_6,
    set_time,
    start_tpdo1,
)
from canopen_conformance.dut import Dut
from canopen_conformance.wire import REMOTE_FLAG, START, STATES, Abort

# fmt: off
# A table: a case is its header, and below it its steps.

sync = Service("sync")
time = Service("time")

COUNTER = (*TPDO1, (0x1019, 0), (0x1800, 6))
LENGTH = (*TPDO1, (0x1019, 0), (0x1014, 0))


sync("default 7.3.3: the default CAN-ID of SYNC is 080h", ((0x1005, 0),),
    do.matches("I", 0x1005, 0, 0x3FFFFFFF, 0x80, "1005h = 080h"))
sync("moved 7.5.2.5: SYNC on another CAN-ID: that one alone acts", (*TPDO1, (0x1005, 0)),
    do.run(enable_tpdo1, 1), do.put("I", 0x1005, 0, 0x90), do.nmt(START), do.send(0x080), do.no_pdo(), do.send(0x090),
    do.pdo())
sync("bit_31 7.5.2.5: bit 31 of 1005h is not looked at", (*TPDO1, (0x1005, 0)),
    do.run(enable_tpdo1, 1), do.put("I", 0x1005, 0, 0x80000090), do.nmt(START), do.send(0x090), do.pdo())
for can_id in (0x000, 0x07F, 0x101, 0x580 | 5, 0x600 | 5, 0x6E0, 0x701):
    sync(f"restricted 7.3.5: 1005h with the restricted CAN-ID {can_id:03X}h: 06090030h", ((0x1005, 0),),
        do.refuses("I", 0x1005, 0, can_id, Abort.INVALID_VALUE))
sync("remote_frame 7.2.5: a remote frame is no SYNC", TPDO1,
    do.run(start_tpdo1, 1), do.send(0x080 | REMOTE_FLAG), do.no_pdo())
for value in (1, 241, 255):
    sync(f"overflow_refused 7.5.2.22: 1019h = {value} is refused", ((0x1019, 0),),
        do.refuses("B", 0x1019, 0, value, Abort.INVALID_VALUE, Abort.TOO_HIGH), do.holds("B", 0x1019, 0, 0))
for value in (0, 2, 240):
    sync(f"overflow_taken 7.5.2.22: 1019h = {value} is taken", ((0x1019, 0),),
        do.accepts("B", 0x1019, 0, value), do.holds("B", 0x1019, 0, value))
sync("counted 7.2.5.3.1: with 1019h a SYNC with its counter acts", COUNTER,
    do.run(enable_tpdo1, 1), do.put("B", 0x1019, 0, 10), do.nmt(START),
    *(step for counter in (1, 2, 10, 1) for step in (do.send(0x080, bytes((counter,))), do.pdo())))
for overflow, data, what in (
    (0, "01", "one byte without 1019h"), (0, "01 02 03 04 05 06 07 08", "eight bytes without 1019h"),
    (10, "", "no data with 1019h"), (10, "01 02", "two bytes with 1019h"),
):
    sync(f"wrong_length 7.2.5.3.1: SYNC of {what}: EMCY 8240h, and no TPDO", LENGTH,
        do.run(enable_tpdo1, 1), do.put("B", 0x1019, 0, overflow), do.nmt(START), do.send(0x080, data),
        do.emcy("40 82 *"), do.no_pdo())


@sync("7.5.2.37: SYNC start value {1}, type {0}: the first TPDO goes with that counter", COUNTER, each=[
    (1, 3, (1, 2, 3, 4, 5), (3, 4, 5)), (2, 4, (1, 2, 3, 4, 5, 6, 7), (4, 6)), (1, 1, (2, 3, 10, 1, 2), (1, 2)),
])
def start_value(dut: Dut, transmission: int, start: int, counters: tuple[int, ...], answered: tuple[int, ...]) -> None:
    can_id = enable_tpdo1(dut, transmission, sync_start=start)
    dut.put("B", 0x1019, 0, 10)
    dut.nmt(START)
    numbers = []
    for counter in counters:
        dut.send(0x080, bytes((counter,)))
        if dut.heard(can_id, 10):
            numbers.append(counter)
    check(tuple(numbers) == answered, f"TPDOs with the counters {answered}", str(numbers))


sync("start_without_counter 7.5.2.37: without a counter the start value has no meaning", COUNTER,
    do.run(start_tpdo1, 1, sync_start=5), do.send(0x080), do.pdo())


for wait_ms, when, fate in ((10, "within", "taken"), (150, "after", "discarded")):
    sync(f"window 7.5.2.7: a synchronous RPDO {when} the window of 1007h is {fate}",
        ((0x1007, 0), (0x1013, 0), (0x1400, 1), (0x1600, 0)),
        do.run(mapped_rpdo1, TIME_U32, transmission=1), do.put("I", 0x1007, 0, 80000), do.nmt(START), set_time,
        do.send(0x080), do.sleep(wait_ms), sends_6, do.send(0x080), do.run(rpdo_was, fate, 0x60000000))


TIME = ((0x1012, 0),)
HIGH_RESOLUTION = ((0x1013, 0),)
CONSUME = 0x80000000
NOON = struct.pack("<IH", 12 * 3600 * 1000, 14000)


time("default 7.3.3: the default CAN-ID of TIME is 100h", TIME,
    do.matches("I", 0x1012, 0, 0x7FF, 0x100, "CAN-ID 100h"))
for value in (0x100, 0x80000390, 0x80000100):
    time(f"taken 7.5.2.15: 1012h = {value:08X}h is taken", TIME,
        do.accepts("I", 0x1012, 0, value), do.holds("I", 0x1012, 0, value))
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


@time("7.5.2.16: 1013h counts microseconds", HIGH_RESOLUTION)
def runs(dut: Dut) -> None:
    first, start_us = dut.integer("I", 0x1013), dut.now_us
    dut.sleep(100)
    second, end_us = dut.integer("I", 0x1013), dut.now_us
    dut.check_ms("between two readings", (second - first) & 0xFFFFFFFF, (end_us - start_us) / 1000)


@time("7.5.2.16: 1013h runs on from what is written, and wraps", HIGH_RESOLUTION)
def written(dut: Dut) -> None:
    dut.put("I", 0x1013, 0, 0xFFFFFFF0)
    start_us = dut.now_us
    dut.sleep(50)
    time_us = dut.integer("I", 0x1013)
    dut.check_ms("since the write", (time_us + 0x10) & 0xFFFFFFFF, (dut.now_us - start_us) / 1000)
