"""A simulated hand for `tipforce demo --view`: five fingers on an in-process bus, moving loads, occasional faults."""

from __future__ import annotations

import contextlib
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
from tipforce.sources.simulated import OPEN, SILENT, SimulatedSource
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


@contextlib.contextmanager
def simulated_hand(moving: bool = True) -> Iterator[tuple[Hand, list[SimulatedSource]]]:
    """Return a simulated hand, not yet commissioned, and the gauges of its fingers, which run in a thread.

    ``moving``: a second thread moves the loads, injects faults and unplugs a finger; otherwise nothing changes.
    """
    sources = [simulated_source(case, seed) for seed, case in enumerate(CASES)]
    devices: list[Device] = []
    for node_id, source in enumerate(sources, 1):
        store = MemoryStore()
        devices.append(fingertip_node(node_id, source, serial=node_id, save=store.save, load=store.load))
    channel, stopped = f"tipforce-view-{id(devices)}", threading.Event()
    threads = [threading.Thread(target=_run, args=(devices, channel, stopped), name="nodes", daemon=True)]
    if moving:
        threads.append(threading.Thread(target=_move, args=(sources, devices, stopped), name="loads", daemon=True))
    with tempfile.TemporaryDirectory(prefix="tipforce-view-") as folder:
        file = _hand_file(Path(folder), channel)
        for thread in threads:
            thread.start()
        try:
            with Hand(file) as hand:
                yield hand, sources
        finally:
            stopped.set()
            for thread in threads:
                thread.join(2.0)


def _hand_file(folder: Path, channel: str) -> HandFile:
    plans = []
    for node_id, (name, case, pull) in enumerate(zip(NAMES, CASES, PULLS, strict=True), 1):
        calibration = f"{name}.toml"
        write_calibration(folder / calibration, replace(case_calibration(case, pull), serial=node_id))
        plans.append(FingerPlan(node_id=node_id, name=name, serial=node_id, calibration=calibration, layout=case))
    return HandFile(
        finger=tuple(plans), hand=HandPlan(sync_hz=SYNC_HZ, pdos=("contact", "gauges"), heartbeat_ms=HEARTBEAT_MS),
        bus={"interface": "virtual", "channel": channel}, folder=str(folder),
    )  # fmt: skip


def _run(devices: list[Device], channel: str, stopped: threading.Event) -> None:
    with can.Bus(interface="virtual", channel=channel) as bus:
        loop.run(devices, PythonCanPort(bus), stopped.is_set)


def _move(sources: list[SimulatedSource], running: list[Device], stopped: threading.Event) -> None:
    """Move the loads; ``running`` loses the unplugged finger for a while."""
    begun_s, devices = time.monotonic(), list(running)
    while not stopped.wait(_STEP_S):
        t_s = time.monotonic() - begun_s
        for k, source in enumerate(sources):
            source.load = load_at(k, t_s)
        t_s %= FAULT_CYCLE_S
        for begin_s, end_s, finger, fault in FAULTS:
            wanted = fault if begin_s <= t_s < end_s else 0
            if sources[finger].fault != wanted:
                sources[finger].set_fault(wanted, 1, 0.0, loop.now_us())
        begin_s, end_s, finger = UNPLUGGED
        plugged = not begin_s <= t_s < end_s
        if plugged != (devices[finger] in running):
            (running.append if plugged else running.remove)(devices[finger])
