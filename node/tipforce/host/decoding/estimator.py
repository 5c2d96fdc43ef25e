"""Contact, standard uncertainties and status of gauge readings, by a calibration that is prepared once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, overload

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray, floats
from tipforce.errors import InputError
from tipforce.fingertip.judgement import RELEASE, Judgement
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.measurements import LARGEST_MICROSTRAIN
from tipforce.host.decoding import judged
from tipforce.host.decoding.judged import Judge, Judged, Readings
from tipforce.samples import reasons
from tipforce.samples.contact import Contact
from tipforce.samples.reasons import Status
from tipforce.sensor.contact import estimate as model
from tipforce.sensor.contact import scalar, scalar_uncertainty, validity

if TYPE_CHECKING:
    Force = tuple[float, float, float]
    Values = tuple[float, float, float, float, float, float]

FEW = 24
"""Readings that one by one, in pure Python, cost less than the constant cost of operations on columns."""
BLOCK = 4096
"""Samples at a time: their columns stay in the processor's cache."""
_UNKNOWN = np.array([scalar.unknown(status | scalar.CALIBRATED) for status in range(256)], dtype=np.uint8)
"""What a status byte makes unknown."""
_FLAGS = (
    (scalar.SATURATED, reasons.LEFT_OUT | reasons.OVERLOAD),
    (scalar.FRONT_END_FAULT, reasons.CONTRADICTION | reasons.FROZEN),
)
"""Bits of ``Status`` that a node would set, and why."""
_FLAGGED = sum(why for _, why in _FLAGS)
_NO_PHI, _NO_THETA = scalar.UNKNOWN_PHI, scalar.UNKNOWN_THETA
_NO_FORCE, _NOTHING = (scalar.NAN,) * 3, (scalar.NAN,) * 6


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """k samples of one finger; NaN stands for unknown. Uncertainties are standard uncertainties (1 sigma)."""

    P_newtons: FloatArray
    """(k,) force magnitude."""
    phi_deg: FloatArray
    """(k,) force direction, (-180, 180]."""
    theta_deg: FloatArray
    """(k,) contact angle."""
    u_P_newtons: FloatArray
    u_phi_deg: FloatArray
    u_theta_deg: FloatArray
    status: npt.NDArray[np.integer[Any]]
    """(k,) bits of ``Status``, uint16."""

    def __len__(self) -> int:
        return len(self.status)

    @staticmethod
    def empty(k: int) -> Contacts:
        """Room for k samples: ``out`` of an ``Estimator``."""
        P, phi, theta, u_P, u_phi, u_theta = (np.empty(k) for _ in range(6))
        return Contacts(P, phi, theta, u_P, u_phi, u_theta, np.empty(k, dtype=np.uint16))

    @property
    def values(self) -> FloatArray:
        """(k, 6) the values and their uncertainties, in this order."""
        return np.stack([getattr(self, name) for name in Contacts.__slots__[:6]], axis=-1)

    def has(self, status: Status) -> npt.NDArray[np.bool_]:
        """(k,) the samples with any of these bits."""
        has_bit: npt.NDArray[np.bool_] = (self.status & np.uint16(status)) != 0
        return has_bit


class Before(NamedTuple):
    """What the sample before leaves for its successor."""

    present: bool = False
    overloaded: bool = False


class Estimator:
    """A calibration prepared for many readings: a call does arithmetic only, of up to ``FEW`` readings in pure Python.
    Sources: equations (1) and (16) of the paper; docs/uncertainty.md."""

    def __init__(self, calibration: Calibration, *, uncertainty: bool = True) -> None:
        """``uncertainty`` False: u_P, u_phi and u_theta are NaN, and BEYOND_FIRST_ORDER, which judges them, is not set.
        Raises InputError for contact limits that are not in order."""
        self.judge = Judge(calibration)
        self.gauges = calibration.gauges
        self._calibration, self._uncertainty = calibration, uncertainty
        self._active = active = self.judge.active
        validity.check_limits(active.limits)
        self._limits = [limit or np.inf for limit in active.converter or ()]
        calibrated, overload = active.forces
        self._unranged = 0 if calibrated > 0.0 else reasons.UNRANGED
        self._calibrated_newtons = calibrated if calibrated > 0.0 else np.inf
        self._overload_newtons = overload if overload > 0.0 else np.inf
        self._release_newtons = RELEASE * self._overload_newtons
        # Microstrain of each gauge beyond which no structure survives; without use where the overload is known.
        limit = judged.LARGEST_STRAIN
        offsets = [] if overload > 0.0 else active.offsets
        self._bounds = [(1e6 * (offset - limit), 1e6 * (offset + limit)) for offset in offsets]
        self._has_own = calibration.parameter_covariance is not None
        ranged, redundant = any(active.range_degC), self.gauges > 3 and active.redundancy > 0.0
        self._is_judged = self._has_own or active.model > 0.0 or active.compensated or ranged or redundant
        solver = active.without(0)[0]
        assert solver is not None
        self._K, self._scaled_K = solver[1], scalar_uncertainty.scaled_covariance(solver[1])
        self._status_of: dict[int, Status] = {}

    @overload
    def __call__(
        self, microstrain: Sequence[float], *, temperature_degC: float | None = None, lost: int = 0,
        was_present: bool = False, was_overloaded: bool = False,
    ) -> Contact: ...  # fmt: skip

    @overload
    def __call__(
        self, microstrain: Sequence[Sequence[float]], *,
        temperature_degC: npt.ArrayLike | None = None, lost: npt.ArrayLike = 0,
        was_present: bool = False, was_overloaded: bool = False, out: Contacts | None = None,
    ) -> Contacts: ...  # fmt: skip

    @overload
    def __call__(  # a Contact or Contacts, by the shape
        self, microstrain: npt.NDArray[Any], *,
        temperature_degC: npt.ArrayLike | None = None, lost: npt.ArrayLike = 0,
        was_present: bool = False, was_overloaded: bool = False, out: Contacts | None = None,
    ) -> Any: ...  # fmt: skip

    def __call__(
        self, microstrain: npt.ArrayLike, *, temperature_degC: npt.ArrayLike | None = None, lost: npt.ArrayLike = 0,
        was_present: bool = False, was_overloaded: bool = False, out: Contacts | None = None,
    ) -> Contact | Contacts:  # fmt: skip
        """Return the ``Contact`` of one reading (n,), or the ``Contacts`` of k readings (k, n), microstrain.

        ``temperature_degC``: one or (k,), NaN or None: not known; ``lost``: bits of failed gauges, one or (k,);
        ``was_...``: of the sample before; ``out``: filled and returned. What is not finite or over 1e6 microstrain
        makes all unknown; in a table a gauge that stands still too long is lost. Raises InputError for other shapes and
        types."""
        n = self.gauges
        if type(microstrain) in {list, tuple} and set(map(type, microstrain)) == {float}:  # type: ignore[arg-type]
            row: Sequence[float] | None = microstrain  # type: ignore[assignment]
        else:
            readings = floats("microstrain", microstrain)
            row = readings.tolist() if readings.ndim == 1 else None
        if row is not None and len(row) == n and out is None:
            degC = scalar.NAN if temperature_degC is None else temperature_degC
            if type(degC) is not float:
                degC = float(_numbers("temperature_degC", degC, ()))
            bits = lost if isinstance(lost, int) else int(_numbers("lost", lost, ()))
            faults, values = self._one(row, degC, bits, was_present, was_overloaded)
            status = _shown(faults)
            if status not in self._status_of:
                self._status_of[status] = Status(status)
            return Contact(0, scalar.NAN, -1, *values, self._status_of[status], tuple(row))
        if row is not None or readings.shape[1:] != (n,):
            raise InputError(f"microstrain has the shape {np.shape(microstrain)}: allowed are (k, {n}) and ({n},)")
        shape, before = (len(readings),), Before(was_present, was_overloaded)
        degC = _numbers("temperature_degC", scalar.NAN if temperature_degC is None else temperature_degC, shape)
        left = _numbers("lost", lost, shape)
        if len(readings) <= FEW:
            return self.few(readings, degC, left, before, out)[0]
        strain = np.where(np.abs(readings) <= LARGEST_MICROSTRAIN, readings, np.nan) * 1e-6
        frozen = judged.frozen_gauges(self._calibration, strain)
        return self.table(Readings(strain, None if temperature_degC is None else degC, left, frozen), before, out)[0]

    def few(
        self, microstrain: FloatArray, temperature_degC: FloatArray, lost: IntArray, before: Before,
        out: Contacts | None = None,
    ) -> tuple[Contacts, Before]:  # fmt: skip
        """Return the contacts of up to ``FEW`` readings (k, n), and what the last one leaves for its successor."""
        contacts, (was_present, was_overloaded) = _room(out, lost.shape), before
        columns = [getattr(contacts, name) for name in Contacts.__slots__]
        given = zip(microstrain.tolist(), temperature_degC.tolist(), lost.tolist(), strict=True)
        for k, reading in enumerate(given):
            faults, values = self._one(*reading, was_present, was_overloaded)
            for column, value in zip(columns, (*values, _shown(faults)), strict=True):
                column[k] = value
            if not faults & reasons.NO_ESTIMATE:
                was_present = bool(faults & scalar.CONTACT_PRESENT)
            was_overloaded = bool(faults & reasons.OVERLOAD)
        return contacts, Before(was_present, was_overloaded)

    def table(self, given: Readings, before: Before, out: Contacts | None = None) -> tuple[Contacts, Before]:
        """Return the same of any number of readings, with the status as a node would give it."""
        contacts, status, after = self.rows(given, before, out)
        for flag, why in _FLAGS:
            status |= np.where(status & why, flag, 0)
        contacts.status[:] = (status | scalar.CALIBRATED) & 0xFFFF
        return contacts, after

    def rows(self, given: Readings, before: Before, out: Contacts | None = None) -> tuple[Contacts, IntArray, Before]:
        """Return the contacts of readings, their status, and what the last one leaves for its successor. The status
        (k,) says by ``reasons.FROZEN``, ``TARE``, ``LEFT_OUT``, ... why a value is unknown or doubtful."""
        k = len(given.strain)
        contacts, status = _room(out, (k,)), np.zeros(k, dtype=np.int64)
        columns = [getattr(contacts, name) for name in Contacts.__slots__[:6]]
        for start in range(0, k, BLOCK):
            rows = slice(start, start + BLOCK)
            values, status[rows] = self._block(given.part(rows), before)
            for column, value in zip(columns, values, strict=True):
                column[rows] = value
            counted = status[rows][(status[rows] & reasons.NO_ESTIMATE) == 0]  # a row without a force changes nothing
            present = bool(counted[-1] & scalar.CONTACT_PRESENT) if len(counted) else before.present
            before = Before(present, bool(status[rows][-1] & reasons.OVERLOAD))
        return contacts, status, before

    @np.errstate(over="ignore")  # an uncertainty that no double has is infinite, as in pure Python
    def _block(self, given: Readings, before: Before) -> tuple[list[FloatArray], IntArray]:
        """([P, phi, theta, u_P, u_phi, u_theta], status) of some rows."""
        if self._limits:
            with np.errstate(invalid="ignore"):
                reached = (np.abs(given.strain) >= self._limits) @ (1 << np.arange(len(self._limits)))
            given = given._replace(lost=reached if given.lost is None else reached | given.lost)
        verdict = self.judge.judge(given, before.overloaded)
        F, K = model.forces(*verdict.F_newtons), model.covariances(verdict.covariance)
        sense = np.where(self._active.pull if given.pull is None else given.pull, 1.0, -1.0)
        contact = model.contact_columns(F, sense)
        status = judged.status_before_contact(verdict, given)
        counts = (status & reasons.NO_ESTIMATE) == 0
        misses = np.zeros(len(status), dtype=np.bool_)
        rows = np.flatnonzero(contact.miss_newtons > 0.0)
        if len(rows):
            noise = scalar.MISS_COVERAGE_FACTOR * model.miss_deviation(F.take(rows), K.take(rows))
            misses[rows] = contact.miss_newtons[rows] > noise + scalar.MISS_FLOOR * contact.P_newtons[rows]
        u = model.deviation_columns(F, K, sense) if self._uncertainty else None
        resolved = self._resolved(verdict, contact, F, K, sense) if u is None else validity.is_resolved(u.P, u.theta)
        bits = validity.status_columns(contact, resolved, misses, self._active.limits, before.present, counts)
        status |= np.where(counts, bits | self._unranged, 0)
        values = [contact.P_newtons, contact.phi_rad * scalar.DEGREES, contact.theta_rad * scalar.DEGREES]
        if u is not None:
            values += [u.P, u.phi * scalar.DEGREES, u.theta * scalar.DEGREES]
        unknown = np.where(counts, _UNKNOWN[status & 0xFF], np.uint8(0xFF))
        if unknown.any():
            hidden = [(unknown & bit) != 0 for bit in (scalar.UNKNOWN_FORCE, _NO_PHI, _NO_THETA)]
            values = [np.where(of, np.nan, value) for of, value in zip(hidden * 2, values, strict=False)]
        if u is None:
            return values + [np.full(len(status), np.nan)] * 3, status
        beyond = np.zeros(len(status), dtype=np.bool_)
        for shown, bend in zip(values[3:], validity.curvature_columns(F, contact.P_newtons, u), strict=True):
            beyond |= np.isfinite(shown) & ~(bend <= validity.CURVATURE_LIMIT)
        status |= np.where(beyond, reasons.BEYOND_FIRST_ORDER, 0)
        return values, status

    def _resolved(
        self, verdict: Judged, contact: model.Contact, F: model.Forces, K: model.Covariance, sense: FloatArray
    ) -> BoolArray:
        """Whether theta is; as on the node, few contacts need their uncertainty for that (scalar.clearly_resolved)."""
        P, trace = contact.P_newtons, verdict.covariance[0] + verdict.covariance[3] + verdict.covariance[5]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u = np.sqrt(trace) / P
            end = np.abs(verdict.F_newtons[1]) / P + scalar.ROOT_2 * u
            bound = u * (1.0 + scalar.ROOT_2 / np.sqrt(1.0 - end * end))
        resolved: BoolArray = (trace > scalar.SMALLEST_STEP) & (end < 1.0) & (bound < scalar.CLEARLY_RESOLVED)
        rows = np.flatnonzero(~resolved & (self._active.limits[1] <= P))
        if len(rows):
            of_rows = model.deviation_columns(F.take(rows), K.take(rows), sense[rows] if sense.ndim else sense)
            resolved[rows] = validity.is_resolved(of_rows.P, of_rows.theta)
        return resolved

    def _one(
        self, microstrain: Sequence[float], degC: float, lost: int, was_present: bool, was_overloaded: bool
    ) -> tuple[int, Values]:
        most, active = LARGEST_MICROSTRAIN, self._active
        readings = [value if -most <= value <= most else scalar.NAN for value in microstrain]
        for k, limit in enumerate(self._limits):
            if abs(1e-6 * readings[k]) >= limit:
                lost |= 1 << k
        K, scaled_K, status = self._K, self._scaled_K, 0
        if lost or self._is_judged:
            F, K, status = self._judged_force(readings, degC, lost, was_overloaded)
            scaled_K = scalar_uncertainty.scaled_covariance(K)
        else:
            F = active.force(active.C, readings)
            for value, (low, high) in zip(readings, self._bounds):  # noqa: B905 - none where 2112h:2 is known
                if value < low or value > high:
                    status |= reasons.OVERLOAD
        return self._values(F, K, scaled_K, status, was_present, was_overloaded)

    def _judged_force(
        self, readings: list[float], degC: float, lost: int, was_overloaded: bool
    ) -> tuple[Force, Values, int]:
        """(force, covariance, status before any contact is known), by the node's own code."""
        if lost:  # a gauge left out may read anything
            readings = [0.0 if lost >> k & 1 else value for k, value in enumerate(readings)]
        judgement = Judgement(self._active, readings, lost, degC, was_overloaded)
        left, faults = lost | judgement.left_out, judgement.bits
        F, K = judgement.force or _NO_FORCE, judgement.covariance()
        if self._has_own and judgement.force is not None:
            own = self.judge.of_parameters(left, *F)
            K = K[0] + own[0], K[1] + own[1], K[2] + own[2], K[3] + own[3], K[4] + own[4], K[5] + own[5]
        if self._bounds:
            for k, strain in enumerate(judgement.strains):
                if abs(strain) > judged.LARGEST_STRAIN and not left >> k & 1:
                    faults |= reasons.OVERLOAD
        status = faults & (reasons.BEYOND_CALIBRATED | reasons.TEMPERATURE | reasons.OVERLOAD)
        F1, F2, F3 = F
        if (F1 - F1) + (F2 - F2) + (F3 - F3) != 0.0:  # NaN or infinity
            status |= faults & reasons.CONTRADICTION or (scalar.SATURATED if lost else 0)
        elif left:
            status |= reasons.LEFT_OUT
        return F, K, status

    def _values(
        self, F: Force, K: Values, scaled_K: scalar_uncertainty.ScaledCovariance | None, status: int, was_present: bool,
        was_overloaded: bool,
    ) -> tuple[int, Values]:  # fmt: skip
        (F1, F2, F3), pull, limits = F, self._active.pull, self._active.limits
        force = scalar.scaled_force(F1, F2, F3)
        P, phi, theta, miss = scalar.contact_of(force, pull)
        if self._calibrated_newtons < P:
            status |= reasons.BEYOND_CALIBRATED
        if self._release_newtons < P and (was_overloaded or self._overload_newtons < P):
            status |= reasons.OVERLOAD
        if status & reasons.NO_ESTIMATE:
            return status, _NOTHING
        status |= self._unranged
        u_P = u_phi = u_theta = u_sine = cosine = 0.0
        if self._uncertainty or not (limits[1] <= P and scalar.clearly_resolved(P, F2, K)):
            u_P, u_phi, u_theta, u_sine, cosine = scalar_uncertainty.deviations(force, scaled_K, pull)
        u_miss = scalar_uncertainty.miss_uncertainty(F1, F2, F3, K) if miss > 0.0 else 0.0
        status |= scalar.status_bits(P, u_P, u_theta, miss, u_miss, theta, limits, was_present)
        unknown = scalar.unknown(status & 0xFF | scalar.CALIBRATED)
        if self._uncertainty:
            if u_P - u_P == 0.0 and not _first_order_holds(P, u_P, u_phi, u_sine, cosine, not unknown & _NO_PHI):
                status |= reasons.BEYOND_FIRST_ORDER
        else:
            u_P = u_phi = u_theta = scalar.NAN
        phi, theta = phi * scalar.DEGREES, theta * scalar.DEGREES
        u_phi, u_theta = u_phi * scalar.DEGREES, u_theta * scalar.DEGREES
        if unknown:
            if unknown & _NO_PHI:
                phi = u_phi = scalar.NAN
            if unknown & _NO_THETA:
                theta = u_theta = scalar.NAN
        return status, (P, phi, theta, u_P, u_phi, u_theta)


def _first_order_holds(P: float, u_P: float, u_phi: float, u_sine: float, cosine: float, phi_known: bool) -> bool:
    """Whether curvature() of what is known is small, as validity.curvature_columns()."""
    infinity, limit = float("inf"), validity.CURVATURE_LIMIT
    bias = u_phi * u_phi * P / u_P if u_P > 0.0 else 0.0 if u_phi == 0.0 else infinity
    squared = cosine * cosine
    bend = 0.0 if not u_sine > 0.0 else u_sine / squared if squared > 0.0 else infinity
    return bias <= limit and bend <= limit and (not phi_known or u_P / P <= limit)


prepared = lru_cache(maxsize=32)(Estimator)  # of the last calibrations: those of a hand's fingers, row after row


def estimate(
    calibration: Calibration, microstrain: npt.ArrayLike, *, temperature_degC: npt.ArrayLike | None = None,
    lost: npt.ArrayLike | None = None, was_present: bool = False,
) -> Contacts:  # fmt: skip
    """Contact, standard uncertainties and status of readings, as `tipforce estimate`. microstrain: (k, n) in time
    order, or (n,); the rest, and the errors, as of an ``Estimator``, to be prepared for many calls."""
    readings, bits = np.atleast_2d(floats("microstrain", microstrain)), 0 if lost is None else lost
    estimator = prepared(calibration)
    contacts: Contacts = estimator(readings, temperature_degC=temperature_degC, lost=bits, was_present=was_present)
    return contacts


def _room(out: Contacts | None, shape: tuple[int, ...]) -> Contacts:
    contacts = Contacts.empty(*shape) if out is None else out
    columns: list[Any] = [getattr(contacts, name, None) for name in Contacts.__slots__]
    whole = all(isinstance(of, np.ndarray) and of.shape == shape and of.flags.writeable for of in columns)
    if not whole or any(of.dtype.kind != "f" for of in columns[:6]) or not np.can_cast("u2", columns[6].dtype):
        raise InputError(f"out: allowed is Contacts.empty({shape[0]})")
    return contacts


def _shown(status: int) -> int:
    """The status as a node would give it, without bits above 16."""
    status |= scalar.CALIBRATED
    if status & _FLAGGED:
        for flag, why in _FLAGS:
            if status & why:
                status |= flag
    return status & 0xFFFF


def _numbers(name: str, given: npt.ArrayLike, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    values = np.asarray(given) if name == "lost" else floats(name, given)
    if values.shape not in {(), shape}:
        allowed = f"are one number and {shape}" if shape else "is one number"
        raise InputError(f"{name} has the shape {values.shape}: allowed {allowed}")
    if name == "lost" and not np.issubdtype(values.dtype, np.integer):
        raise InputError(f"lost has the type {values.dtype}: allowed are integers, bits of gauges")
    return np.broadcast_to(values.astype(np.int64) if name == "lost" else values, shape)
