"""The exported C against the Python estimator: samples, reference, and how far apart the two may be, derived.

A force of the C code differs from the exact one by at most e (``force_error``). What follows from that, with rounding
r of the arithmetic (2^-24 for float, 2^-53 for double, 2^-29 in fixed point), l the step of a force and a that of an
angle:

- P: sqrt(2) e + 4 r P + l. Both branches, hypot(F1, F3) and (hypot + abs(F2)) / 2, change by no more.
- phi: the direction of (F1, F3) turns by asin(sqrt(2) e / hypot) at most, + 4 r + a.
- theta: phi, and asin(x), x = F2 / hypot. dx = (1 + sqrt(2)) e / hypot + 8 r; asin over dx changes by
  dx / sqrt(1 - (abs(x) + dx)^2), and by 2 asin(sqrt(dx / 2)) at most, which is what holds at a tangential contact.
- standard uncertainties: their relative change is that of the slope of asin over one standard uncertainty of x (the
  step), which with 1 - x^2 = c2 is 8 dx / max(c2, step), and sqrt(dx / step) where c2 is no more than a few steps (the
  end of the chord moves like asin there); that of the direction, phi's bound times the square root of the condition of
  F's covariance; and what the arithmetic makes of them: 1e-3 for float, 5e-3 in fixed point. u(theta) is that of the
  difference of two angles, which may cancel: there the share is one of u(theta) + 2 u(phi).
"""

import ctypes
import math
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tipforce.sensor.contact import scalar, scalar_uncertainty
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix
from tipforce_tools.export import write_c_files

HOST_FLAGS = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-O2"]
SANITIZE = ["-fsanitize=undefined", "-fno-sanitize-recover=all"]
REALS: dict[str, Any] = {"float": ctypes.c_float, "double": ctypes.c_double}
FORCE_STEP, ANGLE_STEP = 2.0**-20, 2.0 * math.pi * 2.0**-32
ROUNDING = {"float": 2.0**-24, "double": 2.0**-53, "fixed": 2.0**-29}
STEP = {"float": (0.0, 0.0), "double": (0.0, 0.0), "fixed": (2 * FORCE_STEP, 4 * ANGLE_STEP)}
OF_UNCERTAINTY = {"float": 1e-3, "double": 1e-7, "fixed": 5e-3}
UNITS_LIMIT = 1 << 27
FULL_FORCE = 1024.0
CALIBRATED = scalar.CALIBRATED
RESULT = ("F1", "F2", "F3", "P", "phi", "theta", "miss", "u_P", "u_phi", "u_theta", "status", "unknown")
UNITS = [FORCE_STEP] * 4 + [ANGLE_STEP] * 2 + [FORCE_STEP] * 2 + [ANGLE_STEP] * 2 + [1.0] * 2  # of RESULT, fixed point
OPAQUE_BYTES = 1 << 13  # for any structure that is only handed on
LAYOUTS: dict[int, Any] = {3: "I", 4: ("L", "R", "T", "U"), 8: ("L", "R", "T", "U", "K_H", "S_H", "K_V", "S_V")}


def gcc(*words: object) -> None:
    """Compile with every warning an error."""
    if shutil.which("gcc") is None:
        pytest.skip("gcc is missing: apt-get install gcc")
    done = subprocess.run(["gcc", *HOST_FLAGS, *map(str, words), "-lm"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


class Library:
    """The C code of n gauges as a shared library. Its structures are numpy's: ``align`` lays them out as C does.

    ``changed``: (file, text, other) is replaced in the source. Undefined behaviour ends the process and says where."""

    def __init__(self, folder: Path, n: int, real: str, changed: tuple[str, str, str] | None = None) -> None:
        write_c_files(folder, n)
        if changed is not None:
            text = (folder / changed[0]).read_text()
            assert text.count(changed[1]) == 1, changed
            (folder / changed[0]).write_text(text.replace(changed[1], changed[2]))
        defined = [f"-DTIPFORCE_REAL={real}", *(["-DTIPFORCE_DOUBLE"] if real == "double" else [])]
        target = folder / f"{real}.so"
        gcc(*SANITIZE, *defined, "-shared", "-fPIC", f"-I{folder}", *folder.glob("*.c"), "-o", target)
        self._functions = ctypes.CDLL(str(target))
        self.n, self.real, self.dtype = n, REALS[real], np.dtype(REALS[real])
        r, names = self.dtype, RESULT[3:-2]
        limits = [(name, r) for name in ("on_N", "off_N", "theta_min_deg", "theta_max_deg")]
        self.calibration = np.dtype(
            [("C", r, (3, n)), ("offset", r, n), ("cov", r, 6), *limits, ("pull", "?")], align=True
        )
        self.result = np.dtype([("F", r, 3), *((name, r) for name in names), ("status", "u1")], align=True)
        fixed = [("F", "i4", 3), ("P", "i4"), ("miss", "i4"), ("phi", "i4"), ("theta", "i4"), ("u_P", "i4")]
        fixed += [("u_phi", "u4"), ("u_theta", "u4"), ("status", "u1"), ("unknown", "u1")]
        self.fixed_result = np.dtype(fixed, align=True)

    def __call__(self, name: str, *arguments: Any) -> int:
        """Call ``tipforce_NAME``: arrays are passed by their address, numpy's numbers as C's int."""
        words = [ctypes.c_void_p(x.ctypes.data) if isinstance(x, np.ndarray) else
                 int(x) if isinstance(x, np.generic) else x for x in arguments]  # fmt: skip
        return int(getattr(self._functions, f"tipforce_{name}")(*words))

    def run(self, block: "Block") -> tuple[np.ndarray, np.ndarray]:
        """RESULT by samples: (samples, 12) of the float variant, and of the fixed-point one; newtons and radians."""
        upper = block.noise[np.triu_indices(self.n)]
        calibration, fixed = np.zeros(1, self.calibration), np.zeros(OPAQUE_BYTES, "u1")
        calibration[["C", "offset", "on_N", "off_N", "theta_min_deg", "theta_max_deg", "pull"]] = [
            (block.C, block.offset, *block.limits, block.pull)
        ]
        self("float_covariance", calibration, upper.astype(self.dtype))
        numbers = (np.ascontiguousarray(block.C), block.offset, upper)
        limits = np.array(block.limits)
        assert self("fixed_setup", fixed, *numbers, ctypes.c_double(block.strain_per_unit), limits, block.pull) & 0xFF
        strain, tare = block.strain.astype(self.dtype), (block.tare * FORCE_STEP).astype(self.dtype)
        floats, ints = np.zeros(len(strain), self.result), np.zeros(len(strain), self.fixed_result)
        for k, known in enumerate(zip(block.early, block.was_present, strict=True)):
            self("float_estimate", calibration, strain[k], tare[k], *known, floats[k : k + 1])
            self("fixed_estimate", fixed, block.units[k], block.tare[k], *known, ints[k : k + 1])
            P, phi = (int(ints[name][k]) for name in ("P", "phi"))
            assert abs(self("fixed_millinewtons", P) - round(1000.0 * FORCE_STEP * P)) <= 1
            assert -18000 < self("fixed_centidegrees", phi) <= 18000
        unknown = [self("unknown", status) & 0xFF for status in floats["status"]]
        of_float = [*floats["F"].T, *(floats[name] for name in RESULT[3:-1]), unknown]
        of_fixed = [*ints["F"].T, *(ints[name] for name in RESULT[3:])]
        return np.column_stack(of_float).astype(float), np.column_stack(of_fixed) * UNITS


@dataclass
class Block:
    """One calibration and its samples."""

    C: np.ndarray  # (3, n)
    offset: np.ndarray
    noise: np.ndarray  # (n, n)
    strain_per_unit: float
    limits: tuple[float, float, float, float]
    pull: bool
    strain: np.ndarray  # (count, n)
    units: np.ndarray  # (count, n) int32
    tare: np.ndarray  # (count, 3) int32
    early: np.ndarray
    was_present: np.ndarray

    def __post_init__(self) -> None:
        cov = self.C @ self.noise @ self.C.T
        self.cov = tuple(float(x) for x in cov[np.triu_indices(3)])
        self.anisotropy = math.sqrt(float(np.linalg.cond(cov)))
        with np.errstate(invalid="ignore"):  # infinite strains
            exact = (self.strain - self.offset) @ self.C.T - self.tare * FORCE_STEP
            self.through = np.max((np.abs(self.strain) + np.abs(self.offset)) @ np.abs(self.C).T, axis=1).tolist()
        self.F: list[list[float]] = exact.tolist()
        self.largest_tare = np.max(np.abs(self.tare), axis=1).tolist()
        self.sum_units = np.sum(np.abs(self.units.astype(float)), axis=1).tolist()
        self.largest_units = np.max(np.abs(self.units.astype(float)), axis=1).tolist()
        self.largest_C = float(np.max(np.abs(self.C)))
        self.references: dict[int, dict[str, float]] = {}


def random_block(random: np.random.Generator, n: int, count: int) -> Block:
    """Loads of every size and direction: tangential, past the tip, none at all, far too large."""
    C = calibration_matrix(FABRICATED, LAYOUTS[n]) * random.uniform(0.3, 3.0)
    structure = strain_matrix(FABRICATED, LAYOUTS[n]) * (1.0 + 0.02 * random.standard_normal((n, 3)))
    C = np.linalg.pinv(structure) * random.uniform(0.5, 2.0) + 0.0 * C
    offset = random.uniform(-2e-4, 2e-4, n)
    deviations = 10.0 ** random.uniform(-7.5, -5.5, n)
    mixed = np.eye(n) + 0.2 * random.standard_normal((n, n))
    noise = (mixed * deviations) @ (mixed * deviations).T
    F = _forces(random, count)
    tare = np.where(random.random((count, 1)) < 0.5, 0, random.integers(-(1 << 18), 1 << 18, (count, 3)))
    strain = (F + tare * FORCE_STEP) @ np.linalg.pinv(C).T + offset
    strain_per_unit = float(random.choice([1e-7, 1.0 / 2560e6]))
    units = np.clip(np.rint(strain / strain_per_unit), -(2**31 - 1), 2**31 - 1)
    early = np.where(random.random(count) < 0.95, CALIBRATED, random.integers(0, 256, count) & 0x8E)
    on = float(random.uniform(0.01, 0.1))
    theta_min = float(random.uniform(-180.0, 90.0))
    limits = (on, on * float(random.uniform(0.3, 1.0)), theta_min, theta_min + float(random.uniform(10.0, 400.0)))
    return Block(
        C, offset, noise, strain_per_unit, limits, bool(random.integers(2)), units * strain_per_unit,
        units.astype("<i4"), tare.astype("<i4"), early, random.integers(0, 2, count),
    )  # fmt: skip


def _forces(random: np.random.Generator, count: int) -> np.ndarray:
    P = 10.0 ** random.uniform(-3.0, 1.6, count)
    phi, delta = random.uniform(-math.pi, math.pi, (2, count))
    kind = random.integers(0, 12, count)
    # Nearly tangential, by ever less, on both sides; and along the axes.
    delta = np.where(kind < 3, np.copysign(math.pi / 2, delta) + 10.0 ** random.uniform(-9.0, -1.0, count), delta)
    phi = np.where(kind == 3, np.rint(phi / (math.pi / 2)) * (math.pi / 2), phi)
    delta = np.where(kind == 3, np.rint(delta / (math.pi / 2)) * (math.pi / 2), delta)
    F = np.stack([P * np.sin(phi), P * np.sin(delta), P * np.cos(phi)], axis=1)
    F[kind == 4, 1] *= 10.0 ** random.uniform(0.0, 1.0, np.count_nonzero(kind == 4))  # past the tip
    F[(kind == 5) & (P < 0.01)] = 0.0
    F[(kind == 6) & (P < 0.01), ::2] = 0.0
    F[(kind == 7) & (P > 20.0)] *= 1e3  # beyond the range of the fixed-point variant
    return F


@dataclass
class Tally:
    """The largest deviations found: P in newtons up to 32.767 N, angles in degrees. ``ordinary``: P from 0.1 to 32.767
    N, 11 degrees from tangential or more; ``uncertainty``: relative, P over 0.1 N; ``status_at_a_limit``: how many
    differ, all of them with the quantity at its limit within the bound."""

    samples: int = 0
    P: float = 0.0
    ordinary_phi_deg: float = 0.0
    ordinary_theta_deg: float = 0.0
    uncertainty: float = 0.0
    status_at_a_limit: int = 0


def check(block: Block, found: np.ndarray, kind: str, tally: Tally) -> None:
    """Every sample is within its bound. Raises AssertionError that names the sample."""
    for k in range(len(block.strain)):
        _check_one(block, k, dict(zip(RESULT, found[k].tolist(), strict=True)), kind, tally)


def force_error(block: Block, k: int, kind: str) -> float:
    """The bound e of a force in newtons."""
    r = ROUNDING[kind]
    n = block.C.shape[1]
    through = block.through[k]
    if kind != "fixed":
        # Each number is rounded, each product, each sum.
        return float((n + 4) * r * (through + block.largest_tare[k] * FORCE_STEP))
    shift = min(40, 11 - math.frexp(block.largest_C * block.strain_per_unit)[1])
    return float(0.5 * FORCE_STEP + 2.0 ** -(20 + shift) * (0.5 * block.sum_units[k] + 1.0) + 1e-15 * through)


def _check_one(block: Block, k: int, got: dict[str, float], kind: str, tally: Tally) -> None:
    early, was = int(block.early[k]), bool(block.was_present[k])
    status = int(got["status"])
    tally.samples += 1
    if scalar.unknown(early) & scalar.UNKNOWN_FORCE:
        assert status == early, (kind, k)
        assert int(got["unknown"]) & scalar.UNKNOWN_FORCE
        return
    F = block.F[k]
    e = force_error(block, k, kind)
    if kind == "fixed":
        too_much = block.largest_units[k] > UNITS_LIMIT
        if too_much or max(map(abs, F)) >= FULL_FORCE - e:
            assert too_much or max(map(abs, F)) <= FULL_FORCE + e or status & scalar.SATURATED, (kind, k)
            assert not too_much or status == early | scalar.SATURATED, (kind, k)
            return
    reference = _reference(block, k, was)
    assert all(abs(got[name] - f) <= e for name, f in zip(("F1", "F2", "F3"), F, strict=True)), (kind, k, got, F, e)
    _check_numbers(F, e, got, reference, kind, k, tally)
    _check_status(block, F, e, got, reference, kind, k, tally, was)


def _reference(block: Block, k: int, was: bool) -> dict[str, float]:
    """What the Python estimator says, once for all variants."""
    if k in block.references:
        return block.references[k]
    f1, f2, f3 = block.F[k]
    cov: Any = block.cov
    P, phi, theta, miss = scalar.contact(f1, f2, f3, block.pull)
    u_P, u_phi, u_theta = scalar_uncertainty.uncertainty(f1, f2, f3, cov, block.pull)
    u_miss = scalar_uncertainty.miss_uncertainty(f1, f2, f3, cov) if miss > 0.0 else 0.0
    bits = scalar.status_bits(P, u_P, u_theta, miss, u_miss, theta, block.limits, was)
    found = block.references[k] = {
        "P": P, "phi": phi, "theta": theta, "miss": miss, "u_P": u_P, "u_phi": u_phi, "u_theta": u_theta,
        "u_miss": u_miss, "bits": float(bits), "anisotropy": block.anisotropy, "u_x": _u_x(f1, f2, f3, P, cov),
    }  # fmt: skip
    return found


def _u_x(f1: float, f2: float, f3: float, P: float, cov: Any) -> float:
    """The standard uncertainty of x = F2 / hypot(F1, F3), which lies within -1 and 1."""
    hypotenuse = math.hypot(f1, f3)
    if hypotenuse == 0.0:
        return 0.0
    x = max(-1.0, min(1.0, f2 / hypotenuse))
    g1, g3 = -x * f1 / hypotenuse, -x * f3 / hypotenuse
    k11, k12, k13, k22, k23, k33 = cov
    variance = g1 * g1 * k11 + k22 + g3 * g3 * k33 + 2.0 * (g1 * k12 + g3 * k23 + g1 * g3 * k13)
    return math.sqrt(max(0.0, variance)) / P


def _bounds(F: list[float], e: float, reference: dict[str, float], kind: str) -> dict[str, float]:
    r, (force_step, angle_step) = ROUNDING[kind], STEP[kind]
    hypotenuse, P = math.hypot(F[0], F[2]), reference["P"]
    found = {"P": 1.5 * e + 4 * r * P + force_step, "phi": math.inf, "theta": math.inf, "share": math.inf}
    if hypotenuse > 2.0 * e:
        found["phi"] = math.asin(min(1.0, 1.5 * e / hypotenuse)) + 8 * r + angle_step
        x = min(1.0, abs(F[1]) / hypotenuse)
        dx = 2.5 * e / (hypotenuse - 1.5 * e) + 8 * r
        turned = 2.0 * math.asin(math.sqrt(min(1.0, dx / 2.0)))
        if x + dx < 1.0:
            turned = min(turned, dx / math.sqrt(1.0 - (x + dx) ** 2))
        found["theta"] = found["phi"] + turned + angle_step
        step = reference["u_x"]
        turning = 4.0 * found["phi"] * reference["anisotropy"]
        c2 = max(0.0, 1.0 - x * x)
        sloping = 8.0 * dx / max(c2, step) if step > 0.0 else math.inf
        if step > 0.0 and c2 < 8.0 * (step + dx):
            sloping += math.sqrt(dx / step)
        found["share"] = OF_UNCERTAINTY[kind] + turning + sloping
    return found


def _check_numbers(
    F: list[float], e: float, got: dict[str, float], reference: dict[str, float], kind: str, k: int, tally: Tally
) -> None:
    bounds = _bounds(F, e, reference, kind)
    force_step, angle_step = STEP[kind]
    shown = (kind, k, F, got, reference, bounds)
    difference = abs(got["P"] - reference["P"])
    assert difference <= bounds["P"], shown
    if max(map(abs, F)) <= 32.767:
        tally.P = max(tally.P, difference)
    assert abs(got["miss"] - reference["miss"]) <= 2.5 * e + bounds["P"], shown
    if bounds["phi"] < 1.0:
        phi, theta = (_apart(got[name], reference[name]) for name in ("phi", "theta"))
        assert phi <= bounds["phi"], shown
        assert theta <= bounds["theta"], shown
        _note_angles(tally, F, reference, math.degrees(phi), math.degrees(theta))
    for name, step in (("u_P", force_step), ("u_phi", angle_step), ("u_theta", angle_step)):
        if bounds["share"] < 0.1 and reference[name] < 6.0:
            scale = reference[name] + (2.0 * reference["u_phi"] if name == "u_theta" else 0.0)
            difference = abs(got[name] - reference[name]) - 2 * step
            assert difference <= bounds["share"] * scale, (name, *shown)
            if reference["P"] > 0.1 and scale > 0.0:
                tally.uncertainty = max(tally.uncertainty, difference / scale)


def _note_angles(tally: Tally, F: list[float], reference: dict[str, float], phi: float, theta: float) -> None:
    if 0.1 < reference["P"] < 32.767 and abs(F[1]) < 0.98 * math.hypot(F[0], F[2]):
        tally.ordinary_phi_deg = max(tally.ordinary_phi_deg, phi)
        tally.ordinary_theta_deg = max(tally.ordinary_theta_deg, theta)


def _apart(a: float, b: float) -> float:
    return abs((a - b + math.pi) % (2.0 * math.pi) - math.pi)


def _check_status(
    block: Block, F: list[float], e: float, got: dict[str, float], reference: dict[str, float], kind: str, k: int,
    tally: Tally, was: bool,
) -> None:  # fmt: skip
    """The status is the same, but for a bit whose quantity is at its limit within the bound."""
    early, wrong = int(block.early[k]), int(got["status"]) ^ (int(block.early[k]) | int(reference["bits"]))
    if not wrong:
        return
    assert not wrong & early
    bounds = _bounds(F, e, reference, kind)
    on, off, theta_min, theta_max = block.limits
    allowed = 0
    near = bounds["P"] + 2 * FORCE_STEP * (kind == "fixed") + 1e-7 * on
    if abs(reference["P"] - (off if was else on)) <= near:
        allowed |= scalar.CONTACT_PRESENT
    share = min(bounds["share"], 1.0)
    resolved_deg = math.degrees(reference["u_theta"])
    if abs(reference["P"] - off) <= near or not abs(resolved_deg - scalar.THETA_RESOLVED_DEG) > share * resolved_deg:
        allowed |= scalar.THETA_UNRESOLVED
    edge = 3.0 * reference["u_miss"] + scalar.MISS_FLOOR * reference["P"]
    # u_miss turns with the direction of (F1, F3).
    turned = 0.01 + 10.0 * min(bounds["phi"], 1.0)
    if abs(reference["miss"] - edge) <= 2.5 * e + bounds["P"] + turned * edge:
        allowed |= scalar.MISSES_TIP
    slack = min(math.degrees(bounds["theta"]), 360.0) + 1e-4
    if any(abs((math.degrees(reference["theta"]) - limit + 180.0) % 360.0 - 180.0) <= slack + 1e-4
           for limit in (theta_min, theta_max)):  # fmt: skip
        allowed |= scalar.OUTSIDE_PAD
    if allowed & ~scalar.OUTSIDE_PAD:
        allowed |= scalar.OUTSIDE_PAD  # judged only where the others say that theta is known
    assert not wrong & ~allowed, (kind, k, F, got, reference, wrong, allowed)
    tally.status_at_a_limit += 1


def compare(libraries: Mapping[str, Library], samples: int, seed: int, per_block: int = 500) -> dict[str, Tally]:
    """Every variant over so many samples; the largest deviations."""
    random = np.random.default_rng(seed)
    tallies = {name: Tally() for name in (*libraries, "fixed")}
    for _ in range(max(1, samples // per_block)):
        block = random_block(random, next(iter(libraries.values())).n, per_block)
        for number, (real, library) in enumerate(libraries.items()):
            floating, fixed = library.run(block)
            check(block, floating, real, tallies[real])
            if number == 0:
                check(block, fixed, "fixed", tallies["fixed"])
    return tallies
