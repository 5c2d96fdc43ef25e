"""PDOs of a fingertip: parameters and types beyond the standard, interrupts (CiA 404), sample counter and status."""

from itertools import product

from canopen_conformance import steps as do
from canopen_conformance.case import Service, check
from canopen_conformance.cases import pdo
from canopen_conformance.cases.pdo import BOTH, EITHER, NO_RTR, refused_cob_id
from canopen_conformance.dut import Dut
from canopen_conformance.wire import EMCY, ENTER_PRE_OPERATIONAL, PDO, REMOTE_FLAG, START, Abort

# fmt: off
# A table: a case is its header, and below it its steps.

pdo_parameters = Service("pdo_parameters", own=True)
rpdo = Service("rpdo", own=True)
tpdo = Service("tpdo", own=True)
interrupts_404 = Service("interrupts_404", standard="CiA 404", own=True)


tolerance_ms = do.late(lambda dut: dut.link.tolerance_ms)
for (communication, _, name), bits in product(BOTH, (0x20000000, 0x800)):
    pdo_parameters(f"extended 7.5.2.35: {name}: a 29-bit CAN-ID is not offered: 06090030h", EITHER,
        do.run(refused_cob_id, communication, ~0, bits))
pdo_parameters("rtr 7.5.2.37: a TPDO that answers to remote frames is not offered: 06090030h", pdo.TPDO1,
    do.run(refused_cob_id, 0x1800, ~NO_RTR))
for (communication, _, name), value in product(BOTH, (252, 253)):
    pdo_parameters(f"rtr_type 7.5.2.37: {name}: transmission type {value} (by remote frame) is refused", EITHER,
        do.refuses("B", communication, 2, value, Abort.INVALID_VALUE))
for communication, mapping, word, what in (
    (0x1800, 0x1A00, 0x10000020, "1000h is not mappable"),
    (0x1800, 0x1A00, 0x21040020, "a write-only object in a TPDO"),
    (0x1400, 0x1600, 0x21200008, "a read-only object in an RPDO"),
    (0x1800, 0x1A00, 0x71300108, "another length than the object's in a TPDO"),
    (0x1400, 0x1600, 0x21300008, "another length than the object's in an RPDO"),
    (0x1400, 0x1600, 0x00050010, "another length than the dummy type's"),
):
    pdo_parameters(f"not_mappable 7.5.2.36: 06040041h: {what}", EITHER,
        do.run(pdo.disable_pdo, communication), do.put("B", mapping, 0, 0),
        do.refuses("I", mapping, 1, word, Abort.NOT_MAPPABLE))
for communication, mapping, name in BOTH:
    pdo_parameters(f"empty_entry 7.5.2.36: {name}: an entry of 0 counted in is refused", EITHER,
        do.run(pdo.disable_pdo, communication), do.put("B", mapping, 0, 0), do.put("I", mapping, 1, 0),
        do.refuses("B", mapping, 0, 1, Abort.NO_OBJECT, Abort.NOT_MAPPABLE))
rpdo("forgotten 7.2.2.2: what waited for a SYNC is forgotten when OPERATIONAL is left", pdo.HIGH_RESOLUTION,
    do.run(pdo.start_rpdo1, transmission=1), pdo.set_time, pdo.sends_6,
    do.nmt(ENTER_PRE_OPERATIONAL), do.nmt(START), do.send(0x080), pdo.not_6)
rpdo("length_cured 7.2.7.1: an RPDO of the right length cures 8210h", (*pdo.HIGH_RESOLUTION, (0x1014, 0)),
    pdo.start_rpdo1,
    do.repeat(2, do.send(PDO), do.expect(EMCY, "10 82 *"), do.send(PDO, bytes(4)), do.expect(EMCY, "00 00 00 *")))
tpdo("cyclic_240 7.2.2.2: type 240: silent for the 200 SYNCs after a TPDO", pdo.TPDO1,
    do.run(pdo.start_tpdo1, 240), do.repeat(239, do.send(0x080)), do.silence(PDO, ms=50), do.send(0x080),
    do.expect(PDO))


tpdo("counted_anew 7.2.2.2: the SYNCs count anew when OPERATIONAL is entered", pdo.TPDO1,
    do.run(pdo.start_tpdo1, 3), do.repeat(2, do.send(0x080)), do.nmt(ENTER_PRE_OPERATIONAL), do.nmt(START),
    do.repeat(2, do.send(0x080), do.silence(PDO, ms=10)), do.send(0x080), do.expect(PDO))
tpdo("acyclic 7.2.2.2: type 0: silent at a SYNC while there was no event", pdo.TPDO1,
    do.run(pdo.start_tpdo1, 0), do.send(0x080), do.sleep(tolerance_ms()), do.forget(PDO),
    do.repeat(3, do.send(0x080)), do.silence(PDO))
for transmission in (254, 255):
    tpdo(f"first_values 7.2.2.2: type {transmission}: sent once when OPERATIONAL is entered", pdo.TPDO1,
        do.run(pdo.start_tpdo1, transmission), do.expect(PDO), do.silence(PDO))
tpdo("remote_frame 7.2.2.5.2: a remote frame is not answered by a TPDO without RTR", pdo.TPDO1,
    pdo.start_tpdo1, do.send(PDO | REMOTE_FLAG), do.silence(PDO))
contents = do.late(lambda dut, *indices: " ".join(dut.read(index).hex(" ") for index in indices))
tpdo("remapped 7.5.2.38: a new mapping: contents in the order of the entries, little-endian", pdo.TPDO1,
    do.run(pdo.start_tpdo1, 1, 0x10010008, 0x21230010, 0x10020020), do.send(0x080),
    do.expect(PDO, contents(0x1001, 0x2123, 0x1002)))
tpdo("nothing_mapped 7.5.2.38: a TPDO that maps nothing is not sent", pdo.TPDO1,
    pdo.enable_tpdo1, do.run(pdo.disable_pdo, 0x1800), do.run(pdo.remap, 0x1A00),
    do.run(pdo.enable_pdo, 0x1800), do.nmt(START), do.send(0x080), do.silence(PDO))
GAUGE_1 = 0x71300110
STATUS, COUNTER = 0x21200008, 0x21210008
NEEDS = (*pdo.TPDO1, (0x6133, 1))
NUMBERED = (*pdo.TPDO1, (0x1019, 0))
SAMPLE_MS = 130  # 100 ms after the last SYNC samples are taken without one


def begin(dut: Dut, transmission: int = 255, inhibit_100us: int | None = None) -> None:
    """TPDO1 carries gauge 1, OPERATIONAL, what it says at first has been heard."""
    pdo.start_tpdo1(dut, transmission, GAUGE_1, inhibit_100us=inhibit_100us)
    dut.sleep(SAMPLE_MS)
    dut.forget(PDO)


def shift(dut: Dut, microstrain: float) -> None:
    """Move gauge 1 by its offset."""
    dut.put("f", 0x6124, 1, microstrain)


for change, what in ((150.0, "sent"), (-150.0, "sent"), (50.0, "silent")):
    interrupts_404(f"delta 6133h: a change of {change} microstrain with a delta of 100: {what}", NEEDS,
        do.put("f", 0x6133, 1, 100.0), begin, do.run(shift, change),
        *([do.expect(PDO, within_ms=SAMPLE_MS)] if what == "sent" else []), do.silence(PDO, ms=SAMPLE_MS))
interrupts_404("delta_off 6133h: delta 0: no interrupt", NEEDS,
    begin, do.run(shift, 1000.0), do.silence(PDO, ms=SAMPLE_MS))
interrupts_404("delta_sum 6133h: small changes add up to a delta", NEEDS,
    do.put("f", 0x6133, 1, 100.0), begin, do.run(shift, 60.0), do.silence(PDO, ms=SAMPLE_MS), do.run(shift, 120.0),
    do.expect(PDO, within_ms=SAMPLE_MS))


for index, limit in ((0x6135, 200.0), (0x6134, -4000.0)):
    interrupts_404(f"limit {index:04X}h: the limit {index:04X}h is passed, and passed again: one TPDO each", NEEDS,
        do.put("f", index, 1, limit), begin, *(step for microstrain in (1.5 * limit, 0.0) for step in (
            do.run(shift, microstrain), do.expect(PDO, within_ms=SAMPLE_MS), do.silence(PDO, ms=SAMPLE_MS))))
interrupts_404("hysteresis 6136h: the hysteresis holds a value outside until it is well inside", NEEDS,
    do.put("f", 0x6135, 1, 200.0), do.put("f", 0x6136, 1, 100.0), begin, do.run(shift, 250.0),
    do.expect(PDO, within_ms=SAMPLE_MS), do.run(shift, 150.0), do.silence(PDO, ms=SAMPLE_MS), do.run(shift, 50.0),
    do.expect(PDO, within_ms=SAMPLE_MS), do.put("f", 0x6134, 1, -200.0), do.put("f", 0x6136, 1, 500.0),
    *(step for value in (-250.0, 250.0) for step in (do.run(shift, value), do.expect(PDO, within_ms=SAMPLE_MS))))
interrupts_404("acyclic CiA 301 7.2.2.2: type 0: an interrupt is sent with the next SYNC, once", NEEDS,
    do.put("f", 0x6133, 1, 100.0), do.run(begin, 0), do.send(0x080), do.sleep(tolerance_ms()), do.forget(PDO),
    do.run(shift, 150.0), do.sleep(5), do.send(0x080), do.expect(PDO), do.sleep(5), do.send(0x080), do.silence(PDO))


@interrupts_404(
    "CiA 301 7.5.2.37: the inhibit time lies between two interrupts; the later value is not lost",
    (*NEEDS, (0x1800, 3)),
)
def inhibit(dut: Dut) -> None:
    dut.put("f", 0x6133, 1, 100.0)
    dut.put("I", 0x6114, 1, 5000)
    begin(dut, 255, inhibit_100us=4000)
    dut.sleep(400)
    shift(dut, 150.0)
    first = dut.expect(PDO, within_ms=SAMPLE_MS)
    shift(dut, 300.0)
    second = dut.expect(PDO, within_ms=500)
    between_ms = (second.at_us - first.at_us) / 1000
    check(between_ms >= 400 - dut.link.tolerance_ms, "400 ms between two TPDOs", f"{between_ms:.0f} ms")
    check(second.data != first.data, "the later value", "the first one again")


@interrupts_404("tipforce 2121h: the sample counter goes up by one for each SYNC, and wraps", pdo.TPDO1)
def counter(dut: Dut) -> None:
    pdo.start_tpdo1(dut, 1, COUNTER)
    last = -1
    for _ in range(260):
        dut.sleep(1)
        dut.send(0x080)
        value = int.from_bytes(dut.expect(PDO).data, "little")
        check(last < 0 or value == (last + 1) & 0xFF, str((last + 1) & 0xFF), str(value))
        last = value


interrupts_404("numbered tipforce 2121h: with 1019h = 240 the counter is the number of the SYNC, 1 to 240", NUMBERED,
    do.run(pdo.enable_tpdo1, 1, COUNTER), do.put("B", 0x1019, 0, 240), do.nmt(START),
    *(step for number in (1, 2, 7, 8, 239, 240, 1, 120)  # also where numbers were left out
      for step in (do.send(0x080, bytes((number,))), do.expect(PDO, f"{number:02X} *"))))


@interrupts_404("tipforce 2121h: all TPDOs of one SYNC carry the same counter", (*pdo.TPDO1, (0x1801, 1)))
def one_sample(dut: Dut) -> None:
    second = dut.integer("I", 0x1801, 1)
    if second & 0x80000000:
        dut.put("I", 0x1801, 1, second & ~0x80000000)
    pdo.start_tpdo1(dut)
    for _ in range(3):
        dut.sleep(1)
        dut.send(0x080)
        first = dut.expect(PDO).data
        other = dut.expect(second & 0x7FF).data
        check(first[7] == other[7] and first[6] == other[6], "one status and counter", f"{first.hex()} {other.hex()}")


@interrupts_404("tipforce 2120h: a SYNC that finds no new sample: status bit 3, the counter repeated", pdo.TPDO1)
def stale(dut: Dut) -> None:
    pdo.enable_tpdo1(dut, 1, STATUS, COUNTER)
    dut.put("I", 0x6114, 1, 1000000)
    dut.nmt(START)
    for _ in range(2):  # one of two pairs lies within one sample period
        for _ in range(2):
            dut.send(0x080)
        first, second = dut.expect(PDO).data, dut.expect(PDO).data
        if second[1] == first[1]:
            break
    check(second[1] == first[1] and second[0] & 8, "bit 3, and the same counter", f"{first.hex()} {second.hex()}")


for value, code in ((4, Abort.TOO_HIGH), (255, Abort.TOO_HIGH)):
    interrupts_404(f"command_refused tipforce 2130h: command {value}: {code:08X}h", (),
        do.refuses("H", 0x2130, 0, value, code))
for size, index in ((1, 0x2120), (1, 0x2121), (2, 0x2122), (2, 0x2123), (2, 0x2124)):
    interrupts_404(f"live_sizes tipforce 2120h: a {size}-byte object is read as its type says", (),
        do.run(lambda dut, i, size: check(len(dut.read(i)) == size, f"{size} bytes", "another size"), index, size))


@interrupts_404("tipforce 2120h: status bit 1 follows the calibration")
def calibrated_bit(dut: Dut) -> None:
    active = dut.integer("I", 0x2103, 3)
    dut.sleep(110)
    status = dut.integer("B", 0x2120)
    check(bool(status & 2) == bool(active), f"bit 1 {bool(active)}", f"{status:02X}h")
