"""What the examples of a page need and its reader need not see: files, nodes on a bus inside the process."""

from __future__ import annotations

import contextlib
import itertools
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from simulated_hand import beam_calibration, finger, running

from tipforce.host.network.connection import Connection
from tipforce.host.network.finger import FingertipClient
from tipforce.host.configuration.measurements import Measurements, write_measurements
from tipforce.sensor.calibration.fit import Readings
from tipforce.sensor.calibration.simulation import simulate

Names = dict[str, Any]
Setup = Callable[[], contextlib.AbstractContextManager[Names]]
SETUPS: dict[str, Setup] = {}
_CHANNELS = itertools.count()


def setup(page: str) -> Callable[[Callable[[], Iterator[Names]]], Setup]:
    """Register the set-up of a page; it runs in an empty working directory and yields names for the page's Python."""

    def register(function: Callable[[], Iterator[Names]]) -> Setup:
        SETUPS[page] = contextlib.contextmanager(function)
        return SETUPS[page]

    return register


@setup("tools.md")
def log_of_one_finger() -> Iterator[Names]:
    """Node 5 at 100 Hz for 1 s: 1.5 N until 0.6 s, then no contact; samples 40 to 42 are missing, heartbeats twice."""
    lines = [f"({1_700_000_000 + t:.6f}) can0 705#05" for t in (0.001, 0.501)]
    for k in range(100):
        t = 1_700_000_000 + k / 100
        contact = (1500, 9000, 4500, 0x03) if k < 60 else (5, -32768, -32768, 0x12)
        lines.append(f"({t:.6f}) can0 080#")
        if not 40 <= k < 43:
            lines.append(f"({t + 0.0002:.6f}) can0 285#{struct.pack('<hhhBB', *contact, k).hex().upper()}")
    Path("run.log").write_text("\n".join(sorted(lines)) + "\n")
    yield {}


@contextlib.contextmanager
def fingers_on_default_bus(*node_ids: int) -> Iterator[None]:
    """Calibrated simulated fingers under 2 N on a bus of this process, which is python-can's default meanwhile."""
    bus = {"interface": "virtual", "channel": f"docs-{next(_CHANNELS)}"}
    with pytest.MonkeyPatch.context() as patch, running([finger(n) for n in node_ids], **bus):
        patch.setitem(can.rc, "interface", bus["interface"])
        patch.setitem(can.rc, "channel", bus["channel"])
        with Connection.open(**bus) as connection:
            for n in node_ids:
                FingertipClient(connection.sdo(n)).apply_calibration(beam_calibration(), store=False)
        yield


@setup("hand.md")
def two_fingers() -> Iterator[Names]:
    """Nodes 1 and 2."""
    with fingers_on_default_bus(1, 2):
        yield {}


@setup("calibration.md")
def simulated_calibration() -> Iterator[Names]:
    """grooves.csv with faults in lines 50 and 61; the true matrix, and the loads of the rows without fault."""
    sim = simulate("I", np.random.default_rng(4))
    assert (np.flatnonzero(sim.true_outlier) + 2).tolist() == [50, 61]
    loads = (sim.P_newtons, sim.phi_rad, sim.theta_rad)
    write_measurements("grooves.csv", Measurements(np.arange(77), sim.strain, *loads, sim.t_s, None, None, None, (), ()))
    good = ~sim.true_outlier
    yield {"true_A": sim.true_A, "loads": Readings(sim.strain[good], *(values[good] for values in loads))}
