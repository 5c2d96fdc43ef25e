"""Samples of one fingertip as messages.

The frame ``<finger>_tip`` has its origin at the centre of the tip: x is the direction of F3 and y of F1 (docs/
mechanics.md), z is normal to the plane of the beams, right-handed. So the force is P (cos phi, sin phi, 0), and the
torque about the origin r P sin(phi - theta) = r F2, around z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce_tools.ros2 import cdr
from tipforce_tools.ros2.definitions import CONTACT, WRENCH

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TipSamples:
    """k samples of one fingertip."""

    t_ns: npt.NDArray[np.int64]
    """(k,) stamps."""
    number: npt.NDArray[np.int64]
    """(k,) of the samples, -1 for none."""
    contact: FloatArray
    """(k, 3) P in newtons, phi and theta in degrees; NaN where unknown."""
    u: FloatArray
    """(k, 3) their standard uncertainties."""
    status: npt.NDArray[np.uint16]
    """(k,) bits of ``contacts.Status``."""
    microstrain: FloatArray
    """(k, n), or (k, 0) where the node does not send it."""

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(k,) where P, phi and theta are all known: where there is a wrench."""
        return np.asarray(np.isfinite(self.contact).all(axis=1))


class TipMessages:
    """Serialise the samples of one fingertip."""

    def __init__(self, frame_id: str, node_id: int, tip_radius_m: float) -> None:
        self._frame_id, self._node_id, self._radius_m = frame_id, node_id, tip_radius_m
        torque = {"wrench.force.z": 0.0, "wrench.torque.x": 0.0, "wrench.torque.y": 0.0}
        self._wrench = cdr.Layout(WRENCH, {"header.frame_id": frame_id, **torque})
        self._contact: dict[int, cdr.Layout] = {}

    def wrenches(self, samples: TipSamples) -> tuple[npt.NDArray[np.int64], list[bytes]]:
        """Return the stamps (j,) and the messages of the samples whose force is known."""
        known = samples.known
        t_ns = samples.t_ns[known]
        rows = self._wrench.rows(len(t_ns))
        P, (phi, theta) = samples.contact[known, 0], np.radians(samples.contact[known, 1:]).T
        cdr.set_stamps(rows, t_ns)
        rows["wrench.force.x"], rows["wrench.force.y"] = P * np.cos(phi), P * np.sin(phi)
        rows["wrench.torque.z"] = self._radius_m * P * np.sin(phi - theta)
        return t_ns, cdr.split(rows)

    def contacts(self, samples: TipSamples) -> list[bytes]:
        """Return a message for each sample."""
        n = samples.microstrain.shape[1]
        if n not in self._contact:
            constants = {"header.frame_id": self._frame_id, "node_id": self._node_id}
            self._contact[n] = cdr.Layout(CONTACT, constants, {"microstrain": n})
        rows = self._contact[n].rows(len(samples))
        cdr.set_stamps(rows, samples.t_ns)
        rows["number"], rows["status"], rows["microstrain"] = samples.number, samples.status, samples.microstrain
        for values, suffix in ((samples.contact, ""), (samples.u, "_uncertainty")):
            rows["force" + suffix] = values[:, 0]
            rows["direction" + suffix], rows["angle" + suffix] = np.radians(values[:, 1]), np.radians(values[:, 2])
        return cdr.split(rows)
