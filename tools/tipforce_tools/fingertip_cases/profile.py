"""Analogue inputs of a fingertip (CiA 404): one value in three forms, unit, status, filters, zero and tare."""

from __future__ import annotations

import math

from canopen_conformance import steps as do
from canopen_conformance.case import CheckError, NotApplicableError, Service, check
from canopen_conformance.dut import Dut
from canopen_conformance.wire import Abort
from tipforce.dictionary import table

profile_404 = Service("profile_404", standard="CiA 404", own=True)
settings_404 = Service("settings_404", standard="CiA 404", own=True)

NEWEST_MS = 110  # a live value that is read is at most 100 ms old
SIMULATED = ((0x2200, 1), (0x2201, 1))
PARTS = ("gauge", "force", "magnitude", "direction", "contact angle")


def gauges(dut: Dut) -> int:
    """How many gauges the device has."""
    return dut.integer("I", 0x1018, 2) & 0xFF


def channel(dut: Dut, part: str) -> int:
    """A channel of this kind: its sub-index."""
    n = gauges(dut)
    return {"gauge": 1, "force": n + 1, "magnitude": n + 4, "direction": n + 5, "contact angle": n + 6}[part]


def uncalibrated(dut: Dut) -> None:
    """Cases about a device without calibration need one."""
    if dut.integer("I", 0x2103, 3):
        raise NotApplicableError("the device is calibrated (`tipforce node --uncalibrated` is not)")


settle = do.sleep(NEWEST_MS)  # after it the next read takes a new sample


for header, kind, index, values in (
    ("sensor_type 6110h: the sensor type of a {0}", "H", 0x6110, (70, 10001, 10002, 10003, 10003)),
    ("unit 6131h: the unit of a {0}", "I", 0x6131, (0xFA010100, 0x210000, 0x210000, 0x410000, 0x410000)),
    ("digits 6132h: the decimal digits of a {0}", "B", 0x6132, (1, 3, 3, 2, 2)),
):
    profile_404.each(header, (), [(part, kind, index, value) for part, value in zip(PARTS, values, strict=True)])(
        lambda part, kind, index, value: lambda dut: dut.holds(kind, index, channel(dut, part), value)
    )


@profile_404("{0:04X}h: sub-index 0 of {0:04X}h counts {1}", each=[
    *((index, "all channels") for index in (0x6110, 0x6112, 0x6114, 0x6130, 0x6131, 0x6132, 0x6150, 0x7130, 0x9130)),
    *((index, "the gauges") for index in (0x6100, 0x6120, 0x6124, 0x6125, 0x61A0, 0x7100, 0x9100)),
])  # fmt: skip
def count(dut: Dut, index: int, which: str) -> None:
    dut.holds("B", index, 0, gauges(dut) + (6 if which == "all channels" else 0))


profile_404.each(
    "read_only {0:04X}h: {0:04X}h cannot be written",
    (),
    list(
        zip((0x6100, 0x6110, 0x6130, 0x6131, 0x6132, 0x6150, 0x7100, 0x7130, 0x9100, 0x9130), "fHfIBBhhii", strict=True)
    ),
)(lambda index, kind: do.refuses(kind, index, 1, 0, Abort.READ_ONLY))


def in_form(value: float, digits: int, kind: str) -> int:
    """The integer form of a REAL32 value: rounded, saturated."""
    highest = 0x7FFF if kind == "h" else 0x7FFFFFFF
    return round(min(max(value * 10.0**digits, -highest), highest))


@profile_404("7130h: 7130h and 9130h are 6130h, to the resolution of 6132h")
def live_forms(dut: Dut) -> None:
    dut.put("f", 0x6124, 1, 123.456)  # so that there is something to see without a load
    settle(dut)
    real = dut.number("f", 0x6130, 1)
    for kind, index in (("h", 0x7130), ("i", 0x9130)):
        if abs(dut.number(kind, index, 1) - in_form(real, 1, kind)) > 1:
            raise CheckError(f"{index:04X}h:1 = {in_form(real, 1, kind)}", str(dut.number(kind, index, 1)))


SETTINGS = (0x120, 0x121, 0x122, 0x123, 0x124, 0x133, 0x134, 0x135, 0x136, 0x148, 0x149)


@profile_404("6{0:03X}h: 6{0:03X}h, 7{0:03X}h and 9{0:03X}h are one value, written through {1}", each=[
    (offset, form) for offset in SETTINGS for form in ("REAL32", "INTEGER16", "INTEGER32")
])  # fmt: skip
def setting_forms(dut: Dut, offset: int, form: str) -> None:
    counts = offset in (0x120, 0x122)
    scale = 1 if counts else 10
    base, kind = {"REAL32": (0x6000, "f"), "INTEGER16": (0x7000, "h"), "INTEGER32": (0x9000, "i")}[form]
    dut.put(kind, base + offset, 1, 210.5 if kind == "f" and not counts else 210 if counts or kind == "f" else 2105)
    real = dut.number("f", 0x6000 + offset, 1)
    dut.holds("h", 0x7000 + offset, 1, round(real * scale))
    dut.holds("i", 0x9000 + offset, 1, round(real * scale))
    check(abs(real - (210 if counts else 210.5)) <= 1e-4, "210.5 (counts: 210)", str(real))


profile_404.each(
    "setting_saturates 7124h: a value that INTEGER16 cannot hold reads as its end", (), [(1e6, 0x7FFF), (-1e6, -0x7FFF)]
)(
    lambda value, shown: (
        do.put("f", 0x6124, 1, value), do.holds("h", 0x7124, 1, shown), do.holds("i", 0x9124, 1, round(value * 10)),
    )
)  # fmt: skip
profile_404.each("not_finite 6130h: {0} is not finite: 06090030h", (), [(math.nan,), (math.inf,), (-math.inf,)])(
    lambda value: tuple(do.refuses("f", index, 1, value, Abort.INVALID_VALUE) for index in (0x6124, 0x6133, 0x6148))
)


@profile_404("6150h: without calibration a {0} is not valid, and unknown in every form", each=[
    (part,) for part in PARTS[1:]
])  # fmt: skip
def unknown(dut: Dut, part: str) -> None:
    uncalibrated(dut)
    sub = channel(dut, part)
    settle(dut)
    dut.holds("B", 0x6150, sub, 1)
    dut.holds("h", 0x7130, sub, table.UNKNOWN_I16)
    dut.holds("i", 0x9130, sub, table.UNKNOWN_I32)
    value = dut.number("f", 0x6130, sub)
    check(math.isnan(value), "NaN", str(value))


profile_404("gauge_valid 6150h: a gauge is valid without calibration")(settle, do.holds("B", 0x6150, 1, 0))


@profile_404("6150h: a gauge beyond INTEGER16: overload {1:02X}h, 7130h at its end, 6130h and 9130h as they are", each=[
    (5000.0, 3, 0x7FFF), (-5000.0, 5, -0x7FFF),
])  # fmt: skip
def overload(dut: Dut, microstrain: float, status: int, shown: int) -> None:
    dut.put("f", 0x6124, 1, microstrain)
    settle(dut)
    dut.holds("B", 0x6150, 1, status)
    dut.holds("h", 0x7130, 1, shown)
    if abs(dut.number("i", 0x9130, 1) - 10 * dut.number("f", 0x6130, 1)) > 100:
        raise CheckError("9130h = 10 x 6130h", "another value")


@profile_404("6150h: simulated fault {0}: gauge 1 {1}", SIMULATED, each=[
    (3, "saturated", 0x7FFF, 3), (2, "open", table.UNKNOWN_I16, 1), (4, "silent", table.UNKNOWN_I16, 1),
])  # fmt: skip
def fault(dut: Dut, number: int, _name: str, shown: int, status: int) -> None:
    try:
        settle(dut)
        dut.put("B", 0x2200, 2, 1)
        dut.put("H", 0x2200, 1, number)
        settle(dut)
        dut.holds("h", 0x7130, 1, shown)
        dut.holds("B", 0x6150, 1, status)
    finally:
        dut.put("H", 0x2200, 1, 0)


@profile_404("6130h: a load that is applied shows in the gauges", SIMULATED)
def load(dut: Dut) -> None:
    before = [dut.number("f", 0x2201, sub) for sub in (1, 2, 3)]
    settle(dut)
    unloaded = dut.number("f", 0x6130, 1)
    try:
        dut.put("f", 0x2201, 2, 90.0)
        dut.put("f", 0x2201, 1, 4.0 + before[0])
        settle(dut)
        check(abs(dut.number("f", 0x6130, 1) - unloaded) >= 5, "another strain", "the same")
    finally:
        for sub, value in enumerate(before, 1):
            dut.put("f", 0x2201, sub, value)


settings_404.each("operating_mode 6112h: operating mode {0} is refused", (), [(0, Abort.TOO_LOW), (2, Abort.TOO_HIGH)])(
    lambda value, code: do.refuses("B", 0x6112, 1, value, code)
)


settings_404("sample_period 6114h: the sample period of one channel is that of all")(
    do.put("I", 0x6114, 2, 1000),
    lambda dut: [dut.holds("I", 0x6114, sub, 1000) for sub in (1, 3, gauges(dut) + 6)],
)
settings_404.each(
    "sample_period_range 6114h: a sample period of {0} microseconds is refused",
    (),
    [(0, Abort.TOO_LOW), (99, Abort.TOO_LOW), (1000001, Abort.TOO_HIGH)],
)(lambda value, code: do.refuses("I", 0x6114, 1, value, code))


settings_404.each(
    "scaling_points 6120h: two scaling points at one field value: 06090030h, the first stays",
    (),
    [(0x6120, 0x6122), (0x6122, 0x6120)],
)(
    lambda index, other: do.unchanged(
        "f", index, 1, lambda dut: dut.refuses("f", index, 1, dut.number("f", other, 1), Abort.INVALID_VALUE)
    )
)


@settings_404("6130h: process value = scaled field value + offset")
def scaling(dut: Dut) -> None:
    dut.put("f", 0x6123, 1, 2000.0)  # gain 0.2 instead of 0.1
    dut.put("f", 0x6124, 1, 10.0)
    settle(dut)
    field, value = dut.number("f", 0x6100, 1), dut.number("f", 0x6130, 1)
    noise = 0.2 * 50  # between two readings
    check(abs(value - (0.2 * field + 10.0)) <= noise, f"0.2 x {field} + 10", str(value))


@settings_404("61A0h: filter type {0} is offered, and is that of all gauges", each=[(1,), (2,), (100,)])
def filter_type(dut: Dut, value: int) -> None:
    dut.put("H", 0x61A1, gauges(dut), 8)
    dut.put("B", 0x61A0, 1, value)
    for sub in (1, gauges(dut)):
        dut.holds("B", 0x61A0, sub, value)
        dut.holds("H", 0x61A1, sub, 8)
    dut.put("B", 0x61A0, 2, 0)
    dut.holds("B", 0x61A0, 1, 0)


settings_404.each(
    "filter_type_refused 61A0h: filter type {0} is refused",
    (),
    [(3, Abort.INVALID_VALUE), (99, Abort.INVALID_VALUE), (101, Abort.TOO_HIGH), (255, Abort.TOO_HIGH)],
)(lambda value, code: (do.refuses("B", 0x61A0, 1, value, code), do.holds("B", 0x61A0, 1, 0)))
settings_404("filter_of_contact 61A0h: a contact channel has no filter: 06090011h")(
    lambda dut: dut.refuses("B", 0x61A0, gauges(dut) + 1, 1, Abort.NO_SUB),
    lambda dut: dut.refuses("H", 0x61A1, gauges(dut) + 1, 1, Abort.NO_SUB),
)


@settings_404("61A1h: a moving average takes {0} values: {1}", each=[
    (256, "taken", 0), (257, "06090031h", Abort.TOO_HIGH), (65535, "06090031h", Abort.TOO_HIGH),
])  # fmt: skip
def filter_window(dut: Dut, value: int, _shown: str, code: int) -> None:
    dut.put("B", 0x61A0, 1, 1)
    if code:
        dut.refuses("H", 0x61A1, 1, value, code)
    else:
        dut.put("H", 0x61A1, 1, value)
    dut.holds("H", 0x61A1, 1, 1 if code else value)


@settings_404("61A1h: filter type {0} takes the constant 65535", each=[(2,), (100,)])
def filter_longest(dut: Dut, kind: int) -> None:
    dut.put("H", 0x61A1, 1, 65535)
    dut.put("B", 0x61A0, 1, kind)
    dut.refuses("B", 0x61A0, 1, 1, Abort.INVALID_VALUE)  # no moving average of so many
    dut.holds("B", 0x61A0, 1, kind)


@settings_404("61A1h: a repeating average of {0} conversions of 1 ms is unknown until then", each=[(300,)])
def filter_block(dut: Dut, values: int) -> None:
    dut.put("I", 0x6114, 1, 1000)
    dut.put("H", 0x61A1, 1, values)
    dut.put("B", 0x61A0, 1, 2)
    settle(dut)
    if not math.isnan(dut.number("f", 0x6130, 1)):
        raise CheckError("6130h:1 unknown before the first average", str(dut.number("f", 0x6130, 1)))
    dut.sleep(values)
    check(not math.isnan(dut.number("f", 0x6130, 1)), "6130h:1 known after the first average", "NaN")


settings_404("autozero_signature 6125h: autozero with a wrong signature: 08000020h")(
    do.refuses("I", 0x6125, 1, 0x6F72657B, Abort.NOT_STORED)
)


@settings_404("6125h: autozero brings the gauge to zero by 6124h alone")
def autozero(dut: Dut) -> None:
    uncalibrated(dut)
    dut.put("f", 0x6124, 1, 100.0)
    settle(dut)
    others = [dut.number("f", index, 1) for index in range(0x6120, 0x6124)]
    dut.put("I", 0x6125, 1, table.SIGNATURE_ZERO)
    settle(dut)
    if abs(dut.number("f", 0x6130, 1)) > 10 or [dut.number("f", index, 1) for index in range(0x6120, 0x6124)] != others:
        raise CheckError("6130h:1 near 0, 6120h-6123h as before", str(dut.number("f", 0x6130, 1)))


@settings_404("6139h: autotare: only the sub-index of F1 exists, with a wrong signature 08000020h")
def autotare_signature(dut: Dut) -> None:
    n = gauges(dut)
    dut.holds("B", 0x6139, 0, n + 1)
    dut.refuses("I", 0x6139, n + 1, 0x61726175, Abort.NOT_STORED)
    dut.refuses("I", 0x6139, 1, table.SIGNATURE_TARA, Abort.NO_SUB)


settings_404("autotare_unknown 6139h: autotare without calibration: 08000022h")(
    uncalibrated, lambda dut: dut.refuses("I", 0x6139, gauges(dut) + 1, table.SIGNATURE_TARA, Abort.DEVICE_STATE)
)
