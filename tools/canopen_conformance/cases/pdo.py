"""PDOs: transmission, reception, timers (CiA 301, 7.2.2); which parameters may be written (7.5.2.35 to 7.5.2.38)."""

import struct
from collections.abc import Iterable
from itertools import pairwise, product

from canopen_conformance import steps as do
from canopen_conformance.case import Service, check, need
from canopen_conformance.dut import LAST_DATA_TYPE, Dut
from canopen_conformance.wire import EMCY, ENTER_PRE_OPERATIONAL, OPERATIONAL, PDO, RESET_COMMUNICATION, START, Abort

# fmt: off
# A table: a case is its header, and below it its steps.

tpdo = Service("tpdo")
rpdo = Service("rpdo")
parameters = Service("pdo_parameters")

INVALID = 0x80000000
TPDO1 = ((0x1800, 1), (0x1800, 2), (0x1A00, 0))
RPDO1 = ((0x1400, 1), (0x1400, 2), (0x1600, 0))


def disable_pdo(dut: Dut, communication: int) -> int:
    """Set bit 31 of a PDO's COB-ID; return the COB-ID without it."""
    cob_id = dut.integer("I", communication, 1) & ~INVALID
    dut.put("I", communication, 1, cob_id | INVALID)
    return cob_id


def enable_pdo(dut: Dut, communication: int) -> None:
    """Make a PDO valid, with its own COB-ID."""
    dut.put("I", communication, 1, disable_pdo(dut, communication))


def move_pdo(dut: Dut, communication: int) -> int:
    """Disable a PDO, give it the CAN-ID 390h, enable it; return the new COB-ID."""
    cob_id = disable_pdo(dut, communication) & ~0x7FF | 0x390
    dut.put("I", communication, 1, cob_id | INVALID)
    dut.put("I", communication, 1, cob_id)
    return cob_id


def remap(dut: Dut, mapping: int, *words: int) -> None:
    """Map ``words`` by the procedure of 7.5.2.36; the PDO is disabled."""
    dut.put("B", mapping, 0, 0)
    for sub, word in enumerate(words, 1):
        dut.put("I", mapping, sub, word)
    dut.put("B", mapping, 0, len(words))


def enable_tpdo1(
    dut: Dut,
    transmission: int = 1,
    *words: int,
    inhibit_100us: int | None = None,
    event_ms: int | None = None,
    sync_start: int | None = None,
) -> None:
    """Set up TPDO1, by default for each SYNC with its own mapping, as ``Dut.pdo_id``; not applicable without one."""
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


def start_tpdo1(dut: Dut, /, transmission: int = 1, *words: int, **timing: int | None) -> None:
    """Set up TPDO1 as ``enable_tpdo1`` does, and start the device."""
    enable_tpdo1(dut, transmission, *words, **timing)
    dut.nmt(START)


def check_mapped(dut: Dut) -> None:
    """End a case about a TPDO1 that maps nothing, or what the device does not have: it sends no frame."""
    count = dut.integer("B", 0x1A00, 0)
    need(count, "TPDO1 maps no object")
    for sub in range(1, count + 1):
        word = dut.integer("I", 0x1A00, sub)
        index, bits = word >> 16, word & 0xFF
        data = dut.try_read(index, word >> 8 & 0xFF) if index > LAST_DATA_TYPE else 0
        fits = isinstance(data, bytes) and bits in (8 * len(data), 1)
        need(fits, f"TPDO1 maps {word:08X}h, which no object of the device fits")


def mapped_rpdo1(dut: Dut, *words: int, transmission: int = 255, event_ms: int = 0) -> None:
    """Set up a valid RPDO1 with this mapping, by default that of 1013h, as ``Dut.pdo_id``."""
    cob_id = disable_pdo(dut, 0x1400)
    remap(dut, 0x1600, *(words or (TIME_U32,)))
    dut.put("B", 0x1400, 2, transmission)
    if event_ms:
        dut.put("H", 0x1400, 5, event_ms)
    dut.put("I", 0x1400, 1, cob_id)
    dut.pdo_id = cob_id & 0x7FF


def start_rpdo1(dut: Dut, *words: int, transmission: int = 255, event_ms: int = 0) -> None:
    """Set up RPDO1 as ``mapped_rpdo1`` does, and start the device."""
    mapped_rpdo1(dut, *words, transmission=transmission, event_ms=event_ms)
    dut.nmt(START)


TIMED = (*TPDO1, (0x1800, 3), (0x1800, 5))
HIGH_RESOLUTION = (*RPDO1, (0x1013, 0))
DEADLINE = (*HIGH_RESOLUTION, (0x1400, 5))
TIME_U32 = 0x10130020  # 1013h, 32 bits: it may be mapped into either direction
TIME = 0x1013


def on_syncs(dut: Dut, numbers: Iterable[int], counted: bool = False) -> list[int]:
    """Which of these SYNCs the TPDO answered; ``counted``: they carry their number."""
    answered = []
    for number in numbers:
        dut.send(0x080, bytes((number,) if counted else ()))
        if dut.heard(PDO, 10) is not None:
            answered.append(number)
    return answered


def cyclic(dut: Dut, every: int) -> None:
    """One TPDO for so many SYNCs."""
    answered = on_syncs(dut, range(3 * every))
    check([b - a for a, b in pairwise(answered)] == 2 * [every], f"three TPDOs, {every} SYNCs apart", f"{answered}")


for transmission in (1, 2, 3, 5):
    tpdo(f"cyclic 7.2.2.2: type {transmission}: one TPDO for {transmission} SYNCs", TPDO1,
        do.run(start_tpdo1, transmission), do.run(cyclic, transmission))
for transmission in (254, 255):
    tpdo(f"event_driven 7.2.2.2: type {transmission}: a SYNC sends nothing", TPDO1,
        do.run(start_tpdo1, transmission), do.sleep(20), do.forget(PDO), do.send(0x080), do.silence(PDO))
for ms in (20, 60):
    tpdo(f"event_timer 7.5.2.37: event timer {ms} ms", TIMED,
        do.run(start_tpdo1, 255, event_ms=ms), do.each_ms(ms, 3, "three times", do.expect(PDO, within_ms=2 * ms)))
tpdo("event_timer_off 7.5.2.37: event timer 0 ends the cyclic sending", TIMED,
    do.run(start_tpdo1, 255, event_ms=20), do.expect(PDO), do.put("H", 0x1800, 5, 0), do.forget(PDO),
    do.silence(PDO, ms=60))
tpdo("event_timer_stops 7.5.2.37: the event timer does nothing outside OPERATIONAL", TIMED,
    do.run(enable_tpdo1, 255, event_ms=20), do.silence(PDO, ms=60), do.nmt(START), do.expect(PDO, within_ms=40),
    do.nmt(ENTER_PRE_OPERATIONAL), do.sleep(5), do.forget(PDO), do.silence(PDO, ms=60))
tpdo("inhibit 7.5.2.37: the inhibit time holds back the event timer", TIMED,
    do.run(start_tpdo1, 255, event_ms=10, inhibit_100us=800),
    do.each_ms(80, 2, "two inhibit times of 80 ms", do.expect(PDO, within_ms=120)))
tpdo("invalid 7.5.2.37: a TPDO with bit 31 set is not sent", TPDO1,
    enable_tpdo1, do.run(disable_pdo, 0x1800), do.nmt(START), do.send(0x080), do.silence(PDO))
tpdo("moved 7.5.2.37: a TPDO that was moved is sent with its new CAN-ID alone", TPDO1,
    enable_tpdo1, do.run(move_pdo, 0x1800), do.nmt(START), do.send(0x080), do.expect(0x390), do.silence(PDO))


@tpdo("7.2.2.5.1: a TPDO is as long as its mapping says", TPDO1)
def length(dut: Dut) -> None:
    enable_tpdo1(dut)
    bits = sum(dut.integer("I", 0x1A00, sub) & 0xFF for sub in range(1, dut.integer("B", 0x1A00, 0) + 1))
    dut.nmt(START)
    dut.send(0x080)
    size = len(dut.expect(PDO).data)
    check(size == (bits + 7) // 8, f"{bits} bits", f"{size} bytes")


def rpdo_was(dut: Dut, fate: str, value: int) -> None:
    """Whether the RPDO that sets 1013h was "taken"."""
    time_us = dut.integer("I", TIME)
    check((time_us >= value) == (fate == "taken"), f"the RPDO {fate}", f"1013h = {time_us:08X}h")


set_time = do.put("I", TIME, 0, 0)  # so that what an RPDO brings shows
sends_6 = do.send(PDO, struct.pack("<I", 0x60000000))
took_6 = do.between("I", TIME, 0, 0x60000000, 0x60FFFFFF)  # it runs on
not_6 = do.between("I", TIME, 0, 0, 0x5FFFFFFF)
for transmission in (254, 255):
    rpdo(f"received 7.2.2.2: an RPDO of type {transmission} acts at once", HIGH_RESOLUTION,
        do.run(start_rpdo1, transmission=transmission), set_time, sends_6, took_6)
for transmission in (0, 1, 240):
    rpdo(f"received_on_sync 7.2.2.2: a synchronous RPDO of type {transmission} acts with the next SYNC",
        HIGH_RESOLUTION,
        do.run(start_rpdo1, transmission=transmission), set_time, sends_6, not_6, do.send(0x080), took_6)
rpdo("last_before_sync 7.2.2.2: of two synchronous RPDOs before a SYNC the last one acts", HIGH_RESOLUTION,
    do.run(start_rpdo1, transmission=1), sends_6, do.send(PDO, struct.pack("<I", 0x70000000)), do.send(0x080),
    do.between("I", TIME, 0, 0x70000000, 0x70FFFFFF))
rpdo("longer 7.2.2.5.1: a longer RPDO: the mapped bytes count", HIGH_RESOLUTION,
    start_rpdo1, do.send(PDO, struct.pack("<II", 0x60000000, 0x99999999)), took_6)
rpdo("shorter 7.2.2.5.1: a shorter RPDO: EMCY 8210h, nothing is taken", (*HIGH_RESOLUTION, (0x1014, 0)),
    start_rpdo1, set_time, do.send(PDO, "00 00 60"), do.expect(EMCY, "10 82 *"), do.between("I", TIME, 0, 0, 0x5FFFFF))
rpdo("dummies 7.4.7.1: dummy entries skip bytes of an RPDO", HIGH_RESOLUTION,
    do.run(start_rpdo1, 0x00050008, TIME_U32, 0x00060010), do.send(PDO, "AA 00 00 00 60 BB CC"), took_6)
rpdo("deadline 7.5.2.35: an RPDO that stays away: EMCY 8250h after its event timer", DEADLINE,
    do.run(start_rpdo1, event_ms=50), do.send(PDO, bytes(4)), do.after(50, "event timer", do.expect(EMCY, "50 82 *")),
    do.silence(EMCY, ms=70), do.send(PDO, bytes(4)), do.expect(EMCY, "00 00 *"))
rpdo("no_deadline 7.5.2.35: an RPDO is not missed before the first one", DEADLINE,
    do.run(start_rpdo1, event_ms=40), do.silence(EMCY, ms=100))
rpdo("no_deadline 7.5.2.35: an RPDO is not missed after OPERATIONAL was left", DEADLINE,
    do.run(start_rpdo1, event_ms=40), do.send(PDO, bytes(4)), do.nmt(ENTER_PRE_OPERATIONAL), do.silence(EMCY, ms=100))
rpdo("in_time 7.5.2.35: RPDOs in time: no EMCY", DEADLINE,
    do.run(start_rpdo1, event_ms=150), do.repeat(4, do.send(PDO, bytes(4)), do.silence(EMCY, ms=70)))
rpdo("invalid_rpdo 7.5.2.35: an RPDO with bit 31 set is not taken", HIGH_RESOLUTION,
    mapped_rpdo1, do.run(disable_pdo, 0x1400), do.nmt(START), set_time, sends_6, not_6)


# The standard names no code for a change while the PDO is valid.
WHILE_VALID = (Abort.DEVICE_STATE, Abort.UNSUPPORTED_ACCESS, Abort.INVALID_VALUE, Abort.GENERAL_ERROR)
BOTH = [(0x1800, 0x1A00, "TPDO1"), (0x1400, 0x1600, "RPDO1")]
EITHER = (*TPDO1, *RPDO1)
NO_RTR = 0x40000000
# Identifiers that no configurable object may have (table 41), with node-ids that exist.
RESTRICTED = (0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x77F, 0x7FF)
U8, U16, U32 = 5, 6, 7  # dummy types


for communication, _, name in BOTH:
    parameters(f"highest_sub 7.5.2.37: sub-index 0 of {name}'s communication parameters", EITHER,
        do.between("B", communication, 0, 2, 6))


@parameters("7.5.2.37: sub-index 4 of {2} is reserved: 06090011h", EITHER, each=BOTH)
def reserved_sub(dut: Dut, communication: int, _mapping: int, _name: str) -> None:
    older = f"{communication:04X}h:04 is the compatibility entry of older versions of CiA 301"
    need(not dut.exists(communication, 4), older)
    dut.refuses("B", communication, 4, 0, Abort.NO_SUB)


other_id = do.late(lambda dut, communication: dut.integer("I", communication, 1) ^ 0x100)
for communication, _, name in BOTH:
    parameters(f"moved_while_valid 7.5.2.35: {name}: another CAN-ID while it is valid: 06090030h", EITHER,
        do.run(enable_pdo, communication), do.unchanged(((communication, 1),),
            do.refuses("I", communication, 1, other_id(communication), Abort.INVALID_VALUE)))
    parameters(f"moved 7.5.2.35: {name}: disabled, moved, enabled", EITHER,
        do.run(lambda dut, index: dut.holds("I", index, 1, move_pdo(dut, index)), communication))


def refused_cob_id(dut: Dut, communication: int, mask: int, bits: int = 0) -> None:
    """Another COB-ID is refused: what the mask leaves of the present one, and these bits."""
    dut.refuses("I", communication, 1, disable_pdo(dut, communication) & mask | bits, Abort.INVALID_VALUE)


for (communication, _, name), can_id in product(BOTH, RESTRICTED):
    parameters(f"restricted 7.3.5: {name} with the restricted CAN-ID {can_id:03X}h: 06090030h", EITHER,
        do.run(refused_cob_id, communication, NO_RTR, can_id))
for (communication, _, name), value in product(BOTH, (241, 246, 251)):
    parameters(f"reserved_type 7.5.2.35: {name}: transmission type {value} is reserved: 06090030h", EITHER,
        do.refuses("B", communication, 2, value, Abort.INVALID_VALUE, Abort.TOO_HIGH))
for (communication, _, name), value in product(BOTH, (0, 1, 240, 254, 255)):
    parameters(f"allowed_type 7.5.2.35: {name}: transmission type {value} is taken", EITHER,
        do.run(disable_pdo, communication), do.put("B", communication, 2, value),
        do.holds("B", communication, 2, value))
for sub, name, kind in ((3, "inhibit time", "H"), (6, "SYNC start value", "B")):
    parameters(f"not_while_valid 7.5.2.37: {name} is not changed while the TPDO is valid",
        (*TPDO1, (0x1800, 3), (0x1800, 6)),
        do.run(enable_tpdo1, 255), do.refuses(kind, 0x1800, sub, 5, *WHILE_VALID), do.holds(kind, 0x1800, sub, 0))
parameters("start_value 7.5.2.37: SYNC start value 241 is refused", ((0x1800, 6),),
    do.run(disable_pdo, 0x1800), do.refuses("B", 0x1800, 6, 241, Abort.TOO_HIGH, Abort.INVALID_VALUE))
for (communication, mapping, name), (sub, what) in product(BOTH, ((0, "the number of entries"), (1, "an entry"))):
    parameters(f"mapping_while_valid 7.5.2.36: {name}: {what} is not written while the PDO is valid", EITHER,
        do.run(enable_pdo, communication), do.refuses("I" if sub else "B", mapping, sub, 0, *WHILE_VALID))


@parameters("7.5.2.36: {2}: an entry is not written while sub-index 0 is not 0", EITHER, each=BOTH)
def entry_while_mapped(dut: Dut, communication: int, mapping: int, _name: str) -> None:
    disable_pdo(dut, communication)
    need(dut.integer("B", mapping, 0), "the PDO maps no object")
    dut.refuses("I", mapping, 1, dut.integer("I", mapping, 1), *WHILE_VALID)


@parameters("7.5.2.36: {2}: an object that is not there: {4}", EITHER, each=[
    (*pdo, word, name) for pdo in BOTH for word, name in ((0xFFFF0008, "no index"), (0x10187708, "no sub-index"))
])
def maps_nothing(dut: Dut, communication: int, mapping: int, _name: str, word: int, _what: str) -> None:
    disable_pdo(dut, communication)
    dut.put("B", mapping, 0, 0)
    code = dut.try_write(mapping, 1, word.to_bytes(4, "little"))
    if not code:  # the standard lets a device look at the entries when sub-index 0 is set
        dut.refuses("B", mapping, 0, 1, Abort.NO_OBJECT, Abort.NO_SUB, Abort.NOT_MAPPABLE)
    elif code not in (Abort.NO_OBJECT, Abort.NO_SUB, Abort.NOT_MAPPABLE):
        dut.refuses("I", mapping, 1, word, Abort.NO_OBJECT, Abort.NO_SUB, Abort.NOT_MAPPABLE)


parameters("too_many_bits 7.5.2.36: more than 64 bits: 06040042h", RPDO1,
    do.run(disable_pdo, 0x1400), do.put("B", 0x1600, 0, 0),
    *(do.put("I", 0x1600, sub, word) for sub, word in enumerate((0x00070020, 0x00070020, 0x00050008), 1)),
    do.refuses("B", 0x1600, 0, 3, Abort.PDO_LENGTH), do.holds("B", 0x1600, 0, 0), do.put("B", 0x1600, 0, 2))
for communication, mapping, name in BOTH:
    parameters(f"too_many_entries 7.5.2.36: {name}: more entries than there are sub-indices is refused", EITHER,
        do.run(disable_pdo, communication), do.put("B", mapping, 0, 0),
        do.refuses("B", mapping, 0, 65, Abort.PDO_LENGTH, Abort.TOO_HIGH, Abort.INVALID_VALUE))
for index, bits in ((U8, 8), (U16, 16), (U32, 32), (2, 8), (3, 16), (4, 32)):
    parameters("dummy 7.4.7.1: dummy types fill an RPDO", RPDO1,
        do.run(mapped_rpdo1, index << 16 | bits))
parameters("dummy_tpdo 7.4.7.1: dummy types are not for a TPDO", TPDO1,
    do.run(disable_pdo, 0x1800), do.put("B", 0x1A00, 0, 0),
    do.refuses("I", 0x1A00, 1, 0x00050008, Abort.NO_OBJECT, Abort.NOT_MAPPABLE))


@parameters("7.5.2.38: a refused mapping leaves the one before", TPDO1)
def refused_mapping(dut: Dut) -> None:
    disable_pdo(dut, 0x1800)
    before = [dut.integer("I", 0x1A00, sub) for sub in range(1, dut.integer("B", 0x1A00, 0) + 1)]
    dut.put("B", 0x1A00, 0, 0)
    if dut.try_write(0x1A00, 1, bytes.fromhex("0800FF5F")):
        for sub, word in enumerate(before, 1):
            dut.holds("I", 0x1A00, sub, word)
parameters("restored 7.2.8.2.1.6: reset communication restores mapping, type and COB-ID", TPDO1,
    do.unchanged(((0x1800, 1), (0x1800, 2), (0x1A00, 0), (0x1A00, 1)),
        do.run(disable_pdo, 0x1800), do.put("B", 0x1800, 2, 7), do.run(remap, 0x1A00), do.reset(RESET_COMMUNICATION)))
parameters("operational 7.5.2.37: PDO parameters are written in OPERATIONAL too", TPDO1,
    do.enter(OPERATIONAL), enable_tpdo1, do.send(0x080), lambda dut: dut.expect(dut.integer("I", 0x1800, 1) & 0x7FF))
