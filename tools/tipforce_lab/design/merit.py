"""Figures of merit of a structure, by beam theory and by the frame, and the designs that no other dominates."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.calibration.statistics import FALSE_ALARM_RATE
from tipforce.sensor.contact.redundancy import detectable_strain, parity, weighted_inverse
from tipforce.sensor.structure.layouts import CALIBRATION_WEIGHT_NEWTONS
from tipforce.sensor.structure.plane_frame import ELASTIC_ROOTS, PAPER_SLIT_M, Frame, slit_closure, worst_stress
from tipforce.sensor.structure.quality import condition_number, noise_gain, shifted
from tipforce.sensor.structure.strain import FABRICATED, Gauge, Geometry, gauge_matrix, gauge_name

_FRICTION = 0.5
_CONTACTS, _DIRECTIONS = 61, 9  # midpoints over pad and friction cone; twice as many change u by less than 1e-3


def load_angles() -> tuple[FloatArray, FloatArray]:
    """Return (phi_rad, theta_rad), each (k,), of the loads of an average: uniform over pad and friction cone."""
    theta = math.pi * ((np.arange(_CONTACTS) + 0.5) / _CONTACTS)
    cone = math.atan(_FRICTION) * (2.0 * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS - 1.0)
    theta, cone = (grid.ravel() for grid in np.meshgrid(theta, cone))
    return theta + math.pi + cone, theta


def load_weights(load_newtons: float) -> FloatArray:
    """Return W_P, W_phi, W_theta, (3, 3, 3), units 1, (rad/N)^2: means of j j^T, j the gradient of each by F."""
    phi, theta = load_angles()
    s, c, zero, delta = np.sin(phi), np.cos(phi), np.zeros_like(phi), phi - theta
    gradient_P = np.stack((s, zero, c), axis=-1)
    gradient_phi = np.stack((c, zero, -s), axis=-1) / load_newtons
    # sin(delta) = F2 / P: d(delta) = (dF2 - sin(delta) dP) / (P cos(delta)), and theta = phi - delta.
    slope_2 = np.stack((zero, 1.0 / np.cos(delta), zero), axis=-1) / load_newtons
    slope_P = np.tan(delta)[:, np.newaxis] * gradient_P / load_newtons
    gradients = (gradient_P, gradient_phi, gradient_phi - slope_2 + slope_P)
    return np.stack([j.T @ j / len(phi) for j in gradients])


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a structure, metres; defaults: the paper's body and its stress. Raises InputError, naming the value."""

    envelope_x_m: float = 2.0 * FABRICATED.r_m
    """Across: 2 r."""
    envelope_y_m: float = FABRICATED.r_m + 0.5 * FABRICATED.h1_m + FABRICATED.d_m
    """From the fixture to the top of the tip: d + h1 / 2 + r."""
    width_m: float = FABRICATED.width_m
    min_thickness_m: float = 0.2e-3
    """Of either beam. The paper names no limit; its thinner beam has 0.4 mm."""
    gauge_length_m: float = 1e-3
    slit_m: float = PAPER_SLIT_M
    """The load must not close it."""
    load_newtons: float = CALIBRATION_WEIGHT_NEWTONS
    max_stress_pascals: float | None = None
    """Anywhere on the beams at the load, at the worst angle; None: that of the paper's body."""

    def __post_init__(self) -> None:
        if not 1e-9 <= self.load_newtons <= 1e9:
            raise InputError(f"load = {self.load_newtons!r} N: allowed is 1e-9 to 1e9")
        for name, value in asdict(self).items():
            if value is not None and not 0.0 < value < math.inf:
                raise InputError(f"limit {name} = {value!r}: allowed is a positive finite number in SI units")

    @property
    def stress_pascals(self) -> float:
        """max_stress_pascals, or its default."""
        return self.max_stress_pascals or worst_stress(FABRICATED, self.load_newtons)


@dataclass(frozen=True, slots=True)
class Merit:
    """Figures of a strain matrix at a given gauge noise and load set."""

    u_P_newtons: float
    """Standard uncertainties: RMS over the load set, from gauge noise alone, first order."""
    u_phi_deg: float
    u_theta_deg: float
    noise_gain_newtons: float
    """sqrt(trace(C C^T)) in newtons per microstrain."""
    smallest_singular_value: float
    """Of the strain matrix, in microstrain per newton: the smallest reading of the gauges for a unit force."""
    condition_number: float


def merit(strain_matrix: npt.ArrayLike, noise_microstrain: float, load_newtons: float) -> Merit:
    """Return the figures of a strain matrix (n, 3), strain per newton; equal white noise on every gauge. A matrix of
    rank below 3 gives infinite uncertainties. Raises InputError for a noise that is negative or not finite."""
    A = 1e6 * np.asarray(strain_matrix, dtype=np.float64)
    if not 0.0 <= noise_microstrain < math.inf:
        raise InputError(f"noise = {noise_microstrain!r} microstrain: allowed is 0 or more, finite")
    if np.linalg.matrix_rank(A) < 3:
        return Merit(math.inf, math.inf, math.inf, math.inf, 0.0, math.inf)
    C = np.linalg.pinv(A)
    u = [noise_microstrain * math.sqrt(np.trace(W @ C @ C.T)) for W in load_weights(load_newtons)]
    return Merit(
        u[0], math.degrees(u[1]), math.degrees(u[2]), noise_gain(C),
        float(np.linalg.svd(A, compute_uv=False)[-1]), condition_number(A),
    )  # fmt: skip


def worst_strain(strain_matrix: npt.ArrayLike, load_newtons: float) -> float:
    """Return the largest reading of any gauge (strain), over the same loads, from a strain matrix (n, 3)."""
    A = np.asarray(strain_matrix, dtype=np.float64)
    return float(np.max(np.hypot(A[:, 0], A[:, 2]) + np.abs(A[:, 1]))) * load_newtons


AGREEMENT = 0.03
"""Relative difference of beam theory and frame above which a design counts as not proven."""


@dataclass(frozen=True, slots=True)
class Assessment:
    """Assessment of a structure: by beam theory, and by the frame with shear and elastic roots."""

    name: str
    geometry: Geometry
    gauges: tuple[Gauge, ...]
    theory: Merit
    frame: Merit
    frame_finite_joint: Merit
    """The frame with the joint as a block of width h2: shows the effect of the joint's size."""
    worst_stress_pascals: float
    worst_strain: float
    """The largest reading of a gauge."""
    slit_load_newtons: float
    """The load that closes the slit."""

    @property
    def disagreement(self) -> float:
        """The largest relative difference of frame and beam theory, over every field of Merit."""
        pairs = [(getattr(self.frame, f.name), getattr(self.theory, f.name)) for f in fields(Merit)]
        return max(0.0 if a == b else abs(a / b - 1.0) if b and math.isfinite(b) else math.inf for a, b in pairs)

    @property
    def agrees(self) -> bool:
        """True if beam theory and the frame agree within AGREEMENT."""
        return self.disagreement <= AGREEMENT


def assess(
    name: str, geometry: Geometry, gauges: Sequence[Gauge], limits: Limits, noise_microstrain: float
) -> Assessment:
    """Return the figures of a structure at load, gauge length (0 for points), slit of the limits. Raises InputError."""
    A, load = gauge_matrix(geometry, gauges), limits.load_newtons
    length_m = 0.0 if any(isinstance(gauge, str) for gauge in gauges) else limits.gauge_length_m
    block = replace(ELASTIC_ROOTS, finite_joint=True)
    matrices = [Frame(geometry, model).strain_matrix(gauges, length_m) for model in (ELASTIC_ROOTS, block)]
    theory, frame, finite = (merit(matrix, noise_microstrain, load) for matrix in (A, *matrices))
    return Assessment(
        name, geometry, tuple(gauges), theory, frame, finite, worst_stress(geometry, load), worst_strain(A, load),
        limits.slit_m / slit_closure(geometry, 1.0),
    )  # fmt: skip


def glued(geometry: Geometry, gauges: Sequence[str], gauge_length_m: float) -> tuple[Gauge, ...]:
    """Return gauges as near to the points as length and vertical beam allow. Raises InputError for an unknown point."""
    positions: list[Gauge] = []
    for point in gauges:
        moved = shifted(geometry, point, 0.5 * gauge_length_m)
        beside = 0.5 * geometry.h2_m if point in ("K_H", "S_H") else 0.0
        positions.append(moved._replace(position_m=beside + moved.position_m))
    return tuple(positions)


FIGURES: dict[str, Callable[[Assessment], float]] = {
    "theta": lambda entry: entry.theory.u_theta_deg,
    "noise": lambda entry: entry.theory.noise_gain_newtons,
    "singular": lambda entry: 1.0 / entry.theory.smallest_singular_value,
    "condition": lambda entry: entry.theory.condition_number,
}
"""The quantities that the search's objectives minimise."""


def pareto(entries: Sequence[Assessment], figures: Sequence[Callable[[Assessment], float]]) -> list[Assessment]:
    """Return the entries that none dominates (a percent counts as equal), the best in the first figure first."""
    kept: list[Assessment] = []
    for entry in sorted(entries, key=lambda e: tuple(figure(e) for figure in figures)):
        values = [figure(entry) for figure in figures]
        others = ([figure(other) for figure in figures] for other in kept)
        if not any(all(o <= v * 1.01 for o, v in zip(other, values, strict=True)) for other in others):
            kept.append(entry)
    return kept


def detectable_microstrain(entry: Assessment, noise_microstrain: float) -> list[float]:
    """The smallest fault of each gauge that a sample shows, microstrain, with C known; none for three gauges."""
    if len(entry.gauges) < 4 or not noise_microstrain > 0.0:
        return []
    A, Sigma = gauge_matrix(entry.geometry, entry.gauges), np.eye(len(entry.gauges)) * noise_microstrain**2 * 1e-12
    strain = detectable_strain(parity(weighted_inverse(A, Sigma), Sigma), FALSE_ALARM_RATE)
    return [1e6 * smallest for smallest in strain.tolist()]


def record(entry: Assessment, noise_microstrain: float) -> dict[str, object]:
    """Return the JSON record of a structure: dimensions, gauges, figures of merit by each model, limits."""
    figures: dict[str, object] = {"name": entry.name, **asdict(entry.geometry)}
    figures["gauges"] = [gauge_name(gauge) for gauge in entry.gauges]
    for prefix, merit in (("", entry.theory), ("frame_", entry.frame), ("finite_joint_", entry.frame_finite_joint)):
        figures |= {f"{prefix}{field.name}": getattr(merit, field.name) for field in fields(Merit)}
    for name in ("worst_stress_pascals", "worst_strain", "slit_load_newtons", "disagreement", "agrees"):
        figures[name] = getattr(entry, name)
    return figures | {"detectable_microstrain": detectable_microstrain(entry, noise_microstrain)}
