"""Interrupts of an analogue input (6133h to 6136h), the sample counter and the status byte in PDOs (CiA 404)."""

from __future__ import annotations

from canopen_conformance.case import CheckError, case, check
from canopen_conformance.dut import START, Dut
from canopen_conformance.setups import TPDO1, enable_tpdo1

GAUGE_1 = 0x71300110
STATUS, COUNTER = 0x21200008, 0x21210008
NEEDS = (*TPDO1, (0x6133, 1))
NUMBERED = (*TPDO1, (0x1019, 0))
SAMPLE_MS = 130  # 100 ms after the last SYNC samples are taken without one


def begin(dut: Dut, transmission: int = 255, **others: int) -> int:
    """TPDO1 carries gauge 1, OPERATIONAL, what it says at first has been heard; its CAN-ID."""
    can_id = enable_tpdo1(dut, transmission, GAUGE_1, **others)
    dut.nmt(START)
    dut.sleep(SAMPLE_MS)
    dut.forget(can_id)
    return can_id


def shift(dut: Dut, microstrain: float) -> None:
    """Move gauge 1 by its offset."""
    dut.put("f", 0x6124, 1, microstrain)


@case("CiA 404 6133h", "a change of {0} microstrain with a delta of 100: {1}", needs=NEEDS, own=True, each=[
    (150.0, "sent"), (-150.0, "sent"), (50.0, "silent"),
])  # fmt: skip
def delta(dut: Dut, change: float, what: str) -> None:
    dut.put("f", 0x6133, 1, 100.0)
    can_id = begin(dut)
    shift(dut, change)
    if what == "sent":
        dut.expect(can_id, within_ms=SAMPLE_MS)
    dut.silence(can_id, ms=SAMPLE_MS)


@case("CiA 404 6133h", "delta 0: no interrupt", needs=NEEDS, own=True)
def delta_off(dut: Dut) -> None:
    can_id = begin(dut)
    shift(dut, 1000.0)
    dut.silence(can_id, ms=SAMPLE_MS)


@case("CiA 404 6133h", "small changes add up to a delta", needs=NEEDS, own=True)
def delta_sum(dut: Dut) -> None:
    dut.put("f", 0x6133, 1, 100.0)
    can_id = begin(dut)
    shift(dut, 60.0)
    dut.silence(can_id, ms=SAMPLE_MS)
    shift(dut, 120.0)
    dut.expect(can_id, within_ms=SAMPLE_MS)


@case("CiA 404 {0:04X}h", "the limit {0:04X}h is passed, and passed again: one TPDO each", needs=NEEDS, own=True, each=[
    (0x6135, 200.0), (0x6134, -200.0),
])  # fmt: skip
def limit(dut: Dut, index: int, value: float) -> None:
    dut.put("f", index, 1, value)
    can_id = begin(dut)
    for microstrain in (1.5 * value, 0.0):
        shift(dut, microstrain)
        dut.expect(can_id, within_ms=SAMPLE_MS)
        dut.silence(can_id, ms=SAMPLE_MS)


@case("CiA 404 6136h", "the hysteresis holds a value outside until it is well inside", needs=NEEDS, own=True)
def hysteresis(dut: Dut) -> None:
    dut.put("f", 0x6135, 1, 200.0)
    dut.put("f", 0x6136, 1, 100.0)
    can_id = begin(dut)
    shift(dut, 250.0)
    dut.expect(can_id, within_ms=SAMPLE_MS)
    shift(dut, 150.0)
    dut.silence(can_id, ms=SAMPLE_MS)
    shift(dut, 50.0)
    dut.expect(can_id, within_ms=SAMPLE_MS)


@case("CiA 301 7.2.2.2", "type 0: an interrupt is sent with the next SYNC, once", needs=NEEDS, own=True)
def acyclic(dut: Dut) -> None:
    dut.put("f", 0x6133, 1, 100.0)
    can_id = begin(dut, 0)
    dut.send(0x080)
    dut.sleep(dut.link.tolerance_ms)
    dut.forget(can_id)
    shift(dut, 150.0)
    dut.sleep(5)
    dut.send(0x080)
    dut.expect(can_id)
    dut.sleep(5)
    dut.send(0x080)
    dut.silence(can_id)


@case(
    "CiA 301 7.5.2.37",
    "the inhibit time lies between two interrupts; the later value is not lost",
    needs=(*NEEDS, (0x1800, 3)),
    own=True,
)
def inhibit(dut: Dut) -> None:
    dut.put("f", 0x6133, 1, 100.0)
    dut.put("I", 0x6114, 1, 5000)
    can_id = begin(dut, 255, inhibit_100us=4000)
    dut.sleep(400)
    shift(dut, 150.0)
    first = dut.expect(can_id, within_ms=SAMPLE_MS)
    shift(dut, 300.0)
    second = dut.expect(can_id, within_ms=500)
    if second.at_us - first.at_us < 1000 * (400 - dut.link.tolerance_ms):
        raise CheckError("400 ms between two TPDOs", f"{(second.at_us - first.at_us) / 1000:.0f} ms")
    check(second.data != first.data, "the later value", "the first one again")


# --- what a PDO carries -----------------------------------------------------------------------------------


@case("tipforce 2121h", "the sample counter goes up by one for each SYNC, and wraps", needs=TPDO1, own=True)
def counter(dut: Dut) -> None:
    can_id = enable_tpdo1(dut, 1, COUNTER)
    dut.nmt(START)
    last = -1
    for _ in range(260):
        dut.sleep(1)
        dut.send(0x080)
        found = dut.expect(can_id).data[0]
        check(last < 0 or found == (last + 1) & 0xFF, str((last + 1) & 0xFF), str(found))
        last = found


@case("tipforce 2121h", "with 1019h = 240 the counter is the number of the SYNC, 1 to 240", needs=NUMBERED, own=True)
def numbered(dut: Dut) -> None:
    can_id = enable_tpdo1(dut, 1, COUNTER)
    dut.put("B", 0x1019, 0, 240)
    dut.nmt(START)
    for number in (1, 2, 7, 8, 239, 240, 1, 120):  # also where numbers were left out
        dut.send(0x080, bytes((number,)))
        found = dut.expect(can_id).data[0]
        check(found == number, str(number), str(found))


@case("tipforce 2121h", "all TPDOs of one SYNC carry the same counter", needs=(*TPDO1, (0x1801, 1)), own=True)
def one_sample(dut: Dut) -> None:
    second = dut.integer("I", 0x1801, 1)
    if second & 0x80000000:
        dut.put("I", 0x1801, 1, second & ~0x80000000)
    can_id = enable_tpdo1(dut, 1)
    dut.nmt(START)
    for _ in range(3):
        dut.sleep(1)
        dut.send(0x080)
        first = dut.expect(can_id).data
        other = dut.expect(second & 0x7FF).data
        check(first[7] == other[7] and first[6] == other[6], "one status and counter", f"{first.hex()} {other.hex()}")


@case("tipforce 2120h", "a SYNC that finds no new sample: status bit 3, the counter repeated", needs=TPDO1, own=True)
def stale(dut: Dut) -> None:
    can_id = enable_tpdo1(dut, 1, STATUS, COUNTER)
    dut.put("I", 0x6114, 1, 1000000)
    dut.nmt(START)
    for _ in range(2):  # one of two pairs lies within one sample period
        for _ in range(2):
            dut.send(0x080)
        first, second = dut.expect(can_id).data, dut.expect(can_id).data
        if second[1] == first[1]:
            break
    check(second[1] == first[1] and second[0] & 8, "bit 3, and the same counter", f"{first.hex()} {second.hex()}")


@case("tipforce 2130h", "command {0}: {1:08X}h", own=True, each=[(4, 0x06090031), (255, 0x06090031)])
def command_refused(dut: Dut, value: int, code: int) -> None:
    dut.refuses("H", 0x2130, 0, value, code)


@case(
    "tipforce 2120h",
    "a {0}-byte object is read as its type says",
    own=True,
    each=[(1, 0x2120), (1, 0x2121), (2, 0x2122), (2, 0x2123), (2, 0x2124)],
)
def live_sizes(dut: Dut, size: int, index: int) -> None:
    check(len(dut.read(index)) == size, f"{size} bytes", "another size")


@case("tipforce 2120h", "status bit 1 follows the calibration", own=True)
def calibrated_bit(dut: Dut) -> None:
    active = dut.integer("I", 0x2103, 3)
    dut.sleep(110)
    if bool(dut.integer("B", 0x2120) & 2) != bool(active):
        raise CheckError(f"bit 1 {bool(active)}", f"{dut.integer('B', 0x2120):02X}h")
