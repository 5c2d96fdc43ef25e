"""The loop of a node: its clock, its end, and hours of it."""

import errno
import subprocess
import time
from collections.abc import Iterable
from itertools import pairwise

import pytest
from bench import endurance

from canopen_device.core.codes import LSS_UNCONFIGURED
from canopen_device.core.emcy import TRANSMIT_OVERFLOW
from canopen_device.running import loop, ports
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource

ROWS = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4))


class Port:
    """A bus where nobody speaks, on a monotonic clock that the test moves."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = 10**9
        self.sent: list[tuple[float, int, bytes]] = []
        monkeypatch.setattr(time, "monotonic_ns", lambda: self.now_ns)

    def receive(self, timeout_s: float) -> loop.Frame | None:
        self.now_ns += max(1000, round(1e9 * timeout_s))
        return None

    def send(self, frames: Iterable[loop.Frame]) -> None:
        self.sent += [(self.now_ns * 1e-9, can_id, data) for can_id, data in frames]

    def request(self, what: str, value: int, delay_ms: int) -> None:
        """Nothing to do."""


def test_the_time_of_day_plays_no_part(monkeypatch: pytest.MonkeyPatch) -> None:
    port = Port(monkeypatch)

    def must_not_be_asked() -> float:
        raise AssertionError("the loop asked for the time of day, which may jump")

    monkeypatch.setattr(time, "time", must_not_be_asked)
    monkeypatch.setattr(time, "time_ns", must_not_be_asked)
    loop.run([fingertip_node(5, SimulatedSource(ROWS))], port, lambda: port.now_ns > 8 * 10**9)
    beats = [now_s for now_s, can_id, data in port.sent if (can_id, data) == (0x705, b"\x7f")]
    assert len(beats) >= 6
    assert all(after - before == pytest.approx(1.0, abs=1e-3) for before, after in pairwise(beats))


def test_nodes_that_end_say_that_they_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    port = Port(monkeypatch)
    devices = [fingertip_node(node_id, SimulatedSource(ROWS)) for node_id in (5, LSS_UNCONFIGURED, 7)]
    loop.run(devices, port, lambda: port.now_ns > 2 * 10**9)
    port.sent.clear()
    loop.say_stopped(devices, port)
    assert [(can_id, data) for _, can_id, data in port.sent] == [(0x705, b"\4"), (0x707, b"\4")]


def test_a_bus_where_nobody_listens_does_not_fill_the_log(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    full = [True]

    class Socket:
        def send(self, _frame: bytes) -> None:
            if full[0]:
                raise OSError(errno.ENOBUFS, "No buffer space available")

    monkeypatch.setattr(ports, "_bound_socket", lambda _name: Socket())
    monkeypatch.setattr(ports, "_FULL_QUEUE_WAIT_S", 0.0)
    port = ports.SocketCanPort("can0")
    for full[0] in (True, False, True):
        port.send([(0x705, b"\5")] * 100)
    assert caplog.text.count("No buffer space available") == 2
    assert port.receive(0.0) == TRANSMIT_OVERFLOW, "the device hears of it all the same (EMCY 8110h)"


@pytest.mark.parametrize(
    ("kind", "touched"),
    [('[{"ifname": "x", "linkinfo": {"info_kind": "can"}}]', True), ('[{"linkinfo": {"info_kind": "vcan"}}]', False),
     ("[{}]", False), ("", False)],
)  # fmt: skip
def test_only_a_link_with_bit_timing_is_switched(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, kind: str, touched: bool
) -> None:
    """LSS "activate bit timing": vcan would be set down and up, and lose frames, for nothing."""
    commands: list[list[str]] = []

    def run(command: list[str], **_options: object) -> subprocess.CompletedProcess[str]:
        if "show" not in command:
            commands.append(command)
        return subprocess.CompletedProcess(command, 0, kind, "")

    monkeypatch.setattr(ports, "_bound_socket", lambda _name: None)
    monkeypatch.setattr(subprocess, "run", run)
    ports.SocketCanPort("x").request("bit-rate", 500_000, 0)
    switched = ["down", "type can bitrate 500000", "up"] if touched else []
    assert [" ".join(command) for command in commands] == [f"ip link set x {words}" for words in switched]
    assert ("x has no bit timing: LSS requests 500000 bit/s" in caplog.text) is not touched


def test_an_endless_loop_is_asked_to_stop_five_times_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    port = Port(monkeypatch)
    device = fingertip_node(5, SimulatedSource(ROWS))
    device.od.values[0x101700] = 0
    asked: list[int] = []

    def stop() -> bool:
        asked.append(port.now_ns)
        return port.now_ns > 5 * 10**9

    loop.run([device], port, stop)
    assert all(after - before <= 200_001_000 for before, after in pairwise(asked)), "a watchdog of 1 s can be fed"


def test_two_hours_leave_no_trace() -> None:
    first, second = endurance.run(2)
    assert second.blocks - first.blocks < 100
    assert second.resident_kb - first.resident_kb < 1024
    assert second.late_us == 0, "each PDO at its SYNC, each heartbeat on its second"
    assert second.heartbeats - first.heartbeats == 3600
    assert second.syncs - first.syncs == 35_999, "one SYNC is lost each hour"
    # Ten SYNCs fall into the outage, of which one finds the device back only at the next try.
    assert 10 <= (second.syncs - first.syncs) - (second.samples - first.samples) <= 12
    assert (second.emcys - first.emcys, second.log_lines - first.log_lines) == (4, 2)
