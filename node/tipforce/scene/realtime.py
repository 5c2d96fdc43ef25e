"""Run a scene on a python-can bus in real time: the nodes in one loop, and a host in parallel that sends the SYNC. The
host has its own connection, so the frames that it records were really on the bus."""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack

import can

from canopen_device.core.codes import NMT_COB_ID, SYNC_COB_ID
from canopen_device.running import loop
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FrameBuffer
from tipforce.host.network.interfaces import open_bus, open_port
from tipforce.scene import schema
from tipforce.scene.build import Finger, actions
from tipforce.scene.results import Recording

_LOG = logging.getLogger(__name__)
_AFTER_ERROR_S = 0.05
_SETTLE_S = 0.05  # without a frame, after the last SYNC
_MOST_SETTLES = 20


class _NodesPort:
    """The nodes' port; ``answered`` counts the SYNCs whose answers were sent."""

    def __init__(self, port: loop.Port) -> None:
        self._port = port
        self._sync = False
        self.answered = 0
        self.send, self.request = port.send, port.request

    def receive(self, timeout_s: float) -> loop.Frame | None:
        """Return the next frame; the loop has answered the one before."""
        self.answered += self._sync
        self._sync = False
        frame = self._port.receive(timeout_s)
        self._sync = frame is not None and frame[0] == SYNC_COB_ID
        return frame


class _Master(FrameBuffer):
    """The frames that the host sends, and those that it receives. An error of the bus does not end the reception."""

    def __init__(self, bus: can.BusABC) -> None:
        super().__init__()
        self._bus = bus
        self._said: list[tuple[int, int, bytes]] = []
        self._refused = self._received = 0
        self.syncs = 0
        self._error: Exception | None = None  # of the last frame
        self._failure: Exception | None = None  # of the reception, until a frame passes
        self.epoch_ns = time.time_ns()

    def __call__(self, msg: can.Message) -> None:
        self._failure = None
        self._received += 1
        super().__call__(msg)

    def on_error(self, exc: Exception) -> None:
        """Continue; without this python-can's thread would end. A bus that fails repeatedly must not occupy a core."""
        self._failure = exc
        time.sleep(_AFTER_ERROR_S)

    def settle(self, port: _NodesPort) -> None:
        """Wait until the nodes have answered and no frame arrives: on a busy machine both may be late."""
        for _ in range(_MOST_SETTLES):
            before, answered = self._received, port.answered >= self.syncs  # an answer just sent is not received yet
            time.sleep(_SETTLE_S)
            if answered and self._received == before:
                return

    def say(self, can_id: int, data: bytes) -> None:
        """Send a frame; one that the bus refuses is counted, because the bus may recover."""
        t_ns = time.time_ns()
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        except (can.CanError, OSError) as error:
            if not self._said:
                raise EnvironmentLackError(f"frame 0x{can_id:03X}: the bus refused it: {error}") from None
            if self._error is None:
                _LOG.warning("the bus failed: %s; the run continues when it works again", error)
            self._error = error
            self._refused += 1
        else:
            self._said.append((t_ns, can_id, data))
            self.syncs += can_id == SYNC_COB_ID
            self._error = None

    def record(self, recording: Recording) -> None:
        """Add every frame to the recording, in the order of their times."""
        frames = self.take_all()
        columns = (frames[name].tolist() for name in ("t_ns", "can_id", "length", "data"))
        heard = [(t_ns, can_id, bytes(data[:n])) for t_ns, can_id, n, data in zip(*columns, strict=True)]
        for t_ns, can_id, data in sorted(heard + self._said, key=lambda row: row[0]):
            recording.add(max(0, (t_ns - self.epoch_ns) // 1000), can_id, data)

    def check(self) -> None:
        """Raise EnvironmentLackError for a bus that is down at the end; log what one that recovered has missed."""
        error = self._error or self._failure
        if error is not None:
            raise EnvironmentLackError(f"the bus failed and did not recover: {error}; the log has what was received")
        if self._refused:
            _LOG.warning("%d SYNCs were not sent while the bus was down", self._refused)


def run_on_bus(
    scene: schema.Scene, fingers: Sequence[Finger], duration_s: float, recording: Recording,
    advance: Callable[[float], None],
) -> None:  # fmt: skip
    """Run the hand in real time; SYNCs that are late, or missed while the bus is down, stay so in the recording. Raises
    EnvironmentLackError for a bus that does not open, or is down at the end; what was received is recorded then too."""
    # Without a bus python-can's inside one process; a unique name keeps two runs in one process apart.
    bus = scene.bus or schema.Bus(interface="virtual", channel=f"tipforce-run-{time.monotonic_ns()}")
    options = {"interface": bus.interface, "channel": bus.channel, "bitrate": bus.bitrate}
    with ExitStack() as opened:
        host = opened.enter_context(open_bus(**options))
        nodes_port, _ = open_port(**options)
        opened.callback(nodes_port.close)
        port = _NodesPort(nodes_port)
        master = _Master(host)
        opened.callback(master.record, recording)  # after the reception; also after an error or Ctrl-C
        notifier = can.Notifier(host, [master], timeout=0.05)
        opened.callback(notifier.stop)
        for finger in fingers:
            port.send(finger.boot(loop.now_us()))
        with loop.running([finger.device for finger in fingers], port):
            master.epoch_ns, start_s = time.time_ns(), time.monotonic()
            recording.start_ns = master.epoch_ns
            clock_us = loop.now_us()
            for finger in fingers:
                finger.clock.start_us = clock_us - clock_us % finger.group.sample_period_us
            master.say(NMT_COB_ID, b"\x01\x00")
            for t_us, fault in actions(scene, fingers, duration_s):
                _wait_until(start_s + 1e-6 * t_us)
                if fault is None:
                    master.say(SYNC_COB_ID, b"")
                else:
                    fault.inject(loop.now_us())
                advance(1e-6 * t_us)
            _wait_until(start_s + duration_s)
            master.settle(port)
    master.check()


def _wait_until(monotonic_s: float) -> None:
    time.sleep(max(0.0, monotonic_s - time.monotonic()))
