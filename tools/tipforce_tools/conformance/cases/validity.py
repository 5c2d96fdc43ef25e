"""Where a calibration is valid, and the configuration counter (docs/objects.md: 2112h to 2116h, 2124h, 2126h)."""

from __future__ import annotations

import math

from canopen_conformance.case import case, check
from canopen_conformance.dut import RESET_NODE, Dut
from tipforce.dictionary import table
from tipforce_tools.conformance.cases.calibration import (
    INVALID_VALUE,
    NEWTONS_PER_STRAIN,
    TOO_HIGH,
    commit,
    loaded,
    record,
    refused,
    stage,
)
from tipforce_tools.conformance.cases.profile_404 import gauges, settle

TOO_LOW = 0x06090032
BEYOND, OVERLOAD = 1 << table.FAULT_BEYOND_CALIBRATED, 1 << table.FAULT_OVERLOAD


@case("tipforce 2104h", "a matrix of {0:g} N per unit strain: 0{1:X}h", own=True, each=[
    (1e-6 * NEWTONS_PER_STRAIN, TOO_LOW), (1e6 * NEWTONS_PER_STRAIN, TOO_HIGH),
])  # fmt: skip
def matrix_size(dut: Dut, newtons_per_strain: float, code: int) -> None:
    n = gauges(dut)
    stage(dut, record(dut, **{f"x2100_{sub}": newtons_per_strain for sub in (1, n + 2, 2 * n + 3)}))
    refused(dut, code)


@case("tipforce {0}h", "{1} may be staged, and is not committed: 06090030h", own=True, each=[
    ("2112", "a calibrated force below zero", "x2112_1", -1.0),
    ("2112", "an overload force below zero", "x2112_2", -1.0),
    ("2112", "a lowest temperature above the highest", "x2112_3", 1.0),
    ("2112", "a model uncertainty below zero", "x2112_5", -0.1), ("2112", "NaN as a force", "x2112_1", math.nan),
    ("2113", "a converter limit below zero", "x2113_1", -1e-3), ("2114", "an infinite offset", "x2114_1", math.inf),
    ("2115", "NaN as gain", "x2115_0", math.nan), ("2116", "a limit below zero", "x2116_0", -1.0),
])  # fmt: skip
def not_valid(dut: Dut, _object: str, _what: str, field: str, value: float) -> None:
    stage(dut, record(dut, **{field: value}))
    refused(dut, INVALID_VALUE)


@case("tipforce 2112h", "{0}: bit {1} of 2124h", own=True, each=[
    ("beyond the calibrated force the value stays", 13, "x2112_1"),
    ("beyond the overload force it is unknown", 15, "x2112_2"),
])  # fmt: skip
def forces(dut: Dut, _what: str, bit: int, field: str) -> None:
    loaded(dut, 5.0)
    commit(dut, record(dut, **{field: 4.0}))
    settle(dut)
    faults, n = dut.integer("H", 0x2124), gauges(dut)
    check(faults & (BEYOND | OVERLOAD) == 1 << bit, f"bit {bit} alone of bits 13 and 15", f"{faults:04X}h")
    known = not math.isnan(dut.number("f", 0x6130, n + 4))
    check(known == (bit == 13), "P known" if bit == 13 else "P unknown", "known" if known else "unknown")
    dut.holds("B", 0x6150, n + 4, 0 if bit == 13 else 3)


@case("tipforce 2113h", "a gauge at its converter limit is saturated", own=True)
def converter_limit(dut: Dut) -> None:
    loaded(dut, 5.0)
    commit(dut, record(dut, x2113_1=4.0 / NEWTONS_PER_STRAIN))
    settle(dut)
    dut.holds("B", 0x6150, 1, 3)
    faults = dut.integer("H", 0x2124)
    check(faults & 1, "bit 0 of 2124h", f"{faults:04X}h")


@case("tipforce 6149h", "{0} outside its span: 6150h {2:02X}h, and the value is {3}", own=True, each=[
    ("a gauge", 1, 3, "unknown"), ("P", 0, 3, "shown"),
])  # fmt: skip
def span(dut: Dut, _what: str, sub: int, status: int, shown: str) -> None:
    loaded(dut, 5.0)
    sub = sub or gauges(dut) + 4
    settle(dut)
    dut.put("f", 0x6149, sub, 0.5 * dut.number("f", 0x6130, sub))
    settle(dut)
    dut.holds("B", 0x6150, sub, status)
    known = not math.isnan(dut.number("f", 0x6130, sub))
    check(known == (shown == "shown"), shown, "shown" if known else "unknown")


@case("tipforce 2126h", "{0} counts where it changes a value, and only then", own=True, each=[
    ("a process value offset", "f", 0x6124, 1, 7.0), ("a span", "f", 0x6149, 1, 999.0),
    ("a filter", "B", 0x61A0, 1, 1), ("a transmission type", "B", 0x1802, 2, 7), ("1019h", "B", 0x1019, 0, 9),
    ("the identifier of SYNC", "I", 0x1005, 0, 0x91), ("that of EMCY", "I", 0x1014, 0, 0x80000091),
    ("the heartbeat", "H", 0x1017, 0, 997), ("an inhibit time", "H", 0x1802, 3, 5),
    ("an event timer", "H", 0x1802, 5, 500), ("a SYNC start value", "B", 0x1802, 6, 3),
    ("a limit of an interrupt", "f", 0x6135, 1, 5.0),
])  # fmt: skip
def counted(dut: Dut, _what: str, kind: str, index: int, sub: int, value: float) -> None:
    before = dut.integer("B", 0x2126)
    dut.put(kind, index, sub, value)
    dut.holds("B", 0x2126, 0, before + 1 & 0xFF)
    dut.put(kind, index, sub, value)
    dut.holds("B", 0x2126, 0, before + 1 & 0xFF)


@case("tipforce 2126h", "{0} written back as it was read does not count", own=True, each=[
    ("an interrupt limit", 0x6135, 1), ("its INTEGER16 form", 0x7135, 1), ("a span", 0x6148, 4), ("1005h", 0x1005, 0),
])  # fmt: skip
def written_back(dut: Dut, _what: str, index: int, sub: int) -> None:
    before = dut.integer("B", 0x2126)
    abort = dut.try_write(index, sub, dut.read(index, sub))
    check(not abort, "accepted", f"abort {abort:08X}")
    dut.holds("B", 0x2126, 0, before)


@case("tipforce 2126h", "a commit, a tare and its end count; a commit of the same record does not", own=True)
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


@case("tipforce 2126h", "0 after a boot", own=True)
def counter_at_boot(dut: Dut) -> None:
    dut.put("f", 0x6124, 1, 7.0)
    dut.reset(RESET_NODE)
    dut.holds("B", 0x2126, 0, 0)
