"""The bound with which a node saves u_theta never says more than the uncertainty itself."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.sensor.contact import scalar

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
