"""Error budget of P, phi, theta: each cause, a set of independent elementary errors, propagated to first order. A fixed
offset, gain, shift or angle is not noise: its row is the scatter of the estimates of many such sensors."""

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from tipforce.arrays import BoolArray, FloatArray
from tipforce.errors import InputError
from tipforce.output_file import save_figure
from tipforce.sensor import Geometry, first_order_holds, force_vector, standard_uncertainties
from tipforce.sensor.calibration.simulation import paper_grooves
from tipforce.sensor.structure.layouts import CALIBRATION_WEIGHT_NEWTONS
from tipforce.sensor.structure.off_axis import PlacedGauge, off_axis_wrenches, wrench_strain_matrix
from tipforce.sensor.structure.quality import shifted
from tipforce.sensor.structure.strain import GaugePosition, position_matrix
from tipforce_lab import plotting as figures

DEGREE = pi / 180.0
_SHIFT_STEP = 1e-3  # of a beam's length: the strain is linear along it, any step gives the derivative
_PLACEMENT_STEP = 1e-6  # metres and radians


@dataclass(frozen=True, slots=True)
class Causes:
    """Standard uncertainties of the causes. The defaults are assumptions to be replaced."""

    noise_strain: float | None = None
    """White noise of each gauge; None: the covariance of the sensor."""
    resolution_strain: float = 0.1e-6
    """One step of the gauge's converter (INTEGER16 in 0.1 microstrain)."""
    gain: float = 1e-3
    """Relative drift of each gauge's sensitivity since the calibration."""
    offset_strain: float = 1e-6
    """Drift of each gauge's zero since the last tare."""
    temperature_K: float = 1.0
    """Away from the temperature of the last tare."""
    apparent_strain_per_K: float = 1e-6
    """Apparent strain that all gauges share."""
    mismatch_strain_per_K: float = 0.2e-6
    """Apparent strain of each gauge in addition."""
    sensitivity_per_K: float = 3e-4
    """Relative change of all strains: Young's modulus of steel, and the gauge factor."""
    hysteresis: float = 5e-4
    """Of each gauge, relative to its largest strain under a load of the same size in any direction: half the width of
    the loop between loading and unloading, as a standard uncertainty. The load before is unknown."""
    creep: float = 5e-4
    """Relative growth of all strains while a load is held: structure, adhesive and backing of one batch of gauges."""
    load_angle_rad: float = 0.5 * DEGREE
    """Scatter of the direction of each calibration load."""
    gravity_rad: float = 0.5 * DEGREE
    """Angle between the two set-ups for the x-loads and the y-loads: all y-loads rotate by it."""
    gauge_shift_m: float = 0.2e-3
    """Of each gauge along its beam; only if C comes from theory, because a calibration removes it."""
    off_axis_newtons: float = 0.5
    """Load along the width of the beams."""
    lateral_offset_m: float = 0.3e-3
    """Of each gauge off the centre line of its beam, for the off-axis load."""
    misalignment_rad: float = 2.0 * DEGREE
    """Of each gauge's axis, for the off-axis load."""


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """Properties of a sensor for the budget."""

    C: FloatArray
    """(3, n), newtons per unit strain."""
    A: FloatArray
    """(n, 3), strain per newton."""
    covariance_strain2: FloatArray
    """(n, n), noise of the gauges."""
    pull: bool
    """Load sense of the readings."""
    calibrated: bool
    """True: C was fitted to loads. False: it comes from theory, with gauges at their nominal places."""
    geometry: Geometry | None = None
    positions: tuple[GaugePosition, ...] = ()
    """Positions of the gauges; without them (or the geometry) shift and off-axis load are unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Loads:
    """Loads P, phi, theta, each of shape (m,)."""

    P_newtons: FloatArray
    phi_rad: FloatArray
    theta_rad: FloatArray

    @property
    def F(self) -> FloatArray:
        """(m, 3), newtons."""
        return force_vector(self.P_newtons, self.phi_rad, self.theta_rad)

    @property
    def turned(self) -> FloatArray:
        """dF / dphi with the contact held, (m, 3), newtons per radian."""
        return force_vector(self.P_newtons, self.phi_rad + 0.5 * np.pi, self.theta_rad)


@dataclass(frozen=True, slots=True, eq=False)
class Budget:
    """Contributions to m loads: standard uncertainties of P (N), phi, theta (rad), (m, 3) each."""

    rows: dict[str, FloatArray]
    """By cause."""
    total: FloatArray
    holds: BoolArray
    """(m, 3): first_order_holds() of the total, for P, phi, theta."""
    left_out: dict[str, str]
    """Cause -> reason why it has no row."""


def groove_loads() -> Loads:
    """Return the calibration: the pulls of the paper's 19 grooves."""
    grooves = paper_grooves()
    return Loads(np.full(grooves.theta_rad.shape, CALIBRATION_WEIGHT_NEWTONS), grooves.phi_rad, grooves.theta_rad)


def pad_loads(P_newtons: float, theta_min_deg: float, theta_max_deg: float, *, pull: bool) -> Loads:
    """Return loads over a whole pad, at most a turn, every 5 degrees of theta and 15 of delta = phi - theta."""
    last_deg = min(theta_max_deg, theta_min_deg + 360.0)
    degrees = np.meshgrid(np.arange(theta_min_deg, last_deg + 1e-9, 5.0), np.arange(-45.0, 46.0, 15.0))
    theta, delta = (np.radians(grid.ravel()) for grid in degrees)
    phi = theta + delta + (0.0 if pull else np.pi)
    return Loads(np.full(theta.shape, P_newtons), phi, theta)


def budget(sensor: Sensor, loads: Loads, causes: Causes) -> Budget:
    """Return the budget of loads, C fitted to the grooves and as many unloaded rows. Raises InputError for shapes."""
    n = sensor.C.shape[1] if sensor.C.ndim == 2 else 0
    if sensor.C.shape != (3, n) or sensor.A.shape != (n, 3) or sensor.covariance_strain2.shape != (n, n):
        raise InputError(
            f"C {sensor.C.shape}, A {sensor.A.shape}, covariance {sensor.covariance_strain2.shape}: "
            "allowed are (3, n), (n, 3), (n, n)"
        )
    F = loads.F
    errors, left_out = elementary_errors(sensor, loads, causes)
    covariances = {cause: E.transpose(1, 2, 0) @ E.transpose(1, 0, 2) for cause, E in errors.items()}
    covariances["total"] = np.asarray(sum(covariances.values()), dtype=np.float64)
    rows = {cause: standard_uncertainties(F, part, pull=sensor.pull) for cause, part in covariances.items()}
    total = rows.pop("total")
    return Budget(rows, total, first_order_holds(F, covariances["total"]), left_out)


def elementary_errors(sensor: Sensor, loads: Loads, causes: Causes) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return (cause -> errors of F, (q, m, 3) newtons, one for each of q independent standard deviations; left out).
    Zeros for a cause without effect. The second gives the reason for each cause that cannot be computed."""
    C, F, n = sensor.C, loads.F, sensor.C.shape[1]
    strain = F @ sensor.A.T
    per_gauge = np.broadcast_to(C.T[:, np.newaxis, :], (n, len(F), 3))  # error of F per unit strain in each gauge
    noise = sensor.covariance_strain2 if causes.noise_strain is None else causes.noise_strain**2 * np.eye(n)
    values, vectors = np.linalg.eigh(noise)
    factor = vectors * np.sqrt(np.maximum(values, 0.0))  # noise = factor factor^T, also of a singular covariance
    # Over all directions and contacts: hypot(A1, A3) + |A2| times P, as in worst_strain(); P = hypot(F1, F3).
    worst = np.hypot(sensor.A[:, 0], sensor.A[:, 2]) + np.abs(sensor.A[:, 1])
    largest = worst[:, np.newaxis] * np.hypot(F[:, 0], F[:, 2])
    common = causes.temperature_K * (causes.apparent_strain_per_K * C.sum(axis=1) + causes.sensitivity_per_K * F)
    errors_by_cause = {
        "gauge noise": np.broadcast_to((C @ factor).T[:, np.newaxis, :], per_gauge.shape),
        "quantisation": causes.resolution_strain / sqrt(12.0) * per_gauge,
        "gain": causes.gain * strain.T[:, :, np.newaxis] * per_gauge,
        "offset": causes.offset_strain * per_gauge,
        "temperature, common": common[np.newaxis],
        "temperature, mismatch": causes.temperature_K * causes.mismatch_strain_per_K * per_gauge,
        "hysteresis": causes.hysteresis * largest[:, :, np.newaxis] * per_gauge,
        "creep": causes.creep * F[np.newaxis],
    }
    none, left_out = np.zeros((1, *F.shape)), {}
    if sensor.calibrated:
        errors_by_cause |= _calibration_errors(F, causes, errors_by_cause["gauge noise"]) | {"gauge position": none}
    else:
        errors_by_cause |= dict.fromkeys(("calibration noise", "load angle", "gravity"), none)
    if sensor.geometry is None or len(sensor.positions) != n:
        missing = ["off-axis load"] if sensor.calibrated else ["gauge position", "off-axis load"]
        left_out = dict.fromkeys(missing, "the positions of the gauges are unknown")
    else:
        if not sensor.calibrated:
            step_m = _SHIFT_STEP * min(sensor.geometry.a_m, sensor.geometry.d_m)
            moved = [shifted(sensor.geometry, place, step_m) for place in sensor.positions]
            at, beyond = (position_matrix(sensor.geometry, places) for places in (sensor.positions, moved))
            by_shift = (beyond - at) @ F.T * (causes.gauge_shift_m / step_m)
            errors_by_cause["gauge position"] = by_shift[:, :, np.newaxis] * per_gauge
        off_axis = _off_axis_strains(sensor.geometry, sensor.positions, loads.theta_rad, causes)
        errors_by_cause["off-axis load"] = np.concatenate([each.T[:, :, np.newaxis] * per_gauge for each in off_axis])
    return {cause: np.asarray(E, dtype=np.float64) for cause, E in errors_by_cause.items()}, left_out


def _calibration_errors(F: FloatArray, causes: Causes, noise: FloatArray) -> dict[str, FloatArray]:
    """Return the errors of F from noise and angles of the calibration. The fit uses F_i for the load F_i + angle F'_i:
    a reading is wrong by -F'_i (G_i^T N^-1 G), for any A; G^T N^-1 G is the part of its variance in F."""
    hung = groove_loads()
    G, each = _with_one(hung.F), _with_one(F)
    solved = np.linalg.solve(G.T @ G + np.diag([0.0, 0.0, 0.0, float(len(G))]), each.T)
    turns = -(G @ solved)[:, :, np.newaxis] * hung.turned[:, np.newaxis, :]
    return {
        "calibration noise": np.sqrt(np.einsum("mi,mi->m", each, solved.T))[:, np.newaxis] * noise,
        "load angle": causes.load_angle_rad * turns,
        "gravity": causes.gravity_rad * turns[~paper_grooves().along_x].sum(axis=0)[np.newaxis],
    }


def gravity_residual(angle_rad: float) -> float:
    """Return the RMS over the load of such an angle between x-loads and y-loads in the residuals of the fit."""
    hung = groove_loads()
    turned = hung.turned * (angle_rad * ~paper_grooves().along_x)[:, np.newaxis]
    rows = np.vstack([turned, np.zeros_like(turned)])
    G = np.vstack([_with_one(hung.F), _with_one(np.zeros_like(hung.F))])
    residual = (rows - G @ np.linalg.lstsq(G, rows, rcond=None)[0])[: len(turned)]
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1)) / np.mean(hung.P_newtons**2)))


def _with_one(F: FloatArray) -> FloatArray:
    return np.column_stack([F, np.ones(len(F))])


def _off_axis_strains(
    geometry: Geometry, positions: tuple[GaugePosition, ...], theta_rad: FloatArray, causes: Causes
) -> list[FloatArray]:
    """Return strains (m, n) from an off-axis load by each gauge's lateral offset, then by each gauge's misalignment."""
    wrenches = causes.off_axis_newtons * off_axis_wrenches(geometry, theta_rad)
    centred = wrench_strain_matrix(geometry, [PlacedGauge(place) for place in positions])
    strains = []
    for step, size in zip(_PLACEMENT_STEP * np.eye(2), (causes.lateral_offset_m, causes.misalignment_rad), strict=True):
        moved = wrench_strain_matrix(geometry, [PlacedGauge(place, *step.tolist()) for place in positions])
        strains.append(wrenches @ ((moved - centred) / _PLACEMENT_STEP * size).T)
    return strains


_QUANTITIES = (("P", "N", 1.0), ("phi", "deg", 180.0 / np.pi), ("theta", "deg", 180.0 / np.pi))
_BAR, _TOTAL = "#0072b2", "#222222"


def plot(error_budget: Budget, path: str) -> None:
    """Draw the standard uncertainty of each cause, RMS over the loads. Raises EnvironmentLackError, and InputError."""
    *parts, total = (np.sqrt(np.mean(u**2, axis=0)) for u in (*error_budget.rows.values(), error_budget.total))
    sizes = np.array(parts)
    order = np.argsort(-sizes[:, 0], kind="stable")
    names = [list(error_budget.rows)[k] for k in order] + ["total"]
    with figures.plotting({"font.size": 9.0}):
        figure = figures.new_figure(9.0, 0.9 + 0.27 * len(names))
        panels = figure.subplots(1, 3, sharey=True)
        for k, (axes, (name, symbol, unit)) in enumerate(zip(panels, _QUANTITIES, strict=True)):
            values = unit * np.append(sizes[order, k], total[k])
            places = np.arange(len(values), dtype=np.float64)
            axes.barh(places, values, color=[_BAR] * len(order) + [_TOTAL], height=0.7)
            for place, value in zip(places, values, strict=True):
                label = f"{value:#.2g}" if value > 1e-6 * total[k] * unit else "0"  # below: rounding
                axes.annotate(label, (value, place), (3, 0), textcoords="offset points", va="center")
            axes.set(xlabel=f"u({name}) ({symbol})", xlim=(0.0, 1.22 * max(values.max(), 1e-300)))
            axes.grid(visible=False)
            axes.tick_params(axis="y", length=0)
        panels[0].set_yticks(range(len(names)), names)
        panels[0].invert_yaxis()
        save_figure(figure, path, dpi=130)
