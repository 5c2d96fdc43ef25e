"""What the node computes alone: a condition number, against numpy's; the bound with which it saves u_theta."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.scalar_condition import condition_number

REAL32 = st.floats(-1e6, 1e6, width=32)


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.integers(3, 8).flatmap(lambda n: st.lists(st.lists(REAL32, min_size=n, max_size=n), min_size=3, max_size=3)))
def test_agrees_with_numpy(rows: list[list[float]]) -> None:
    singular = np.linalg.svd(np.array(rows, dtype=np.float64), compute_uv=False)
    found = condition_number(rows)
    if singular[0] == 0.0:
        assert found == math.inf
    elif singular[-1] <= 1e-13 * singular[0]:
        # Here numpy's own smallest singular value is rounding noise; either way the matrix is refused.
        assert found > 1e12
    else:
        expected = singular[0] / singular[-1]
        assert found == pytest.approx(expected, rel=1e-12 + 1e-14 * expected)


@pytest.mark.parametrize("exponent", range(11))
@pytest.mark.parametrize("n", [3, 8])
def test_known_singular_values(exponent: int, n: int) -> None:
    rng = np.random.default_rng(100 * exponent + n)
    left = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    right = np.linalg.qr(rng.normal(size=(n, n)))[0][:3]
    rows = left @ np.diag([1.0, 10.0 ** (-exponent / 2), 10.0**-exponent]) @ right
    assert condition_number(rows.tolist()) == pytest.approx(10.0**exponent, rel=1e-14 * 10.0**exponent + 1e-12)


@pytest.mark.parametrize("scale", [1e-38, 1e-20, 1.0, 1e20, 3e38])
def test_does_not_depend_on_the_scale(scale: float) -> None:
    rows = [[scale * value for value in row] for row in ([4.0, 1.0, 0.0], [1.0, 3.0, 1.0], [0.0, 1.0, 2.0])]
    assert condition_number(rows) == pytest.approx(np.linalg.cond([[4, 1, 0], [1, 3, 1], [0, 1, 2]]), rel=1e-12)


@pytest.mark.parametrize(
    "rows",
    [
        [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.0, 1.0]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]],
        [[1e-45, 0.0, 0.0], [0.0, 3e38, 0.0], [0.0, 3e38, 0.0]],
    ],
)
def test_singular_matrix_has_no_usable_condition_number(rows: list[list[float]]) -> None:
    assert condition_number(rows) > 1e15


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_element_not_finite_gives_nan(value: float) -> None:
    for k in range(9):
        flat = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        flat[k] = value
        assert math.isnan(condition_number([flat[0:3], flat[3:6], flat[6:9]]))


Covariance = tuple[float, float, float, float, float, float]


@settings(max_examples=400)
@given(
    st.floats(-1, 1), st.floats(-math.pi, math.pi), st.floats(-15, 6), st.floats(-6, 1), st.integers(0, 1 << 32),
    st.booleans(),
)  # fmt: skip
def test_what_is_clearly_resolved_is_resolved(
    sine: float, phi: float, exponent: float, noise: float, seed: int, pull: bool
) -> None:
    P = 10.0**exponent
    root = np.random.default_rng(seed).normal(size=(3, 3)) * P * 10.0**noise
    matrix = root @ root.T
    cov: Covariance = tuple(matrix[np.triu_indices(3)].tolist())
    F1, F2, F3 = P * math.sin(phi), P * sine, P * math.cos(phi)
    found, *_ = scalar.contact(F1, F2, F3, pull)
    _, _, u_theta = scalar.uncertainty(F1, F2, F3, cov, pull)
    if scalar.clearly_resolved(found, F2, cov):
        assert math.degrees(u_theta) < scalar.THETA_RESOLVED_DEG


def test_a_good_sensor_is_clearly_resolved_and_numbers_that_are_none_never() -> None:
    cov: Covariance = (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
    assert scalar.clearly_resolved(1.0, 0.7, cov)
    assert not scalar.clearly_resolved(1.0, 1.0, cov)
    assert not scalar.clearly_resolved(0.0, 0.0, cov)
    assert not scalar.clearly_resolved(math.nan, 0.0, cov)
    assert not scalar.clearly_resolved(1.0, 0.0, (math.nan, 0.0, 0.0, 1e-6, 0.0, 1e-6))
    assert not scalar.clearly_resolved(1.0, math.inf, cov)
