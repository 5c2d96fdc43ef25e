"""The node's arithmetic in single precision, as most microcontrollers have it, emulated in CPython.

The WebAssembly build of MicroPython has doubles. With numpy.float32 in place of each float every operation is rounded
to single precision, literals included; asin, atan2 and sqrt are rounded from double, which no real library beats.
"""

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from canopen_device.core.node import Device
from micropython.footprint import ready_node
from micropython.recording import Talk
from tipforce.dictionary import table
from tipforce.fingertip.application import Fingertip
from tipforce.fingertip.calibration import Active
from tipforce.sensor.contact import scalar

single = np.float32
_FUNCTIONS = ("asin", "atan2", "sqrt", "ldexp")


@contextmanager
def single_functions() -> Iterator[None]:
    """``sensor.scalar`` computes in single precision on what is single."""
    kept = dict(vars(scalar))

    def rounded(function: Any) -> Any:
        def call(*args: float) -> np.float32:
            return single(function(*[x if isinstance(x, int) else float(x) for x in args]))

        return call

    try:
        for name in _FUNCTIONS:
            setattr(scalar, name, rounded(getattr(math, name)))
        for name in ("pi", "TWO_PI", "DEGREES"):
            setattr(scalar, name, single(kept[name]))
        with np.errstate(all="ignore"):
            yield
    finally:
        for name in (*_FUNCTIONS, "pi", "TWO_PI", "DEGREES"):
            setattr(scalar, name, kept[name])


def make_single(device: Device) -> Fingertip:
    """Bring what a calibrated node computes with to single precision."""
    fingertip = device.application
    assert isinstance(fingertip, Fingertip)
    active = fingertip.calibration.active
    assert active is not None
    packing = fingertip.calibration.packing
    values: list[Any] = [
        single(value) if letter == "f" else value
        for letter, value in zip(packing[1:], struct.unpack(packing, active.record), strict=True)
    ]
    fingertip.calibration.active = Active(active.record, values, fingertip.n)
    fingertip.channels.scaling = [(single(gain), single(bias)) for gain, bias in fingertip.channels.scaling]  # type: ignore[misc]
    return fingertip


@dataclass
class Difference:
    """How far TPDO2 of the two nodes is apart, in its own units: 1 mN, 0.01 degree, 0.01 degree."""

    samples: int
    changed: int  # samples in which anything at all differs
    P: int
    phi: int
    theta: int
    status: int  # samples with another status byte


def compare(loads: list[tuple[float, float, float]]) -> Difference:
    """Put the same loads on a node with doubles and on one with single precision."""
    double_node, single_node = ready_node(), ready_node()
    fingertip = make_single(single_node.recorded.device)
    found = Difference(len(loads), 0, 0, 0, 0, 0)
    for load in loads:
        ours = _contact_pdo(double_node, load)
        with single_functions():
            theirs = _contact_pdo(single_node, load)
            numbers = (*fingertip.sample.force(), *fingertip.sample.contact(), *fingertip.sample.uncertainty())
        # What fell back to a double somewhere would prove nothing. With a saturated gauge nothing is computed.
        assert fingertip.sample.lost or all(isinstance(number, np.float32) for number in numbers if number), numbers
        found.changed += ours != theirs
        found.status += ours[3] != theirs[3]
        apart = [abs(a - b) if table.UNKNOWN_I16 not in (a, b) else 0 for a, b in zip(ours, theirs, strict=True)]
        found.P, found.phi = max(found.P, apart[0]), max(found.phi, apart[1])
        found.theta = max(found.theta, apart[2])
    return found


def _contact_pdo(talk: Talk, load: tuple[float, float, float]) -> tuple[int, ...]:
    talk.load(*load)
    (data,) = [data for can_id, data in talk.sync() if can_id == 0x285]
    return struct.unpack("<hhhBB", data)[:4]
