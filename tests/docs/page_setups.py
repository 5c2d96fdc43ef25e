"""What the examples of a page need and its reader need not see: files, nodes on a bus inside the process."""

import contextlib
import functools
import itertools
import math
import os
import pty
import select
import struct
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from bench.measure import background

import tipforce
from canopen_device.running.store import FileStore
from canopen_device.testing import Conversation, MemoryStore, text
from docs.runner import Terminal
from fingertip.finger import forces
from host.bus_with_nodes import beam_calibration, new_channel, running
from sources.iio_tree import Tree
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration, write_calibration
from tipforce.sensor import Readings
from tipforce.sensor.calibration.simulation import simulate
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources import iio_sysfs
from tipforce.sources.iio_gauges import Capture, open_iio
from tipforce.sources.layout_file import read_bridge
from tipforce.sources.simulated import SimulatedSource
from tipforce_tools.doctor import machine
from tools.rig import message as can_message
from tools.rig import write_readings

Names = dict[str, Any]
Setup = Callable[[], contextlib.AbstractContextManager[Names]]
SETUPS: dict[str, Setup] = {}


def setup(page: str) -> Callable[[Callable[[], Iterator[Names]]], Setup]:
    """Register the set-up of a page; it runs in an empty working directory and yields names for the page's Python."""

    def register(function: Callable[[], Iterator[Names]]) -> Setup:
        SETUPS[page] = contextlib.contextmanager(function)
        return SETUPS[page]

    return register


@setup("decode.md")
def logs_of_fingers() -> Iterator[Names]:
    """run.log of one finger, and two days of two fingers."""
    write_log_of_one_finger()
    write_two_days_of_two_fingers()
    yield {}


def pdos(t_s: float, node: int, counter: int, status: int, **values: Sequence[int]) -> list[str]:
    """Lines of candump with a finger's ``gauges`` and ``contact``, those that are given."""
    bases = {"gauges": 0x180, "contact": 0x280}
    data = {bases[name] + node: struct.pack("<hhhBB", *each, status, counter % 256) for name, each in values.items()}
    return [f"({t_s:.6f}) can0 {can_id:03X}#{each.hex().upper()}" for can_id, each in data.items()]


def write_log_of_one_finger() -> None:
    """Node 5 at 100 Hz for 1 s: 1.5 N until 0.6 s, then no contact; samples 40 to 42 are missing, heartbeats twice."""
    lines = [f"({1_700_000_000 + t:.6f}) can0 705#05" for t in (0.001, 0.501)]
    for k in range(100):
        t = 1_700_000_000 + k / 100
        status, contact = (0x03, (1500, 9000, 4500)) if k < 60 else (0x12, (5, -32768, -32768))
        lines.append(f"({t:.6f}) can0 080#")
        if not 40 <= k < 43:
            lines += pdos(t + 0.0002, 5, k, status, contact=contact)
    Path("run.log").write_text("\n".join(sorted(lines)) + "\n")


def write_two_days_of_two_fingers() -> None:
    """Logs of nodes 1 and 2 on two days, at 10 Hz for 30 s: grips of 2 s, a drift of SG1, lost samples, a boot-up."""
    for day in range(2):
        lines = []
        for k in range(300):
            t = 1_700_000_000 + 86_400 * day + k / 10
            lines.append(f"({t:.6f}) can0 080#")
            for node in (1, 2):
                touched = k % 100 < 20 * node
                if (day, node) == (1, 2) and k in (50, 51):
                    continue
                contact = (1000 * node + k, 9000, 4500) if touched else (0, -32768, -32768)
                gauges = (300 * node if touched else 20 * day * node, 10, -10)
                status = 0x03 if touched else 0x02
                lines += pdos(t + 0.0001 * node, node, k + 300 * day, status, gauges=gauges, contact=contact)
        lines.append(f"({t + 1:.6f}) can0 702#00")
        Path(f"day-{day + 1}.log").write_text("\n".join(lines) + "\n")


@contextlib.contextmanager
def default_bus() -> Iterator[dict[str, Any]]:
    """A bus inside this process that python-can's configuration names."""
    bus = {"interface": "virtual", "channel": new_channel()}
    with pytest.MonkeyPatch.context() as patch:
        for key, value in bus.items():
            patch.setitem(can.rc, key, value)
        yield bus


@contextlib.contextmanager
def fingers_on_default_bus(*node_ids: int) -> Iterator[None]:
    """Calibrated simulated fingers under 2 N on a bus of this process, which is python-can's default meanwhile."""
    with default_bus() as bus, tipforce.simulated_hand(node_ids, dict.fromkeys(node_ids, (2.0, 90.0, 45.0)), **bus):
        yield


@contextlib.contextmanager
def serial_adapter(bus: can.BusABC) -> Iterator[str]:
    """A USB adapter with the slcan protocol (Lawicel) on a bus: the path of its pseudo-terminal."""
    master, terminal = pty.openpty()
    tty.setraw(terminal)

    def work(stop: threading.Event) -> None:
        received, is_open = b"", False
        while not stop.is_set():
            if select.select([master], [], [], 0.001)[0]:
                *commands, received = (received + os.read(master, 4096)).split(b"\r")
                for command in map(bytes.decode, commands):
                    if command[:1] in ("O", "C"):
                        is_open = command == "O"
                    elif command[:1] == "t":
                        bus.send(can_message(int(command[1:4], 16), bytes.fromhex(command[5:])))
            while (message := bus.recv(0)) is not None:
                if is_open:
                    line = f"t{message.arbitration_id:03X}{message.dlc}{message.data.hex().upper()}\r"
                    os.write(master, line.encode())

    with bus, background(work):
        yield os.ttyname(terminal)
    os.close(master)
    os.close(terminal)


@setup("adapter.md")
def finger_behind_a_serial_adapter() -> Iterator[Names]:
    """Node 5 under 1.95 N, which the noise never shows as 2, behind /dev/ttyACM0."""
    pytest.importorskip("serial")
    finger = {5: (1.95, 90.0, 45.0)}
    with default_bus() as bus, tipforce.simulated_hand([5], finger, **bus), serial_adapter(can.Bus(**bus)) as path:
        terminal = Terminal()
        yield {"shell": lambda line: terminal(line.replace("/dev/ttyACM0", path))}


@setup("hand.md")
def two_fingers() -> Iterator[Names]:
    """Nodes 1 and 2."""
    with fingers_on_default_bus(1, 2):
        yield {}


@setup("calibration.md")
def simulated_calibration() -> Iterator[Names]:
    """grooves.csv with faults in lines 9 and 61; the true matrix, and the loads of the rows without fault."""
    sim = simulate("I", np.random.default_rng(4))
    assert (np.flatnonzero(sim.true_outlier) + 2).tolist() == [9, 61]
    loads = (sim.P_newtons, sim.phi_rad, sim.theta_rad)
    write_readings(Path("grooves.csv"), sim)
    good = ~sim.true_outlier
    yield {"true_A": sim.true_A, "loads": Readings(sim.strain[good], *(values[good] for values in loads))}


def beam_record(noise_strain: float, serial: int) -> Calibration:
    """Gauge case I as beam theory has it."""
    return beam_calibration(covariance_strain2=np.eye(3) * noise_strain**2, serial=serial, date=20261121)


class Bench:
    """Files that look like a 16-bit converter of Linux Industrial I/O, and a node that reads them."""

    def __init__(self, folder: Path, bus: dict[str, Any]) -> None:
        self.bus = bus
        folder.mkdir()
        tree, channels = Tree(folder.absolute()), {f"voltage{k}": 0 for k in range(3)}
        self.chip = tree.add(0, "spi0.0", channels, "ad7124-4", "be:u16/16>>0", in_voltage_scale="0.0503540")
        self.devices = tree.root
        self.node = contextlib.ExitStack()
        self.gauges_read([0.0, 0.0, 0.0])

    def gauges_read(self, microstrains: list[float]) -> None:
        """Set the counts; a value that is read without SYNC is at most 100 ms old."""
        for k, microstrain in enumerate(microstrains):
            volts = 1.65 + 1.02 * 250.0 * 1.65e-6 * microstrain  # gain 250, and 2 % more
            (self.chip / f"in_voltage{k}_raw").write_text(f"{round(volts / 50.354e-6)}\n")
        time.sleep(0.15)

    def hang(self, P_newtons: float, phi_deg: float, theta_deg: float) -> None:
        """Put a load on the tip."""
        self.gauges_read((1e6 * strain_matrix(FABRICATED, "I") @ forces((P_newtons, phi_deg, theta_deg))).tolist())

    def start_node(self) -> None:
        """`tipforce node` with finger.toml, in a thread."""
        bridge = read_bridge("finger.toml")
        source = open_iio("spi0.0", "finger.toml", 3, bridge, Capture("poll"), self.devices)
        store = FileStore(Path("node-5.json").absolute())
        device = fingertip_node(5, source, serial=5, save=store.save, load=store.load)
        self.node.enter_context(running([device], self.bus["channel"]))
        time.sleep(0.15)

    def stop_node(self) -> None:
        """End it."""
        self.node.close()

    def disconnect(self) -> None:
        """Take the converter away."""
        self.chip.rename(self.chip.with_name("disconnected"))
        time.sleep(0.3)

    def connect(self) -> None:
        """Put it back."""
        self.chip.with_name("disconnected").rename(self.chip)
        time.sleep(0.4)


@setup("hardware.md")
def converter_and_node() -> Iterator[Names]:
    """The converter, its node, and the calibration that perfect weights would give."""
    with default_bus() as bus, pytest.MonkeyPatch.context() as patch:
        bench = Bench(Path("kernel"), bus)
        patch.setattr(iio_sysfs, "ROOT", bench.devices)
        checks = functools.partial(machine.iio_checks, bench.devices, Path("kernel"), Path("none"))
        patch.setattr(machine, "iio_checks", checks)
        write_calibration(Path("calibration.toml"), beam_record(4e-8, serial=1))
        try:
            yield {
                "shell": Terminal("-q"),
                "read_by_gauges": bench.gauges_read,
                **{name: getattr(bench, name) for name in ("hang", "start_node", "stop_node", "disconnect", "connect")},
            }
        finally:
            bench.stop_node()


class ByteByByte:
    """The node of protocol.md. ``cansend can0 FRAME`` prints the frames that it sends in response."""

    def __init__(self) -> None:
        self.source = SimulatedSource(strain_matrix(FABRICATED, "I").tolist())
        self.source.load = (4.4, 90.0, 45.0)
        flash = MemoryStore()
        self.talk = Conversation(fingertip_node(5, self.source, save=flash.save, load=flash.load), emcy=True)
        self.record = beam_record(0.5e-6, serial=7).record()

    def __call__(self, line: str) -> None:
        """Run one line of the page."""
        if line != "# power on":
            assert line.startswith("cansend can0 ")
            self.talk.now_us += 1000
            self.talk.send(line.split()[2])
        for frame in self.talk.take():
            print(text(frame))

    def send_segments(self, first: int, end: int) -> None:
        """The segments of the record that the page leaves out; each must be confirmed."""
        for k in range(first, end):
            toggle, segment = (k % 2) << 4, self.record[7 * k : 7 * k + 7]
            self.talk.step([(0x605, bytes((toggle,)) + segment)])
            assert self.talk.take() == [(0x585, bytes((0x20 | toggle,)) + bytes(7))]


@setup("protocol.md")
def node_byte_by_byte() -> Iterator[Names]:
    """The node, its source, and the record that the page writes."""
    node = ByteByByte()
    yield {"shell": node, "source": node.source, "send_segments": node.send_segments}


@setup("python.md")
def finger_and_files() -> Iterator[Names]:
    """Node 5 under 2 N at phi = 90, theta = 45 degrees, and a table of loads with an offset of 12 microstrain."""
    A, rng = strain_matrix(FABRICATED, "I"), np.random.default_rng(1)
    directions = ((0, 20), (0, 60), (90, 30), (90, 60), (90, 90), (90, 120), (180, 120), (180, 160))
    rows = ["SG1,SG2,SG3,P_N,phi_deg,theta_deg"]
    for P, (phi, theta) in itertools.product((0.0, 2.2, 4.4), directions):
        V = 1e6 * A @ force_vector(P, math.radians(phi), math.radians(theta)) + 12 + rng.normal(0, 0.5, 3)
        rows.append(",".join(str(value) for value in (*V.round(2), P, phi, theta)))
    Path("grooves.csv").write_text("\n".join(rows) + "\n")
    with fingers_on_default_bus(5):
        yield {}


@setup("simulate.md")
def lamp_of_the_page() -> Iterator[Names]:
    """The EDS that the page shows."""
    page = (Path(__file__).parents[2] / "docs" / "simulate.md").read_text(encoding="utf-8")
    Path("lamp.eds").write_text(page.split("```ini\n")[1].split("```")[0])
    yield {}
