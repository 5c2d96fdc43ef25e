"""PDOs: transmission, reception, timers (CiA 301, 7.2.2)."""

from __future__ import annotations

import struct
from itertools import pairwise

from canopen_conformance import steps as do
from canopen_conformance.case import CheckError, NotApplicableError, Service, check
from canopen_conformance.dut import LAST_DATA_TYPE, Dut
from canopen_conformance.wire import ENTER_PRE_OPERATIONAL, START

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


TIMED = (*TPDO1, (0x1800, 3), (0x1800, 5))
HIGH_RESOLUTION = (*RPDO1, (0x1013, 0))
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
    can_id = enable_tpdo1(dut, transmission)
    dut.nmt(START)
    answered = on_syncs(dut, can_id, 3 * transmission)
    steps = [b - a for a, b in pairwise(answered)]
    if len(answered) != 3 or any(step != transmission for step in steps):
        raise CheckError(f"three TPDOs, {transmission} SYNCs apart", f"answers to SYNC {answered}")


@tpdo("7.2.2.2: type {0}: a SYNC sends nothing", TPDO1, each=[(254,), (255,)])
def event_driven(dut: Dut, transmission: int) -> None:
    enable_tpdo1(dut, transmission)
    dut.nmt(START)
    dut.sleep(20)
    dut.forget_pdo()
    dut.send(0x080)
    dut.no_pdo()


@tpdo("7.5.2.37: event timer {0} ms", TIMED, each=[(20,), (60,)])
def event_timer(dut: Dut, ms: int) -> None:
    enable_tpdo1(dut, 255, event_ms=ms)
    dut.nmt(START)
    first = dut.pdo(within_ms=2 * ms)
    for _ in range(3):
        last = dut.pdo(within_ms=2 * ms)
    dut.check_ms("three times", last.at_us - first.at_us, 3 * ms)


tpdo("event_timer_off 7.5.2.37: event timer 0 ends the cyclic sending", TIMED)(
    do.run(enable_tpdo1, 255, event_ms=20),
    do.nmt(START),
    do.pdo(),
    do.put("H", 0x1800, 5, 0),
    do.forget_pdo(),
    do.no_pdo(ms=60),
)
tpdo("event_timer_stops 7.5.2.37: the event timer does nothing outside OPERATIONAL", TIMED)(
    do.run(enable_tpdo1, 255, event_ms=20),
    do.no_pdo(ms=60),
    do.nmt(START),
    do.pdo(within_ms=40),
    do.nmt(ENTER_PRE_OPERATIONAL),
    do.sleep(5),
    do.forget_pdo(),
    do.no_pdo(ms=60),
)


@tpdo("7.5.2.37: the inhibit time holds back the event timer", TIMED)
def inhibit(dut: Dut) -> None:
    enable_tpdo1(dut, 255, event_ms=10, inhibit_100us=800)
    dut.nmt(START)
    first = dut.pdo()
    for _ in range(2):
        last = dut.pdo(within_ms=120)
    dut.check_ms("two inhibit times of 80 ms", last.at_us - first.at_us, 160)


tpdo("invalid 7.5.2.37: a TPDO with bit 31 set is not sent", TPDO1)(
    do.run(enable_tpdo1, 1), do.run(disable_pdo, 0x1800), do.nmt(START), do.send(0x080), do.no_pdo()
)


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


RPDO_TIME_U32 = 0x10130020  # 1013h, 32 bits


def high_resolution(dut: Dut, at_least: int, below: int) -> None:
    """1013h, which runs on, lies in this range."""
    time_us = dut.integer("I", TIME)
    check(at_least <= time_us < below, f"1013h in {at_least:08X}h..{below:08X}h", f"{time_us:08X}h")


def set_time(dut: Dut) -> None:
    """1013h to 0, so that what an RPDO brings shows."""
    dut.put("I", TIME, 0, 0)


@rpdo("7.2.2.2: an RPDO of type {0} acts at once", HIGH_RESOLUTION, each=[(254,), (255,)])
def received(dut: Dut, transmission: int) -> None:
    mapped_rpdo1(dut, RPDO_TIME_U32, transmission=transmission)
    dut.nmt(START)
    set_time(dut)
    dut.send_pdo(struct.pack("<I", 0x60000000))
    high_resolution(dut, 0x60000000, 0x61000000)


rpdo.each(
    "received_on_sync 7.2.2.2: a synchronous RPDO of type {0} acts with the next SYNC",
    HIGH_RESOLUTION,
    [(0,), (1,), (240,)],
)(
    lambda transmission: (
        do.run(mapped_rpdo1, RPDO_TIME_U32, transmission=transmission),
        do.nmt(START),
        set_time,
        do.send_pdo(struct.pack("<I", 0x60000000)),
        do.run(high_resolution, 0, 0x60000000),
        do.send(0x080),
        do.run(high_resolution, 0x60000000, 0x61000000),
    )
)
rpdo("last_before_sync 7.2.2.2: of two synchronous RPDOs before a SYNC the last one acts", HIGH_RESOLUTION)(
    do.run(mapped_rpdo1, RPDO_TIME_U32, transmission=1),
    do.nmt(START),
    do.send_pdo(struct.pack("<I", 0x60000000)),
    do.send_pdo(struct.pack("<I", 0x70000000)),
    do.send(0x080),
    do.run(high_resolution, 0x70000000, 0x71000000),
)
rpdo("longer 7.2.2.5.1: a longer RPDO: the mapped bytes count", HIGH_RESOLUTION)(
    do.run(mapped_rpdo1, RPDO_TIME_U32),
    do.nmt(START),
    do.send_pdo(struct.pack("<II", 0x60000000, 0x99999999)),
    do.run(high_resolution, 0x60000000, 0x61000000),
)
rpdo("shorter 7.2.2.5.1: a shorter RPDO: EMCY 8210h, nothing is taken", (*HIGH_RESOLUTION, (0x1014, 0)))(
    do.run(mapped_rpdo1, RPDO_TIME_U32),
    do.nmt(START),
    set_time,
    do.send_pdo("00 00 60"),
    do.emcy("10 82 *"),
    do.run(high_resolution, 0, 0x600000),
)
rpdo("dummies 7.4.7.1: dummy entries skip bytes of an RPDO", HIGH_RESOLUTION)(
    do.run(mapped_rpdo1, 0x00050008, RPDO_TIME_U32, 0x00060010),
    do.nmt(START),
    do.send_pdo("AA 00 00 00 60 BB CC"),
    do.run(high_resolution, 0x60000000, 0x61000000),
)


@rpdo(
    "7.5.2.35: an RPDO that stays away: EMCY 8250h after its event timer",
    (*HIGH_RESOLUTION, (0x1400, 5)),
)
def deadline(dut: Dut) -> None:
    mapped_rpdo1(dut, RPDO_TIME_U32, event_ms=50)
    dut.nmt(START)
    dut.send_pdo(bytes(4))
    start_us = dut.now_us
    frame = dut.emcy("50 82 *")
    dut.check_ms("event timer", frame.at_us - start_us, 50)
    dut.no_emcy(ms=70)
    dut.send_pdo(bytes(4))
    dut.emcy("00 00 *")


@rpdo("7.5.2.35: an RPDO is not missed {1}", (*HIGH_RESOLUTION, (0x1400, 5)), each=[
    (False, "before the first one"), (True, "after OPERATIONAL was left"),
])  # fmt: skip
def no_deadline(dut: Dut, came: bool, _when: str) -> None:
    mapped_rpdo1(dut, RPDO_TIME_U32, event_ms=40)
    dut.nmt(START)
    if came:
        dut.send_pdo(bytes(4))
        dut.nmt(ENTER_PRE_OPERATIONAL)
    dut.no_emcy(ms=100)


rpdo("in_time 7.5.2.35: RPDOs in time: no EMCY", (*HIGH_RESOLUTION, (0x1400, 5)))(
    do.run(mapped_rpdo1, RPDO_TIME_U32, event_ms=150),
    do.nmt(START),
    do.repeat(4, do.send_pdo(bytes(4)), do.no_emcy(ms=70)),
)
rpdo("invalid_rpdo 7.5.2.35: an RPDO with bit 31 set is not taken", HIGH_RESOLUTION)(
    do.run(mapped_rpdo1, RPDO_TIME_U32),
    do.run(disable_pdo, 0x1400),
    do.nmt(START),
    set_time,
    do.send_pdo(struct.pack("<I", 0x60000000)),
    do.run(high_resolution, 0, 0x60000000),
)
