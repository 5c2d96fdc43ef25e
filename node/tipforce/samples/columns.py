"""What columns of signals say of samples: status, contact and uncertainty, the same for a page, a log and a message."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.host.configuration.calibration import Calibration
from tipforce.samples import reasons
from tipforce.samples.reasons import Status
from tipforce.sensor.contact import estimate, scalar
from tipforce.sensor.contact.estimate import force_vector

RealArray = npt.NDArray[np.floating[Any]]
_CONTACT, _FORCES = ("P", "phi", "theta"), ("F1", "F2", "F3")
_DOUBTS = np.uint16(sum(reasons.COMPUTED.values()) & ~Status.CONTACT)


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """m rows of k fingers with n gauges, or m samples of one finger; the history of a page keeps them as float32."""

    t_ns: npt.NDArray[np.int64]
    """(m,) time of each SYNC, or of reception."""
    contact: RealArray
    """(m, k, 3) P in newtons, phi and theta in degrees; NaN where unknown."""
    u: RealArray
    """(m, k, 3) standard uncertainty of each, in the same units; NaN where unknown."""
    gauges: RealArray
    """(m, k, n) strain in microstrain; NaN where unknown or not sent."""
    status: npt.NDArray[np.uint16]
    """(m, k) bits of ``Status``."""

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """All arrays, in order."""
        return self.t_ns, self.contact, self.u, self.gauges, self.status

    def part(self, rows: slice) -> Block:
        """Return some rows as views."""
        return Block(*(column[rows] for column in self.columns))

    @classmethod
    def zeros(cls, rows: int, fingers: int, gauges: int) -> Block:
        """Return rows of float32 to be filled."""
        contact, u, strains = (np.zeros((rows, fingers, q), dtype=np.float32) for q in (3, 3, gauges))
        return cls(np.zeros(rows, dtype=np.int64), contact, u, strains, np.zeros((rows, fingers), dtype=np.uint16))


def contact_values(
    columns: Mapping[str, npt.NDArray[Any]], strain: FloatArray, status: npt.NDArray[np.uint16],
    calibration: Calibration | None,
) -> tuple[FloatArray, npt.NDArray[np.uint16]]:  # fmt: skip
    """P in newtons, phi and theta in degrees, (k, 3), NaN where unknown, and doubts as ``Status``, (k,), of k samples:
    from P, phi and theta in ``columns``, else F1, F2, F3, else ``strain`` (k, n) by the calibration."""
    sent = columns.keys() >= {*_CONTACT} or columns.keys() >= {*_FORCES}
    if sent or calibration is None or calibration.gauges != strain.shape[-1]:
        pull = calibration is not None and calibration.pull
        return sent_values(columns, status, pull), np.zeros(len(status), dtype=np.uint16)
    # The gauges of a node that is calibrated are judged here: one that is left out must not count.
    from tipforce.host.decoding.contact_columns import History, of_samples  # its import costs time
    from tipforce.host.decoding.estimator import Before, prepared

    hidden = np.uint16(Status.NO_ANSWER | Status.STALE | Status.FAULT | Status.CALIBRATED)
    first = status[status & hidden == Status.CALIBRATED][:1]
    history = History(Before(present=bool((first & Status.CONTACT).any())))
    readable = np.where(status & Status.CALIBRATED, status, Status.NO_ANSWER).astype(np.uint16)
    flags = {name: column for name, column in columns.items() if name != "temperature"}  # seldom: not in each block
    rows, contacts = of_samples(prepared(calibration), flags, 1e6 * strain, readable, history)
    values, doubts = np.full((len(status), 3), np.nan), np.zeros(len(status), dtype=np.uint16)
    values[rows], doubts[rows] = contacts.values[:, :3], contacts.status & _DOUBTS
    return values, doubts


def sent_values(
    columns: Mapping[str, npt.NDArray[Any]], status: npt.NDArray[np.uint16], pull: bool = False
) -> FloatArray:
    """The values of ``contact_values`` that were sent, or follow from the forces that were, by the load sense."""
    if columns.keys() >= {*_CONTACT} or not columns.keys() >= {*_FORCES}:  # a mapping may have P alone
        unknown = np.full(len(status), np.nan)
        return np.stack([columns.get(name, unknown) for name in _CONTACT], axis=-1).astype(np.float64)
    contact = estimate.contacts(np.stack([columns[name] for name in _FORCES], axis=-1), pull=pull)
    values = np.stack([contact.P_newtons, np.degrees(contact.phi_rad), np.degrees(contact.theta_rad)], axis=-1)
    for value in np.unique(status).tolist():
        lost = 0xFF if value & Status.NO_ANSWER else scalar.unknown(value & 0xFF, True)
        at = status == value
        for k, bit in enumerate((scalar.UNKNOWN_FORCE, scalar.UNKNOWN_PHI, scalar.UNKNOWN_THETA)):
            if lost & bit:
                values[at, k] = np.nan
    return values


def uncertainties(
    contact: FloatArray, node: npt.NDArray[np.uint8], calibrations: Mapping[int, Calibration | None]
) -> FloatArray:  # fmt: skip
    """Standard uncertainties (k, 3) of contacts (k, 3) of nodes (k,), in newtons and degrees, from gauge noise. NaN for
    a node without a calibration, and for what is unknown itself."""
    u = np.full(contact.shape, np.nan)
    for pull in (False, True):
        tips = {node_id: tip for node_id, tip in calibrations.items() if tip is not None and tip.pull == pull}
        if not tips:
            continue
        place_of = np.full(256, -1)
        place_of[list(tips)] = range(len(tips))
        rows = np.flatnonzero(place_of[node] >= 0)
        place, (P, phi, theta) = place_of[node[rows]], contact[rows].T
        # F2 has no effect on u(P) and u(phi): where theta is unknown any contact point on the line will do.
        phi_rad = np.radians(phi)
        F = force_vector(P, phi_rad, np.where(np.isnan(theta), phi_rad, np.radians(theta)))
        covariances = np.stack([tip.covariance_F for tip in tips.values()])
        covariance = covariances[place] if len(tips) > 1 else covariances[0]
        uncertainty = estimate.standard_uncertainties(F, covariance, pull=pull)
        uncertainty[:, 1:] *= 180.0 / np.pi
        # Without contact there is no direction: take the worst one.
        worst = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[:, ::2, ::2])[:, -1], 0.0))
        uncertainty[:, 0] = np.where(np.isnan(phi) & ~np.isnan(P), worst[place], uncertainty[:, 0])
        u[rows] = uncertainty
    u[np.isnan(contact)] = np.nan
    return u
