"""The load on fingertips of a MuJoCo model: which geoms are whose, the wrench on each tip, and what its gauges see."""

from __future__ import annotations

from collections.abc import Mapping
from math import hypot, sqrt

import numpy as np

from tipforce.errors import EnvironmentLackError, InputError

try:
    import mujoco
except ImportError:
    raise EnvironmentLackError('MuJoCo is not installed: pip install "tipforce[mujoco]"') from None

Wrench = tuple[float, float, float, float, float, float, float, int]
"""Force and moment about the site, world axes, the sum of the magnitudes of the contact forces, and their number."""


class TipContacts:
    """The contacts of fingers with ``sites``, in this order. Raises InputError as ``Fingertips`` does."""

    def __init__(self, model: mujoco.MjModel, sites: Mapping[str, str]) -> None:
        self._model = model
        self.sites = [_site(model, finger, site) for finger, site in sites.items()]
        self._owners = _owners(model, list(sites), self.sites)
        self._force = np.zeros(6)

    def check(self, data: mujoco.MjData) -> None:
        """Raise InputError for data of another model."""
        sizes, own = (len(data.geom_xpos), len(data.site_xpos)), (self._model.ngeom, self._model.nsite)
        if sizes != own:
            raise InputError(f"data of {sizes[0]} geoms and {sizes[1]} sites: the model of the fingertips has {own}")

    def wrenches(self, data: mujoco.MjData) -> list[Wrench | None]:
        """Return the wrench on each finger; None for one without a contact.

        Torque of a contact (``condim`` 4 and 6) counts. A contact of two fingers loads both, with opposite signs.
        """
        wrenches: list[Wrench | None] = [None] * len(self.sites)
        count = data.ncon
        if not count:
            return wrenches
        contacts, owners = data.contact, self._owners
        model, buffer, contact_force = self._model, self._force, mujoco.mj_contactForce
        geoms, frames, positions = contacts.geom.tolist(), contacts.frame.tolist(), contacts.pos.tolist()
        for k in range(count):
            geom_1, geom_2 = geoms[k]
            one, two = owners[geom_1], owners[geom_2]
            if one == two:
                continue
            contact_force(model, data, k, buffer)
            force, frame, position = buffer.tolist(), frames[k], positions[k]
            if two >= 0:  # the frame's x points from geom 1 to geom 2; the force is that on geom 2
                wrenches[two] = _added(wrenches[two], data.site_xpos[self.sites[two]].tolist(), force, frame, position)
            if one >= 0:
                force = [-component for component in force]
                wrenches[one] = _added(wrenches[one], data.site_xpos[self.sites[one]].tolist(), force, frame, position)
        return wrenches


def _added(
    before: Wrench | None, origin: list[float], force: list[float], frame: list[float], position: list[float]
) -> Wrench:
    """Return a wrench with one contact added: ``force`` on the tip, and its torque, along the contact's ``frame``."""
    n, s, t, turn, roll_1, roll_2 = force
    a, b, c, d, e, f, g, h, i = frame
    x, y, z = position
    ox, oy, oz = origin
    x, y, z = x - ox, y - oy, z - oz
    fx, fy, fz = a * n + d * s + g * t, b * n + e * s + h * t, c * n + f * s + i * t
    mx, my, mz = y * fz - z * fy, z * fx - x * fz, x * fy - y * fx
    if turn or roll_1 or roll_2:
        mx += a * turn + d * roll_1 + g * roll_2
        my += b * turn + e * roll_1 + h * roll_2
        mz += c * turn + f * roll_1 + i * roll_2
    size = sqrt(n * n + s * s + t * t)
    if before is None:
        return fx, fy, fz, mx, my, mz, size, 1
    gx, gy, gz, nx, ny, nz, total, count = before
    return gx + fx, gy + fy, gz + fz, nx + mx, ny + my, nz + mz, total + size, count + 1


def _site(model: mujoco.MjModel, finger: str, site: str) -> int:
    number: int = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
    if number < 0:
        names = [model.site(k).name for k in range(model.nsite)]
        raise InputError(f"finger {finger}: site {site!r}: allowed are {', '.join(filter(None, names)) or 'none'}")
    return number


def _owners(model: mujoco.MjModel, fingers: list[str], sites: list[int]) -> list[int]:
    """Return by geom the finger whose tip it is, -1 for none: the geoms of the site's body and of those below it."""
    tips: dict[int, int] = {}
    for finger, site in enumerate(sites):
        body = int(model.site_bodyid[site])
        if body == 0:
            raise InputError(f"finger {fingers[finger]}: its site is on the world: allowed is one on a body of the tip")
        other = tips.setdefault(body, finger)
        if other != finger:
            raise InputError(f"fingers {fingers[other]} and {fingers[finger]}: allowed is one finger for each body")
    owners = []
    for geom_body in model.geom_bodyid.tolist():
        body = geom_body
        while body and body not in tips:
            body = int(model.body_parentid[body])
        owners.append(tips.get(body, -1))
    for finger, name in enumerate(fingers):
        if finger not in owners:
            raise InputError(f"finger {name}: the body of its site has no geom: allowed is one that can be touched")
    return [*owners, -1]  # of a contact with a flex, whose geom is -1


Vector = tuple[float, float, float]


class Load:
    """The load on one tip at one time step; vectors (3,) are along x, y and z of the site (``mjcf.py``).

    ``F_newtons`` are F1, F2, F3, equation (16) of the paper: all that the gauges see.
    """

    __slots__ = ("F_newtons", "_axes", "_rows", "_wrench")

    def __init__(self, axes: list[float], wrench: Wrench, r_m: float, strain_per_newton: list[Vector]) -> None:
        """``axes``: the site's rotation by rows."""
        a, b, c, d, e, f, g, h, i = self._axes = axes
        fx, fy, fz, mx, my, mz, _total, _count = self._wrench = wrench
        self.F_newtons: Vector = b * fx + e * fy + h * fz, (c * mx + f * my + i * mz) / r_m, a * fx + d * fy + g * fz
        self._rows = strain_per_newton

    @property
    def contacts(self) -> int:
        """Contacts on the tip."""
        return self._wrench[7]

    @property
    def sum_newtons(self) -> float:
        """The magnitudes of the contact forces, added up."""
        return self._wrench[6]

    @property
    def force_newtons(self) -> Vector:
        """The sum of the contact forces."""
        F = self.F_newtons
        c, f, i = self._axes[2::3]
        fx, fy, fz = self._wrench[:3]
        return F[2], F[0], c * fx + f * fy + i * fz

    @property
    def moment_newton_metres(self) -> Vector:
        """Their moment about the site."""
        a, b, c, d, e, f, g, h, i = self._axes
        mx, my, mz = self._wrench[3:6]
        return a * mx + d * my + g * mz, b * mx + e * my + h * mz, c * mx + f * my + i * mz

    @property
    def microstrain(self) -> list[float]:
        """The strain of each gauge, without offset and noise."""
        f1, f2, f3 = self.F_newtons
        return [1e6 * (c1 * f1 + c2 * f2 + c3 * f3) for c1, c2, c3 in self._rows]

    @property
    def P_newtons(self) -> float:
        """The force in the sensor's plane."""
        return hypot(self.F_newtons[0], self.F_newtons[2])

    @property
    def unseen_newtons(self) -> float:
        """The force out of the sensor's plane, along z, which the gauges do not see."""
        return abs(self.force_newtons[2])

    @property
    def unseen_newton_metres(self) -> float:
        """The moment about x and y, which the gauges do not see: of forces along z, and of contacts off the plane."""
        moment = self.moment_newton_metres
        return hypot(moment[0], moment[1])

    @property
    def cancelled_newtons(self) -> float:
        """By how much the magnitudes of several contact forces exceed that of their sum; the gauges see the sum."""
        x, y, z = self.force_newtons
        return max(0.0, self.sum_newtons - sqrt(x * x + y * y + z * z))
