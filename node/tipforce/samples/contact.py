"""One sample of one finger, as people and programs read it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from tipforce.samples import reasons
from tipforce.samples.reasons import Status

Fields = Mapping[str, Callable[[Any, int], Any]]
"""By name of a field what makes it of a row and the place of the finger in it."""


class _MadeLater:
    __slots__ = ("_source",)
    _source: tuple[Fields, Any, int]


@dataclass(frozen=True, slots=True)
class Contact(_MadeLater):
    """One sample of one finger. NaN stands for unknown; ``reason`` says why. ``u_...`` are standard uncertainties (1
    sigma) from the gauge noise of the calibration, NaN where no calibration is known."""

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

    def __getattr__(self, name: str) -> Any:
        """Make a field. Raises AttributeError for another name."""
        if name not in Contact.__slots__:
            raise AttributeError(f"Contact has no {name!r}")
        fields, row, place = self._source
        value = fields[name](row, place)
        object.__setattr__(self, name, value)  # the class is frozen
        return value

    @property
    def present(self) -> bool:
        """Whether the finger touches something: P is over the contact threshold (2110h:4, 5)."""
        return Status.CONTACT in self.status

    @property
    def reason(self) -> str:
        """Why a value is unknown or doubtful, in words; "" where P, phi and theta are known and nothing is flagged."""
        return self.missing or reasons.why(
            int(self.status),
            force_known=not math.isnan(self.P_newtons),
            angles_known=not math.isnan(self.phi_deg + self.theta_deg),
        )

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
        shown = [
            f"{value:.{digits}f} {unit}" if math.isfinite(value) else "unknown"
            for value, digits, unit in ((self.P_newtons, 3, "N"), (self.phi_deg, 2, "deg"), (self.theta_deg, 2, "deg"))
        ]
        values = f"{shown[0]}, phi {shown[1]}, theta {shown[2]}"
        return f"{values} ({self.reason})" if self.reason else values
