"""Analogue inputs of a fingertip (CiA 404): one value in three forms, unit, status, filters, zero and tare."""

import math

from canopen_conformance import steps as do
from canopen_conformance.case import Service, check, need
from canopen_conformance.dut import Dut
from canopen_conformance.wire import Abort
from tipforce.dictionary import table

# fmt: off
# A table: a case is its header, and below it its steps.

profile_404 = Service("profile_404", standard="CiA 404", own=True)
settings_404 = Service("settings_404", standard="CiA 404", own=True)

NEWEST_MS = 110  # a live value that is read is at most 100 ms old
SIMULATED = ((0x2200, 1), (0x2201, 1))
PARTS = ("gauge", "force", "magnitude", "direction", "contact angle")


def gauges(dut: Dut) -> int:
    """How many gauges the device has."""
    return dut.product_code & 0xF


def channel(dut: Dut, part: str) -> int:
    """A channel of this kind: its sub-index."""
    n = gauges(dut)
    return {"gauge": 1, "force": n + 1, "magnitude": n + 4, "direction": n + 5, "contact angle": n + 6}[part]


def uncalibrated(dut: Dut) -> None:
    """Cases about a device without calibration need one."""
    need(not dut.integer("I", 0x2103, 3), "the device is calibrated (`tipforce node --uncalibrated` is not)")


count, sub_of = do.late(gauges), do.late(channel)
F1, P = sub_of("force"), sub_of("magnitude")
settle = do.sleep(NEWEST_MS)  # after it the next read takes a new sample


for header, kind, index, values in (
    ("sensor_type 6110h: the sensor type", "H", 0x6110, (70, 10001, 10002, 10003, 10003)),
    ("unit 6131h: the unit", "I", 0x6131, (0xFA010100, 0x210000, 0x210000, 0x410000, 0x410000)),
    ("digits 6132h: the decimal digits", "B", 0x6132, (1, 3, 3, 2, 2)),
):
    for part, value in zip(PARTS, values, strict=True):
        profile_404(f"{header} of a {part}", (),
            do.holds(kind, index, sub_of(part), value))
for which, channels, indices in (
    ("all channels", sub_of("contact angle"), (0x6110, 0x6112, 0x6114, 0x6130, 0x6131, 0x6132, 0x6150, 0x7130, 0x9130)),
    ("the gauges", count(), (0x6100, 0x6120, 0x6124, 0x6125, 0x61A0, 0x7100, 0x9100)),
):
    for index in indices:
        profile_404(f"count {index:04X}h: sub-index 0 of {index:04X}h counts {which}", (),
            do.holds("B", index, 0, channels))
for index, kind in (
    (0x6100, "f"), (0x6110, "H"), (0x6130, "f"), (0x6131, "I"), (0x6132, "B"), (0x6150, "B"), (0x7100, "h"),
    (0x7130, "h"), (0x9100, "i"), (0x9130, "i"),
):
    profile_404(f"read_only {index:04X}h: {index:04X}h cannot be written", (),
        do.refuses(kind, index, 1, 0, Abort.READ_ONLY))
in_tenths = do.late(lambda dut: 10 * dut.number("f", 0x6130, 1))()
profile_404("live_forms 7130h: 7130h and 9130h are 6130h, to the resolution of 6132h", (),
    do.put("f", 0x6124, 1, 123.456),  # so that there is something to see without a load
    settle, do.near(0x7130, 1, in_tenths, 1, "h"), do.near(0x9130, 1, in_tenths, 1, "i"))
SETTINGS = (0x120, 0x121, 0x122, 0x123, 0x124, 0x133, 0x134, 0x135, 0x136, 0x148, 0x149)


@profile_404("6{0:03X}h: 6{0:03X}h, 7{0:03X}h and 9{0:03X}h are one value, written through {1}", each=[
    (offset, form) for offset in SETTINGS for form in ("REAL32", "INTEGER16", "INTEGER32")
])
def setting_forms(dut: Dut, offset: int, form: str) -> None:
    counts = offset in (0x120, 0x122)
    scale = 1 if counts else 10
    base, kind = {"REAL32": (0x6000, "f"), "INTEGER16": (0x7000, "h"), "INTEGER32": (0x9000, "i")}[form]
    dut.put(kind, base + offset, 1, 210.5 if kind == "f" and not counts else 210 if counts or kind == "f" else 2105)
    real = dut.number("f", 0x6000 + offset, 1)
    dut.holds("h", 0x7000 + offset, 1, round(real * scale))
    dut.holds("i", 0x9000 + offset, 1, round(real * scale))
    check(abs(real - (210 if counts else 210.5)) <= 1e-4, "210.5 (counts: 210)", str(real))


for microstrain, shown in ((1e6, 0x7FFF), (-1e6, -0x7FFF)):
    profile_404("setting_saturates 7124h: a value that INTEGER16 cannot hold reads as its end", (),
        do.put("f", 0x6124, 1, microstrain), do.holds("h", 0x7124, 1, shown),
        do.holds("i", 0x9124, 1, round(microstrain * 10)))
for number in (math.nan, math.inf, -math.inf):
    profile_404(f"not_finite 6130h: {number} is not finite: 06090030h", (),
        *(do.refuses("f", index, 1, number, Abort.INVALID_VALUE) for index in (0x6124, 0x6133, 0x6148)))


for part in PARTS[1:]:
    profile_404(f"unknown 6150h: without calibration a {part} is not valid, and unknown in every form", (),
        uncalibrated, settle, do.holds("B", 0x6150, sub_of(part), 1),
        do.holds("h", 0x7130, sub_of(part), table.UNKNOWN_I16), do.holds("i", 0x9130, sub_of(part), table.UNKNOWN_I32),
        do.known(0x6130, sub_of(part), False))
profile_404("gauge_valid 6150h: a gauge is valid without calibration", (),
    settle, do.holds("B", 0x6150, 1, 0))

# The default span is what INTEGER16 holds.
for microstrain, status, shown in ((5000.0, 3, 0x7FFF), (-5000.0, 5, -0x7FFF)):
    profile_404(f"overload 6150h: a gauge beyond INTEGER16: overload {status:02X}h, "
        "7130h at its end, 6130h and 9130h as they are", (),
        do.put("f", 0x6148, 1, -1e6), do.put("f", 0x6149, 1, 1e6), do.put("f", 0x6124, 1, microstrain), settle,
        do.holds("B", 0x6150, 1, status), do.holds("h", 0x7130, 1, shown), do.near(0x9130, 1, in_tenths, 100, "i"))


without_fault = do.undone_by(do.put("H", 0x2200, 1, 0))
for number, name, shown, status in (
    (3, "saturated", 0x7FFF, 3), (2, "open", table.UNKNOWN_I16, 1), (4, "silent", table.UNKNOWN_I16, 1),
):
    profile_404(f"fault 6150h: simulated fault {number}: gauge 1 {name}", SIMULATED,
        do.within(without_fault, settle, do.put("B", 0x2200, 2, 1), do.put("H", 0x2200, 1, number), settle,
            do.holds("h", 0x7130, 1, shown), do.holds("B", 0x6150, 1, status)))


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


for value, code in ((0, Abort.TOO_LOW), (2, Abort.TOO_HIGH)):
    settings_404(f"operating_mode 6112h: operating mode {value} is refused", (),
        do.refuses("B", 0x6112, 1, value, code))


settings_404("sample_period 6114h: the sample period of one channel is that of all", (),
    do.put("I", 0x6114, 2, 1000), *(do.holds("I", 0x6114, sub, 1000) for sub in (1, 3, sub_of("contact angle"))))
for value, code in ((0, Abort.TOO_LOW), (99, Abort.TOO_LOW), (1000001, Abort.TOO_HIGH)):
    settings_404(f"sample_period_range 6114h: a sample period of {value} microseconds is refused", (),
        do.refuses("I", 0x6114, 1, value, code))
for index, other in ((0x6120, 0x6122), (0x6122, 0x6120)):
    settings_404("scaling_points 6120h: two scaling points at one field value: 06090030h, the first stays", (),
        do.unchanged(((index, 1),), do.refuses("f", index, 1, do.late(Dut.number)("f", other, 1), Abort.INVALID_VALUE)))


scaled = do.late(lambda dut: 0.2 * dut.number("f", 0x6100, 1) + 10.0)  # with a gain of 0.2 instead of 0.1
settings_404("scaling 6130h: process value = scaled field value + offset", (),
    do.put("f", 0x6123, 1, 2000.0), do.put("f", 0x6124, 1, 10.0), settle,
    do.near(0x6130, 1, scaled(), 0.2 * 50))  # the noise between two readings
for value in (1, 2, 100):
    settings_404(f"filter_type 61A0h: filter type {value} is offered, and is that of all gauges", (),
        do.put("H", 0x61A1, count(), 8), do.put("B", 0x61A0, 1, value),
        *(step for sub in (1, count()) for step in (do.holds("B", 0x61A0, sub, value), do.holds("H", 0x61A1, sub, 8))),
        do.put("B", 0x61A0, 2, 0), do.holds("B", 0x61A0, 1, 0))
for value, code in ((3, Abort.INVALID_VALUE), (99, Abort.INVALID_VALUE), (101, Abort.TOO_HIGH), (255, Abort.TOO_HIGH)):
    settings_404(f"filter_type_refused 61A0h: filter type {value} is refused", (),
        do.refuses("B", 0x61A0, 1, value, code), do.holds("B", 0x61A0, 1, 0))
settings_404("filter_of_contact 61A0h: a contact channel has no filter: 06090011h", (),
    do.refuses("B", 0x61A0, F1, 1, Abort.NO_SUB), do.refuses("H", 0x61A1, F1, 1, Abort.NO_SUB))
settings_404("filter_window 61A1h: a moving average takes 256 values: taken", (),
    do.put("B", 0x61A0, 1, 1), do.put("H", 0x61A1, 1, 256), do.holds("H", 0x61A1, 1, 256))
for value in (257, 65535):
    settings_404(f"filter_window 61A1h: a moving average takes {value} values: 06090031h", (),
        do.put("B", 0x61A0, 1, 1), do.refuses("H", 0x61A1, 1, value, Abort.TOO_HIGH), do.holds("H", 0x61A1, 1, 1))
for longest in (2, 100):
    settings_404(f"filter_longest 61A1h: filter type {longest} takes the constant 65535", (),
        do.put("H", 0x61A1, 1, 65535), do.put("B", 0x61A0, 1, longest),
        do.refuses("B", 0x61A0, 1, 1, Abort.INVALID_VALUE), do.holds("B", 0x61A0, 1, longest))


settings_404("filter_block 61A1h: a repeating average of 300 conversions of 1 ms is unknown until then", (),
    do.put("I", 0x6114, 1, 1000), do.put("H", 0x61A1, 1, 300), do.put("B", 0x61A0, 1, 2), settle,
    do.known(0x6130, 1, False), do.sleep(300), do.known(0x6130, 1, True))
settings_404("autozero_signature 6125h: autozero with a wrong signature: 08000020h", (),
    do.refuses("I", 0x6125, 1, 0x6F72657B, Abort.NOT_STORED))
settings_404("autozero 6125h: autozero brings the gauge to zero by 6124h alone", (),
    uncalibrated, do.put("f", 0x6124, 1, 100.0), settle,
    do.unchanged([(index, 1) for index in range(0x6120, 0x6124)],
        do.put("I", 0x6125, 1, table.SIGNATURE_ZERO), settle, do.near(0x6130, 1, 0, 10)))
settings_404(
    "autotare_signature 6139h: autotare: only the sub-index of F1 exists, with a wrong signature 08000020h", (),
    do.holds("B", 0x6139, 0, F1), do.refuses("I", 0x6139, F1, 0x61726175, Abort.NOT_STORED),
    do.refuses("I", 0x6139, 1, table.SIGNATURE_TARA, Abort.NO_SUB))
settings_404("autotare_unknown 6139h: autotare without calibration: 08000022h", (),
    uncalibrated, do.refuses("I", 0x6139, F1, table.SIGNATURE_TARA, Abort.DEVICE_STATE),
    do.refuses("H", 0x2130, 0, table.COMMAND_TARE, Abort.DEVICE_STATE))
