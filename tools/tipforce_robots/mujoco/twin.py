"""Fingertips of a MuJoCo model: contacts to strain, converter counts, status and contact, by the node's own code.

Each fingertip is a whole node (``tipforce.fingertip``) whose gauge source reads the contacts of the model. Weight and
inertia of the tip itself are not in the contacts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from canopen_device.core import communication
from canopen_device.core.node import Device
from canopen_device.running.store import MemoryStore
from tipforce.errors import InputError
from tipforce.fingertip.application import Fingertip
from tipforce.fingertip.calibration import CALIBRATION_GROUP
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.samples import reasons
from tipforce.samples.reasons import Status
from tipforce.samples.record import Contact
from tipforce.scene.build import commit_calibration, download
from tipforce.scene.simulated_bus import beam_calibration, check_noise
from tipforce.sensor.contact import scalar
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import strain_matrix
from tipforce.sources.simulated import SimulatedSource
from tipforce_robots.mujoco.load import Load, TipContacts, Vector, Wrench

if TYPE_CHECKING:
    import mujoco

    from canopen_device.core.node import Frame
    from tipforce.fingertip.sample import Sample

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
    """The fingertips of ``model``: ``sites`` has a site by name of finger; the geoms of its body are the tip's surface.

    ``layout``: of the gauges, see ``tipforce.sensor``. Each node has ``calibration``, by default that of beam theory
    for contacts that push; ``noise_microstrain`` is the white noise of each gauge, the same in each run with the same
    ``seed``. ``node_ids`` by finger, default 1, 2, ... Raises InputError for a site that does not exist, one on a body
    without geoms or with another finger's, node-ids and numbers that are not allowed.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        sites: Mapping[str, str],
        *,
        layout: str = "I",
        calibration: Calibration | None = None,
        noise_microstrain: float = 0.5,
        seed: int = 0,
        node_ids: Mapping[str, int] | None = None,
    ) -> None:
        check_noise(noise_microstrain)
        self._noise_microstrain = noise_microstrain
        self._rows: list[Vector] = [(a, b, c) for a, b, c in strain_matrix(FABRICATED, layout).tolist()]
        self._calibration = calibration or beam_calibration(layout, noise_microstrain=noise_microstrain)
        if self._calibration.gauges != len(self._rows):
            raise InputError(f"calibration of {self._calibration.gauges} gauges: the layout has {len(self._rows)}")
        self.node_ids = _node_ids(list(sites), node_ids)
        self._contacts = TipContacts(model, sites)
        self.reset(seed)

    def reset(self, seed: int = 0) -> None:
        """Make new nodes, powered on at time 0, as after ``mj_resetData``; ``seed`` is that of the noise."""
        self._data: mujoco.MjData | None = None
        self._now_us = 0
        self._loads: list[Load] | None = None
        self.boot_frames: list[Frame] = []
        """What the nodes sent when they were powered on."""
        self.devices: list[Device] = []
        """The nodes, in the order of the fingers."""
        for k, node_id in enumerate(self.node_ids.values()):
            source = SimulatedSource(
                self._rows, self._noise_microstrain, seed=1000 * seed + node_id, forces=self._forces(k)
            )
            self.devices.append(self._node(node_id, source))
        self._fingertips = [_application(device) for device in self.devices]

    def read(self, data: mujoco.MjData) -> dict[str, TwinSample]:
        """Take a sample of each finger, as at a SYNC; call it after ``mj_step``.

        A second sample within the sample period of the node (6114h, 500 us) is stale. Raises InputError where the time
        of ``data`` went back (call ``reset``), or for data of another model.
        """
        now_us = self.at(data)
        loads, t_s, samples = self._present(), 1e-6 * now_us, {}
        for k, (name, node_id) in enumerate(self.node_ids.items()):
            self.devices[k].now_us = now_us
            fingertip = self._fingertips[k]
            fingertip.on_sync(now_us, 0)
            samples[name] = TwinSample(name, node_id, t_s, fingertip.sample, loads[k])
        return samples

    def loads(self, data: mujoco.MjData) -> dict[str, Load]:
        """Return the true load of each finger; no sample is taken. Raises InputError as ``read`` does."""
        self.at(data)
        return dict(zip(self.node_ids, self._present(), strict=True))

    def at(self, data: mujoco.MjData) -> int:
        """Let the nodes read ``data`` as it is now; return its time in microseconds. Raises as ``read`` does."""
        if data is not self._data:
            self._contacts.check(data)
        try:
            now_us: int = round(1e6 * data.time)
        except (ValueError, OverflowError):
            raise InputError(f"the time of data is {data.time}: allowed is a finite one") from None
        if now_us < self._now_us:
            raise InputError(f"the time of data went back from {self._now_us} to {now_us} us: call reset() before")
        self._data, self._now_us, self._loads = data, now_us, None
        return now_us

    def _present(self) -> list[Load]:
        """Return the loads, found when first asked for."""
        if self._loads is None:
            assert self._data is not None
            axes, r_m, rows = self._data.site_xmat, FABRICATED.r_m, self._rows
            self._loads = [
                Load(_NO_TURN, _NO_LOAD, r_m, rows) if wrench is None else Load(axes[site].tolist(), wrench, r_m, rows)
                for site, wrench in zip(self._contacts.sites, self._contacts.wrenches(self._data), strict=True)
            ]
        return self._loads

    def _forces(self, k: int) -> Callable[[int], Vector]:
        """The source's function: F1, F2, F3 of finger ``k`` in the present state, whenever its conversion began."""
        return lambda _now_us: (0.0, 0.0, 0.0) if self._data is None else self._present()[k].F_newtons

    def _node(self, node_id: int, source: SimulatedSource) -> Device:
        """Return a node that is powered on and has stored the calibration."""
        store = MemoryStore()
        device = fingertip_node(node_id, source, len(self._rows), 1000 + node_id, store.save, store.load)
        self.boot_frames += device.step(0)[0]
        commit_calibration(device, self._calibration)
        download(device, communication.STORE_PARAMETERS, CALIBRATION_GROUP, b"save")
        return device


def _application(device: Device) -> Fingertip:
    assert isinstance(device.application, Fingertip)
    return device.application


def _node_ids(fingers: list[str], chosen: Mapping[str, int] | None) -> dict[str, int]:
    if not fingers:
        raise InputError("sites: allowed is one finger or more")
    if chosen is not None and set(chosen) != set(fingers):
        raise InputError(f"node_ids of {', '.join(chosen)}: allowed are those of {', '.join(fingers)}")
    by_finger = {name: k if chosen is None else chosen[name] for k, name in enumerate(fingers, 1)}
    if len(set(by_finger.values())) != len(by_finger) or not all(1 <= node_id <= 127 for node_id in by_finger.values()):
        raise InputError(f"node_ids {list(by_finger.values())}: allowed are different ones from 1 to 127")
    return by_finger
