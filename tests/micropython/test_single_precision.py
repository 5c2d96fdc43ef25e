"""The node's arithmetic in single precision, as most microcontrollers have it, emulated in CPython.

The WebAssembly build of MicroPython has doubles. With numpy.float32 in place of each float every operation is rounded
to single precision, literals included; asin, atan2 and sqrt are rounded from double, which no real library beats."""

import random
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from canopen_device.core.node import Device
from micropython.footprint import ready_node
from micropython.recording import Talk
from tipforce.dictionary import table
from tipforce.fingertip.calibration import Active
from tipforce.fingertip.node import Fingertip
from tipforce.sensor.contact import scalar, scalar_uncertainty

single = np.float32
_FUNCTIONS, _CONSTANTS = ("asin", "atan2", "sqrt", "ldexp"), ("pi", "TWO_PI", "DEGREES")


@contextmanager
def single_functions() -> Iterator[None]:
    """What a node computes by these modules is in single precision on what is single."""
    names = (*_FUNCTIONS, *_CONSTANTS)
    modules = (scalar, scalar_uncertainty)
    kept = [(module, name, vars(module)[name]) for module in modules for name in names if name in vars(module)]

    def rounded(function: Any) -> Any:
        def call(*args: float) -> np.float32:
            return single(function(*[x if isinstance(x, int) else float(x) for x in args]))

        return call

    try:
        for module, name, value in kept:
            setattr(module, name, rounded(value) if name in _FUNCTIONS else single(value))
        with np.errstate(all="ignore"):
            yield
    finally:
        for module, name, value in kept:
            setattr(module, name, value)


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


def contact_pdos(
    loads: list[tuple[float, float, float]],
) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    """TPDO2 (P, phi, theta, status) of a node with doubles, and of one with single precision, for each load."""
    double_node, single_node = ready_node(), ready_node()
    fingertip = make_single(single_node.recorded.device)
    for load in loads:
        ours = _contact_pdo(double_node, load)
        with single_functions():
            theirs = _contact_pdo(single_node, load)
            numbers = (*fingertip.sample.force(), *fingertip.sample.contact(), *fingertip.sample.uncertainty())
        # What fell back to a double somewhere would prove nothing. With a saturated gauge nothing is computed.
        assert fingertip.sample.lost or all(isinstance(number, np.float32) for number in numbers if number), numbers
        yield ours, theirs


def _contact_pdo(talk: Talk, load: tuple[float, float, float]) -> tuple[int, ...]:
    talk.load(*load)
    (data,) = [data for can_id, data in talk.sync() if can_id == 0x285]
    return struct.unpack("<hhhBB", data)[:4]


def test_the_contact_pdo_differs_by_one_unit_at_most() -> None:
    """The units: 1 mN, 0.01 degree."""
    chance = random.Random(20250131)
    loads = [
        (10.0 ** chance.uniform(-1.5, 1.4), chance.uniform(-60.0, 60.0), chance.uniform(-60.0, 60.0))
        for _ in range(1000)
    ]
    changed = [(ours, theirs) for ours, theirs in contact_pdos(loads) if ours != theirs]
    assert len(changed) <= 20
    for (*ours, status), (*theirs, other_status) in changed:
        assert status == other_status
        assert all(abs(a - b) <= 1 for a, b in zip(ours, theirs, strict=True) if table.UNKNOWN_I16 not in (a, b))
