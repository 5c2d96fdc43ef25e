"""From rows of a hand to blocks of contacts with their uncertainty: vectorised over rows and fingers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.dictionary.table import STATUS_BITS
from tipforce.host.hand.rows import Rows
from tipforce.sensor.contact import estimate as contact_model
from tipforce.sensor.contact.force import force_vector
from tipforce_tools.view.fingers import Finger

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]

CONTACT, CALIBRATED, SATURATED, REPEATED = 1, 2, 4, 8
THETA_UNRESOLVED, MISSES_TIP, OUTSIDE_PAD, FAULT = 16, 32, 64, 128
MISSING = 256
"""In ``status``, beside the bits of the status byte (2120h): the finger did not answer."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """m rows of k fingers with n gauges."""

    t_ns: npt.NDArray[np.int64]
    """(m,) time of each SYNC."""
    contact: Float32Array
    """(m, k, 3) P in newtons, phi and theta in degrees; NaN where unknown."""
    u: Float32Array
    """(m, k, 3) standard uncertainty of each, in the same units; NaN where unknown."""
    gauges: Float32Array
    """(m, k, n) strain in microstrain; NaN where unknown or not sent."""
    status: npt.NDArray[np.uint16]
    """(m, k)"""

    def __len__(self) -> int:
        return len(self.t_ns)


def block_of_rows(rows: Rows, fingers: Sequence[Finger], gauges: int, health_u_P: FloatArray | None = None) -> Block:
    """Rows, whose columns are those of ``fingers``, as a block.

    Without the contact PDO the contact comes from forces, or from gauges and the finger's calibration. ``health_u_P``
    (m, k) stands in for u(P) where no calibration is known.
    """
    shape = rows.counter.shape
    status = np.where(rows.missing, MISSING, 0).astype(np.uint16)
    for bit, (name, _) in enumerate(STATUS_BITS):
        if name in rows.columns:
            status |= rows.columns[name].astype(np.uint16) << np.uint16(bit)
    strains = np.full((*shape, gauges), np.nan)
    for k in range(gauges):
        if f"SG{k + 1}" in rows.columns:
            strains[..., k] = rows.columns[f"SG{k + 1}"]
    contact = _contact(rows, fingers, strains, status)
    u = uncertainties(contact, fingers)
    if health_u_P is not None:
        u[..., 0] = np.where(np.isnan(u[..., 0]) & ~np.isnan(contact[..., 0]), health_u_P, u[..., 0])
    return Block(rows.sync_ns, contact.astype(np.float32), u.astype(np.float32), strains.astype(np.float32), status)


def uncertainties(contact: FloatArray, fingers: Sequence[Finger]) -> FloatArray:
    """Standard uncertainties (m, k, 3) of contacts (m, k, 3), N and degrees, from the calibrations' gauge noise.

    NaN for a finger without a calibration, and for what is unknown itself.
    """
    u = np.full(contact.shape, np.nan)
    for pull in (False, True):
        chosen = [k for k, f in enumerate(fingers) if f.calibration is not None and f.calibration.pull == pull]
        if not chosen:
            continue
        P, phi, theta = np.moveaxis(contact[:, chosen], -1, 0)
        # Of P and phi, F2 changes nothing: where theta is unknown any contact point on the line will do.
        phi_rad = np.radians(phi)
        F = force_vector(P, phi_rad, np.where(np.isnan(theta), phi_rad, np.radians(theta)))
        covariances = np.stack([_covariance(fingers[k]) for k in chosen])
        found = contact_model.standard_uncertainties(F, np.broadcast_to(covariances, (*F.shape, 3)), pull=pull)
        found[..., 1:] *= 180.0 / np.pi
        # Without contact there is no direction: the worst one then.
        in_plane = covariances[:, ::2, ::2]
        worst = np.sqrt(np.maximum(np.linalg.eigvalsh(in_plane)[:, -1], 0.0))
        found[..., 0] = np.where(np.isnan(phi) & ~np.isnan(P), worst, found[..., 0])
        u[:, chosen] = found
    u[np.isnan(contact)] = np.nan
    return u


def _covariance(finger: Finger) -> FloatArray:
    assert finger.calibration is not None
    return finger.calibration.covariance_F


def _contact(rows: Rows, fingers: Sequence[Finger], strains: FloatArray, status: npt.NDArray[np.uint16]) -> FloatArray:
    columns, contact = rows.columns, np.full((*rows.counter.shape, 3), np.nan)
    if "P" in columns:
        for k, name in enumerate(("P", "phi", "theta")):
            contact[..., k] = columns[name]
        return contact
    for k, finger in enumerate(fingers):
        pull = finger.calibration is not None and finger.calibration.pull
        if "F1" in columns:
            F = np.stack([columns[name][:, k] for name in ("F1", "F2", "F3")], axis=-1)
            found = contact_model.contacts(F, pull=pull)
        elif finger.calibration is not None and finger.calibration.gauges == strains.shape[-1]:
            one = finger.calibration
            _, found = contact_model.estimate(one.C, strains[:, k] * 1e-6, one.offset_strain, pull=pull)
        else:
            continue
        contact[:, k] = np.stack([found.P_newtons, np.degrees(found.phi_rad), np.degrees(found.theta_rad)], axis=-1)
    # As the node does it (OBJECTS.md, status byte).
    contact[status & (REPEATED | FAULT | SATURATED | MISSING) != 0] = np.nan
    contact[status & CONTACT == 0, 1:] = np.nan
    contact[status & (THETA_UNRESOLVED | MISSES_TIP) != 0, 2] = np.nan
    return contact
