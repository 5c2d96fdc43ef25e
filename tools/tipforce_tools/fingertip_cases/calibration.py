"""Calibration of a fingertip: stage, commit, lock, validity of its values (2100h to 2126h, 2140h, 2141h)."""

import binascii
import math
import struct
from functools import partial

from canopen_conformance import steps as do
from canopen_conformance.case import Service, Step
from canopen_conformance.dut import Dut
from canopen_conformance.wire import RESET_NODE, RESETS, Abort
from canopen_device.core import codes
from tipforce.dictionary import table, table_objects
from tipforce_tools.fingertip_cases.profile import F1, P, channel, gauges, settle, sub_of

# fmt: off
# A table: a case is its header, and below it its steps.

calibration = Service("calibration", standard="tipforce", own=True)
validity = Service("validity", standard="tipforce", own=True)

NEWTONS_PER_STRAIN = 5000.0
ON_N, OFF_N = 0.5, 0.3


def record(dut: Dut, /, **changed: float) -> bytes:
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


made = do.late(record)
stage_record = do.run(stage, made())  # without changes


def commit(dut: Dut, data: bytes) -> None:
    """Stage and activate; it must be taken."""
    stage(dut, data)
    dut.put("I", 0x2104, 0, table.SIGNATURE_COMMIT)


def refused(code: int) -> Step:
    """A commit is refused, and the active calibration is as before."""
    active = ((0x2140, 0), (0x2103, 3), (0x2103, 4))
    return do.unchanged(active, do.refuses("I", 0x2104, 0, table.SIGNATURE_COMMIT, code))


def not_committed(dut: Dut, code: int, /, **changed: float) -> None:
    """A record with these changes may be staged, and its commit is refused."""
    stage(dut, record(dut, **changed))
    refused(code)(dut)


crc = do.late(lambda dut, **changed: binascii.crc32(record(dut, **changed)))
commit_record = do.run(commit, made())
commit_staged = do.put("I", 0x2104, 0, table.SIGNATURE_COMMIT)


calibration("staged 2141h: the staged record is written and read as one byte string", (),
    stage_record, do.reads(0x2141, 0, made()), do.holds("f", 0x2100, 1, NEWTONS_PER_STRAIN),
    do.holds("f", 0x2110, 4, ON_N))
resized = do.late(lambda dut, more: record(dut)[:-1] if more < 0 else record(dut) + b"\0")
for more, code in ((1, Abort.TOO_LONG), (-1, Abort.TOO_SHORT)):
    calibration(f"staged_size 2141h: a record of {more:+d} bytes is refused, the staged one stays", (),
        stage_record, do.refuses_bytes(0x2141, 0, resized(more), code), do.reads(0x2141, 0, made()))


calibration("staged_sense 2141h: a load sense of 2 in a record is refused", (),
    do.refuses_bytes(0x2141, 0, made(x2110_6=2), Abort.INVALID_VALUE), do.refuses("B", 0x2110, 6, 2, Abort.TOO_HIGH))
calibration("staged_crc 2103h: 2103h:2 is the CRC-32 of the staged record", (),
    do.run(stage, made(x2102_1=77)), do.holds("I", 0x2103, 2, crc(x2102_1=77)), do.put("I", 0x2102, 1, 78),
    do.holds("I", 0x2103, 2, crc(x2102_1=78)))
calibration("condition 2102h: 2102h:5 is the condition number of the staged matrix", (),
    do.run(stage, made(x2100_1=4 * NEWTONS_PER_STRAIN)), do.near(0x2102, 5, 4.0, 1e-4), do.put("f", 0x2100, 1, 0.0),
    do.holds("f", 0x2102, 5, math.inf), do.refuses("f", 0x2102, 5, 1.0, Abort.READ_ONLY))


calibration("committed 2104h: a commit activates: CRC, generation, 2140h, status bit 1", (),
    do.rises("I", 0x2103, 4, 1, commit_record, do.holds("I", 0x2103, 3, crc())), do.reads(0x2140, 0, made()), settle,
    do.matches("B", 0x2120, 0, 2, 2, "status bit 1"))
calibration("staged_only 2104h: a staged write changes nothing that is active", (),
    commit_record, do.put("f", 0x2100, 1, 1.0), do.reads(0x2140, 0, made()))
for signature in (0, 0x74696D64, 0x65766173):
    calibration("wrong_signature 2104h: a wrong signature: 08000020h", (),
        stage_record, do.refuses("I", 0x2104, 0, signature, Abort.NOT_STORED))
calibration("wrong_crc 2104h: CRC mismatch: 06040043h", (),
    stage_record, do.put("I", 0x2103, 1, 1), refused(Abort.INCOMPATIBLE))
calibration("late_write 2104h: a write after the CRC was given: 06040043h", (),
    stage_record, do.put("f", 0x2101, 1, 1e-6), refused(Abort.INCOMPATIBLE))
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
    do.run(stage, made(x2100_1=4 * NEWTONS_PER_STRAIN)), do.put("f", 0x2105, 1, 3.0), refused(Abort.TOO_HIGH),
    do.put("f", 0x2105, 1, 5.0), commit_staged)
for value, code in ((0.5, Abort.TOO_LOW), (math.nan, Abort.INVALID_VALUE)):
    calibration(f"condition_limit_range 2105h: a condition limit of {value} is refused", (),
        do.refuses("f", 0x2105, 1, value, code))


unlocked = do.undone_by(do.put("I", 0x2105, 3, table.SIGNATURE_OPEN))
lock = do.put("B", 0x2105, 2, 1)
calibration("locked 2105h: locked: staged writes and commit are refused with 08000022h", (),
    stage_record, do.within(unlocked, lock,
        do.refuses("f", 0x2100, 1, 1.0, Abort.DEVICE_STATE), do.refuses("B", 0x2110, 6, 1, Abort.DEVICE_STATE),
        do.refuses_bytes(0x2141, 0, made(), Abort.DEVICE_STATE), do.refuses("f", 0x2105, 1, 10.0, Abort.DEVICE_STATE),
        do.refuses("B", 0x2105, 2, 0, Abort.DEVICE_STATE), refused(Abort.DEVICE_STATE),
        do.holds("B", 0x2105, 2, 1)),
    commit_staged)
for command, name in RESETS:
    calibration(f"lock_kept 2105h: the lock outlives {name}", (),
        do.within(unlocked, lock, do.reset(command), do.refuses("f", 0x2100, 1, 1.0, Abort.DEVICE_STATE)))
calibration("wrong_unlock 2105h: unlocking with a wrong signature: 08000020h, still locked", (),
    do.within(unlocked, lock, do.refuses("I", 0x2105, 3, 0x6E65706E, Abort.NOT_STORED), do.holds("B", 0x2105, 2, 1)))
calibration("active_read_only 2140h: the active record cannot be written", (),
    do.refuses_bytes(0x2140, 0, made(), Abort.READ_ONLY))


def loaded(dut: Dut, newtons: float) -> None:
    """A committed calibration under which gauge 1 shows F1 = ``newtons``, by its offset."""
    commit(dut, record(dut))
    settle(dut)
    dut.put(
        "f", 0x6124, 1, dut.number("f", 0x6124, 1) - dut.number("f", 0x6130, 1) + newtons / NEWTONS_PER_STRAIN * 1e6
    )
    settle(dut)


calibration("contact 2120h: contact: bit 0, P is the size of F", (),
    do.run(loaded, 5.0), do.near(0x6130, F1, 5, 0.5), do.near(0x6130, P, 5, 0.5),
    do.matches("B", 0x2120, 0, 1, 1, "contact present"))
calibration("zero_in_contact CiA 404 6125h: autozero is refused while contact is present: 08000022h", (),
    do.run(loaded, 5.0), do.refuses("I", 0x6125, 1, table.SIGNATURE_ZERO, Abort.DEVICE_STATE),
    do.refuses("H", 0x2130, 0, table.COMMAND_ZERO, Abort.DEVICE_STATE))
calibration("tare CiA 404 6139h: autotare takes the force as zero; command 2 clears it", (),
    do.run(loaded, 5.0), do.put("I", 0x6139, F1, table.SIGNATURE_TARA), settle, do.near(0x6130, F1, 0, 0.5),
    do.near(0x2111, 1, 5, 0.5), do.put("H", 0x2130, 0, table.COMMAND_CLEAR_TARE), do.holds("f", 0x2111, 1, 0.0))
forgotten = do.undone_by(do.put("I", 0x1011, 4, codes.SIGNATURE_LOAD), do.reset(), do.holds("I", 0x2103, 3, 0))
calibration("stored 2100h: 1010h:4 stores the active record, 1011h:4 forgets it", ((0x1010, 4),),
    do.run(commit, made(x2102_1=99)), do.within(forgotten,
        do.unchanged(((0x2103, 4),),
            do.put("I", 0x1010, 4, codes.SIGNATURE_SAVE), do.refuses("f", 0x2100, 1, 7.0, 0), do.reset()),
        do.reads(0x2140, 0, made(x2102_1=99)), do.reads(0x2141, 0, made(x2102_1=99))), persistent=True)


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
for what, bit, field, status in (
    ("beyond the calibrated force the value stays", table.FAULT_BEYOND_CALIBRATED, "x2112_1", 0),
    ("beyond the overload force it is unknown", table.FAULT_OVERLOAD, "x2112_2", 3),
):
    validity(f"forces 2112h: {what}: bit {bit} of 2124h", (),
        do.run(loaded, 5.0), do.run(commit, made(**{field: 4.0})), settle,
        do.matches("H", 0x2124, 0, 0xA000, 1 << bit, f"bit {bit} alone of bits 13 and 15"),
        do.known(0x6130, P, not status), do.holds("B", 0x6150, P, status))
validity("converter_limit 2113h: a gauge at its converter limit is saturated", (),
    do.run(loaded, 5.0), do.run(commit, made(x2113_1=4.0 / NEWTONS_PER_STRAIN)), settle, do.holds("B", 0x6150, 1, 3),
    do.matches("H", 0x2124, 0, 1, 1, "bit 0 of 2124h"))


half = do.late(lambda dut, part: 0.5 * dut.number("f", 0x6130, channel(dut, part)))
for what, part, status, shown in (("a gauge", "gauge", 3, "unknown"), ("P", "magnitude", 3, "shown")):
    validity(f"span 6149h: {what} outside its span: 6150h {status:02X}h, and the value is {shown}", (),
        do.run(loaded, 5.0), settle, do.put("f", 0x6149, sub_of(part), half(part)), settle,
        do.holds("B", 0x6150, sub_of(part), status), do.known(0x6130, sub_of(part), shown == "shown"))


counts = partial(do.rises, "B", 0x2126, 0)
for what, kind, at, sub, number in (
    ("a process value offset", "f", 0x6124, 1, 7.0), ("a span", "f", 0x6149, 1, 999.0), ("a filter", "B", 0x61A0, 1, 1),
    ("a transmission type", "B", 0x1802, 2, 7), ("1019h", "B", 0x1019, 0, 9),
    ("the identifier of SYNC", "I", 0x1005, 0, 0x91), ("that of EMCY", "I", 0x1014, 0, 0x80000091),
    ("the heartbeat", "H", 0x1017, 0, 997), ("an inhibit time", "H", 0x1802, 3, 5),
    ("an event timer", "H", 0x1802, 5, 500), ("a SYNC start value", "B", 0x1802, 6, 3),
    ("a limit of an interrupt", "f", 0x6135, 1, 5.0),
):
    validity(f"counted 2126h: {what} counts where it changes a value, and only then", (),
        counts(1, do.put(kind, at, sub, number)), counts(0, do.put(kind, at, sub, number)))
for what, at, sub in (
    ("an interrupt limit", 0x6135, 1), ("its INTEGER16 form", 0x7135, 1), ("a span", 0x6148, 4), ("1005h", 0x1005, 0),
):
    validity(f"written_back 2126h: {what} written back as it was read does not count", (),
        counts(0, do.refuses_bytes(at, sub, do.late(Dut.read)(at, sub), 0)))
validity("counted_commands 2126h: a commit, a tare and its end count; a commit of the same record does not", (),
    do.run(loaded, 5.0), counts(0, commit_record), counts(1, do.run(commit, made(x2102_1=78))), settle,
    counts(1, do.put("I", 0x6139, F1, table.SIGNATURE_TARA)),
    counts(1, do.put("H", 0x2130, 0, table.COMMAND_CLEAR_TARE)))
validity("counter_at_boot 2126h: 0 after a boot", (),
    do.put("f", 0x6124, 1, 7.0), do.reset(RESET_NODE), do.holds("B", 0x2126, 0, 0))
