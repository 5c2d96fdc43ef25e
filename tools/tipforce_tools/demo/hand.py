"""A simulated hand for `tipforce demo --view`: five fingers on an in-process bus, moving loads, occasional faults."""

from __future__ import annotations

import contextlib
import itertools
import math
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import can

from canopen_device.core.node import Device
from canopen_device.running import loop
from canopen_device.running.ports import PythonCanPort
from canopen_device.running.store import MemoryStore
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand
from tipforce.sources.simulated import OPEN, SILENT
from tipforce_tools.demo.job import case_calibration, simulated_source

NAMES = ("thumb", "index", "middle", "ring", "little")
CASES = ("I", "II", "III", "I", "II")
PULLS = (False, False, False, True, False)
SYNC_HZ = 50.0
HEARTBEAT_MS = 250
FAULT_CYCLE_S = 24.0
FAULTS = ((8.0, 11.0, 2, OPEN), (14.0, 16.5, 4, SILENT))
"""(begin, end) within the cycle, the finger, and the fault (2200h)."""
UNPLUGGED = (19.0, 22.0, 1)
_STEP_S = 0.01
_CHANNELS = itertools.count()


def load_at(finger: int, t_s: float) -> tuple[float, float, float]:
    """Return (P newtons, phi and theta in degrees) of a contact that rolls over the tip, ends, and starts again.

    A push is inclined towards the centre, a pull away from it, by a friction angle of at most about 20 degrees.
    """
    phase = 0.9 * finger
    theta = 90.0 + 48.0 * math.sin(0.45 * t_s + phase)
    grip = math.sin(0.31 * t_s + 1.7 * phase)
    P = max(0.0, 2.4 + 2.6 * grip + 0.25 * math.sin(2.1 * t_s + phase))
    lean = 18.0 * math.sin(0.8 * t_s + 2.0 * phase)
    phi = theta + lean + (0.0 if PULLS[finger % len(PULLS)] else 180.0)
    return P, (phi + 180.0) % 360.0 - 180.0, theta


class SimulatedHand:
    """The nodes in one thread, and a second thread that moves the loads. ``moving`` False: constant loads."""

    def __init__(self, folder: Path, sync_hz: float = SYNC_HZ, moving: bool = True, faults: bool = True) -> None:
        self.channel = f"tipforce-view-{next(_CHANNELS)}"
        self.sources = [simulated_source(case, seed) for seed, case in enumerate(CASES)]
        self.devices: list[Device] = []
        plans = []
        for k, (name, source) in enumerate(zip(NAMES, self.sources, strict=True)):
            store = MemoryStore()
            self.devices.append(fingertip_node(k + 1, source, serial=k + 1, save=store.save, load=store.load))
            calibration = replace(case_calibration(CASES[k], PULLS[k]), serial=k + 1)
            write_calibration(folder / f"{name}.toml", calibration)
            plans.append(
                FingerPlan(node_id=k + 1, name=name, serial=k + 1, calibration=f"{name}.toml", layout=CASES[k])
            )
        self.file = HandFile(
            finger=tuple(plans), hand=HandPlan(sync_hz=sync_hz, pdos=("contact", "gauges"), heartbeat_ms=HEARTBEAT_MS),
            bus={"interface": "virtual", "channel": self.channel}, folder=str(folder),
        )  # fmt: skip
        self._running = list(self.devices)
        self._stopped = threading.Event()
        self._threads = [threading.Thread(target=self._run, name="nodes", daemon=True)]
        if moving:
            self._threads.append(threading.Thread(target=self._move, args=(faults,), name="loads", daemon=True))

    def plug(self, finger: int, plugged: bool) -> None:
        """Disconnect a finger (from 0) from the bus, or reconnect it."""
        device = self.devices[finger]
        if plugged and device not in self._running:
            self._running.append(device)
        elif not plugged and device in self._running:
            self._running.remove(device)

    def start(self) -> None:
        """Power on."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Power off."""
        self._stopped.set()
        for thread in self._threads:
            thread.join(2.0)

    def _run(self) -> None:
        with can.Bus(interface="virtual", channel=self.channel) as bus:
            loop.run(self._running, PythonCanPort(bus), self._stopped.is_set)

    def _move(self, faults: bool) -> None:
        begun_s = time.monotonic()
        while not self._stopped.wait(_STEP_S):
            t_s = time.monotonic() - begun_s
            for k, source in enumerate(self.sources):
                source.load = load_at(k, t_s)
            if faults:
                self._fail(t_s % FAULT_CYCLE_S)

    def _fail(self, t_s: float) -> None:
        now_us = loop.now_us()
        for begin_s, end_s, finger, fault in FAULTS:
            wanted = fault if begin_s <= t_s < end_s else 0
            if self.sources[finger].fault != wanted:
                self.sources[finger].set_fault(wanted, 1, 0.0, now_us)
        begin_s, end_s, finger = UNPLUGGED
        self.plug(finger, not begin_s <= t_s < end_s)


@contextlib.contextmanager
def simulated_hand(
    moving: bool = True, faults: bool = True, sync_hz: float = SYNC_HZ
) -> Iterator[tuple[Hand, SimulatedHand]]:
    """Return a simulated hand, not yet commissioned, and its nodes."""
    with tempfile.TemporaryDirectory(prefix="tipforce-view-") as folder:
        nodes = SimulatedHand(Path(folder), sync_hz, moving, faults)
        nodes.start()
        try:
            with Hand(nodes.file) as hand:
                yield hand, nodes
        finally:
            nodes.close()
