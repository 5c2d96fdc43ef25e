"""condition_number(), by which the node itself refuses a bad matrix, against numpy's singular values."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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


def test_zero_row_and_zero_matrix_are_infinite() -> None:
    assert condition_number([[0.0] * 3] * 3) == math.inf
    assert condition_number([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]) == math.inf


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_element_not_finite_gives_nan(value: float) -> None:
    for k in range(9):
        flat = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        flat[k] = value
        assert math.isnan(condition_number([flat[0:3], flat[3:6], flat[6:9]]))
