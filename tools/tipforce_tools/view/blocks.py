"""Convert rows of a hand to blocks of contacts with uncertainty, vectorised over rows and fingers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding import status_words
from tipforce.host.decoding.contacts import contact_values, status_of, uncertainties
from tipforce.host.hand.rows import Rows
from tipforce.sensor.contact import scalar
from tipforce_tools.view.fingers import Finger

FloatArray = npt.NDArray[np.float64]
RealArray = npt.NDArray[np.floating[Any]]

CONTACT, CALIBRATED, SATURATED, REPEATED = (
    scalar.CONTACT_PRESENT, scalar.CALIBRATED, scalar.SATURATED, scalar.STALE,
)  # fmt: skip
THETA_UNRESOLVED, MISSES_TIP, OUTSIDE_PAD, FAULT = (
    scalar.THETA_UNRESOLVED, scalar.MISSES_TIP, scalar.OUTSIDE_PAD, scalar.FRONT_END_FAULT,
)  # fmt: skip
MISSING = status_words.NO_ANSWER
"""Bit of ``status``, which has those of ``contacts.Status``: no response from the finger."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """m rows of k fingers with n gauges; the history of a page keeps them as float32."""

    t_ns: npt.NDArray[np.int64]
    """(m,) time of each SYNC."""
    contact: RealArray
    """(m, k, 3) P in newtons, phi and theta in degrees; NaN where unknown."""
    u: RealArray
    """(m, k, 3) standard uncertainty of each, in the same units; NaN where unknown."""
    gauges: RealArray
    """(m, k, n) strain in microstrain; NaN where unknown or not sent."""
    status: npt.NDArray[np.uint16]
    """(m, k)"""

    def __len__(self) -> int:
        return len(self.t_ns)


def block_of_rows(
    rows: Rows,
    fingers: Sequence[Finger],
    gauges: int,
    health_u_P: FloatArray | None = None,
    faults: npt.NDArray[np.int64] | None = None,
) -> Block:
    """Convert rows, whose columns are those of ``fingers``, to a block.

    Without the contact PDO the contact is computed from forces, or from gauges and the finger's calibration.
    ``health_u_P`` (m, k) is used as u(P) if no calibration is known; ``faults`` (m, k) is 2124h.
    """
    shape = rows.counter.shape
    status = status_of(rows.columns, shape) | np.where(rows.missing, np.uint16(MISSING), np.uint16(0))
    if faults is not None:
        status |= (faults & status_words.JUDGED).astype(np.uint16)
    strains = np.full((*shape, gauges), np.nan)
    for k in range(gauges):
        if f"SG{k + 1}" in rows.columns:
            strains[..., k] = rows.columns[f"SG{k + 1}"]
    known = status | np.uint16(CALIBRATED)  # by the host's calibration, if the node has none
    columns = [{name: values[:, k] for name, values in rows.columns.items()} for k in range(len(fingers))]
    contact = np.stack(
        [
            contact_values(columns[k], strains[:, k] * 1e-6, known[:, k], finger.calibration)
            for k, finger in enumerate(fingers)
        ],
        axis=1,
    )
    u = uncertainties(contact, [finger.calibration for finger in fingers])
    if health_u_P is not None:
        u[..., 0] = np.where(np.isnan(u[..., 0]) & ~np.isnan(contact[..., 0]), health_u_P, u[..., 0])
    return Block(rows.sync_ns, contact, u, strains, status)
