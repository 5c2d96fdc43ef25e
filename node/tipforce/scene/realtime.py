"""Run a scene on a python-can bus in real time: the nodes in one loop, and a host in parallel that sends the SYNC.

The host has its own connection, so the frames that it records were really on the bus.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import can

from tipforce.device.codes import NMT_COB_ID, SYNC_COB_ID
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FrameBuffer
from tipforce.host.network.open_bus import open_bus
from tipforce.running import loop
from tipforce.running.ports import PythonCanPort, SocketCanPort
from tipforce.scene import schema
from tipforce.scene.build import Finger
from tipforce.scene.recording import Recording
from tipforce.scene.simulate import fault_events, sync_times

_SETTLE_S = 0.05  # after the last SYNC, for its PDOs


def run_on_bus(
    scene: schema.Scene,
    fingers: Sequence[Finger],
    duration_s: float,
    recording: Recording,
    advance: Callable[[float], None],
) -> None:
    """Run the hand for ``duration_s`` of real time. Raises EnvironmentLackError for a bus that fails or does not open.

    Frames of other nodes on that bus are recorded too. SYNCs that are late because the machine is busy stay late: the
    times in the recording show it.
    """
    options = _bus_options(scene.bus)
    with ExitStack() as opened:
        host = opened.enter_context(open_bus(**options))
        port = _port(options, opened)
        buffer = FrameBuffer()
        notifier = can.Notifier(host, [buffer], timeout=0.05)
        opened.callback(notifier.stop)
        with _running(fingers, port):
            epoch_ns, start_s = time.time_ns(), time.monotonic()
            clock_us = loop.now_us()
            for finger in fingers:
                finger.clock.start_us = clock_us - clock_us % finger.group.sample_period_us
            said: list[tuple[int, int, bytes]] = []

            def say(can_id: int, data: bytes) -> None:
                said.append((time.time_ns(), can_id, data))
                try:
                    host.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
                except can.CanError as error:
                    raise EnvironmentLackError(f"frame 0x{can_id:03X}: the bus refused it: {error}") from None

            say(NMT_COB_ID, b"\x01\x00")
            for t_us, act in _acts(scene, fingers, duration_s, say):
                _wait_until(start_s + 1e-6 * t_us)
                act()
                advance(1e-6 * t_us)
            _wait_until(start_s + duration_s)
            time.sleep(_SETTLE_S)
    frames = buffer.take_all()
    columns = (frames[name].tolist() for name in ("t_ns", "can_id", "length", "data"))
    heard = [(t_ns, can_id, bytes(data[:n])) for t_ns, can_id, n, data in zip(*columns, strict=True)]
    for t_ns, can_id, data in sorted(heard + said, key=lambda row: row[0]):
        recording.add(max(0, (t_ns - epoch_ns) // 1000), can_id, data)


def _bus_options(bus: schema.Bus | None) -> dict[str, Any]:
    if bus is None:
        # python-can's bus inside one process; a unique name keeps two runs in one process apart.
        return {"interface": "virtual", "channel": f"tipforce-run-{time.monotonic_ns()}"}
    return {"interface": bus.interface, "channel": bus.channel, "bitrate": bus.bitrate}


def _port(options: dict[str, Any], opened: ExitStack) -> loop.Port:
    """Return the nodes' own connection: the kernel's sockets for SocketCAN, python-can for every other interface."""
    if sys.platform == "linux" and options["interface"] == "socketcan" and options["channel"]:
        try:
            return SocketCanPort(options["channel"])
        except OSError as error:
            raise EnvironmentLackError(
                f"interface socketcan, channel {options['channel']}: {error.strerror}; `ip -br link` lists interfaces"
            ) from error
    return PythonCanPort(opened.enter_context(open_bus(**options)))


@contextmanager
def _running(fingers: Sequence[Finger], port: loop.Port) -> Iterator[None]:
    """Run the booted nodes in a separate thread."""
    for finger in fingers:
        port.send(finger.boot(loop.now_us()))
    stopped = threading.Event()
    devices = [finger.device for finger in fingers]
    thread = threading.Thread(target=loop.run, args=(devices, port, stopped.is_set), name="nodes")
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()


def _acts(
    scene: schema.Scene, fingers: Sequence[Finger], duration_s: float, say: Callable[[int, bytes], None]
) -> list[tuple[int, Callable[[], None]]]:
    """Return (t_us, action) in order; a fault precedes the SYNC of the same time."""
    acts: list[tuple[int, Callable[[], None]]] = []
    for at_us, finger, fault, gauge, magnitude in fault_events(scene, fingers):
        if at_us <= 1e6 * duration_s:
            acts.append((at_us, partial(_inject, finger, fault, gauge, magnitude)))
    acts += [(t_us, partial(say, SYNC_COB_ID, b"")) for t_us in sync_times(scene, duration_s)]
    return sorted(acts, key=lambda act: act[0])


def _inject(finger: Finger, fault: int, gauge: int, magnitude: float) -> None:
    finger.source.set_fault(fault, gauge, magnitude, loop.now_us())


def _wait_until(monotonic_s: float) -> None:
    remaining_s = monotonic_s - time.monotonic()
    if remaining_s > 0.0:
        time.sleep(remaining_s)
