"""Methods to compute P and theta from counts, each prepared once, then timed. Integers are int64 arrays for registers,
a narrower sum wraps, angles are binary, 2^32 per turn. MicroPython is its WebAssembly build under Node.js."""

import binascii
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from math import pi
from pathlib import Path

import numpy as np

from tipforce.arrays import FloatArray, IntArray
from tipforce.errors import EnvironmentLackError
from tipforce.fingertip.calibration import Active
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.estimate import contacts, force_from_strain
from tipforce_lab.report.study import Effort, Timing, quartiles

COUNT_BITS = 24
RANGE_MICROSTRAIN = 1024.0
LSB_MICROSTRAIN = RANGE_MICROSTRAIN / 2 ** (COUNT_BITS - 1)  # 2^-13: a count is an exact binary fraction


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """Counts of the converter and their exact result, rounded once to a float64 and a remainder."""

    C: FloatArray
    """(3, 3), newtons per unit strain: these floats are taken as exact."""
    counts: IntArray
    """(k, 3)."""
    P_newtons: list[Decimal]
    theta_deg: list[Decimal]
    full_scale_newtons: float
    """The smallest load that uses the converter's full range."""


MODULE = Path(sys.prefix) / "micropython/node_modules/@micropython/micropython-webassembly-pyscript/micropython.mjs"
HEAP_BYTES = 64 << 20  # this build collects garbage only between runs
TIMEOUT_S = 120
_LAST_CHARACTERS = 200
_LAUNCHER = """
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";
const job = JSON.parse(readFileSync(0, "utf8"));
const { loadMicroPython } = await import(pathToFileURL(job.module).href);
const lines = [];
const stdout = (line) => lines.push(line);
const python = await loadMicroPython({ heapsize: job.heap, pystack: 16384, stdout, linebuffer: true });
for (const [path, text] of Object.entries(job.files)) python.FS.writeFile(path, text);
try {
    for (const call of job.calls) python.runPython(call);
} catch (error) {
    process.stderr.write(`${error.message}\\n`);
    process.exitCode = 1;
}
process.stdout.write(lines.map((line) => line + "\\n").join(""));
"""


def run_micropython(files: Mapping[str, str], calls: Sequence[str]) -> list[str]:
    """Run ``calls`` with ``files``; return the lines printed. Raises EnvironmentLackError if they cannot run."""
    node = shutil.which("node")
    if node is None:
        raise EnvironmentLackError("Node.js, which runs MicroPython here, is not installed (apt: nodejs)")
    if not MODULE.exists():
        raise EnvironmentLackError("MicroPython is not installed in this environment: run tools/bootstrap.sh test")
    job = {"files": dict(files), "calls": list(calls), "heap": HEAP_BYTES, "module": str(MODULE)}
    command = [node, "--input-type=module", "-e", _LAUNCHER]
    try:
        done = subprocess.run(
            command, input=json.dumps(job), capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise EnvironmentLackError(f"MicroPython did not finish within {TIMEOUT_S} s") from None
    if done.returncode:
        raise EnvironmentLackError(f"MicroPython failed: {done.stderr.strip()[-_LAST_CHARACTERS:]}")
    return done.stdout.splitlines()


Estimate = tuple[FloatArray, FloatArray]
"""P in newtons and theta in degrees, (k,) each."""
Method = Callable[[], Estimate]
Arctangent = Callable[[IntArray, IntArray], IntArray]

TURN = 1 << 32
_RATIO_BITS = 30


def in_integers(C_bits: int, reading_bits: int, sum_bits: int, arctangent: Arctangent, given: Contacts) -> Method:
    """Return the computation in integers of these widths; the largest coefficient of C fills its own."""
    per_count = given.C * (LSB_MICROSTRAIN * 1e-6 * 2.0 ** (COUNT_BITS - reading_bits))
    unit_newtons = float(np.abs(per_count).max()) / ((1 << C_bits - 1) - 1)
    coefficients = np.rint(per_count / unit_newtons).astype(np.int64).T
    # Sums of three products, cut to 30 bits: then the sum of two squares stays in 63.
    shift = max(0, C_bits + reading_bits - 30)

    def work() -> Estimate:
        sums = _shifted(given.counts, COUNT_BITS - reading_bits) @ coefficients
        if sum_bits == 32:
            sums = sums.astype(np.int32).astype(np.int64)  # wraps, as the register does
        F1, F2, F3 = np.moveaxis(_shifted(sums, shift), -1, 0)
        a1, a2, a3 = np.abs(F1), np.abs(F2), np.abs(F3)
        large, small = np.maximum(a1, a3), np.minimum(a1, a3)
        hypotenuse = square_root(large * large + small * small)
        cosine_squared = (large - a2) * (large + a2) + small * small
        P = np.where(cosine_squared >= 0, hypotenuse, (hypotenuse + a2) >> 1)
        theta = arctangent(F1, F3) - arctangent(F2, -square_root(np.maximum(cosine_squared, 0)))
        theta = (theta + TURN // 2) % TURN - TURN // 2
        return P.astype(np.float64) * (unit_newtons * 2.0**shift), theta.astype(np.float64) * (360.0 / TURN)

    return work


def square_root(value: IntArray) -> IntArray:
    """Return the integer square root of (k,) numbers from 0 to 2^62, rounded down."""
    root: IntArray = np.sqrt(value.astype(np.float64)).astype(np.int64)
    root -= root * root > value
    root += (root + 1) * (root + 1) <= value
    return root


def cordic(iterations: int) -> Arctangent:
    """Compute atan2 by shifts and additions only: each iteration rotates by atan(2^-k) towards the x-axis."""
    angles = [round(np.arctan(2.0**-k) * TURN / (2.0 * np.pi)) for k in range(iterations)]

    def arctangent(y: IntArray, x: IntArray) -> IntArray:
        x, y = _normalised(x, y)
        angle = np.where(x < 0, TURN // 2, 0)
        x, y = np.abs(x), np.where(x < 0, -y, y)
        for k, step in enumerate(angles):
            down = y > 0
            turn = np.where(down, 1, -1)
            x, y = x + turn * (y >> k), y - turn * (x >> k)
            angle = angle + turn * step
        return angle

    return arctangent


def table(size: int) -> Arctangent:
    """Compute atan2 from a table of size + 1 angles over one octant, with linear interpolation."""
    entries = np.rint(np.arctan(np.arange(size + 1) / size) * TURN / (2.0 * np.pi)).astype(np.int64)
    step_bits = _RATIO_BITS - (size.bit_length() - 1)  # size is a power of two

    def arctangent(y: IntArray, x: IntArray) -> IntArray:
        x, y = _normalised(x, y)
        ax, ay = np.abs(x), np.abs(y)
        large, small = np.maximum(ax, ay), np.minimum(ax, ay)
        ratio = (small << _RATIO_BITS) // np.maximum(large, 1)
        entry = np.minimum(ratio >> step_bits, size - 1)
        past = ratio - (entry << step_bits)
        angle = entries[entry] + ((entries[entry + 1] - entries[entry]) * past >> step_bits)
        angle = np.where(ay > ax, TURN // 4 - angle, angle)
        angle = np.where(x < 0, TURN // 2 - angle, angle)
        signed: IntArray = np.where(y < 0, -angle, angle)
        return signed

    return arctangent


def _normalised(x: IntArray, y: IntArray) -> tuple[IntArray, IntArray]:
    """Shift both left until the larger fills 29 bits: CORDIC lengthens its vector by 1.65, and a register has 32."""
    exponent = np.frexp(np.maximum(np.abs(x), np.abs(y)).astype(np.float64))[1]
    shift = np.maximum(0, 29 - exponent)
    return x << shift, y << shift


def _shifted(value: IntArray, bits: int) -> IntArray:
    return (value + (1 << bits - 1)) >> bits if bits else value


def bulk_float64(given: Contacts) -> Method:
    """``sensor.contact.estimate``."""

    def work() -> Estimate:
        contact = contacts(force_from_strain(given.C, given.counts * (LSB_MICROSTRAIN * 1e-6)), pull=False)
        return contact.P_newtons, np.degrees(contact.theta_rad)

    return work


def single_precision(factored: bool, given: Contacts) -> Method:
    """Return the bare formula in float32. factored: c^2 = (L - |F2|)(L + |F2|) + S^2; else P^2 - F2^2."""
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


def on_the_node(form: str, given: Contacts) -> Method:
    """Return the computation of a node under CPython per sample: REAL32 C, doubles, and the object in ``form``."""
    values = [*np.float32(given.C).ravel().tolist(), *[0.0] * 3, *[0.0] * 4, *[0.0] * 6]
    active = Active(b"", [*values, 0.015, -180.0, 180.0, 0.0, 0.0, 0.0, *[0.0] * 13], 3)
    gain, counts = LSB_MICROSTRAIN, given.counts.tolist()

    def work() -> Estimate:
        rows = []
        for row in counts:
            F1, F2, F3 = active.force(active.C, [gain * c for c in row])
            P, _phi, theta, _miss = scalar.contact(F1, F2, F3, False)
            rows.append((P, theta * scalar.DEGREES))
        columns = np.array(rows)
        if form == "REAL32":
            columns = columns.astype(np.float32).astype(np.float64)
        if form == "INTEGER16":
            columns = np.rint(columns * (1000.0, 100.0)) / (1000.0, 100.0)
        return columns[:, 0], columns[:, 1]

    return work


_ON_MICROPYTHON = """
import struct, binascii, time
import scalar
def stored(path):
    with open(path, 'rb') as f:
        return binascii.a2b_base64(f.read())
C = struct.unpack("<9f", stored("/C"))
C = [list(C[k:k + 3]) for k in (0, 3, 6)]
counts = stored("/counts")
counts = [struct.unpack("<3i", counts[k:k + 12]) for k in range(0, len(counts), 12)]
def work():
    contact, rows, offsets = scalar.contact, [], [0.0, 0.0, 0.0]
    for row in counts:
        V = [s - o for s, o in zip([1e-6 * (LSB * c) for c in row], offsets)]
        F1, F2, F3 = [sum([c * v for c, v in zip(r, V)]) for r in C]
        rows.append(contact(F1, F2, F3, False))
    return rows
"""
_TIMED = """
started = time.ticks_ms()
for _ in range(REPEATS): work()
print("ms", time.ticks_diff(time.ticks_ms(), started))
"""
_SHOWN = 'print("out", binascii.hexlify(b"".join([struct.pack("<2d", f[0], f[2]) for f in work()])).decode())'


def on_micropython(given: Contacts, effort: Effort) -> tuple[Estimate, Timing]:
    """Return the node's scalar estimator on MicroPython, REAL32 C, doubles. Raises EnvironmentLackError without it."""
    counts, runs = given.counts, effort.pick(3, 7)
    repeats = max(1, 2000 // len(counts))  # its clock has a resolution of 1 ms, and a sample takes about 30 us
    files = {
        "/scalar.py": Path(scalar.__file__).read_text(encoding="utf-8"),
        "/C": binascii.b2a_base64(np.float32(given.C).astype("<f4").tobytes()).decode(),
        "/counts": binascii.b2a_base64(counts.astype("<i4").tobytes()).decode(),
    }
    program = _ON_MICROPYTHON.replace("LSB", repr(LSB_MICROSTRAIN))
    lines = run_micropython(files, [program, "work()", *[_TIMED.replace("REPEATS", str(repeats))] * runs, _SHOWN])
    seconds = [float(line[3:]) * 1e-3 / (repeats * len(counts)) for line in lines if line.startswith("ms ")]
    (shown,) = [line[4:] for line in lines if line.startswith("out ")]
    P, theta_rad = np.frombuffer(binascii.unhexlify(shown), "<f8").reshape(-1, 2).T
    return (P, np.degrees(theta_rad)), quartiles(seconds)
