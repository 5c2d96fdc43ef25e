"""Simulated fingers on a CAN bus, run by one thread: a substitute for hardware in the recipes and in your own tests.

The bus is any that python-can knows: ``interface="virtual"`` inside one process, ``interface="socketcan",
channel="vcan0"`` on a Linux kernel with vcan, where every other program sees the same frames.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import can
import numpy as np

from tipforce.device.node import Device
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.running import loop
from tipforce.running.ports import PythonCanPort
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import calibration_matrix, strain_matrix
from tipforce.sources.simulated import SimulatedSource

NOISE_MICROSTRAIN = 0.5


def finger(node_id: int, load: tuple[float, float, float] = (2.0, 90.0, 45.0)) -> Device:
    """A finger under ``load``: P in newtons, phi and theta in degrees. Gauge case I, as beam theory has it."""
    source = SimulatedSource(strain_matrix(FABRICATED, "I").tolist(), NOISE_MICROSTRAIN, seed=node_id)
    source.load = load
    flash: dict[str, bytes] = {}
    return fingertip_node(
        node_id,
        source,
        serial=1000 + node_id,
        save=lambda group, data: not flash.update({group: data}),
        load=flash.get,
    )


def beam_calibration() -> Calibration:
    """The calibration that such a finger would get from perfect weights."""
    covariance = np.eye(3) * (NOISE_MICROSTRAIN * 1e-6) ** 2
    return Calibration(calibration_matrix(FABRICATED, "I"), np.zeros(3), covariance, layout_code=1, pull=True)


@contextlib.contextmanager
def running(devices: Sequence[Device], **bus: Any) -> Iterator[None]:
    """Run ``devices`` on a bus (keywords of can.Bus) until the block ends. A failure in their loop is raised there."""
    stopped = threading.Event()
    failures: list[Exception] = []
    with can.Bus(**bus) as opened:

        def work() -> None:
            try:
                loop.run(devices, PythonCanPort(opened), stopped.is_set)
            except Exception as error:
                failures.append(error)

        thread = threading.Thread(target=work, name="simulated hand")
        thread.start()
        try:
            yield
        finally:
            stopped.set()
            thread.join()
    if failures:
        raise failures[0]
