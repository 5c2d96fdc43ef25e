"""The fingers of the soak: nodes that were brought up once, and then live in simulated time."""

from __future__ import annotations

import math
import random
import tempfile
import threading
from pathlib import Path

import can
import numpy as np

from tipforce.device import communication
from tipforce.device.codes import NMT_COB_ID
from tipforce.device.node import Device
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.calibration_file import write_calibration
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand
from tipforce.host.hand.sync_numbers import LARGEST
from tipforce.running import loop
from tipforce.running.ports import PythonCanPort
from tipforce.running.store import FileStore
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import calibration_matrix, strain_matrix
from tipforce.sources.simulated import SimulatedSource

NOISE_MICROSTRAIN = 0.5
_CONTACT = 0x280


def calibration() -> Calibration:
    """What the simulated fingers are."""
    return Calibration(
        C=calibration_matrix(FABRICATED, "I"), offset_strain=np.zeros(3), serial=1, date=20260102, layout_code=1,
        covariance_strain2=np.eye(3) * (NOISE_MICROSTRAIN * 1e-6) ** 2, pull=True,
    )  # fmt: skip


class Finger:
    """One node; power and converter can fail until a stated time."""

    def __init__(self, node_id: int, blobs: dict[str, bytes], seed: int) -> None:
        self.node_id = node_id
        self.last_contact = b""
        self._blobs, self._seed = blobs, seed
        self._random = random.Random(seed)
        self._off_until_s = self._broken_until_s = -1.0
        self._booted_s = 0.0
        self._device = self._power()

    def _power(self) -> Device:
        self.source = SimulatedSource(strain_matrix(FABRICATED, "I").tolist(), NOISE_MICROSTRAIN, seed=self._seed)
        return fingertip_node(self.node_id, self.source, serial=self.node_id, load=self._blobs.get)

    @property
    def well(self) -> bool:
        """Nothing is wrong with it."""
        return self._off_until_s < 0.0 and self._broken_until_s < 0.0

    def switch_off(self, until_s: float) -> None:
        """Power loss."""
        self._off_until_s = until_s

    def break_source(self, fault: int, until_s: float) -> None:
        """A fault of 2200h."""
        self._broken_until_s = until_s
        self.source.set_fault(fault, 1 + self._random.randrange(3), 50.0, 0)

    def end_trouble(self, now_s: float) -> None:
        """Power comes back, the converter works again."""
        if 0.0 <= self._off_until_s <= now_s:
            self._off_until_s, self._booted_s = -1.0, now_s
            self._device = self._power()
        if 0.0 <= self._broken_until_s <= now_s:
            self._broken_until_s = -1.0
            self.source.set_fault(0, 1, 0.0, 0)

    def step(self, now_s: float, frames: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
        """Give it frames and the time."""
        if self._off_until_s >= 0.0:
            return []
        if any(can_id == NMT_COB_ID for can_id, _ in frames):  # the hand numbers the SYNC before it starts a finger
            self._device.od.values[communication.SYNC_OVERFLOW << 8] = LARGEST
        P = 2.0 + 1.5 * math.sin(now_s + self.node_id)
        self.source.load = (P, 40.0 * math.sin(0.7 * now_s), 30.0)
        sent, _due_us = self._device.step(round((now_s - self._booted_s) * 1e6), frames)
        found = [(can_id, bytes(data)) for can_id, data in sent]
        for can_id, data in found:
            if can_id == _CONTACT + self.node_id:
                self.last_contact = data
        return found


def stored_fingers(count: int, seed: int) -> list[Finger]:
    """Bring ``count`` nodes up on an in-process bus as a hand does, and keep what they stored."""
    channel = f"soak-{seed}-{count}"
    with tempfile.TemporaryDirectory() as folder:
        stores = {n: FileStore(Path(folder) / f"{n}.json") for n in range(1, count + 1)}
        rows = strain_matrix(FABRICATED, "I").tolist()
        devices = [
            fingertip_node(n, SimulatedSource(rows), serial=n, save=store.save, load=store.load)
            for n, store in stores.items()
        ]
        stopped = threading.Event()
        with can.Bus(interface="virtual", channel=channel) as bus:
            port = PythonCanPort(bus)
            thread = threading.Thread(target=loop.run, args=(devices, port, stopped.is_set), name="nodes")
            thread.start()
            try:
                _bring_up(channel, Path(folder), count)
            finally:
                stopped.set()
                thread.join()
        groups = ("communication", "application", "calibration", "lss")
        blobs = {n: {g: blob for g in groups if (blob := s.load(g)) is not None} for n, s in stores.items()}
    return [Finger(n, blobs[n], seed + n) for n in blobs]


def _bring_up(channel: str, folder: Path, count: int) -> None:
    write_calibration(folder / "cal.toml", calibration())
    fingers = tuple(FingerPlan(node_id=n, serial=n, calibration="cal.toml") for n in range(1, count + 1))
    file = HandFile(
        finger=fingers, hand=HandPlan(heartbeat_ms=100, store=True),
        bus={"interface": "virtual", "channel": channel}, folder=str(folder),
    )  # fmt: skip
    with Hand(file) as hand:
        failed = [str(report) for report in hand.bring_up() if not report.ok]
    if failed:
        raise RuntimeError("; ".join(failed))
