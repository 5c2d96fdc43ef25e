"""The settings of an analogue input: scaling, period, filter, autozero and autotare (CiA 404)."""

from __future__ import annotations

import math

from canopen_conformance.case import CheckError, case, check
from canopen_conformance.dut import Dut
from tipforce.dictionary import table
from tipforce_tools.conformance.cases.profile_404 import gauges, settle, uncalibrated

INVALID_VALUE, TOO_HIGH, TOO_LOW = 0x06090030, 0x06090031, 0x06090032
SIGNATURE, STATE = 0x08000020, 0x08000022


@case("CiA 404 6112h", "operating mode {0} is refused", own=True, each=[(0, TOO_LOW), (2, TOO_HIGH)])
def operating_mode(dut: Dut, value: int, code: int) -> None:
    dut.refuses("B", 0x6112, 1, value, code)


@case("CiA 404 6114h", "the sample period of one channel is that of all", own=True)
def sample_period(dut: Dut) -> None:
    dut.put("I", 0x6114, 2, 1000)
    for sub in (1, 3, gauges(dut) + 6):
        dut.holds("I", 0x6114, sub, 1000)


@case(
    "CiA 404 6114h",
    "a sample period of {0} microseconds is refused",
    own=True,
    each=[(0, TOO_LOW), (99, TOO_LOW), (1000001, TOO_HIGH)],
)
def sample_period_range(dut: Dut, value: int, code: int) -> None:
    dut.refuses("I", 0x6114, 1, value, code)


@case(
    "CiA 404 6120h",
    "two scaling points at one field value: 06090030h, the first stays",
    own=True,
    each=[(0x6120, 0x6122), (0x6122, 0x6120)],
)
def scaling_points(dut: Dut, index: int, other: int) -> None:
    before = dut.number("f", index, 1)
    dut.refuses("f", index, 1, dut.number("f", other, 1), INVALID_VALUE)
    dut.holds("f", index, 1, before)


@case("CiA 404 6130h", "process value = scaled field value + offset", own=True)
def scaling(dut: Dut) -> None:
    dut.put("f", 0x6123, 1, 2000.0)  # gain 0.2 instead of 0.1
    dut.put("f", 0x6124, 1, 10.0)
    settle(dut)
    field, value = dut.number("f", 0x6100, 1), dut.number("f", 0x6130, 1)
    check(
        abs(value - (0.2 * field + 10.0)) <= 0.2 * 50, f"0.2 x {field} + 10", str(value)
    )  # noise between two readings


@case("CiA 404 61A0h", "filter type {0} is offered, and is that of all gauges", own=True, each=[(1,), (2,), (100,)])
def filter_type(dut: Dut, value: int) -> None:
    dut.put("H", 0x61A1, gauges(dut), 8)
    dut.put("B", 0x61A0, 1, value)
    for sub in (1, gauges(dut)):
        dut.holds("B", 0x61A0, sub, value)
        dut.holds("H", 0x61A1, sub, 8)
    dut.put("B", 0x61A0, 2, 0)
    dut.holds("B", 0x61A0, 1, 0)


@case("CiA 404 61A0h", "filter type {0} is refused", own=True, each=[
    (3, INVALID_VALUE), (99, INVALID_VALUE), (101, TOO_HIGH), (255, TOO_HIGH),
])  # fmt: skip
def filter_type_refused(dut: Dut, value: int, code: int) -> None:
    dut.refuses("B", 0x61A0, 1, value, code)
    dut.holds("B", 0x61A0, 1, 0)


@case("CiA 404 61A0h", "a contact channel has no filter: 06090011h", own=True)
def filter_of_contact(dut: Dut) -> None:
    dut.refuses("B", 0x61A0, gauges(dut) + 1, 1, 0x06090011)
    dut.refuses("H", 0x61A1, gauges(dut) + 1, 1, 0x06090011)


@case("CiA 404 61A1h", "a moving average takes {0} values: {1}", own=True, each=[
    (256, "taken", 0), (257, "06090031h", TOO_HIGH), (65535, "06090031h", TOO_HIGH),
])  # fmt: skip
def filter_window(dut: Dut, value: int, _shown: str, code: int) -> None:
    dut.put("B", 0x61A0, 1, 1)
    if code:
        dut.refuses("H", 0x61A1, 1, value, code)
    else:
        dut.put("H", 0x61A1, 1, value)
    dut.holds("H", 0x61A1, 1, 1 if code else value)


@case("CiA 404 61A1h", "filter type {0} takes the constant 65535", own=True, each=[(2,), (100,)])
def filter_longest(dut: Dut, kind: int) -> None:
    dut.put("H", 0x61A1, 1, 65535)
    dut.put("B", 0x61A0, 1, kind)
    dut.refuses("B", 0x61A0, 1, 1, INVALID_VALUE)  # no moving average of so many
    dut.holds("B", 0x61A0, 1, kind)


@case("CiA 404 61A1h", "a repeating average of {0} conversions of 1 ms is unknown until then", own=True, each=[(300,)])
def filter_block(dut: Dut, values: int) -> None:
    dut.put("I", 0x6114, 1, 1000)
    dut.put("H", 0x61A1, 1, values)
    dut.put("B", 0x61A0, 1, 2)
    settle(dut)
    if not math.isnan(dut.number("f", 0x6130, 1)):
        raise CheckError("6130h:1 unknown before the first average", str(dut.number("f", 0x6130, 1)))
    dut.sleep(values)
    check(not math.isnan(dut.number("f", 0x6130, 1)), "6130h:1 known after the first average", "NaN")


@case("CiA 404 6125h", "autozero with a wrong signature: 08000020h", own=True)
def autozero_signature(dut: Dut) -> None:
    dut.refuses("I", 0x6125, 1, 0x6F72657B, SIGNATURE)


@case("CiA 404 6125h", "autozero brings the gauge to zero by 6124h alone", own=True)
def autozero(dut: Dut) -> None:
    uncalibrated(dut)
    dut.put("f", 0x6124, 1, 100.0)
    settle(dut)
    others = [dut.number("f", index, 1) for index in range(0x6120, 0x6124)]
    dut.put("I", 0x6125, 1, table.SIGNATURE_ZERO)
    settle(dut)
    if abs(dut.number("f", 0x6130, 1)) > 10 or [dut.number("f", index, 1) for index in range(0x6120, 0x6124)] != others:
        raise CheckError("6130h:1 near 0, 6120h-6123h as before", str(dut.number("f", 0x6130, 1)))


@case("CiA 404 6139h", "autotare: only the sub-index of F1 exists, with a wrong signature 08000020h", own=True)
def autotare_signature(dut: Dut) -> None:
    n = gauges(dut)
    dut.holds("B", 0x6139, 0, n + 1)
    dut.refuses("I", 0x6139, n + 1, 0x61726175, SIGNATURE)
    dut.refuses("I", 0x6139, 1, table.SIGNATURE_TARA, 0x06090011)


@case("CiA 404 6139h", "autotare without calibration: 08000022h", own=True)
def autotare_unknown(dut: Dut) -> None:
    uncalibrated(dut)
    dut.refuses("I", 0x6139, gauges(dut) + 1, table.SIGNATURE_TARA, STATE)
