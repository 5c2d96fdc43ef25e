"""Methods to compute P and theta from counts: each prepared once, then timed as a function without arguments."""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from math import pi
from pathlib import Path

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.fingertip.active_calibration import Active
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.estimate import estimate as estimate_in_bulk
from tipforce_lab.report import micropython
from tipforce_lab.report.studies import estimator_fixed as fixed
from tipforce_lab.report.studies.estimator_inputs import LSB_MICROSTRAIN, Contacts
from tipforce_lab.report.study import Effort, Timing, quartiles

Estimate = tuple[FloatArray, FloatArray]
"""P in newtons and theta in degrees, (k,) each."""
Method = Callable[[], Estimate]

PULL = False


def bulk_float64(given: Contacts) -> Method:
    """``sensor.contact.estimate``."""

    def work() -> Estimate:
        _, contact = estimate_in_bulk(given.C, given.counts * (LSB_MICROSTRAIN * 1e-6), pull=PULL)
        return contact.P_newtons, np.degrees(contact.theta_rad)

    return work


def single_precision(given: Contacts, factored: bool) -> Method:
    """Return the bare formula in float32, without scaling and checks.

    factored: c^2 = (L - |F2|)(L + |F2|) + S^2, L and S the larger and smaller of |F1|, |F3|; else P^2 - F2^2.
    """
    real = np.float32
    C = given.C.T.astype(real)
    counts = given.counts.astype(real)
    lsb, turn, degree = real(LSB_MICROSTRAIN * 1e-6), real(2.0 * pi), real(180.0 / pi)

    def work() -> Estimate:
        F1, F2, F3 = np.moveaxis((counts * lsb) @ C, -1, 0)
        a1, a2, a3 = np.abs(F1), np.abs(F2), np.abs(F3)
        P = np.sqrt(F1 * F1 + F3 * F3)
        if factored:
            large, small = np.maximum(a1, a3), np.minimum(a1, a3)
            squared = (large - a2) * (large + a2) + small * small
        else:
            squared = P * P - F2 * F2
        theta = np.arctan2(F1, F3) - np.arctan2(F2, -np.sqrt(np.maximum(squared, real(0.0))))
        theta = theta - turn * np.rint(theta / turn)
        return P.astype(np.float64), (theta * degree).astype(np.float64)

    return work


def on_the_node(given: Contacts, form: str) -> Method:
    """Return the computation of a node under CPython per sample: REAL32 C, doubles, and the object in ``form``."""
    values = [*np.float32(given.C).ravel().tolist(), *[0.0] * 3, *[0.0] * 4, *[0.0] * 6]
    active = Active(b"", [*values, 0.015, -180.0, 180.0, 0.0, 0.0, 0.0, *[0.0] * 13], 3)
    gain, counts = LSB_MICROSTRAIN, given.counts.tolist()

    def work() -> Estimate:
        found = []
        for row in counts:
            F1, F2, F3 = active.force(active.C, [gain * c for c in row])
            P, _phi, theta, _miss = scalar.contact(F1, F2, F3, PULL)
            found.append((P, theta * scalar.DEGREES))
        P_column, theta_column = np.array(found).T
        return P_column, theta_column

    return {"inside": work, "REAL32": lambda: _as_real32(work()), "INTEGER16": lambda: _as_integer16(work())}[form]


def _as_real32(found: Estimate) -> Estimate:
    P, theta = found
    return P.astype(np.float32).astype(np.float64), theta.astype(np.float32).astype(np.float64)


def _as_integer16(found: Estimate) -> Estimate:
    P, theta = found
    return np.rint(P * 1000.0) / 1000.0, np.rint(theta * 100.0) / 100.0


def in_integers(given: Contacts, form: fixed.Format) -> Method:
    """``estimator_fixed``."""
    coefficients, unit = fixed.prepared(given.C, form)
    return lambda: fixed.estimate(coefficients, unit, given.counts, form)


_ON_MICROPYTHON = """
import struct, binascii, time
import scalar
def told(path):
    with open(path, 'rb') as f:
        return binascii.a2b_base64(f.read())
C = struct.unpack("<9f", told("/C"))
C = [list(C[k:k + 3]) for k in (0, 3, 6)]
counts = told("/counts")
counts = [struct.unpack("<3i", counts[k:k + 12]) for k in range(0, len(counts), 12)]
def work():
    contact, found, offsets = scalar.contact, [], [0.0, 0.0, 0.0]
    for row in counts:
        V = [s - o for s, o in zip([1e-6 * (LSB * c) for c in row], offsets)]
        F1, F2, F3 = [sum([c * v for c, v in zip(r, V)]) for r in C]
        found.append(contact(F1, F2, F3, False))
    return found
"""
_TIMED = """
started = time.ticks_ms()
for _ in range(REPEATS): work()
print("ms", time.ticks_diff(time.ticks_ms(), started))
"""
_SHOWN = 'print("out", binascii.hexlify(b"".join([struct.pack("<2d", f[0], f[2]) for f in work()])).decode())'


def on_micropython(given: Contacts, effort: Effort) -> tuple[Estimate, Timing]:
    """Return the node's scalar estimator on MicroPython, REAL32 C, doubles. Raises EnvironmentLackError without it."""
    counts = given.counts
    repeats = max(1, 2000 // len(counts))  # its clock has a resolution of 1 ms, and a sample takes about 30 us
    files = {
        "/scalar.py": Path(scalar.__file__).read_text(encoding="utf-8"),
        "/C": _base64(np.float32(given.C).astype("<f4").tobytes()),
        "/counts": _base64(counts.astype("<i4").tobytes()),
    }
    runs = effort.pick(3, 7)
    program = _ON_MICROPYTHON.replace("LSB", repr(LSB_MICROSTRAIN))
    lines = micropython.run(files, [program, "work()", *[_TIMED.replace("REPEATS", str(repeats))] * runs, _SHOWN])
    seconds = [float(line[3:]) * 1e-3 / (repeats * len(counts)) for line in lines if line.startswith("ms ")]
    (shown,) = [line[4:] for line in lines if line.startswith("out ")]
    raw = binascii.unhexlify(shown)
    P, theta_rad = np.array(struct.unpack(f"<{len(raw) // 8}d", raw)).reshape(-1, 2).T
    return (P, np.degrees(theta_rad)), quartiles(seconds)


def _base64(data: bytes) -> str:
    return binascii.b2a_base64(data, newline=False).decode()
