"""What a status says, in words: the one table for everything that a person reads.

A status has the bits of ``contacts.Status``: the status byte 2120h, three bits of the host, and bits 12 to 15 of 2124h.
"""

from __future__ import annotations

from collections.abc import Iterable

from tipforce.dictionary import table
from tipforce.sensor.contact import scalar

NO_ANSWER, BEYOND_FIRST_ORDER, LEFT_OUT, UNRANGED = 1 << 8, 1 << 9, 1 << 10, 1 << 11
"""Bits of the host: no response; see ``first_order_holds``; the force does without a gauge; 2112h:1 is not known."""
CONTRADICTION, BEYOND_CALIBRATED = 1 << table.FAULT_CONTRADICTION, 1 << table.FAULT_BEYOND_CALIBRATED
TEMPERATURE, OVERLOAD = 1 << table.FAULT_TEMPERATURE, 1 << table.FAULT_OVERLOAD
JUDGED = CONTRADICTION | BEYOND_CALIBRATED | TEMPERATURE | OVERLOAD
"""Bits 12 to 15 of 2124h."""
NOT_CALIBRATED = "not calibrated"
UNKNOWN_TO_THE_NODE = "unknown to the node"

WORDS = {
    NO_ANSWER: "no response",
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
BY_NAME = {
    "contact": "contact",
    "calibrated": "calibrated",
    "saturated": f"{WORDS[scalar.SATURATED]} or left out",
    "stale": WORDS[scalar.STALE],
    "theta_unresolved": WORDS[scalar.THETA_UNRESOLVED],
    "misses_tip": WORDS[scalar.MISSES_TIP],
    "outside_pad": WORDS[scalar.OUTSIDE_PAD],
    "fault": WORDS[scalar.FRONT_END_FAULT],
    "beyond_first_order": WORDS[BEYOND_FIRST_ORDER],
    "gauge_left_out": WORDS[LEFT_OUT],
    "unranged": WORDS[UNRANGED],
    "contradiction": WORDS[CONTRADICTION],
    "beyond_calibrated": WORDS[BEYOND_CALIBRATED],
    "temperature_outside": WORDS[TEMPERATURE],
    "overload": WORDS[OVERLOAD],
    **{f"fault_{name}": WORDS.get(1 << bit & JUDGED, text) for bit, name, text in table.FAULT_BITS},
}
"""By the name of a flag, as decoders have it: of a node, or computed from the gauges by a calibration."""
_INSTEAD = {scalar.FRONT_END_FAULT: CONTRADICTION, scalar.SATURATED: OVERLOAD}
"""The bit of 2124h that says more than one of the status byte."""
_OF_ANGLES = scalar.MISSES_TIP | scalar.THETA_UNRESOLVED | scalar.OUTSIDE_PAD | BEYOND_FIRST_ORDER


def why_no_force(status: int) -> list[str]:
    """Why there is no force, the most specific reason first; empty where the status does not say."""
    found = []
    for bit in (NO_ANSWER, scalar.FRONT_END_FAULT, scalar.STALE, scalar.SATURATED):
        if status & bit:
            more = _INSTEAD.get(bit, 0)
            found.append(WORDS[more if status & more else bit])
    if not status & (NO_ANSWER | scalar.CALIBRATED):
        found.append(NOT_CALIBRATED)
    return found


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


def flags(status: int) -> list[str]:
    """Every bit that is set and not as it should be, in words, whatever it hides."""
    bits = status & ~(scalar.SATURATED if status & LEFT_OUT else 0)
    return [text for bit, text in WORDS.items() if bits & bit]


def of_faults(faults: int) -> list[str]:
    """2124h in words."""
    found = [f"SG{k + 1} saturated or left out" for k in range(table.MAX_GAUGES) if faults >> k & 1]
    return found + [BY_NAME[f"fault_{name}"] for bit, name, _ in table.FAULT_BITS if faults >> bit & 1]


def not_seen(node_ids: Iterable[int]) -> str:
    """What a log without TPDO4 and EMCY of some nodes does not show."""
    shown = ", ".join(map(str, dict.fromkeys(node_ids)))  # a node may be on several buses
    return (
        f"node {shown}: neither TPDO4 nor EMCY, so gauges that contradict each other, overload, temperature and "
        "extrapolation could not be seen (2124h bits 12 to 15; TPDO4 is off by default)"
    )
