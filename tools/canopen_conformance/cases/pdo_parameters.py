"""The parameters of PDOs: which COB-ID, type and mapping may be written, and when (CiA 301, 7.5.2.35 to 7.5.2.38)."""

from __future__ import annotations

from itertools import product

from canopen_conformance import steps as do
from canopen_conformance.case import NotApplicableError, Service, check
from canopen_conformance.cases.pdo import INVALID, RPDO1, TPDO1, disable_pdo, enable_tpdo1, mapped_rpdo1, remap
from canopen_conformance.dut import Dut
from canopen_conformance.wire import OPERATIONAL, RESET_COMMUNICATION, Abort

# fmt: off
# A table: a case is its header, and below it its steps.

case = Service("pdo_parameters")

WHILE_VALID = (
    Abort.DEVICE_STATE,
    Abort.UNSUPPORTED_ACCESS,
    Abort.INVALID_VALUE,
    Abort.GENERAL_ERROR,
)  # the standard names no code here
BOTH = [(0x1800, 0x1A00, "TPDO1"), (0x1400, 0x1600, "RPDO1")]
EITHER = (*TPDO1, *RPDO1)
NO_RTR = 0x40000000
# Identifiers that no configurable object may have (table 41), with node-ids that exist.
RESTRICTED = (0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x77F, 0x7FF)
U8, U16, U32 = 5, 6, 7  # dummy types


@case("7.5.2.37: sub-index 0 of {2}'s communication parameters", EITHER, each=BOTH)
def highest_sub(dut: Dut, communication: int, _mapping: int, _name: str) -> None:
    highest = dut.integer("B", communication, 0)
    check(2 <= highest <= 6, "2 to 6", str(highest))


@case("7.5.2.37: sub-index 4 of {2} is reserved: 06090011h", EITHER, each=BOTH)
def reserved_sub(dut: Dut, communication: int, _mapping: int, _name: str) -> None:
    if dut.exists(communication, 4):
        raise NotApplicableError(f"{communication:04X}h:04 is the compatibility entry of older versions of CiA 301")
    dut.refuses("B", communication, 4, 0, Abort.NO_SUB)


@case("7.5.2.35: {2}: another CAN-ID while it is valid: 06090030h", EITHER, each=BOTH)
def moved_while_valid(dut: Dut, communication: int, _mapping: int, _name: str) -> None:
    cob_id = disable_pdo(dut, communication)
    dut.put("I", communication, 1, cob_id)
    dut.refuses("I", communication, 1, cob_id ^ 0x100, Abort.INVALID_VALUE)
    dut.holds("I", communication, 1, cob_id)


@case("7.5.2.35: {2}: disabled, moved, enabled", EITHER, each=BOTH)
def moved(dut: Dut, communication: int, _mapping: int, _name: str) -> None:
    cob_id = disable_pdo(dut, communication)
    new = cob_id & ~0x7FF | 0x390
    dut.put("I", communication, 1, new | INVALID)
    dut.put("I", communication, 1, new)
    dut.holds("I", communication, 1, new)


def refused_cob_id(dut: Dut, communication: int, mask: int, bits: int = 0) -> None:
    """Another COB-ID is refused: what the mask leaves of the present one, and these bits."""
    dut.refuses("I", communication, 1, disable_pdo(dut, communication) & mask | bits, Abort.INVALID_VALUE)


for (communication, _, name), can_id in product(BOTH, RESTRICTED):
    case(f"restricted 7.3.5: {name} with the restricted CAN-ID {can_id:03X}h: 06090030h", EITHER,
        do.run(refused_cob_id, communication, NO_RTR, can_id))
for (communication, _, name), value in product(BOTH, (241, 246, 251)):
    case(f"reserved_type 7.5.2.35: {name}: transmission type {value} is reserved: 06090030h", EITHER,
        do.refuses("B", communication, 2, value, Abort.INVALID_VALUE, Abort.TOO_HIGH))
for (communication, _, name), value in product(BOTH, (0, 1, 240, 254, 255)):
    case(f"allowed_type 7.5.2.35: {name}: transmission type {value} is taken", EITHER,
        do.run(disable_pdo, communication), do.put("B", communication, 2, value),
        do.holds("B", communication, 2, value))
for sub, name, kind in ((3, "inhibit time", "H"), (6, "SYNC start value", "B")):
    case(f"not_while_valid 7.5.2.37: {name} is not changed while the TPDO is valid", (*TPDO1, (0x1800, 3), (0x1800, 6)),
        do.run(enable_tpdo1, 255), do.refuses(kind, 0x1800, sub, 5, *WHILE_VALID), do.holds(kind, 0x1800, sub, 0))
case("start_value 7.5.2.37: SYNC start value 241 is refused", ((0x1800, 6),),
    do.run(disable_pdo, 0x1800), do.refuses("B", 0x1800, 6, 241, Abort.TOO_HIGH, Abort.INVALID_VALUE))


@case("7.5.2.36: {2}: {4} is not written while the PDO is valid", EITHER, each=[
    (*pdo, sub, name) for pdo in BOTH for sub, name in ((0, "the number of entries"), (1, "an entry"))
])
def mapping_while_valid(dut: Dut, communication: int, mapping: int, _name: str, sub: int, _what: str) -> None:
    dut.put("I", communication, 1, disable_pdo(dut, communication))
    dut.refuses("I" if sub else "B", mapping, sub, 0, *WHILE_VALID)


@case("7.5.2.36: {2}: an entry is not written while sub-index 0 is not 0", EITHER, each=BOTH)
def entry_while_mapped(dut: Dut, communication: int, mapping: int, _name: str) -> None:
    disable_pdo(dut, communication)
    if not dut.integer("B", mapping, 0):
        raise NotApplicableError("the PDO maps no object")
    dut.refuses("I", mapping, 1, dut.integer("I", mapping, 1), *WHILE_VALID)


@case("7.5.2.36: {2}: an object that is not there: {4}", EITHER, each=[
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


case("too_many_bits 7.5.2.36: more than 64 bits: 06040042h", RPDO1,
    do.run(disable_pdo, 0x1400), do.put("B", 0x1600, 0, 0),
    *(do.put("I", 0x1600, sub, word) for sub, word in enumerate((0x00070020, 0x00070020, 0x00050008), 1)),
    do.refuses("B", 0x1600, 0, 3, Abort.PDO_LENGTH), do.holds("B", 0x1600, 0, 0), do.put("B", 0x1600, 0, 2))
for communication, mapping, name in BOTH:
    case(f"too_many_entries 7.5.2.36: {name}: more entries than there are sub-indices is refused", EITHER,
        do.run(disable_pdo, communication), do.put("B", mapping, 0, 0),
        do.refuses("B", mapping, 0, 65, Abort.PDO_LENGTH, Abort.TOO_HIGH, Abort.INVALID_VALUE))
for index, bits in ((U8, 8), (U16, 16), (U32, 32), (2, 8), (3, 16), (4, 32)):
    case("dummy 7.4.7.1: dummy types fill an RPDO", RPDO1,
        do.run(mapped_rpdo1, index << 16 | bits))
case("dummy_tpdo 7.4.7.1: dummy types are not for a TPDO", TPDO1,
    do.run(disable_pdo, 0x1800), do.put("B", 0x1A00, 0, 0),
    do.refuses("I", 0x1A00, 1, 0x00050008, Abort.NO_OBJECT, Abort.NOT_MAPPABLE))


@case("7.5.2.38: a refused mapping leaves the one before", TPDO1)
def refused_mapping(dut: Dut) -> None:
    disable_pdo(dut, 0x1800)
    before = [dut.integer("I", 0x1A00, sub) for sub in range(1, dut.integer("B", 0x1A00, 0) + 1)]
    dut.put("B", 0x1A00, 0, 0)
    if dut.try_write(0x1A00, 1, bytes.fromhex("0800FF5F")):
        for sub, word in enumerate(before, 1):
            dut.holds("I", 0x1A00, sub, word)


@case("7.2.8.2.1.6: reset communication restores mapping, type and COB-ID", TPDO1)
def restored(dut: Dut) -> None:
    entries = [("I", 0x1800, 1), ("B", 0x1800, 2), ("B", 0x1A00, 0), ("I", 0x1A00, 1)]
    before = [dut.integer(*entry) for entry in entries]
    disable_pdo(dut, 0x1800)
    dut.put("B", 0x1800, 2, 7)
    remap(dut, 0x1A00)
    dut.reset(RESET_COMMUNICATION)
    for entry, value in zip(entries, before, strict=True):
        dut.holds(*entry, value)


case("operational 7.5.2.37: PDO parameters are written in OPERATIONAL too", TPDO1,
    do.enter(OPERATIONAL), do.run(enable_tpdo1, 1), do.send(0x080),
    lambda dut: dut.expect(dut.integer("I", 0x1800, 1) & 0x7FF))
