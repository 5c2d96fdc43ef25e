"""PDOs: transmission, reception, timers (CiA 301, 7.2.2)."""

from __future__ import annotations

import struct
from itertools import pairwise

from canopen_conformance import steps as do
from canopen_conformance.case import NotApplicableError, Service, check
from canopen_conformance.dut import LAST_DATA_TYPE, Dut
from canopen_conformance.wire import ENTER_PRE_OPERATIONAL, START

# fmt: off
# A table: a case is its header, and below it its steps.

tpdo = Service("tpdo")
rpdo = Service("rpdo")

INVALID = 0x80000000
TPDO1 = ((0x1800, 1), (0x1800, 2), (0x1A00, 0))
RPDO1 = ((0x1400, 1), (0x1400, 2), (0x1600, 0))


def disable_pdo(dut: Dut, communication: int) -> int:
    """Set bit 31 of a PDO's COB-ID; return the COB-ID without it."""
    cob_id = dut.integer("I", communication, 1) & ~INVALID
    dut.put("I", communication, 1, cob_id | INVALID)
    return cob_id


def remap(dut: Dut, mapping: int, *words: int) -> None:
    """Map ``words`` by the procedure of 7.5.2.36; the PDO is disabled."""
    dut.put("B", mapping, 0, 0)
    for sub, word in enumerate(words, 1):
        dut.put("I", mapping, sub, word)
    dut.put("B", mapping, 0, len(words))


def enable_tpdo1(
    dut: Dut,
    transmission: int,
    *words: int,
    inhibit_100us: int | None = None,
    event_ms: int | None = None,
    sync_start: int | None = None,
) -> int:
    """Set up TPDO1 with this type and mapping (none: unchanged) as ``Dut.pdo_id``; return its CAN-ID.

    A TPDO1 without mapped objects is not applicable.
    """
    cob_id = disable_pdo(dut, 0x1800)
    if words:
        remap(dut, 0x1A00, *words)
    else:
        check_mapped(dut)
    dut.put("B", 0x1800, 2, transmission)
    for value, sub, kind in ((inhibit_100us, 3, "H"), (event_ms, 5, "H"), (sync_start, 6, "B")):
        if value is not None or dut.exists(0x1800, sub):
            dut.put(kind, 0x1800, sub, value or 0)
    dut.put("I", 0x1800, 1, cob_id)
    dut.pdo_id = cob_id & 0x7FF
    return dut.pdo_id


def start_tpdo1(dut: Dut, /, transmission: int, *words: int, **timing: int | None) -> int:
    """Set up TPDO1 as ``enable_tpdo1`` does, and start the device."""
    can_id = enable_tpdo1(dut, transmission, *words, **timing)
    dut.nmt(START)
    return can_id


def check_mapped(dut: Dut) -> None:
    """End a case about a TPDO1 that maps nothing, or what the device does not have: it sends no frame."""
    count = dut.integer("B", 0x1A00, 0)
    if not count:
        raise NotApplicableError("TPDO1 maps no object")
    for sub in range(1, count + 1):
        word = dut.integer("I", 0x1A00, sub)
        index, bits = word >> 16, word & 0xFF
        data = dut.try_read(index, word >> 8 & 0xFF) if index > LAST_DATA_TYPE else 0
        if isinstance(data, int) or bits not in (8 * len(data), 1):
            raise NotApplicableError(f"TPDO1 maps {word:08X}h, which no object of the device fits")


def mapped_rpdo1(dut: Dut, *words: int, transmission: int = 255, event_ms: int = 0) -> int:
    """Set up a valid RPDO1 with this mapping as ``Dut.pdo_id``; return its CAN-ID."""
    cob_id = disable_pdo(dut, 0x1400)
    remap(dut, 0x1600, *words)
    dut.put("B", 0x1400, 2, transmission)
    if event_ms:
        dut.put("H", 0x1400, 5, event_ms)
    dut.put("I", 0x1400, 1, cob_id)
    dut.pdo_id = cob_id & 0x7FF
    return dut.pdo_id


def start_rpdo1(dut: Dut, *words: int, transmission: int = 255, event_ms: int = 0) -> None:
    """Set up RPDO1 as ``mapped_rpdo1`` does, and start the device."""
    mapped_rpdo1(dut, *words, transmission=transmission, event_ms=event_ms)
    dut.nmt(START)


TIMED = (*TPDO1, (0x1800, 3), (0x1800, 5))
HIGH_RESOLUTION = (*RPDO1, (0x1013, 0))
DEADLINE = (*HIGH_RESOLUTION, (0x1400, 5))
TIME_U32 = 0x10130020  # 1013h, 32 bits: it may be mapped into either direction
TIME = 0x1013


def on_syncs(dut: Dut, can_id: int, count: int) -> list[int]:
    """Which of ``count`` SYNCs, from 1, the TPDO answered."""
    answered = []
    for number in range(1, count + 1):
        dut.send(0x080)
        if dut.heard(can_id, 10) is not None:
            answered.append(number)
    return answered


@tpdo("7.2.2.2: type {0}: one TPDO for {0} SYNCs", TPDO1, each=[(1,), (2,), (3,), (5,)])
def cyclic(dut: Dut, transmission: int) -> None:
    can_id = start_tpdo1(dut, transmission)
    answered = on_syncs(dut, can_id, 3 * transmission)
    right = [b - a for a, b in pairwise(answered)] == 2 * [transmission]
    check(right, f"three TPDOs, {transmission} SYNCs apart", f"answers to SYNC {answered}")


for transmission in (254, 255):
    tpdo(f"event_driven 7.2.2.2: type {transmission}: a SYNC sends nothing", TPDO1,
        do.run(start_tpdo1, transmission), do.sleep(20), do.forget_pdo(), do.send(0x080), do.no_pdo())
for ms in (20, 60):
    tpdo(f"event_timer 7.5.2.37: event timer {ms} ms", TIMED,
        do.run(start_tpdo1, 255, event_ms=ms), do.each_ms(ms, 3, "three times", do.pdo(within_ms=2 * ms)))
tpdo("event_timer_off 7.5.2.37: event timer 0 ends the cyclic sending", TIMED,
    do.run(start_tpdo1, 255, event_ms=20), do.pdo(), do.put("H", 0x1800, 5, 0), do.forget_pdo(), do.no_pdo(ms=60))
tpdo("event_timer_stops 7.5.2.37: the event timer does nothing outside OPERATIONAL", TIMED,
    do.run(enable_tpdo1, 255, event_ms=20), do.no_pdo(ms=60), do.nmt(START), do.pdo(within_ms=40),
    do.nmt(ENTER_PRE_OPERATIONAL), do.sleep(5), do.forget_pdo(), do.no_pdo(ms=60))


@tpdo("7.5.2.37: the inhibit time holds back the event timer", TIMED)
def inhibit(dut: Dut) -> None:
    start_tpdo1(dut, 255, event_ms=10, inhibit_100us=800)
    first = dut.pdo()
    for _ in range(2):
        last = dut.pdo(within_ms=120)
    dut.check_ms("two inhibit times of 80 ms", last.at_us - first.at_us, 160)


tpdo("invalid 7.5.2.37: a TPDO with bit 31 set is not sent", TPDO1,
    do.run(enable_tpdo1, 1), do.run(disable_pdo, 0x1800), do.nmt(START), do.send(0x080), do.no_pdo())


@tpdo("7.5.2.37: a TPDO that was moved is sent with its new CAN-ID alone", TPDO1)
def moved(dut: Dut) -> None:
    enable_tpdo1(dut, 1)
    cob_id = disable_pdo(dut, 0x1800) & ~0x7FF | 0x390
    dut.put("I", 0x1800, 1, cob_id | INVALID)
    dut.put("I", 0x1800, 1, cob_id)
    dut.nmt(START)
    dut.send(0x080)
    dut.expect(0x390)
    dut.no_pdo()


@tpdo("7.2.2.5.1: a TPDO is as long as its mapping says", TPDO1)
def length(dut: Dut) -> None:
    enable_tpdo1(dut, 1)
    bits = sum(dut.integer("I", 0x1A00, sub) & 0xFF for sub in range(1, dut.integer("B", 0x1A00, 0) + 1))
    dut.nmt(START)
    dut.send(0x080)
    size = len(dut.pdo().data)
    check(size == (bits + 7) // 8, f"{bits} bits", f"{size} bytes")


def high_resolution(dut: Dut, at_least: int, below: int) -> None:
    """1013h, which runs on, lies in this range."""
    time_us = dut.integer("I", TIME)
    check(at_least <= time_us < below, f"1013h in {at_least:08X}h..{below:08X}h", f"{time_us:08X}h")


def rpdo_was(dut: Dut, fate: str, value: int) -> None:
    """Whether the RPDO that sets 1013h was "taken"."""
    time_us = dut.integer("I", TIME)
    check((time_us >= value) == (fate == "taken"), f"the RPDO {fate}", f"1013h = {time_us:08X}h")


set_time = do.put("I", TIME, 0, 0)  # so that what an RPDO brings shows
sends_6 = do.send_pdo(struct.pack("<I", 0x60000000))
took_6 = do.run(high_resolution, 0x60000000, 0x61000000)
for transmission in (254, 255):
    rpdo(f"received 7.2.2.2: an RPDO of type {transmission} acts at once", HIGH_RESOLUTION,
        do.run(start_rpdo1, TIME_U32, transmission=transmission), set_time, sends_6, took_6)
for transmission in (0, 1, 240):
    rpdo(f"received_on_sync 7.2.2.2: a synchronous RPDO of type {transmission} acts with the next SYNC",
        HIGH_RESOLUTION,
        do.run(start_rpdo1, TIME_U32, transmission=transmission), set_time, sends_6,
        do.run(high_resolution, 0, 0x60000000), do.send(0x080), took_6)
rpdo("last_before_sync 7.2.2.2: of two synchronous RPDOs before a SYNC the last one acts", HIGH_RESOLUTION,
    do.run(start_rpdo1, TIME_U32, transmission=1), sends_6, do.send_pdo(struct.pack("<I", 0x70000000)), do.send(0x080),
    do.run(high_resolution, 0x70000000, 0x71000000))
rpdo("longer 7.2.2.5.1: a longer RPDO: the mapped bytes count", HIGH_RESOLUTION,
    do.run(start_rpdo1, TIME_U32), do.send_pdo(struct.pack("<II", 0x60000000, 0x99999999)), took_6)
rpdo("shorter 7.2.2.5.1: a shorter RPDO: EMCY 8210h, nothing is taken", (*HIGH_RESOLUTION, (0x1014, 0)),
    do.run(start_rpdo1, TIME_U32), set_time, do.send_pdo("00 00 60"), do.emcy("10 82 *"),
    do.run(high_resolution, 0, 0x600000))
rpdo("dummies 7.4.7.1: dummy entries skip bytes of an RPDO", HIGH_RESOLUTION,
    do.run(start_rpdo1, 0x00050008, TIME_U32, 0x00060010), do.send_pdo("AA 00 00 00 60 BB CC"), took_6)
rpdo("deadline 7.5.2.35: an RPDO that stays away: EMCY 8250h after its event timer", DEADLINE,
    do.run(start_rpdo1, TIME_U32, event_ms=50), do.send_pdo(bytes(4)), do.after(50, "event timer", do.emcy("50 82 *")),
    do.no_emcy(ms=70), do.send_pdo(bytes(4)), do.emcy("00 00 *"))


@rpdo("7.5.2.35: an RPDO is not missed {1}", DEADLINE, each=[
    (False, "before the first one"), (True, "after OPERATIONAL was left"),
])
def no_deadline(dut: Dut, came: bool, _when: str) -> None:
    start_rpdo1(dut, TIME_U32, event_ms=40)
    if came:
        dut.send_pdo(bytes(4))
        dut.nmt(ENTER_PRE_OPERATIONAL)
    dut.no_emcy(ms=100)


rpdo("in_time 7.5.2.35: RPDOs in time: no EMCY", DEADLINE,
    do.run(start_rpdo1, TIME_U32, event_ms=150), do.repeat(4, do.send_pdo(bytes(4)), do.no_emcy(ms=70)))
rpdo("invalid_rpdo 7.5.2.35: an RPDO with bit 31 set is not taken", HIGH_RESOLUTION,
    do.run(mapped_rpdo1, TIME_U32), do.run(disable_pdo, 0x1400), do.nmt(START), set_time, sends_6,
    do.run(high_resolution, 0, 0x60000000))
