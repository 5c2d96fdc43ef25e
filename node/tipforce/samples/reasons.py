"""Why a value is unknown or doubtful, in words: the one table for everything that a person reads."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from tipforce.dictionary import table
from tipforce.sensor.contact import scalar

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


class Status(enum.IntFlag):
    """The status byte (2120h), and bits 12 to 15 of 2124h. Bit 8: no answer; bit 9: see ``first_order_holds``; bit 10:
    a gauge is left out; bit 11: the calibration states no force range."""

    CONTACT = scalar.CONTACT_PRESENT
    CALIBRATED = scalar.CALIBRATED
    SATURATED = scalar.SATURATED
    STALE = scalar.STALE
    THETA_UNRESOLVED = scalar.THETA_UNRESOLVED
    MISSES_TIP = scalar.MISSES_TIP
    OUTSIDE_PAD = scalar.OUTSIDE_PAD
    FAULT = scalar.FRONT_END_FAULT
    NO_ANSWER = 1 << 8
    BEYOND_FIRST_ORDER = 1 << 9
    LEFT_OUT = 1 << 10
    UNRANGED = 1 << 11
    CONTRADICTION = 1 << table.FAULT_CONTRADICTION
    BEYOND_CALIBRATED = 1 << table.FAULT_BEYOND_CALIBRATED
    TEMPERATURE = 1 << table.FAULT_TEMPERATURE
    OVERLOAD = 1 << table.FAULT_OVERLOAD


NO_ANSWER, BEYOND_FIRST_ORDER = int(Status.NO_ANSWER), int(Status.BEYOND_FIRST_ORDER)
LEFT_OUT, UNRANGED = int(Status.LEFT_OUT), int(Status.UNRANGED)
CONTRADICTION, BEYOND_CALIBRATED = int(Status.CONTRADICTION), int(Status.BEYOND_CALIBRATED)
TEMPERATURE, OVERLOAD = int(Status.TEMPERATURE), int(Status.OVERLOAD)
JUDGED = CONTRADICTION | BEYOND_CALIBRATED | TEMPERATURE | OVERLOAD
"""Bits 12 to 15 of 2124h."""
PRESENT, NO_RESPONSE, DOUBTFUL, MIXED, CHANGED = range(5)
"""Of a sample in a row of a hand: it is shown, or why there is none."""
OF_ROW = ("", "no response", "two values for one SYNC", "PDOs of two samples", "changed by another, not verified")
"""In words."""
NOT_CALIBRATED = "not calibrated"
UNKNOWN_TO_THE_NODE = "unknown to the node"

WORDS = {
    NO_ANSWER: OF_ROW[NO_RESPONSE],
    scalar.FRONT_END_FAULT: "front-end fault",
    scalar.STALE: "no new sample",
    scalar.SATURATED: "gauge saturated",
    scalar.MISSES_TIP: "line of action misses the tip",
    scalar.THETA_UNRESOLVED: "theta unresolved",
    scalar.OUTSIDE_PAD: "theta outside the pad",
    BEYOND_FIRST_ORDER: "uncertainty beyond first order",
    LEFT_OUT: "a gauge is left out",
    UNRANGED: "the calibration states no force range",
    CONTRADICTION: "gauges contradict each other",
    BEYOND_CALIBRATED: "beyond the calibrated force",
    TEMPERATURE: "temperature outside the calibration or unknown",
    OVERLOAD: "overload",
}
"""By bit, in the order in which they are said."""
COMPUTED = {
    "contact": scalar.CONTACT_PRESENT,
    "theta_unresolved": scalar.THETA_UNRESOLVED,
    "misses_tip": scalar.MISSES_TIP,
    "outside_pad": scalar.OUTSIDE_PAD,
    "beyond_first_order": BEYOND_FIRST_ORDER,
    "gauge_left_out": LEFT_OUT,
    "unranged": UNRANGED,
    "contradiction": CONTRADICTION,
    "beyond_calibrated": BEYOND_CALIBRATED,
    "temperature_outside": TEMPERATURE,
    "overload": OVERLOAD,
}
"""By the name of a flag that a calibration gives: its bit."""
BITS = {
    **{name: 1 << bit for bit, (name, _) in enumerate(table.STATUS_BITS)},
    **COMPUTED,
    **{f"fault_{name}": 1 << bit for bit, name, _ in table.FAULT_BITS if 1 << bit & JUDGED},
}
"""The same of every flag that a status has."""
BY_NAME = {
    **{name: WORDS.get(bit, name) for name, bit in BITS.items()},
    **{f"fault_{name}": WORDS.get(1 << bit & JUDGED, text) for bit, name, text in table.FAULT_BITS},
    "saturated": f"{WORDS[scalar.SATURATED]} or left out",
}
"""By the name of a flag, as decoders have it: of a node, or computed from the gauges by a calibration."""
FROZEN, TARE = 1 << 16, 1 << 17
"""Of rows of `tipforce estimate`, beside the bits of a status: a gauge stands still; an unloaded reading."""
_NO_ESTIMATE = {
    TARE: "tare",
    scalar.SATURATED: "saturated",
    FROZEN: "frozen",
    OVERLOAD: "overload",
    CONTRADICTION: "contradiction",  # where no gauge could be left out
}
NO_ESTIMATE = sum(_NO_ESTIMATE)
"""Bits that leave a row without a value."""
_OF_ESTIMATE = {bit: name for name, bit in COMPUTED.items()} | {
    scalar.CONTACT_PRESENT: "no_contact",  # said where the bit is clear
    TEMPERATURE: "temperature",
}
_INSTEAD = {scalar.FRONT_END_FAULT: CONTRADICTION, scalar.SATURATED: OVERLOAD}
"""The bit of 2124h that says more than one of the status byte."""
LARGEST_NEWTONS = 32.767
"""The end of INTEGER16: a force that reads it may be any larger one, which a node shows in 6150h alone."""
_OF_ANGLES = scalar.MISSES_TIP | scalar.THETA_UNRESOLVED | scalar.OUTSIDE_PAD | BEYOND_FIRST_ORDER


_CONTACT, _ANGLES, _THETA = ({"P", "phi", "theta", "F1", "F2", "F3"}, {"phi", "theta"}, {"theta"})
CAUSES: dict[str, tuple[str, bool, set[str] | None]] = {
    "contradiction": ("fault_contradiction", True, _CONTACT),
    "overload": ("fault_overload", True, _CONTACT),
    "fault": ("fault", True, None),
    "stale": ("stale", True, None),
    "uncalibrated": ("calibrated", False, _CONTACT),
    "saturated": ("saturated", True, _CONTACT),
    "no_contact": ("contact", False, _ANGLES),
    "theta_unresolved": ("theta_unresolved", True, _THETA),
    "misses_tip": ("misses_tip", True, _THETA),
}
"""Of an unknown value, to count: the flag, whether it is set then, the signals that it makes unknown (None: all)."""


def why_no_force(status: int) -> list[str]:
    """Why there is no force, the most specific reason first; empty where the status does not say."""
    bits = (bit for bit in (NO_ANSWER, scalar.FRONT_END_FAULT, scalar.STALE, scalar.SATURATED) if status & bit)
    words = [WORDS[status & _INSTEAD.get(bit, 0) or bit] for bit in bits]
    return words if status & (NO_ANSWER | scalar.CALIBRATED) else [*words, NOT_CALIBRATED]


def why_no_angle(status: int, theta: bool = True) -> str:
    """Why phi, or only theta, is unknown where the force is not; empty where the status does not say."""
    if not status & scalar.CONTACT_PRESENT:
        return "no contact"
    bits = (scalar.MISSES_TIP, scalar.THETA_UNRESOLVED) if theta else ()
    return next((WORDS[bit] for bit in bits if status & bit), "")


def doubts(status: int) -> list[str]:
    """What is to be known of a force that has a value; the words on angles only while there is contact."""
    if status & scalar.SATURATED and not status & OVERLOAD:
        status |= LEFT_OUT  # the other gauges give the force
    said = LEFT_OUT | UNRANGED | JUDGED
    if status & scalar.CONTACT_PRESENT:
        said |= _OF_ANGLES
    return [text for bit, text in WORDS.items() if status & said & bit]


def why(status: int, *, force_known: bool, angles_known: bool) -> str:
    """Why a value of a sample is unknown or doubtful; "" where P, phi and theta are known and nothing is flagged."""
    no_force = why_no_force(status & ~scalar.SATURATED if force_known else status)
    if no_force or not force_known:
        return ", ".join(no_force) or UNKNOWN_TO_THE_NODE
    words = doubts(status)
    if not status & scalar.CONTACT_PRESENT:
        words.insert(0, why_no_angle(status))
    elif not words and not angles_known:
        words.append(UNKNOWN_TO_THE_NODE)
    return ", ".join(words)


def flags(status: int) -> list[str]:
    """Every bit that is set and not as it should be, in words, whatever it hides."""
    bits = status & ~(scalar.SATURATED if status & LEFT_OUT else 0)
    return [text for bit, text in WORDS.items() if bits & bit]


def of_estimate(status: int) -> str:
    """The status of a row of `tipforce estimate` as its words."""
    for bit, word in _NO_ESTIMATE.items():
        if status & bit:
            return word
    shown = status ^ scalar.CONTACT_PRESENT
    return " ".join(word for bit, word in _OF_ESTIMATE.items() if shown & bit) or "ok"


def of_faults(faults: int) -> list[str]:
    """2124h in words."""
    gauges = [f"SG{k + 1} saturated or left out" for k in range(table.MAX_GAUGES) if faults >> k & 1]
    return gauges + [BY_NAME[f"fault_{name}"] for bit, name, _ in table.FAULT_BITS if faults >> bit & 1]


def not_seen(node_ids: Iterable[int]) -> str:
    """What a log without TPDO4 and EMCY of some nodes does not show."""
    shown = ", ".join(map(str, dict.fromkeys(node_ids)))  # a node may be on several buses
    return (
        f"node {shown}: neither TPDO4 nor EMCY, so gauges that contradict each other, overload, temperature and "
        "extrapolation could not be seen (2124h bits 12 to 15; TPDO4 is off by default)"
    )


def status_of(columns: Mapping[str, npt.NDArray[Any]], shape: tuple[int, ...]) -> npt.NDArray[np.uint16]:
    """Bits of ``Status`` from the columns of flags, sent or computed, and of forces; ``shape`` is that of each."""
    import numpy  # what only shows reasons loads none

    status = numpy.zeros(shape, dtype=numpy.uint16)
    for name, bit in BITS.items():
        if name in columns:
            status |= (columns[name] == 1).astype(numpy.uint16) * numpy.uint16(bit)
    for name in columns.keys() & {"P"} or columns.keys() & {"F1", "F2", "F3"}:
        status |= (abs(columns[name]) == LARGEST_NEWTONS).astype(numpy.uint16) * numpy.uint16(OVERLOAD)
    return status
