"""Calibration of a fingertip: stage, commit, lock, validity of its values (2100h to 2126h, 2140h, 2141h)."""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager

from canopen_conformance import steps as do
from canopen_conformance.case import CheckError, Service, check
from canopen_conformance.dut import Dut
from canopen_conformance.wire import RESET_NODE, RESETS, Abort
from canopen_device.core import codes
from tipforce.dictionary import table, table_objects
from tipforce_tools.fingertip_cases.profile import gauges, settle

# fmt: off
# A table: a case is its header, and below it its steps.

calibration = Service("calibration", standard="tipforce", own=True)
validity = Service("validity", standard="tipforce", own=True)

NEWTONS_PER_STRAIN = 5000.0
ON_N, OFF_N = 0.5, 0.3


def record(dut: Dut, **changed: float) -> bytes:
    """A calibration record of which gauges 1 to 3 give F1 to F3; ``changed`` names fields as "2110:4" says it."""
    values: list[float] = []
    n = gauges(dut)
    fields = table_objects.staged(n)
    for index, sub, kind in fields:
        value = 0.0
        if index == 0x2100 and sub in (1, n + 2, 2 * n + 3):
            value = NEWTONS_PER_STRAIN
        elif (index, sub) in ((0x2110, 4), (0x2110, 5)):
            value = ON_N if sub == 4 else OFF_N
        value = changed.get(f"x{index:04X}_{sub}", value)
        values.append(value if kind == "f" else int(value))
    return struct.pack("<" + "".join(kind for _index, _sub, kind in fields), *values)


def stage(dut: Dut, data: bytes) -> None:
    """Write the staged record and its expected CRC."""
    dut.refuses_bytes(0x2141, 0, data, 0)
    dut.put("I", 0x2103, 1, binascii.crc32(data))


def stage_record(dut: Dut) -> None:
    """Stage the record as it is without changes."""
    stage(dut, record(dut))


def commit(dut: Dut, data: bytes) -> None:
    """Stage and activate; it must be taken."""
    stage(dut, data)
    dut.put("I", 0x2104, 0, table.SIGNATURE_COMMIT)


def refused(dut: Dut, code: int) -> None:
    """A commit is refused, and the active calibration is as before."""
    active = ((0x2140, 0), (0x2103, 3), (0x2103, 4))
    before = [dut.read(*entry) for entry in active]
    dut.refuses("I", 0x2104, 0, table.SIGNATURE_COMMIT, code)
    check([dut.read(*entry) for entry in active] == before, "the active calibration unchanged", "another one")


def not_committed(dut: Dut, code: int, /, **changed: float) -> None:
    """A record with these changes may be staged, and its commit is refused."""
    stage(dut, record(dut, **changed))
    refused(dut, code)


@calibration("2141h: the staged record is written and read as one byte string")
def staged(dut: Dut) -> None:
    data = record(dut)
    stage(dut, data)
    check(dut.read(0x2141) == data, "the record", "another one")
    dut.holds("f", 0x2100, 1, NEWTONS_PER_STRAIN)
    dut.holds("f", 0x2110, 4, ON_N)


@calibration("2141h: a record of {0:+d} bytes is refused, the staged one stays", each=[
    (1, Abort.TOO_LONG), (-1, Abort.TOO_SHORT),
])
def staged_size(dut: Dut, more: int, code: int) -> None:
    data = record(dut)
    stage(dut, data)
    dut.refuses_bytes(0x2141, 0, (data + b"\0")[: len(data) + more], code)
    check(dut.read(0x2141) == data, "the record", "another one")


@calibration("2141h: a load sense of 2 in a record is refused")
def staged_sense(dut: Dut) -> None:
    fields = table_objects.staged(gauges(dut))
    at = fields.index((0x2110, 6, "B"))
    place = struct.calcsize("<" + "".join(kind for _index, _sub, kind in fields[:at]))
    data = record(dut)
    dut.refuses_bytes(0x2141, 0, data[:place] + b"\2" + data[place + 1 :], Abort.INVALID_VALUE)
    dut.refuses("B", 0x2110, 6, 2, Abort.TOO_HIGH)


@calibration("2103h: 2103h:2 is the CRC-32 of the staged record")
def staged_crc(dut: Dut) -> None:
    data = record(dut, x2102_1=77)
    stage(dut, data)
    dut.holds("I", 0x2103, 2, binascii.crc32(data))
    dut.put("I", 0x2102, 1, 78)
    dut.holds("I", 0x2103, 2, binascii.crc32(record(dut, x2102_1=78)))


@calibration("2102h: 2102h:5 is the condition number of the staged matrix")
def condition(dut: Dut) -> None:
    stage(dut, record(dut, x2100_1=4 * NEWTONS_PER_STRAIN))
    condition = dut.number("f", 0x2102, 5)
    check(abs(condition - 4.0) <= 1e-4, "4", str(condition))
    dut.put("f", 0x2100, 1, 0.0)
    dut.holds("f", 0x2102, 5, math.inf)
    dut.refuses("f", 0x2102, 5, 1.0, Abort.READ_ONLY)


@calibration("2104h: a commit activates: CRC, generation, 2140h, status bit 1")
def committed(dut: Dut) -> None:
    generation = dut.integer("I", 0x2103, 4)
    data = record(dut)
    commit(dut, data)
    dut.holds("I", 0x2103, 3, binascii.crc32(data))
    dut.holds("I", 0x2103, 4, generation + 1)
    check(dut.read(0x2140) == data, "the record in 2140h", "another one")
    settle(dut)
    check(dut.integer("B", 0x2120) & 2, "status bit 1", "clear")


@calibration("2104h: a staged write changes nothing that is active")
def staged_only(dut: Dut) -> None:
    data = record(dut)
    commit(dut, data)
    dut.put("f", 0x2100, 1, 1.0)
    check(dut.read(0x2140) == data, "the committed record", "another one")


for signature in (0, 0x74696D64, 0x65766173):
    calibration("wrong_signature 2104h: a wrong signature: 08000020h", (),
        stage_record, do.refuses("I", 0x2104, 0, signature, Abort.NOT_STORED))
calibration("wrong_crc 2104h: CRC mismatch: 06040043h", (),
    stage_record, do.put("I", 0x2103, 1, 1), do.run(refused, Abort.INCOMPATIBLE))
calibration("late_write 2104h: a write after the CRC was given: 06040043h", (),
    stage_record, do.put("f", 0x2101, 1, 1e-6), do.run(refused, Abort.INCOMPATIBLE))
for field, what, value in (
    ("x2100_2", "NaN in the matrix", math.nan), ("x2101_1", "infinity in an offset", math.inf),
    ("x2106_1", "NaN in the covariance", math.nan), ("x2110_1", "NaN as tip radius", math.nan),
):
    calibration(f"not_finite 2104h: {what} may be staged, and is not committed: 06090030h", (),
        do.run(not_committed, Abort.INVALID_VALUE, **{field: value}))
for what, fields in (
    ("theta minimum above maximum", {"x2110_2": 20.0, "x2110_3": 10.0}),
    ("contact-off above contact-on", {"x2110_5": 0.6}),
):
    calibration(f"contradiction 2104h: {what}: 06090030h", (),
        do.run(not_committed, Abort.INVALID_VALUE, **fields))
for what, value in (("a singular", 0.0), ("an ill-conditioned", 0.1)):
    calibration(f"ill_conditioned 2104h: {what} matrix: 06090031h", (),
        do.run(not_committed, Abort.TOO_HIGH, x2100_1=value))
calibration("condition_limit 2105h: a lower condition limit refuses what was allowed", (),
    lambda dut: stage(dut, record(dut, x2100_1=4 * NEWTONS_PER_STRAIN)), do.put("f", 0x2105, 1, 3.0),
    do.run(refused, Abort.TOO_HIGH), do.put("f", 0x2105, 1, 5.0), do.put("I", 0x2104, 0, table.SIGNATURE_COMMIT))
for value, code in ((0.5, Abort.TOO_LOW), (math.nan, Abort.INVALID_VALUE)):
    calibration(f"condition_limit_range 2105h: a condition limit of {value} is refused", (),
        do.refuses("f", 0x2105, 1, value, code))


@contextmanager
def with_lock(dut: Dut) -> Iterator[None]:
    """Locked within, unlocked with the signature after."""
    try:
        dut.put("B", 0x2105, 2, 1)
        yield
    finally:
        dut.put("I", 0x2105, 3, table.SIGNATURE_OPEN)


@calibration("2105h: locked: staged writes and commit are refused with 08000022h")
def locked(dut: Dut) -> None:
    data = record(dut)
    stage(dut, data)
    with with_lock(dut):
        dut.refuses("f", 0x2100, 1, 1.0, Abort.DEVICE_STATE)
        dut.refuses("B", 0x2110, 6, 1, Abort.DEVICE_STATE)
        dut.refuses_bytes(0x2141, 0, data, Abort.DEVICE_STATE)
        dut.refuses("f", 0x2105, 1, 10.0, Abort.DEVICE_STATE)
        dut.refuses("B", 0x2105, 2, 0, Abort.DEVICE_STATE)
        refused(dut, Abort.DEVICE_STATE)
        dut.holds("B", 0x2105, 2, 1)
    dut.put("I", 0x2104, 0, table.SIGNATURE_COMMIT)


for command, name in RESETS:
    calibration(f"lock_kept 2105h: the lock outlives {name}", (),
        do.within(with_lock, do.reset(command), do.refuses("f", 0x2100, 1, 1.0, Abort.DEVICE_STATE)))
calibration("wrong_unlock 2105h: unlocking with a wrong signature: 08000020h, still locked", (),
    do.within(with_lock, do.refuses("I", 0x2105, 3, 0x6E65706E, Abort.NOT_STORED), do.holds("B", 0x2105, 2, 1)))
calibration("active_read_only 2140h: the active record cannot be written", (),
    lambda dut: dut.refuses_bytes(0x2140, 0, record(dut), Abort.READ_ONLY))


def loaded(dut: Dut, newtons: float) -> None:
    """A committed calibration under which gauge 1 shows F1 = ``newtons``, by its offset."""
    commit(dut, record(dut))
    settle(dut)
    dut.put(
        "f", 0x6124, 1, dut.number("f", 0x6124, 1) - dut.number("f", 0x6130, 1) + newtons / NEWTONS_PER_STRAIN * 1e6
    )
    settle(dut)


@calibration("2120h: contact: bit 0, P is the size of F")
def contact(dut: Dut) -> None:
    loaded(dut, 5.0)
    n = gauges(dut)
    force, magnitude = dut.number("f", 0x6130, n + 1), dut.number("f", 0x6130, n + 4)
    if not dut.integer("B", 0x2120) & 1 or abs(force - 5) > 0.5 or abs(magnitude - abs(force)) > 0.5:
        raise CheckError("contact present, F1 = 5 N, P = 5 N", f"F1 {force}, P {magnitude}")


calibration("zero_in_contact CiA 404 6125h: autozero is refused while contact is present: 08000022h", (),
    do.run(loaded, 5.0), do.refuses("I", 0x6125, 1, table.SIGNATURE_ZERO, Abort.DEVICE_STATE),
    do.refuses("H", 0x2130, 0, table.COMMAND_ZERO, Abort.DEVICE_STATE))


@calibration("CiA 404 6139h: autotare takes the force as zero; command 2 clears it")
def tare(dut: Dut) -> None:
    loaded(dut, 5.0)
    n = gauges(dut)
    dut.put("I", 0x6139, n + 1, table.SIGNATURE_TARA)
    settle(dut)
    if abs(dut.number("f", 0x6130, n + 1)) > 0.5 or abs(dut.number("f", 0x2111, 1) - 5) > 0.5:
        raise CheckError("F1 = 0, tare 5 N", f"{dut.number('f', 0x6130, n + 1)}")
    dut.put("H", 0x2130, 0, table.COMMAND_CLEAR_TARE)
    dut.holds("f", 0x2111, 1, 0.0)


@calibration("2100h: 1010h:4 stores the active record, 1011h:4 forgets it", ((0x1010, 4),), persistent=True)
def stored(dut: Dut) -> None:
    data = record(dut, x2102_1=99)
    commit(dut, data)
    generation = dut.integer("I", 0x2103, 4)
    dut.put("I", 0x1010, 4, codes.SIGNATURE_SAVE)
    dut.refuses("f", 0x2100, 1, 7.0, 0)
    dut.reset()
    records = dut.read(0x2140), dut.read(0x2141), dut.integer("I", 0x2103, 4)
    dut.put("I", 0x1011, 4, codes.SIGNATURE_LOAD)
    dut.reset()
    dut.holds("I", 0x2103, 3, 0)
    check(records == (data, data, generation), "the stored record, active and staged", "another one")


BEYOND, OVERLOAD = 1 << table.FAULT_BEYOND_CALIBRATED, 1 << table.FAULT_OVERLOAD


@validity("2104h: a matrix of {0:g} N per unit strain: 0{1:X}h", each=[
    (1e-6 * NEWTONS_PER_STRAIN, Abort.TOO_LOW), (1e6 * NEWTONS_PER_STRAIN, Abort.TOO_HIGH),
])
def matrix_size(dut: Dut, newtons_per_strain: float, code: int) -> None:
    n = gauges(dut)
    not_committed(dut, code, **{f"x2100_{sub}": newtons_per_strain for sub in (1, n + 2, 2 * n + 3)})


for index, what, field, value in (
    ("2112", "a calibrated force below zero", "x2112_1", -1.0),
    ("2112", "an overload force below zero", "x2112_2", -1.0),
    ("2112", "a lowest temperature above the highest", "x2112_3", 1.0),
    ("2112", "a model uncertainty below zero", "x2112_5", -0.1), ("2112", "NaN as a force", "x2112_1", math.nan),
    ("2113", "a converter limit below zero", "x2113_1", -1e-3), ("2114", "an infinite offset", "x2114_1", math.inf),
    ("2115", "NaN as gain", "x2115_0", math.nan), ("2116", "a limit below zero", "x2116_0", -1.0),
):
    validity(f"not_valid {index}h: {what} may be staged, and is not committed: 06090030h", (),
        do.run(not_committed, Abort.INVALID_VALUE, **{field: value}))


@validity("2112h: {0}: bit {1} of 2124h", each=[
    ("beyond the calibrated force the value stays", 13, "x2112_1"),
    ("beyond the overload force it is unknown", 15, "x2112_2"),
])
def forces(dut: Dut, _what: str, bit: int, field: str) -> None:
    loaded(dut, 5.0)
    commit(dut, record(dut, **{field: 4.0}))
    settle(dut)
    faults, n = dut.integer("H", 0x2124), gauges(dut)
    check(faults & (BEYOND | OVERLOAD) == 1 << bit, f"bit {bit} alone of bits 13 and 15", f"{faults:04X}h")
    known = not math.isnan(dut.number("f", 0x6130, n + 4))
    check(known == (bit == 13), "P known" if bit == 13 else "P unknown", "known" if known else "unknown")
    dut.holds("B", 0x6150, n + 4, 0 if bit == 13 else 3)


@validity("2113h: a gauge at its converter limit is saturated")
def converter_limit(dut: Dut) -> None:
    loaded(dut, 5.0)
    commit(dut, record(dut, x2113_1=4.0 / NEWTONS_PER_STRAIN))
    settle(dut)
    dut.holds("B", 0x6150, 1, 3)
    faults = dut.integer("H", 0x2124)
    check(faults & 1, "bit 0 of 2124h", f"{faults:04X}h")


@validity("6149h: {0} outside its span: 6150h {2:02X}h, and the value is {3}", each=[
    ("a gauge", 1, 3, "unknown"), ("P", 0, 3, "shown"),
])
def span(dut: Dut, _what: str, sub: int, status: int, shown: str) -> None:
    loaded(dut, 5.0)
    sub = sub or gauges(dut) + 4
    settle(dut)
    dut.put("f", 0x6149, sub, 0.5 * dut.number("f", 0x6130, sub))
    settle(dut)
    dut.holds("B", 0x6150, sub, status)
    known = not math.isnan(dut.number("f", 0x6130, sub))
    check(known == (shown == "shown"), shown, "shown" if known else "unknown")


@validity("2126h: {0} counts where it changes a value, and only then", each=[
    ("a process value offset", "f", 0x6124, 1, 7.0), ("a span", "f", 0x6149, 1, 999.0), ("a filter", "B", 0x61A0, 1, 1),
    ("a transmission type", "B", 0x1802, 2, 7), ("1019h", "B", 0x1019, 0, 9),
    ("the identifier of SYNC", "I", 0x1005, 0, 0x91), ("that of EMCY", "I", 0x1014, 0, 0x80000091),
    ("the heartbeat", "H", 0x1017, 0, 997), ("an inhibit time", "H", 0x1802, 3, 5),
    ("an event timer", "H", 0x1802, 5, 500), ("a SYNC start value", "B", 0x1802, 6, 3),
    ("a limit of an interrupt", "f", 0x6135, 1, 5.0),
])
def counted(dut: Dut, _what: str, kind: str, index: int, sub: int, value: float) -> None:
    before = dut.integer("B", 0x2126)
    dut.put(kind, index, sub, value)
    dut.holds("B", 0x2126, 0, before + 1 & 0xFF)
    dut.put(kind, index, sub, value)
    dut.holds("B", 0x2126, 0, before + 1 & 0xFF)


@validity("2126h: {0} written back as it was read does not count", each=[
    ("an interrupt limit", 0x6135, 1), ("its INTEGER16 form", 0x7135, 1), ("a span", 0x6148, 4), ("1005h", 0x1005, 0),
])
def written_back(dut: Dut, _what: str, index: int, sub: int) -> None:
    before = dut.integer("B", 0x2126)
    abort = dut.try_write(index, sub, dut.read(index, sub))
    check(not abort, "accepted", f"abort {abort:08X}")
    dut.holds("B", 0x2126, 0, before)


@validity("2126h: a commit, a tare and its end count; a commit of the same record does not")
def counted_commands(dut: Dut) -> None:
    loaded(dut, 5.0)
    n, before = gauges(dut), dut.integer("B", 0x2126)
    commit(dut, record(dut))
    dut.holds("B", 0x2126, 0, before)
    commit(dut, record(dut, x2102_1=78))
    dut.holds("B", 0x2126, 0, before + 1 & 0xFF)
    settle(dut)
    dut.put("I", 0x6139, n + 1, table.SIGNATURE_TARA)
    dut.holds("B", 0x2126, 0, before + 2 & 0xFF)
    dut.put("H", 0x2130, 0, table.COMMAND_CLEAR_TARE)
    dut.holds("B", 0x2126, 0, before + 3 & 0xFF)


validity("counter_at_boot 2126h: 0 after a boot", (),
    do.put("f", 0x6124, 1, 7.0), do.reset(RESET_NODE), do.holds("B", 0x2126, 0, 0))
