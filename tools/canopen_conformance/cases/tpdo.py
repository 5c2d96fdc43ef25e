"""TPDOs at work: transmission types, timers, contents (CiA 301, 7.2.2)."""

from __future__ import annotations

from itertools import pairwise

from canopen_conformance.case import CheckError, Service, check
from canopen_conformance.dut import ENTER_PRE_OPERATIONAL, START, Dut
from canopen_conformance.setups import INVALID, RPDO1, TPDO1, disable_pdo, enable_tpdo1

case = Service("tpdo")

TIMED = (*TPDO1, (0x1800, 3), (0x1800, 5))
HIGH_RESOLUTION = (*RPDO1, (0x1013, 0))
TIME_U32 = 0x10130020  # 1013h, 32 bits: it may be mapped into either direction
TIME = 0x1013


def on_syncs(dut: Dut, can_id: int, count: int) -> list[int]:
    """Which of ``count`` SYNCs, from 1, the TPDO answered."""
    found = []
    for number in range(1, count + 1):
        dut.send(0x080)
        if dut.heard(can_id, 10) is not None:
            found.append(number)
    return found


@case("CiA 301 7.2.2.2", "type {0}: one TPDO for {0} SYNCs", needs=TPDO1, each=[(1,), (2,), (3,), (5,)])
def cyclic(dut: Dut, transmission: int) -> None:
    can_id = enable_tpdo1(dut, transmission)
    dut.nmt(START)
    found = on_syncs(dut, can_id, 3 * transmission)
    steps = [b - a for a, b in pairwise(found)]
    if len(found) != 3 or any(step != transmission for step in steps):
        raise CheckError(f"three TPDOs, {transmission} SYNCs apart", f"answers to SYNC {found}")


@case("CiA 301 7.2.2.2", "type {0}: a SYNC sends nothing", needs=TPDO1, each=[(254,), (255,)])
def event_driven(dut: Dut, transmission: int) -> None:
    can_id = enable_tpdo1(dut, transmission)
    dut.nmt(START)
    dut.sleep(20)
    dut.forget(can_id)
    dut.send(0x080)
    dut.silence(can_id)


@case("CiA 301 7.5.2.37", "event timer {0} ms", needs=TIMED, each=[(20,), (60,)])
def event_timer(dut: Dut, ms: int) -> None:
    can_id = enable_tpdo1(dut, 255, event_ms=ms)
    dut.nmt(START)
    first = dut.expect(can_id, within_ms=2 * ms)
    for _ in range(3):
        last = dut.expect(can_id, within_ms=2 * ms)
    dut.check_ms("three times", last.at_us - first.at_us, 3 * ms)


@case("CiA 301 7.5.2.37", "event timer 0 ends the cyclic sending", needs=TIMED)
def event_timer_off(dut: Dut) -> None:
    can_id = enable_tpdo1(dut, 255, event_ms=20)
    dut.nmt(START)
    dut.expect(can_id)
    dut.put("H", 0x1800, 5, 0)
    dut.forget(can_id)
    dut.silence(can_id, ms=60)


@case("CiA 301 7.5.2.37", "the event timer does nothing outside OPERATIONAL", needs=TIMED)
def event_timer_stops(dut: Dut) -> None:
    can_id = enable_tpdo1(dut, 255, event_ms=20)
    dut.silence(can_id, ms=60)
    dut.nmt(START)
    dut.expect(can_id, within_ms=40)
    dut.nmt(ENTER_PRE_OPERATIONAL)
    dut.sleep(5)
    dut.forget(can_id)
    dut.silence(can_id, ms=60)


@case("CiA 301 7.5.2.37", "the inhibit time holds back the event timer", needs=TIMED)
def inhibit(dut: Dut) -> None:
    can_id = enable_tpdo1(dut, 255, event_ms=10, inhibit_100us=800)
    dut.nmt(START)
    first = dut.expect(can_id)
    for _ in range(2):
        last = dut.expect(can_id, within_ms=120)
    dut.check_ms("two inhibit times of 80 ms", last.at_us - first.at_us, 160)


@case("CiA 301 7.5.2.37", "a TPDO with bit 31 set is not sent", needs=TPDO1)
def invalid(dut: Dut) -> None:
    can_id = enable_tpdo1(dut, 1)
    disable_pdo(dut, 0x1800)
    dut.nmt(START)
    dut.send(0x080)
    dut.silence(can_id)


@case("CiA 301 7.5.2.37", "a TPDO that was moved is sent with its new CAN-ID alone", needs=TPDO1)
def moved(dut: Dut) -> None:
    can_id = enable_tpdo1(dut, 1)
    cob_id = disable_pdo(dut, 0x1800) & ~0x7FF | 0x390
    dut.put("I", 0x1800, 1, cob_id | INVALID)
    dut.put("I", 0x1800, 1, cob_id)
    dut.nmt(START)
    dut.send(0x080)
    dut.expect(0x390)
    dut.silence(can_id)


@case("CiA 301 7.2.2.5.1", "a TPDO is as long as its mapping says", needs=TPDO1)
def length(dut: Dut) -> None:
    can_id = enable_tpdo1(dut, 1)
    bits = sum(dut.integer("I", 0x1A00, sub) & 0xFF for sub in range(1, dut.integer("B", 0x1A00, 0) + 1))
    dut.nmt(START)
    dut.send(0x080)
    found = len(dut.expect(can_id).data)
    check(found == (bits + 7) // 8, f"{bits} bits", f"{found} bytes")
