"""What goes into a calibration fit: readings under known loads, how they came about, and the checks of both."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray, floats
from tipforce.errors import InputError
from tipforce.sensor.calibration.regressors import DRIFTS
from tipforce.sensor.structure.layouts import MAX_GAUGES, MIN_GAUGES
from tipforce.sensor.structure.strain import Gauge, Geometry, gauge_matrix


def require_no_rail(
    strain: FloatArray, loads: FloatArray, saturation_strain: npt.ArrayLike | None, lines: IntArray | None = None
) -> None:
    """Raise InputError for an extreme of a gauge that looks like a converter's limit: in rows of different loads or
    three rows, more often than others. strain (m, n); loads (m, 3), P, phi, theta; lines (m,), to name."""
    limit = np.broadcast_to(floats("rail", np.inf if saturation_strain is None else saturation_strain), strain.shape[1])
    if saturation_strain is not None and np.isinf(limit).all():
        return
    inside, loaded = np.abs(strain) < limit, loads[:, 0] > 0.0
    candidates = []
    for k, readings in enumerate(strain.T):
        some = readings[inside[:, k]]
        for extreme in {float(some.max(initial=0.0)), float(some.min(initial=0.0))} - {0.0}:
            same = readings == extreme
            candidates.append((f"SG{k + 1} reads", extreme, same, readings[~same & inside[:, k] & loaded]))
    size = np.abs(strain)
    if largest := float(size[inside].max(initial=0.0)):
        same = size == largest
        others = size[inside & ~same & loaded[:, np.newaxis]]
        candidates.append(("several gauges read", largest, same.any(axis=1), others))
    for whose, extreme, same, others in candidates:
        usual = int(np.unique(others, return_counts=True)[1].max(initial=1))
        rows = np.flatnonzero(same)
        different = len(np.unique(loads[rows], axis=0)) > 1
        if loaded[rows].all() and len(rows) > usual and (different or len(rows) > 2):
            places, what = (rows, "rows") if lines is None else (lines[rows], "lines")
            shown = f"{', '.join(map(str, places[:5]))}{', ...' if len(places) > 5 else ''}"
            value = np.floor(abs(extreme) * 1e9) / 1e3  # below what the converter shows
            advice = (
                ": state it (saturation_strain), or inf if the readings have none" if lines is None else
                f". If it is, give --saturation {value:.10g}; if the readings have no limit, --saturation none"
            )  # fmt: skip
            raise InputError(
                f"{whose} exactly {extreme * 1e6:g} microstrain, the extreme, in {len(rows)} rows ({what} {shown}): "
                f"that is what a converter's limit looks like{advice}"
            )


LOSSES = ("huber", "soft_l1", "none")
LEAST, MOST = 1e-50, 1e50
"""Of loads, strains and noise in any unit: squares of their quotients stay in range."""


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """m rows of n gauges under known loads, in the order in which they were taken."""

    strain: FloatArray
    """(m, n), tension positive."""
    P_newtons: FloatArray
    """(m,), at least zero; 0 is an unloaded reading (tare)."""
    phi_rad: FloatArray
    """(m,): direction of the force on the tip."""
    theta_rad: FloatArray
    """(m,): angle of the contact on the tip."""
    t_s: FloatArray | None = None
    """(m,), not decreasing; needed for a drift only."""
    weight: FloatArray | None = None
    """(m,), above zero: how many readings a row is the mean of. Its gauge noise is Sigma_V / weight."""
    temperature_degC: FloatArray | None = None
    """(m,): of the sensor."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Prior of A: beam theory, for a calibration with few loads."""

    A: FloatArray
    """(n, 3), strain per newton."""
    relative_scatter: float = 0.1
    """Standard deviation of each entry, as a fraction of the root mean square entry of its gauge."""


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """How the readings are believed to have come about."""

    offset: bool = True
    """False: the readings are zero without a load (tared), and no offset is fitted."""
    drift: Literal["none", "tare", "linear"] = "none"
    """The offset over time: constant, interpolated between tares, or a straight line."""
    loss: Literal["huber", "soft_l1", "none"] = "huber"
    """How rows that disagree are treated; "none": least squares, outliers are named and kept."""
    temperature: bool = False
    """Fit how the offsets change with temperature; needs temperatures of the rows."""
    phi_scatter_rad: float = 0.0
    """Standard deviation of the direction of the load that all rows of a groove (equal phi and theta) have in common.
    It counts as six observed angles: the data say how large it is, and that of each row."""
    theta_scatter_rad: float = 0.0
    """The same of the place of the load."""
    noise_strain: float | FloatArray | None = None
    """Standard deviation of a gauge reading, if it is known (scalar or (n,)); None: estimated from the residuals."""
    saturation_strain: float | FloatArray | None = None
    """Converter limit (scalar or (n,)), readings at it are left out. inf: none. None: unknown, a repeated one is
    refused."""
    prior: Prior | None = None


def beam_prior(geometry: Geometry, gauges: Sequence[Gauge], relative_scatter: float = 0.1) -> Prior:
    """Return beam theory (Table 1) as prior; gauges as layout() returns them. Raises InputError as gauge_matrix()."""
    return Prior(gauge_matrix(geometry, gauges), relative_scatter)


def checked(readings: Readings, model: Model) -> Readings:
    """Return the readings as float arrays. Raises InputError naming the row (from 0), the value and what is allowed."""
    strain = floats("strain", readings.strain)
    if strain.ndim != 2 or not MIN_GAUGES <= strain.shape[1] <= MAX_GAUGES or not strain.size:
        raise InputError(
            f"strain has the shape {strain.shape}: allowed is (m, n), n = {MIN_GAUGES} to {MAX_GAUGES} gauges"
        )
    _check("strain", strain, np.isfinite(strain), "are finite numbers")
    _check("strain", strain, np.abs(strain) <= MOST, f"is {-MOST:g} to {MOST:g}")
    if not np.abs(strain).max() >= LEAST:
        raise InputError(f"strain: no reading reaches {LEAST:g}: the gauges are dead or disconnected")
    m, n = strain.shape
    P, phi, theta = (_column(name, getattr(readings, name), m) for name in ("P_newtons", "phi_rad", "theta_rad"))
    _check("P_newtons", P, P >= 0.0, "is 0 or more (turn phi by 180 degrees)")
    in_range = (P == 0.0) | ((P >= LEAST) & (P <= MOST))
    _check("P_newtons", P, in_range, f"is 0 (unloaded), or {LEAST:g} to {MOST:g} N")
    for name, angle in (("phi_rad", phi), ("theta_rad", theta)):
        _check(name, angle, np.abs(angle) <= 4.0 * np.pi, "is -4 pi to 4 pi; from degrees: np.radians()")
    if not (P > 0.0).any():
        raise InputError(f"all {m} rows are unloaded: add loads")
    t, weight, T = (
        None if (given := getattr(readings, name)) is None else _column(name, given, m)
        for name in ("t_s", "weight", "temperature_degC")
    )
    if t is not None and (np.diff(t) < 0.0).any():
        row = int(np.argmax(np.diff(t) < 0.0)) + 1
        raise InputError(
            f"t_s[{row}] = {t[row]:g} is before t_s[{row - 1}] = {t[row - 1]:g}: rows must be in time order"
        )
    if weight is not None:
        _check("weight", weight, (weight >= 1e-9) & (weight <= 1e9), "is 1e-09 to 1e+09")
    if T is not None:
        _check("temperature_degC", T, (T >= -273.15) & (T <= 1000.0), "is -273.15 to 1000")
    if model.temperature and T is None:
        raise InputError("a temperature coefficient needs the temperature of every row (column temperature_degC)")
    _check_model(model, n)
    require_no_rail(strain, np.stack((P, phi, theta), axis=-1), model.saturation_strain)
    return Readings(strain, P, phi, theta, t, weight, T)


def _check_model(model: Model, n: int) -> None:
    for name, value, allowed in (("drift", model.drift, DRIFTS), ("loss", model.loss, LOSSES)):
        if value not in allowed:
            raise InputError(f"{name} {value!r} is not known: allowed are {', '.join(allowed)}")
    if model.drift != "none" and not model.offset:
        raise InputError(f"drift {model.drift!r} needs an offset to drift: allowed with offset=False is 'none'")
    for name in ("phi_scatter_rad", "theta_scatter_rad"):
        if not 0.0 <= getattr(model, name) < 1.0:
            raise InputError(f"{name} = {getattr(model, name)!r}: allowed is 0 to 1 (small angles)")
    for name in ("noise_strain", "saturation_strain"):
        array = floats(name, 1.0 if getattr(model, name) is None else getattr(model, name))
        most = MOST if name == "noise_strain" else np.inf
        if array.shape not in {(), (n,)} or not ((array > 0.0) & (array <= most)).all():
            raise InputError(
                f"{name} = {array}: allowed is a number above 0, up to {most:g}, or one for each of the {n} gauges"
            )
    if model.prior is not None:
        _check_prior(model.prior, n)


def _check_prior(prior: Prior, n: int) -> None:
    A, share = floats("prior", prior.A), prior.relative_scatter
    if A.shape != (n, 3) or not (np.abs(A) <= MOST).all() or not A.any(axis=1).all():
        raise InputError(f"the prior has the shape {A.shape}: allowed is ({n}, 3), finite, no row of zeros")
    if not 1e-9 <= share <= 1e9:
        raise InputError(f"prior relative_scatter = {share!r}: allowed is 1e-9 to 1e9, as 0.1")


def _column(name: str, values: npt.ArrayLike, m: int) -> FloatArray:
    column = floats(name, values)
    if column.shape != (m,):
        raise InputError(f"{name} has the shape {column.shape}: allowed is ({m},), one for each row of strain")
    _check(name, column, np.isfinite(column), "are finite numbers")
    return column


def _check(name: str, values: FloatArray, allowed: BoolArray, words: str) -> None:
    if not allowed.all():
        place = np.argwhere(~allowed)[0].tolist()
        raise InputError(f"{name}{place} = {values[tuple(place)]:g}: allowed {words}")


STANDARD_GRAVITY = 9.80665
LIKE, UNLIKE = 0.95, 0.8
"""Cosine of the angle between rows of A, as measured and by theory: the same gauge, and another one."""
_SUSPECTS = {
    1e-6: "strain in SI units where microstrain is meant (multiply SG1.. by 1e6)",
    1e6: "microstrain given twice (multiply SG1.. by 1e-6)",
    1e-3: "strain in millistrain, or loads in millinewtons (a factor of 1000)",
    1e3: "strain in nanostrain, or loads in kilonewtons (a factor of 1000)",
    STANDARD_GRAVITY / 1000.0: "loads in grams (multiply P_N by 0.00980665)",
    STANDARD_GRAVITY: "loads in kilograms (multiply P_N by 9.80665)",
}
"""Response over theory -> what gives it."""


def require_degrees(readings: Readings) -> None:
    """Raise InputError where all directions of loads fit into a turn in radians: they were meant as degrees."""
    loaded = np.asarray(readings.P_newtons) > 0.0
    phi, theta = (np.degrees(np.asarray(values)[loaded]) for values in (readings.phi_rad, readings.theta_rad))
    if (np.abs(phi) <= 2.0 * np.pi).all() and (np.abs(theta) <= 2.0 * np.pi).all() and len(np.unique(theta)) > 2:
        raise InputError(
            f"theta_deg runs from {theta.min():.4g} to {theta.max():.4g}, phi_deg as little: those look like radians; "
            "allowed are degrees (multiply phi_deg and theta_deg by 57.29578)"
        )


def require_size(A: FloatArray, theory: FloatArray, allowed: float, whose: str) -> None:
    """Raise InputError where A (n, 3) is more than the factor ``allowed`` off theory, with the cause it suspects."""
    size = np.linalg.norm(A, axis=1) / np.linalg.norm(theory, axis=1)
    ratio = float(np.exp(np.median(np.log(size))))
    if 1.0 / allowed <= ratio <= allowed:
        return
    factor = min(_SUSPECTS, key=lambda one: abs(np.log(one / ratio)))
    near = abs(np.log(factor / ratio)) < np.log(3.0)
    words = _SUSPECTS[factor] if near else "another unit of strain or load, or another gauge factor"
    raise InputError(
        f"the gauges respond {ratio:.3g} times as much as beam theory says for {whose} (allowed {1.0 / allowed:.2g} to "
        f"{allowed:g}): suspected is {words}; for another structure give --layout FILE with its dimensions"
    )


def require_order(A: FloatArray, theory: FloatArray, layout: str) -> None:
    """Raise InputError where two gauges respond as theory says of each other, and not as it says of themselves."""
    unit = [rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (A, theory)]
    like = np.abs(unit[0] @ unit[1].T)
    for i in range(len(A)):
        for k in range(i + 1, len(A)):
            if min(like[i, k], like[k, i]) > LIKE and max(like[i, i], like[k, k]) < UNLIKE:
                raise InputError(
                    f"SG{i + 1} and SG{k + 1} look swapped: each responds as beam theory says of the other in {layout} "
                    f"(cosine {like[i, k]:.2f} and {like[k, i]:.2f}, of its own place {like[i, i]:.2f} and "
                    f"{like[k, k]:.2f}): exchange their columns, or give --layout in the order of the columns"
                )
