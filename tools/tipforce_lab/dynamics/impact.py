"""Impact of a body on the tip, or of the finger on a stop: contact force, contact times, and the gauges' readings.

Linear contact: exact, each phase a linear system (switched.py). Hertzian contact: hertz.py, which needs scipy.
Contact starts at time 0 and may open and close again, because the tip vibrates. The contact itself is lossless.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import State, checked_loads
from tipforce.sensor.dynamics.model import Modes
from tipforce_lab.dynamics.assembly import Assembly, Striker
from tipforce_lab.dynamics.slit import SlitStop
from tipforce_lab.dynamics.switched import March, Touch


class Impact(NamedTuple):
    """Results between 0 and the end of a run."""

    touches: tuple[Touch, ...]
    """Contact 0 is the body's, if there is one; the next two are the stops of the left and right arm."""
    elastic_newtons: FloatArray
    """(m, 3): F in the arms at the sample times: the gauges measure it, plus local bending near a closed stop."""
    vertical_newtons: FloatArray
    """(m, 3): F in the vertical beam."""
    contact_newtons: FloatArray
    """(m, n): force of each contact at the sample times."""
    body_speed_m_s: float
    """At the end, towards the tip: negative after a rebound."""
    structure: State
    """At the end."""


def impact(
    modes: Modes | None,
    striker: Striker,
    until_s: float,
    times_s: npt.ArrayLike = (),
    slit: SlitStop | None = None,
    start: State | None = None,
) -> Impact:
    """Return the course of an impact that starts at 0, structure at rest unless ``start`` says otherwise.

    modes: None is rigid ground. times_s: (m,) rising, from 0 to until_s. Raises InputError for times out of range,
    a run that needs too many steps, a Hertzian contact with a slit; EnvironmentLackError for a Hertzian contact
    without scipy.
    """
    t = _checked_times(times_s, until_s)
    if striker.exponent != 1.0:
        if slit is not None:
            raise InputError("a Hertzian contact and a slit in one run: allowed is a linear contact with a slit")
        from tipforce_lab.dynamics.hertz import hertz_impact

        return Impact(*hertz_impact(modes, striker, until_s, t, start))
    assembly = Assembly(modes, striker, slit)
    march = touching(assembly, assembly.start(start))
    rows = _Rows(assembly, march)
    for time_s in t:
        march.advance(float(time_s))
        rows.note()
    march.advance(until_s)
    return rows.result()


def overload(
    modes: Modes,
    slit: SlitStop,
    times_s: npt.ArrayLike,
    loads_newtons: npt.ArrayLike,
    start: State | None = None,
) -> Impact:
    """Return the response of a structure with a stop to a load that is linear between its samples, (m,) and (m, 3).

    The sample times are those of the load and must rise strictly. Raises InputError for times or shapes that do
    not fit, or loads that are not finite.
    """
    t, F = floats("times_s", times_s), checked_loads(loads_newtons)
    if t.shape != (len(F),) or not (np.diff(t) > 0.0).all() or not np.isfinite(t).all():
        raise InputError(f"times of shape {t.shape}: allowed are {len(F)} finite numbers that rise strictly")
    if not np.isfinite(F).all():
        raise InputError("loads: allowed are finite numbers")
    assembly = Assembly(modes, None, slit)
    march = March(assembly.system, assembly.start(start), float(t[0]))
    rows = _Rows(assembly, march)
    for k in range(len(t)):
        march.state[assembly.load : assembly.rate] = F[k]
        rows.note()
        if k + 1 < len(t):
            march.state[assembly.rate : assembly.one] = (F[k + 1] - F[k]) / (t[k + 1] - t[k])
            march.disturbed()
            march.advance(float(t[k + 1]))
    return rows.result()


def touching(assembly: Assembly, state: FloatArray) -> March:
    """Return a run that starts with the body's contact just closed."""
    march = March(assembly.system, state)
    march.close(0)
    return march


class _Rows:
    """Samples of a run."""

    def __init__(self, assembly: Assembly, march: March) -> None:
        self.assembly, self.march = assembly, march
        self.arms: list[FloatArray] = []
        self.vertical: list[FloatArray] = []
        self.contact: list[FloatArray] = []

    def note(self) -> None:
        forces = self.march.forces_newtons
        arms, vertical = self.assembly.elastic(self.march.state, forces)
        self.arms.append(arms)
        self.vertical.append(vertical)
        self.contact.append(forces)

    def result(self) -> Impact:
        n, march, assembly = len(self.march.system.closure), self.march, self.assembly
        return Impact(
            march.finish(), np.array(self.arms).reshape(-1, 3), np.array(self.vertical).reshape(-1, 3),
            np.array(self.contact).reshape(-1, n),
            assembly.body_speed(march.state) if assembly.striker else 0.0, assembly.structure(march.state),
        )  # fmt: skip


def _checked_times(times_s: npt.ArrayLike, until_s: float) -> FloatArray:
    t = floats("times_s", times_s).reshape(-1)
    if not 0.0 < until_s < math.inf:
        raise InputError(f"until_s = {until_s!r}: allowed is a positive finite number")
    if not ((t >= 0.0) & (t <= until_s)).all() or (np.diff(t) < 0.0).any():
        raise InputError(f"times: allowed are rising numbers from 0 to until_s, {until_s!r}")
    return t
