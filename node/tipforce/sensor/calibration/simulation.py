"""The paper's grooves (section 4.1), and simulated calibrations in them: a sensor with faults, and the truth."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray
from tipforce.sensor.calibration.regressors import grooves
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.layouts import GROOVES_DEG, Layout
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix


@dataclass(frozen=True, slots=True, eq=False)
class Grooves:
    """Directions in which a rope pulls, one entry per groove."""

    theta_rad: FloatArray
    phi_rad: FloatArray
    along_x: npt.NDArray[np.bool_]


def paper_grooves() -> Grooves:
    """Return the 19 grooves of section 4.1; those along y are those that pull up (phi = 90 degrees)."""
    phi_deg, theta_deg = np.transpose(GROOVES_DEG)
    return Grooves(np.radians(theta_deg), np.radians(phi_deg), phi_deg != 90.0)


@dataclass(frozen=True, slots=True)
class Faults:
    """What goes wrong in a simulated calibration; the defaults are a bad day."""

    noise_strain: float = 1e-6
    offset_strain: float = 30e-6
    """Standard deviation of the gauges' offsets."""
    drift_strain: float = 15e-6
    """Standard deviation of the drift over the whole calibration."""
    warm_up: float = 0.5
    """Share of the drift's variance that is a warm-up (exponential); the rest is linear in time."""
    groove_scatter_rad: float = np.radians(0.5)
    """Standard deviation of the error of phi and of theta that all rows of a groove have in common."""
    hang_scatter_rad: float = np.radians(0.1)
    """Standard deviation of phi and of theta each time that a weight is hung."""
    outlier_share: float = 0.02
    """Share of rows with a fault: a jump of one gauge, or a weight that was not the one written down."""
    saturation: float | None = 0.93
    """Converter limit as a fraction of the largest reading; None for none."""


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """Readings of m rows, and the truth."""

    strain: FloatArray
    """(m, n), clipped at the converter's limit."""
    P_newtons: FloatArray
    phi_rad: FloatArray
    theta_rad: FloatArray
    t_s: FloatArray
    saturation_strain: float | None
    true_A: FloatArray
    """(n, 3)."""
    true_offset_strain: FloatArray
    """(m, n): at each row."""
    true_outlier: BoolArray
    faults: Faults


def true_matrix(gauges: Layout, rng: np.random.Generator) -> FloatArray:
    """Return the strain matrix of a real sensor, (n, 3): beam theory, each gauge 5 % and each entry 3 % off."""
    theory = strain_matrix(FABRICATED, gauges)
    size = np.linalg.norm(theory, axis=1, keepdims=True)
    real: FloatArray = theory * (1.0 + 0.05 * rng.normal(size=size.shape)) + 0.03 * size * rng.normal(size=theory.shape)
    return real


def simulate(
    gauges: Layout,
    rng: np.random.Generator,
    faults: Faults | None = None,
    weights_newtons: tuple[float, ...] = (1.1, 2.2, 4.4),
) -> Simulated:
    """Return one calibration: every groove with every weight, grooves in random order, a tare before each and last."""
    faults = faults or Faults()
    P, phi, theta = schedule(rng, weights_newtons)
    m, A = P.size, true_matrix(gauges, rng)
    n = A.shape[0]
    t_s: FloatArray = 20.0 * np.arange(m, dtype=np.float64)
    x = t_s / t_s[-1]
    shares = np.sqrt([[1.0 - faults.warm_up], [faults.warm_up]])
    rates = faults.drift_strain * shares * rng.normal(size=(2, n))
    drift = np.outer(x, rates[0]) + np.outer(1.0 - np.exp(-4.0 * x), rates[1])
    offset = faults.offset_strain * rng.normal(size=n) + drift
    groove = grooves(phi, theta)
    scatter = faults.groove_scatter_rad * rng.normal(size=(2, int(groove.max()) + 1))[:, groove]
    scatter += faults.hang_scatter_rad * rng.normal(size=(2, m))
    clean = force_vector(P, phi, theta) @ A.T + offset
    limit = None if faults.saturation is None else faults.saturation * float(np.abs(clean).max())
    outlier = np.zeros(m, dtype=np.bool_)
    outlier[rng.choice(m, round(faults.outlier_share * m), replace=False)] = True
    hung = np.where(outlier & (P > 0.0) & (rng.random(m) < 0.5), rng.choice([0.5, 1.5], m) * P, P)
    strain = force_vector(hung, phi + scatter[0], theta + scatter[1]) @ A.T + offset
    strain += faults.noise_strain * rng.normal(size=(m, n))
    jumps = outlier & (hung == P)
    strain[jumps, rng.integers(n, size=m)[jumps]] += (rng.choice([-1, 1], m) * rng.uniform(50e-6, 500e-6, m))[jumps]
    if limit is not None:
        strain = np.clip(strain, -limit, limit)
    return Simulated(strain, P, phi, theta, t_s, limit, A, offset, outlier, faults)


def unseen_forces(rng: np.random.Generator, count: int) -> FloatArray:
    """Return forces that no calibration row has, (count, 3): 0.3 to 4.4 N, any theta of the pad, pulls and pushes."""
    theta, delta = rng.uniform(0.0, np.pi, count), np.radians(rng.uniform(-85.0, 85.0, count))
    turn = np.where(rng.random(count) < 0.5, np.pi, 0.0)
    return force_vector(rng.uniform(0.3, 4.4, count), theta + delta + turn, theta)


def schedule(rng: np.random.Generator, weights_newtons: tuple[float, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return P (newtons), phi, theta (radians), (m,) each: all weights in each groove of the paper, tares between."""
    tare, paper = (0.0, 0.0, 0.0), paper_grooves()
    places = rng.permutation(np.stack((paper.phi_rad, paper.theta_rad), axis=-1))
    rows = [row for place in places for row in (tare, *((weight, *place) for weight in weights_newtons))]
    P, phi, theta = np.array([*rows, tare]).T
    return P, phi, theta
