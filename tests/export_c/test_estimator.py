"""The exported C code, compiled and run: it agrees with the Python estimator within the derived bounds.

A test that needs a compiler is skipped, and says so, when there is none; `make test` installs one."""

from __future__ import annotations

import ctypes
import math
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from canopen_device import types
from export_c import estimators
from export_c.estimators import CALIBRATED, FORCE_STEP, SANITIZE, Block, Library, gcc
from tipforce.dictionary import table
from tipforce.dictionary.names import objects
from tipforce.sensor.contact import scalar
from tipforce_tools.export import c_files, row_words

SAMPLES = 10_000
DOCUMENT = Path(__file__).parents[2] / "docs/firmware.md"
Libraries = Callable[[int, str], Library]
Both = Callable[[Block], list[dict[str, float]]]
UNKNOWN = scalar.UNKNOWN_FORCE | scalar.UNKNOWN_PHI | scalar.UNKNOWN_THETA


def test_agrees_with_python(library: Libraries) -> None:
    tallies = estimators.compare({"float": library(3, "float")}, SAMPLES, seed=1)
    tallies["double"] = estimators.compare({"double": library(3, "double")}, SAMPLES // 10, seed=2)["double"]
    assert [tally.samples for tally in tallies.values()] == [SAMPLES, SAMPLES, SAMPLES // 10]
    for name, tally in tallies.items():
        assert tally.status_at_a_limit < SAMPLES // 500, (name, tally)
        # What the documents promise of an ordinary contact.
        assert tally.P < 1e-3, (name, tally)
        assert max(tally.ordinary_phi_deg, tally.ordinary_theta_deg) < 0.01, (name, tally)


@pytest.mark.parametrize("n", [4, 8])
def test_more_gauges(n: int, library: Libraries) -> None:
    estimators.compare({"float": library(n, "float")}, 1000, seed=n)


@pytest.mark.parametrize(
    ("file", "text", "other"),
    [
        ("tipforce_fixed.c", "phi - normal", "phi - normal + 4096u"),  # 3.4e-4 degree
        ("tipforce_fixed.c", "P += miss / 2;", "P += miss;"),
        ("tipforce_fixed.c", "RESOLVED (UINT32_MAX / 12u)", "RESOLVED (UINT32_MAX / 11u)"),
        ("tipforce_fixed.c", "outward * outward) / 2", "outward * outward) / 3"),
        ("tipforce_float.c", "pull ? s->cosine : -s->cosine", "pull ? -s->cosine : s->cosine"),
        ("tipforce_float.c", "3.0)", "2.9)"),
    ],
)
def test_a_mistake_is_found(file: str, text: str, other: str, tmp_path: Path) -> None:
    library = Library(tmp_path, 3, "float", (file, text, other))
    with pytest.raises(AssertionError):
        estimators.compare({"float": library}, 10_000, seed=1)


def one(units: list[int], strain: list[float] | None = None, early: int = CALIBRATED, scale: float = 1.0) -> Block:
    """Three gauges that are F1, F2, F3 in micronewtons times ``scale``; push; contact from 0.05 N."""
    strain_per_unit = 1e-7
    return Block(
        np.eye(3) * scale * 10.0, np.zeros(3), np.eye(3) * 1e-16, strain_per_unit, (0.05, 0.03, -80.0, 80.0), False,
        np.array([strain if strain is not None else [u * strain_per_unit for u in units]]),
        np.array([units], "<i4"), np.zeros((1, 3), "<i4"), np.array([early]), np.array([0]),
    )  # fmt: skip


@pytest.fixture
def both(library: Libraries) -> Callable[[Block], list[dict[str, float]]]:
    """What the float variant and the fixed-point one make of a sample."""
    return lambda block: [
        dict(zip(estimators.RESULT, found[0].tolist(), strict=True)) for found in library(3, "float").run(block)
    ]


def test_no_load_at_all(both: Both) -> None:
    floating, fixed = both(one([0, 0, 0]))
    for found in (floating, fixed):
        assert found["P"] == 0.0
        assert int(found["unknown"]) & (scalar.UNKNOWN_PHI | scalar.UNKNOWN_THETA) == 6
        assert int(found["status"]) == CALIBRATED | scalar.THETA_UNRESOLVED
        assert abs(found["u_P"] - 1e-7) < 2 * FORCE_STEP
    assert math.isnan(floating["phi"])
    assert math.isnan(floating["theta"])


def test_exactly_tangential_and_straight(both: Both) -> None:
    for units, phi, theta in (([0, 1000000, 1000000], 0.0, -90.0), ([0, 0, 1000000], 0.0, 180.0),
                              ([1000000, 0, 0], 90.0, -90.0), ([0, 0, -1000000], 180.0, 0.0)):  # fmt: skip
        for found in both(one(units)):
            assert math.degrees(estimators._apart(found["phi"], math.radians(phi))) < 1e-4
            assert math.degrees(estimators._apart(found["theta"], math.radians(theta))) < 1e-4
            assert abs(found["P"] - 1.0) < 1e-6


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_number(both: Both, value: float) -> None:
    floating, _fixed = both(one([1, 2, 3], [value, 1e-6, 1e-6]))
    assert all(math.isnan(floating[name]) for name in ("P", "phi", "theta", "u_P", "u_phi", "u_theta"))
    assert not int(floating["status"]) & scalar.CONTACT_PRESENT


def test_float_at_the_ends_of_its_range(both: Both) -> None:
    """Squares of forces would over- or underflow: they are scaled first."""
    for size in (1e-28, 1e-20, 1e20, 1e35):
        floating, _fixed = both(one([0, 0, 0], [3e-7 * size, 1e-7 * size, 4e-7 * size]))
        assert abs(floating["P"] / (5e-6 * size) - 1.0) < 1e-6
        assert abs(floating["phi"] - math.atan2(3, 4)) < 1e-6


@pytest.mark.parametrize("units", [2**31 - 1, -(2**31) + 1, (1 << 27) + 1])
def test_fixed_point_beyond_its_range_is_saturated(both: Both, units: int) -> None:
    _floating, fixed = both(one([units, 0, 0], [0.0, 0.0, 0.0]))
    assert int(fixed["status"]) == CALIBRATED | scalar.SATURATED
    assert int(fixed["unknown"]) & UNKNOWN == UNKNOWN
    _floating, fixed = both(one([0, 1_000_000, 0], scale=1100.0))  # 1100 N
    assert int(fixed["status"]) == CALIBRATED | scalar.SATURATED


def test_fixed_point_refuses_noise_that_is_not_finite(library: Libraries) -> None:
    fixed = np.zeros(estimators.OPAQUE_BYTES, "u1")
    rest = ctypes.c_double(1e-7), np.array([0.05, 0.03, -80.0, 80.0]), 0
    for value in (math.nan, math.inf, -math.inf, 1e-15):
        numbers = np.eye(3) * 1e4, np.zeros(3), np.array([1e-14, value, 0.0, 1e-14, 0.0, 1e-14])
        assert library(3, "float")("fixed_setup", fixed, *numbers, *rest) & 0xFF == (value == 1e-15)


@pytest.mark.parametrize("early", [0, scalar.SATURATED | CALIBRATED, scalar.STALE | CALIBRATED, 0x80 | CALIBRATED])
def test_what_the_caller_knows_hides_the_force(both: Both, early: int) -> None:
    floating, fixed = both(one([300000, 100000, 400000], early=early))
    for found in (floating, fixed):
        assert int(found["status"]) == early
        assert int(found["unknown"]) & UNKNOWN == UNKNOWN
    assert math.isnan(floating["P"])
    assert fixed["P"] == 0.0


DUMP = """
#include <stdio.h>
#include "tipforce_od.h"
int main(void)
{
    for (unsigned k = 0; k < TIPFORCE_OD_COUNT; k++) {
        const tipforce_od_entry *e = tipforce_od_find(tipforce_od[k].index, tipforce_od[k].sub);
        printf("%u %u %u %u %u %lu %lu %lu %s\\n", e->index, e->sub, e->type, e->access, e->flags,
               (unsigned long)e->value, (unsigned long)e->low, (unsigned long)e->high, e->text ? e->text : "");
    }
    return tipforce_od_find(0x1000, 1) || tipforce_od_find(0xFFFF, 0) || tipforce_od_find(0, 0) ||
           TIPFORCE_OD_STATUS_2120 != 0x2120;
}
"""


@pytest.mark.parametrize(("n", "converter"), [(3, table.CONVERTER_16), (8, table.CONVERTER_24)])
def test_the_dictionary_is_the_table(n: int, converter: table.Converter, tmp_path: Path) -> None:
    for name, text in c_files(n, converter).items():
        (tmp_path / name).write_text(text)
    (tmp_path / "dump.c").write_text(DUMP)
    gcc(*SANITIZE, tmp_path / "dump.c", tmp_path / "tipforce_od.c", "-o", tmp_path / "dump")
    lines = subprocess.run([tmp_path / "dump"], capture_output=True, text=True, check=True).stdout.splitlines()
    rows = [row for each in objects(n, False, converter) for row in each.entries]
    assert len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        words = line.split(" ", 8)
        assert [int(word) for word in words[:3]] == [row.index, row.sub, types.data_type(row.type).code]
        assert [int(word) for word in words[4:8]] == list(row_words(row))
        limits = (64 if row.low is not None else 0) | (128 if row.high is not None else 0)
        assert row.type == "s" or int(words[4]) & 192 == limits, row.name
        if row.type == "s":
            assert words[8] == row.default
        elif row.type == "f":
            assert struct.unpack("<f", struct.pack("<I", int(words[5])))[0] == pytest.approx(row.default, rel=1e-6)


def test_the_example_of_the_documents_compiles(tmp_path: Path) -> None:
    (block,) = DOCUMENT.read_text(encoding="utf-8").split("```c\n")[1:]
    for name, text in c_files(3).items():
        (tmp_path / name).write_text(text)
    (tmp_path / "example.c").write_text(block.split("```")[0] + "int main(void) { return 0; }\n")
    gcc(*tmp_path.glob("*.c"), "-o", tmp_path / "example")
    with pytest.raises(AssertionError, match="tipforce_both_or_none"):  # without -DTIPFORCE_DOUBLE
        gcc("-DTIPFORCE_REAL=double", "-c", tmp_path / "tipforce_float.c", "-o", tmp_path / "float.o")
