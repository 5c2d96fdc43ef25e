"""Numbers printed in the paper, for comparison. This module computes nothing."""

from typing import NamedTuple


class PrintedMaximum(NamedTuple):
    """One row of Table 2, in units of a P / h1^2 with h2 = 1.633 h1 (its last column)."""

    theta_deg: float
    phi_deg: float
    maximum: float


TABLE_2 = {
    "L": PrintedMaximum(180.0, 90.0, 3.0),
    "R": PrintedMaximum(180.0, -90.0, 3.0),
    "T": PrintedMaximum(0.0, 90.0, 4.5),
    "U": PrintedMaximum(0.0, -90.0, 4.5),
    "K_H": PrintedMaximum(180.0, 90.0, 4.5),
    "S_H": PrintedMaximum(0.0, 90.0, 4.5),
    "K_V": PrintedMaximum(0.0, 90.0, 2.25),
    "S_V": PrintedMaximum(0.0, -90.0, 2.25),
}

TABLE_3_THEORY = {"I": 2.55, "II": 2.62, "III": 2.69}
TABLE_3_SIMULATION = {"I": 2.53, "II": 3.36, "III": 3.94}
"""Finite elements (ANSYS)."""
TABLE_3_MEASUREMENT = {"I": 3.50, "II": 3.50, "III": 3.34}

MEASURED_MATRICES = {
    "I": ((0.673, 0.594, -0.019), (-0.280, 0.238, 0.002), (-0.379, 0.317, 0.997)),
    "II": ((-0.909, 0.373, -0.021), (0.377, 0.349, 0.003), (0.513, 0.471, 1.102)),
    "III": ((-0.658, -0.813, -0.023), (0.608, -0.755, -0.011), (0.825, -1.016, 1.093)),
}
"""Section 4.3: C of equation (1) "without scaling", hence in a unit of its own; three decimals."""
HALF_DIGIT = 0.0005

_X_GROOVES_DEG = (5.0, 15.0, 30.0, 45.0, 60.0, 120.0, 135.0, 150.0, 165.0, 175.0)
_Y_GROOVES_DEG = (30.0, 45.0, 60.0, 75.0, 90.0, 105.0, 120.0, 135.0, 150.0)
GROOVES_DEG = (
    *((0.0 if theta < 90.0 else 180.0, theta) for theta in _X_GROOVES_DEG),
    *((90.0, theta) for theta in _Y_GROOVES_DEG),
)
"""Section 4.1: (phi, theta) of the 10 grooves along x and the 9 along y. The paper does not state their sense; a rope
can only pull away from the tip: along x to +x (phi = 0) below theta = 90 degrees, else to -x (180), along y up."""
CALIBRATION_WEIGHT_NEWTONS = 4.4
CALIBRATION_THETA_DEG = (0.0, 90.0)
"""Section 4.3: the grooves between which the matrices were fitted."""
GAUGE_LENGTH_M = 1e-3
