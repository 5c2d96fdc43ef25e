"""Contacts of one finger as named values: one sample, or arrays of samples, each with uncertainty and status."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.dictionary import table
from tipforce.dictionary.table import STATUS_BITS
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding import status_words
from tipforce.sensor.contact import estimate, scalar
from tipforce.sensor.contact.force import force_vector

FloatArray = npt.NDArray[np.float64]
_NAN = float("nan")


class Status(enum.IntFlag):
    """The status byte of a sample (2120h); bits 12 to 15 are those of 2124h, as far as they could be seen.

    Bit 8: the finger did not answer; bit 9: see ``first_order_holds``; bit 10: the force does without a gauge;
    bit 11: the calibration states no force range.
    """

    CONTACT = scalar.CONTACT_PRESENT
    CALIBRATED = scalar.CALIBRATED
    SATURATED = scalar.SATURATED
    STALE = scalar.STALE
    THETA_UNRESOLVED = scalar.THETA_UNRESOLVED
    MISSES_TIP = scalar.MISSES_TIP
    OUTSIDE_PAD = scalar.OUTSIDE_PAD
    FAULT = scalar.FRONT_END_FAULT
    NO_ANSWER = status_words.NO_ANSWER
    BEYOND_FIRST_ORDER = status_words.BEYOND_FIRST_ORDER
    LEFT_OUT = status_words.LEFT_OUT
    UNRANGED = status_words.UNRANGED
    CONTRADICTION = status_words.CONTRADICTION
    BEYOND_CALIBRATED = status_words.BEYOND_CALIBRATED
    TEMPERATURE = status_words.TEMPERATURE
    OVERLOAD = status_words.OVERLOAD


@dataclass(frozen=True, slots=True)
class Contact:
    """One sample of one finger. NaN stands for unknown; ``reason`` says why.

    ``u_...`` are standard uncertainties (1 sigma) from the gauge noise of the calibration, NaN where no calibration is
    known.
    """

    node_id: int
    t_s: float
    """Time of reception, seconds of the epoch."""
    counter: int
    """Sample counter (2121h), -1 where there is none."""
    P_newtons: float
    """Force magnitude."""
    phi_deg: float
    """Force direction, (-180, 180]."""
    theta_deg: float
    """Contact angle."""
    u_P_newtons: float
    u_phi_deg: float
    u_theta_deg: float
    status: Status
    microstrain: tuple[float, ...] = ()
    """Gauge strain, one value per gauge; empty where the finger does not send it."""
    name: str = ""
    """Name of the finger in its hand file."""
    missing: str = ""
    """Why there is no sample, where ``status`` is NO_ANSWER for another reason than that none came."""

    @property
    def present(self) -> bool:
        """Whether the finger touches something: P is over the contact threshold (2110h:4, 5)."""
        return Status.CONTACT in self.status

    @property
    def reason(self) -> str:
        """Why a value is unknown or doubtful, in words; "" where P, phi and theta are known and nothing is flagged."""
        if self.missing:
            return self.missing
        status, force_known = int(self.status), not math.isnan(self.P_newtons)
        found = status_words.why_no_force(status & ~scalar.SATURATED if force_known else status)
        if found:
            return ", ".join(found)
        if not force_known:
            return status_words.UNKNOWN_TO_THE_NODE
        found = status_words.doubts(status)
        if not self.present:
            found.insert(0, status_words.why_no_angle(status))
        elif not found and math.isnan(self.phi_deg + self.theta_deg):
            found.append(status_words.UNKNOWN_TO_THE_NODE)
        return ", ".join(found)

    @property
    def ok(self) -> bool:
        """Whether P, phi and theta are known and nothing is flagged."""
        return not self.reason

    @property
    def F_newtons(self) -> tuple[float, float, float]:
        """F1 = P sin(phi), F2 = P sin(phi - theta), F3 = P cos(phi): equation (16) of the paper; NaN where unknown."""
        phi, delta = math.radians(self.phi_deg), math.radians(self.phi_deg - self.theta_deg)
        return self.P_newtons * math.sin(phi), self.P_newtons * math.sin(delta), self.P_newtons * math.cos(phi)

    def __str__(self) -> str:
        """For people: ``4.40 N, phi 90.0, theta 45.0 degrees`` and what is flagged."""
        values = f"{self.P_newtons:.3f} N, phi {self.phi_deg:.2f} deg, theta {self.theta_deg:.2f} deg"
        return f"{values} ({self.reason})" if self.reason else values


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
    status: npt.NDArray[np.uint16]
    """(k,) bits of ``Status``."""

    def __len__(self) -> int:
        return len(self.status)

    def has(self, status: Status) -> npt.NDArray[np.bool_]:
        """(k,) the samples with any of these bits."""
        found: npt.NDArray[np.bool_] = (self.status & np.uint16(status)) != 0
        return found


def no_answer(node_id: int, t_s: float, name: str = "", missing: str = "") -> Contact:
    """The contact of a finger that did not answer, or whose answer is not shown; ``missing`` says why."""
    unknown = (_NAN,) * 6
    return Contact(node_id, t_s, -1, *unknown, Status.NO_ANSWER, name=name, missing=missing)


def status_of(columns: Mapping[str, npt.NDArray[Any]], shape: tuple[int, ...]) -> npt.NDArray[np.uint16]:
    """The status byte, and bits 12 to 15 of 2124h, from the columns of their bits; ``shape`` is that of each column."""
    status = np.zeros(shape, dtype=np.uint16)
    for number, name, _ in table.FAULT_BITS:
        if 1 << number & status_words.JUDGED and f"fault_{name}" in columns:
            status |= (columns[f"fault_{name}"] == 1).astype(np.uint16) << np.uint16(number)
    for bit, (name, _) in enumerate(STATUS_BITS):
        if name in columns:
            status |= (columns[name] == 1).astype(np.uint16) << np.uint16(bit)
    return status


def contact_values(
    columns: Mapping[str, npt.NDArray[Any]],
    strain: FloatArray,
    status: npt.NDArray[np.uint16],
    calibration: Calibration | None,
) -> FloatArray:
    """P in newtons, phi and theta in degrees, (k, 3), of k samples of one finger; NaN where unknown.

    As the node sent them where ``columns`` has P, phi and theta; else from F1, F2, F3; else from ``strain`` (k, n),
    strain, and the calibration, without the gauges that the node left out. What ``status`` (k,) makes unknown is NaN as
    on the node (scalar.unknown).
    """
    if columns.keys() >= {"P", "phi", "theta"}:
        return np.stack([columns[name] for name in ("P", "phi", "theta")], axis=-1).astype(np.float64)
    pull = calibration is not None and calibration.pull
    if columns.keys() >= {"F1", "F2", "F3"}:
        F = np.stack([columns[name] for name in ("F1", "F2", "F3")], axis=-1)
        found = estimate.contacts(F, pull=pull)
    elif calibration is not None and calibration.gauges == strain.shape[-1] > table.MIN_GAUGES:
        return _redundant(columns, strain, status, calibration)
    elif calibration is not None and calibration.gauges == strain.shape[-1]:
        _, found = estimate.estimate(calibration.C, strain, calibration.offset_strain, pull=pull)
    else:  # a mapping may have P alone
        unknown = np.full(len(status), np.nan)
        return np.stack([columns.get(name, unknown) for name in ("P", "phi", "theta")], axis=-1).astype(np.float64)
    values = np.stack([found.P_newtons, np.degrees(found.phi_rad), np.degrees(found.theta_rad)], axis=-1)
    for value in np.unique(status).tolist():
        lost = 0xFF if value & Status.NO_ANSWER else scalar.unknown(value & 0xFF, columns.keys() >= {"F1", "F2", "F3"})
        at = status == value
        for k, bit in enumerate((scalar.UNKNOWN_FORCE, scalar.UNKNOWN_PHI, scalar.UNKNOWN_THETA)):
            if lost & bit:
                values[at, k] = np.nan
    return values


def _redundant(
    columns: Mapping[str, npt.NDArray[Any]],
    strain: FloatArray,
    status: npt.NDArray[np.uint16],
    calibration: Calibration,
) -> FloatArray:
    """The values of more than three gauges, judged here: one that is left out must not count."""
    from tipforce.host.decoding.estimates import estimate as judged_estimate  # it builds on this module
    from tipforce.host.decoding.health import lost_gauges
    from tipforce.host.decoding.judged import at_end

    values = np.full((len(status), 3), np.nan)
    hidden = np.uint16(Status.NO_ANSWER | Status.STALE | Status.FAULT)
    rows = np.flatnonzero((status & hidden == 0) & (status & np.uint16(Status.CALIBRATED) != 0))
    if not len(rows):
        return values
    microstrain = 1e6 * strain[rows]
    lost = lost_gauges(columns, strain.shape)[rows] | at_end(microstrain)
    present = bool(status[rows[0]] & Status.CONTACT)
    found = judged_estimate(calibration, microstrain, lost=lost, was_present=present)
    values[rows] = np.stack([found.P_newtons, found.phi_deg, found.theta_deg], axis=-1)
    # The node left a gauge out and nothing says which.
    values[rows[(status[rows] & np.uint16(Status.SATURATED) != 0) & ~found.has(Status.SATURATED)]] = np.nan
    return values


def uncertainties(contact: FloatArray, calibrations: Sequence[Calibration | None]) -> FloatArray:
    """Standard uncertainties (m, k, 3) of contacts (m, k, 3) of k fingers, in newtons and degrees, from gauge noise.

    NaN for a finger without a calibration, and for what is unknown itself.
    """
    u = np.full(contact.shape, np.nan)
    for pull in (False, True):
        chosen = [k for k, one in enumerate(calibrations) if one is not None and one.pull == pull]
        if not chosen:
            continue
        P, phi, theta = np.moveaxis(contact[:, chosen], -1, 0)
        # F2 has no effect on u(P) and u(phi): where theta is unknown any contact point on the line will do.
        phi_rad = np.radians(phi)
        F = force_vector(P, phi_rad, np.where(np.isnan(theta), phi_rad, np.radians(theta)))
        covariances = np.stack([one.covariance_F for one in calibrations if one is not None and one.pull == pull])
        found = estimate.standard_uncertainties(F, np.broadcast_to(covariances, (*F.shape, 3)), pull=pull)
        found[..., 1:] *= 180.0 / np.pi
        # Without contact there is no direction: take the worst one.
        in_plane = covariances[:, ::2, ::2]
        worst = np.sqrt(np.maximum(np.linalg.eigvalsh(in_plane)[:, -1], 0.0))
        found[..., 0] = np.where(np.isnan(phi) & ~np.isnan(P), worst, found[..., 0])
        u[:, chosen] = found
    u[np.isnan(contact)] = np.nan
    return u
