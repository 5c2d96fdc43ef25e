"""Whole nodes whose gauges read the contacts of a MuJoCo model, which do not contain the tip's weight and inertia."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import hypot, sqrt
from typing import TYPE_CHECKING

import numpy as np

from canopen_device.core.node import Device
from canopen_device.running.loop import MemoryStore
from tipforce.arrays import whole
from tipforce.errors import InputError, needing
from tipforce.fingertip.node import Fingertip, fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.samples import reasons
from tipforce.samples.contact import Contact
from tipforce.samples.reasons import Status
from tipforce.scene.delivered import CALIBRATION, beam_calibration, check_noise, stored_calibration
from tipforce.sensor import FABRICATED, strain_matrix
from tipforce.sensor.contact import scalar
from tipforce.sensor.structure.layouts import CUSTOM_LAYOUT_CODE, layout_code
from tipforce.sources.simulated import SimulatedSource

with needing('MuJoCo is not installed: pip install "tipforce[mujoco]"'):
    import mujoco

if TYPE_CHECKING:
    from canopen_device.core.node import Frame
    from tipforce.fingertip.sample import Sample

Vector = tuple[float, float, float]
Wrench = tuple[float, float, float, float, float, float, float, int]
"""Force and moment about the site, world axes, the sum of the magnitudes of the contact forces, and their number."""


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


class Load:
    """The load on one tip; vectors (3,) along x, y, z of the site. ``F_newtons``: F1, F2, F3, equation (16), all that
    the gauges see; ``force_newtons``: sum of the contact forces, ``sum_newtons`` of their magnitudes."""

    __slots__ = ("F_newtons", "_axes", "_rows", "_wrench", "contacts", "sum_newtons")

    def __init__(self, axes: list[float], wrench: Wrench, r_m: float, strain_per_newton: list[Vector]) -> None:
        """``axes``: the site's rotation by rows."""
        a, b, c, d, e, f, g, h, i = axes
        x, y, z, p, q, r, self.sum_newtons, self.contacts = wrench
        self.F_newtons: Vector = b * x + e * y + h * z, (c * p + f * q + i * r) / r_m, a * x + d * y + g * z
        self._axes, self._wrench, self._rows = axes, wrench, strain_per_newton

    @property
    def force_newtons(self) -> Vector:
        """The sum of the contact forces."""
        c, f, i = self._axes[2::3]
        x, y, z = self._wrench[:3]
        return self.F_newtons[2], self.F_newtons[0], c * x + f * y + i * z

    @property
    def moment_newton_metres(self) -> Vector:
        """The sum of their moments about the site."""
        a, b, c, d, e, f, g, h, i = self._axes
        p, q, r = self._wrench[3:6]
        return a * p + d * q + g * r, b * p + e * q + h * r, c * p + f * q + i * r

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
        return hypot(*self.moment_newton_metres[:2])

    @property
    def cancelled_newtons(self) -> float:
        """By how much the magnitudes of several contact forces exceed that of their sum; the gauges see the sum."""
        x, y, z = self.force_newtons
        return max(self.sum_newtons - sqrt(x * x + y * y + z * z), 0.0)  # in this order NaN stays NaN


_NAN = float("nan")
_NO_LOAD: Wrench = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
_NO_TURN = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


class TwinSample:
    """One sample of one fingertip, as its node has it, beside the true ``load``. NaN stands for unknown."""

    __slots__ = ("_sample", "load", "name", "node_id", "t_s")

    def __init__(self, name: str, node_id: int, t_s: float, sample: Sample, load: Load) -> None:
        self.name, self.node_id, self.t_s, self._sample, self.load = name, node_id, t_s, sample, load

    @property
    def counts(self) -> tuple[int, ...]:
        """The converter's counts, with noise and quantisation; empty where the source gave none."""
        reading = self._sample.reading
        return () if reading is None else tuple(reading.counts)

    @property
    def microstrain(self) -> tuple[float, ...]:
        """What the node makes of the counts (6130h)."""
        return tuple(self._sample.microstrains)

    @property
    def status(self) -> Status:
        """2120h, and bits 12 to 15 of 2124h, as in ``tipforce.Contact``."""
        bits = self._sample.status() | self._sample.faults & reasons.JUDGED
        return Status(bits | (reasons.LEFT_OUT if self._sample.spared else 0))

    @property
    def F_newtons(self) -> Vector:
        """F1, F2, F3."""
        return (_NAN, _NAN, _NAN) if self._unknown_force() else self._sample.force()

    @property
    def P_newtons(self) -> float:
        """Force magnitude."""
        return _NAN if self._unknown_force() else self._sample.contact()[0]

    @property
    def u_P_newtons(self) -> float:
        """Standard uncertainty of P."""
        return _NAN if self._unknown_force() else self._sample.magnitude_uncertainty()

    @property
    def phi_deg(self) -> float:
        """Force direction, (-180, 180]."""
        return self._angle(scalar.UNKNOWN_PHI, self._sample.contact()[1])

    @property
    def theta_deg(self) -> float:
        """Contact angle."""
        return self._angle(scalar.UNKNOWN_THETA, self._sample.contact()[2])

    @property
    def contact(self) -> Contact:
        """The same as a ``tipforce.Contact``, with the uncertainties of the angles, ``reason`` and text."""
        u_phi, u_theta = self._sample.uncertainty()[1:]
        return Contact(
            self.node_id, self.t_s, self._sample.counter, self.P_newtons, self.phi_deg, self.theta_deg,
            self.u_P_newtons, self._angle(scalar.UNKNOWN_PHI, u_phi), self._angle(scalar.UNKNOWN_THETA, u_theta),
            self.status, self.microstrain, self.name,
        )  # fmt: skip

    def _unknown_force(self) -> int:
        return self._sample.unknown_early() & scalar.UNKNOWN_FORCE

    def _angle(self, bit: int, value_rad: float) -> float:
        return _NAN if self._sample.unknown() & bit else value_rad * scalar.DEGREES


class Fingertips:
    """The fingertips of ``model``: ``sites`` by name of finger; the geoms of its body are the tip's surface.

    ``calibration``: by default beam theory for contacts that push; ``noise_microstrain`` depends on ``seed`` alone;
    ``node_ids``: by default 1, 2, ... Raises InputError for a site that does not exist, one on a body without geoms or
    with another finger's, node-ids and numbers that are not allowed."""

    def __init__(
        self, model: mujoco.MjModel, sites: Mapping[str, str], *, layout: str = "I",
        calibration: Calibration | None = None, noise_microstrain: float = 0.5, seed: int = 0,
        node_ids: Mapping[str, int] | None = None,
    ) -> None:  # fmt: skip
        self._noise_microstrain = noise_microstrain = check_noise(noise_microstrain)
        self._rows: list[Vector] = [(a, b, c) for a, b, c in strain_matrix(FABRICATED, layout).tolist()]
        self._calibration = calibration or beam_calibration(layout, noise_microstrain=noise_microstrain)
        if self._calibration.gauges != len(self._rows):
            raise InputError(f"calibration of {self._calibration.gauges} gauges: the layout has {len(self._rows)}")
        if len({self._calibration.layout_code, layout_code(layout)} - {CUSTOM_LAYOUT_CODE}) > 1:
            raise InputError(f"calibration of another layout: allowed is one of {layout!r}, or without a layout")
        self._stored = stored_calibration(self._calibration)
        self.node_ids = _node_ids(list(sites), node_ids)
        self._model, self._force = model, np.zeros(6)
        self._sites, self._owners = _tips(model, sites)
        self.reset(seed)

    def reset(self, seed: int = 0) -> None:
        """Make new nodes, powered on at time 0, as after ``mj_resetData``; ``seed``, an integer, is of the noise."""
        seed = whole("seed", seed)
        self._data: mujoco.MjData | None = None
        self._now_us = 0
        self._loads: list[Load] | None = None
        self.boot_frames: list[Frame] = []
        """What the nodes sent when they were powered on."""
        self.devices: list[Device] = []
        """The nodes, in the order of the fingers."""
        for k, node_id in enumerate(self.node_ids.values()):
            own_seed, store = 1000 * seed + node_id, MemoryStore()
            source = SimulatedSource(self._rows, self._noise_microstrain, seed=own_seed, forces=self._forces(k))
            store.groups[CALIBRATION] = self._stored
            device = fingertip_node(node_id, source, len(self._rows), 1000 + node_id, store.save, store.load)
            self.boot_frames += device.step(0)[0]
            self.devices.append(device)

    def read(self, data: mujoco.MjData) -> dict[str, TwinSample]:
        """Take a sample of each finger, as at a SYNC, after ``mj_step``; within the sample period (6114h, 500 us) it is
        stale. Raises InputError where the time of ``data`` went back (call ``reset``), or for data of another model."""
        now_us = self.at(data)
        loads, t_s, samples = self._present(), 1e-6 * now_us, {}
        for k, (name, node_id) in enumerate(self.node_ids.items()):
            self.devices[k].now_us = now_us
            fingertip = self.devices[k].application
            assert isinstance(fingertip, Fingertip)
            fingertip.on_sync(now_us, 0)
            samples[name] = TwinSample(name, node_id, t_s, fingertip.sample, loads[k])
        return samples

    def loads(self, data: mujoco.MjData) -> dict[str, Load]:
        """Return the true load of each finger; no sample is taken. Raises InputError as ``read`` does."""
        self.at(data)
        return dict(zip(self.node_ids, self._present(), strict=True))

    def at(self, data: mujoco.MjData) -> int:
        """Let the nodes read ``data`` as it is now; return its time in microseconds. Raises as ``read`` does."""
        sizes, own = (len(data.geom_xpos), len(data.site_xpos)), (self._model.ngeom, self._model.nsite)
        if data is not self._data and sizes != own:
            raise InputError(f"data of {sizes[0]} geoms and {sizes[1]} sites: the model of the fingertips has {own}")
        try:
            now_us: int = round(1e6 * data.time)
        except (ValueError, OverflowError):
            raise InputError(f"the time of data is {data.time}: allowed is a finite one") from None
        if now_us < self._now_us:
            raise InputError(f"the time of data went back from {self._now_us} to {now_us} us: call reset() before")
        self._data, self._now_us, self._loads = data, now_us, None
        return now_us

    def _present(self) -> list[Load]:
        if self._loads is None:
            assert self._data is not None
            axes, r_m, rows = self._data.site_xmat, FABRICATED.r_m, self._rows
            self._loads = [
                Load(_NO_TURN, _NO_LOAD, r_m, rows) if wrench is None else Load(axes[site].tolist(), wrench, r_m, rows)
                for site, wrench in zip(self._sites, self._wrenches(self._data), strict=True)
            ]
        return self._loads

    def _wrenches(self, data: mujoco.MjData) -> list[Wrench | None]:
        """Return the wrench on each finger, None without a contact; a contact of two fingers loads both, oppositely."""
        wrenches: list[Wrench | None] = [None] * len(self._sites)
        if not data.ncon:
            return wrenches
        contacts, owners, sites, origins = data.contact, self._owners, self._sites, data.site_xpos
        model, buffer, contact_force = self._model, self._force, mujoco.mj_contactForce
        each = zip(contacts.geom.tolist(), contacts.frame.tolist(), contacts.pos.tolist(), strict=True)
        for k, ((geom_1, geom_2), frame, position) in enumerate(each):
            on_1, on_2 = owners[geom_1], owners[geom_2]
            if on_1 == on_2:
                continue
            contact_force(model, data, k, buffer)  # on geom 2, to which the frame's x points
            force = buffer.tolist()
            if on_2 >= 0:
                wrenches[on_2] = _added(wrenches[on_2], origins[sites[on_2]].tolist(), force, frame, position)
            if on_1 >= 0:
                force = [-component for component in force]
                wrenches[on_1] = _added(wrenches[on_1], origins[sites[on_1]].tolist(), force, frame, position)
        return wrenches

    def _forces(self, k: int) -> Callable[[int], Vector]:
        """The source's function: F1, F2, F3 of finger ``k`` in the present state, whenever its conversion began."""
        return lambda _now_us: (0.0, 0.0, 0.0) if self._data is None else self._present()[k].F_newtons


def _tips(model: mujoco.MjModel, sites: Mapping[str, str]) -> tuple[list[int], list[int]]:
    """The number of each finger's site, and by geom of it or below it the finger, elsewhere -1."""
    numbers, tips = list[int](), dict[int, str]()
    for finger, site in sites.items():
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
        if number < 0:
            names = ", ".join(filter(None, (model.site(k).name for k in range(model.nsite))))
            raise InputError(f"finger {finger}: site {site!r}: allowed are {names or 'none'}")
        body = int(model.site_bodyid[number])
        if body == 0:
            raise InputError(f"finger {finger}: its site is on the world: allowed is one on a body of the tip")
        if tips.setdefault(body, finger) != finger:
            raise InputError(f"fingers {tips[body]} and {finger}: allowed is one finger for each body")
        numbers.append(number)
    order, owners = list(sites), []
    for geom_body in model.geom_bodyid.tolist():
        body = geom_body
        while body and body not in tips:
            body = int(model.body_parentid[body])
        owners.append(order.index(tips[body]) if body else -1)
    for k, finger in enumerate(order):
        if k not in owners:
            raise InputError(f"finger {finger}: the body of its site has no geom: allowed is one that can be touched")
    return numbers, [*owners, -1]  # of a contact with a flex, whose geom is -1


def _node_ids(fingers: list[str], chosen: Mapping[str, int] | None) -> dict[str, int]:
    if not fingers:
        raise InputError("sites: allowed is one finger or more")
    if chosen is not None and set(chosen) != set(fingers):
        raise InputError(f"node_ids of {', '.join(map(str, chosen))}: allowed are those of {', '.join(fingers)}")
    by_finger = {name: k if chosen is None else chosen[name] for k, name in enumerate(fingers, 1)}
    if len(set(by_finger.values())) != len(by_finger) or not all(k in range(1, 128) for k in by_finger.values()):
        raise InputError(f"node_ids {list(by_finger.values())}: allowed are different ones from 1 to 127")
    return {name: int(node_id) for name, node_id in by_finger.items()}
