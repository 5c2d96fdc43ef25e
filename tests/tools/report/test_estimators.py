"""The study of the estimator's arithmetic: its reference, its integers, and what theory says of the errors."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest

from tipforce.errors import EnvironmentLackError
from tipforce.sensor.contact import scalar
from tipforce_lab.report.studies import estimator_methods as methods
from tipforce_lab.report.studies import estimators
from tipforce_lab.report.study import Study
from tools.report.made import Tiny, at_once


@pytest.fixture(scope="module")
def found() -> dict[str, Study]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimators, "timed", at_once)
        steps: list[None] = []
        studies = {one.key: one for one in estimators.studies(Tiny(), lambda: steps.append(None))}
    assert len(steps) == estimators.STEPS
    return studies


def worst(study: Study) -> dict[tuple[str, str], float]:
    return {(one.method, point.setting): point.error for one in study.series for point in one.points}


def test_arctan2_of_the_reference() -> None:
    rng = np.random.default_rng(3)
    with localcontext() as context:
        context.prec = estimators.DIGITS
        for y, x in [*rng.normal(size=(200, 2)).tolist(), [0.0, 1.0], [1.0, 0.0], [-1.0, 0.0], [1.0, -1.0]]:
            assert float(estimators.arctan2(Decimal(y), Decimal(x))) == pytest.approx(math.atan2(y, x), rel=4e-16)


def test_the_reference_agrees_with_more_digits_to_its_stated_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def answers() -> methods.Contacts:
        return estimators.contacts(np.random.default_rng(5), 20, sliding=True)

    usual = answers()
    monkeypatch.setattr(estimators, "DIGITS", 90)
    finer = answers()
    for a, b in zip(usual.P_newtons + usual.theta_deg, finer.P_newtons + finer.theta_deg, strict=True):
        assert abs(a - b) < estimators.REFERENCE_ERROR


def test_the_reference_agrees_with_the_node_where_doubles_do() -> None:
    given = estimators.contacts(np.random.default_rng(6), 50)
    F = given.counts * (methods.LSB_MICROSTRAIN * 1e-6) @ given.C.T
    for (F1, F2, F3), P, theta_deg in zip(F.tolist(), given.P_newtons, given.theta_deg, strict=True):
        got_P, _phi, theta_rad, _miss = scalar.contact(F1, F2, F3, False)
        assert got_P == pytest.approx(float(P), rel=1e-13)
        assert math.degrees(theta_rad) == pytest.approx(float(theta_deg), abs=1e-10)


def test_the_corners_of_the_converter_are_contacts() -> None:
    given = estimators.contacts(np.random.default_rng(7), 4, corners=True)
    full = np.abs(given.counts).min(axis=1) > 0.97 * 2 ** (methods.COUNT_BITS - 1)
    assert full[4:].all()
    assert not full[:4].any()


@pytest.mark.parametrize("value", [0, 1, 2, 3, 4, 10**15 + 7, (1 << 31) ** 2, (1 << 31) ** 2 - 1, (1 << 62) - 1])
def test_the_integer_root_is_exact(value: int) -> None:
    assert int(methods.square_root(np.array([value]))[0]) == math.isqrt(value)


@pytest.mark.parametrize(
    ("arctangent", "bound"),
    [(methods.cordic(12), 2.0**-11), (methods.cordic(24), 2.0**-23), (methods.table(64), 0.65 / 8 / 64**2)],
)
def test_arctangents_keep_their_bound(arctangent: methods.Arctangent, bound: float) -> None:
    """CORDIC: the last angle, atan(2^-(n-1)); a table: h^2 / 8 times the largest |atan''| (0.65), and rounding."""
    rng = np.random.default_rng(8)
    y, x = np.rint(2.0 ** rng.uniform(10, 29, (2, 4000)) * rng.choice([-1, 1], (2, 4000))).astype(np.int64)
    off = arctangent(y, x) * (2.0 * np.pi / methods.TURN) - np.arctan2(y, x)
    off -= 2.0 * np.pi * np.rint(off / (2.0 * np.pi))
    assert np.abs(off).max() < bound * 1.01 + 1e-8


def test_errors_of_the_force(found: dict[str, Study]) -> None:
    """16 bits wrap in a narrow accumulator alone; single precision is ample."""
    force = worst(found["estimator-force"])
    assert force[estimators.WRAPS, "16-bit C"] * 4.94 > 5.0  # newtons
    assert force[estimators.WRAPS, "12-bit C"] == force[estimators.INT16, "12-bit C"]
    for method, setting, bound in (
        (estimators.INT16, "16-bit C", 5e-4), (estimators.WRAPS, "14-bit C", 5e-4),
        (estimators.FLOAT32, "float32 C", 1e-6), (estimators.NODE, "inside, REAL32 C", 1e-6),
        (estimators.FLOAT64, "float64 C", 1e-14), (estimators.INT32, "28 iterations", 1e-7),
    ):  # fmt: skip
        assert force[method, setting] < bound, method


def test_the_integer_object_rounds_to_its_resolution(found: dict[str, Study]) -> None:
    full_scale = estimators.contacts(np.random.default_rng(0), 2).full_scale_newtons
    rounded = worst(found["estimator-force"])[estimators.NODE, "INTEGER16 object"] * full_scale
    assert 0.3e-3 < rounded < 0.501e-3
    assert 0.003 < worst(found["estimator-angle"])[estimators.NODE, "INTEGER16 object"] < 0.0051


def test_more_work_is_more_exact(found: dict[str, Study]) -> None:
    series = {one.method: [point.error for point in one.points] for one in found["estimator-angle"].series}
    for method in (estimators.INT32, estimators.INT32_TABLE, estimators.INT16):
        assert series[method] == sorted(series[method], reverse=True), method
    # Four more iterations are sixteen times as exact, a table four times as long too, until the readings' noise.
    assert series[estimators.INT32][0] / series[estimators.INT32][1] == pytest.approx(16.0, rel=0.3)
    assert series[estimators.INT32_TABLE][0] / series[estimators.INT32_TABLE][1] == pytest.approx(16.0, rel=0.3)


def test_errors_grow_towards_tangency_for_every_arithmetic(found: dict[str, Study]) -> None:
    usual, tangent = worst(found["estimator-angle"]), worst(found["estimator-tangent"])
    for key in ((estimators.FLOAT64, "float64 C"), (estimators.FLOAT32, "float32 C")):
        assert tangent[key] > 5.0 * usual[key]


def test_root_mean_square_is_below_the_largest(found: dict[str, Study]) -> None:
    for study in found.values():
        for one in study.series:
            assert all(0.0 < (point.rms_error or 0.0) <= point.error for point in one.points)


def test_without_micropython_its_method_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(*_args: object) -> None:
        raise EnvironmentLackError("Node.js is not installed")

    monkeypatch.setattr("tipforce_lab.report.studies.estimator_methods.run_micropython", lacking)
    monkeypatch.setattr(estimators, "timed", at_once)
    for one in estimators.studies(Tiny(), lambda: None):
        assert one.left_out == {estimators.MICROPYTHON: "Node.js is not installed"}
        assert estimators.MICROPYTHON not in [series.method for series in one.series]


def test_micropython_gives_the_same_as_the_node(found: dict[str, Study]) -> None:
    angle = worst(found["estimator-angle"])
    there, here = (estimators.MICROPYTHON, "REAL32 C"), (estimators.NODE, "inside, REAL32 C")
    assert angle[there] == pytest.approx(angle[here], rel=1e-6)


def test_code_that_fails_on_micropython_is_told_shortly() -> None:
    with pytest.raises(EnvironmentLackError, match="ZeroDivisionError") as caught:
        methods.run_micropython({}, ["1 / 0"])
    assert len(str(caught.value)) < 300
