"""Access of a hand to its bus: SDO and NMT, all frames, a SYNC producer. On SocketCAN a raw socket receives, also the
kernel's SYNCs. Elsewhere python-can does both, and own SYNCs, sent by a thread, are inserted among the frames."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import cycle, pairwise
from statistics import median
from typing import Any

import can
import numpy as np

from canopen_device.core.codes import FUNCTION_MASK, HEARTBEAT_BASE, SDO_RESPONSE_BASE, SYNC_COB_ID
from tipforce.dictionary import objects
from tipforce.errors import EnvironmentLackError, TipforceError
from tipforce.host.frames.frame_array import FrameArray, FrameBuffer
from tipforce.host.hand.file import HandFile
from tipforce.host.live.receive import open_receiver
from tipforce.host.live.receiver import Receiver
from tipforce.host.network.bus import Bus
from tipforce.host.network.find import responding_nodes
from tipforce.host.network.interfaces import open_bus
from tipforce.samples.sync_numbers import LARGEST

SERVICE_FILTERS = (
    {"can_id": SDO_RESPONSE_BASE, "can_mask": FUNCTION_MASK, "extended": False},
    {"can_id": HEARTBEAT_BASE, "can_mask": HEARTBEAT_BASE, "extended": False},
)
"""Frames for a connection beside a receiver: SDO responses, heartbeats, LSS. PDOs would cost 15 us each twice."""

_LAST_SLEEP_S = 0.05  # stop() of a SYNC takes at most so long
KEPT_FRAMES = 20_000  # in the connection's buffer: a hand runs for days, and only the search for nodes reads it


class Link:
    """An open bus: a connection, its frames, and SYNCs; not ``owned``: it stays open. On SocketCAN also a receiver of
    all frames, and python-can's bus, by which the kernel sends the SYNCs."""

    owned = True

    def __init__(
        self, connection: Bus, owned: bool = True, receiver: Receiver | None = None, bus: can.BusABC | None = None
    ) -> None:
        self.connection, self.owned, self._socketcan, self._bus = connection, owned, receiver, bus
        connection.buffer.limit = KEPT_FRAMES
        self._frames = FrameBuffer()
        if self._socketcan is None:
            connection.notifier.add_listener(self._frames)

    def receive(self, timeout_s: float) -> FrameArray:
        """Return the received frames, FRAME (n,), SYNCs included. Raises EnvironmentLackError if the bus fails."""
        if self._socketcan is not None:
            return self._socketcan.receive(timeout_s)
        self.connection.check_reception()
        return self._frames.take_some(time.monotonic() + timeout_s)

    def start_sync(self, period_s: float, data: Sequence[bytes]) -> Callable[[], None]:
        """Send SYNCs with ``data`` in turn until the returned function is called. Raises EnvironmentLackError."""
        if self._bus is not None:
            return kernel_sync(self._bus, period_s, data)

        def sync(number: bytes) -> None:
            # First into the stream, then onto the bus: no answer can precede its SYNC.
            self._frames.put((time.time_ns(), SYNC_COB_ID, number))
            self.connection.send(SYNC_COB_ID, number)

        return ThreadSync(sync, period_s, data).stop

    @property
    def dropped(self) -> int:
        """Frames lost because they were not read in time."""
        return self._frames.dropped if self._socketcan is None else self._socketcan.dropped

    def close(self) -> None:
        """Close the bus, or stop listening to it."""
        if self._socketcan is not None:
            self._socketcan.close()
        if self.owned:
            self.connection.close()
        else:
            with suppress(ValueError):
                self.connection.notifier.remove_listener(self._frames)


def open_link(options: Mapping[str, Any]) -> Link:
    """Open the bus that ``options`` (keywords of ``can.Bus``) name. Raises EnvironmentLackError."""
    if options.get("interface") != "socketcan":
        return Link(Bus(open_bus(**options)))
    receiver = open_receiver(options)
    try:
        receiver.receive(0.0)  # an interface that is down can be opened; reading raises the error
        bus = open_bus(**options)
    except BaseException:
        receiver.close()
        raise
    bus.set_filters(SERVICE_FILTERS)  # type: ignore[arg-type]
    return Link(Bus(bus), receiver=receiver, bus=bus)


def kernel_sync(bus: can.BusABC, period_s: float, data: Sequence[bytes]) -> Callable[[], None]:
    """Send SYNCs with ``data`` in turn by CAN_BCM, else by a thread of python-can, until the returned function is
    called. Raises EnvironmentLackError."""
    messages = [can.Message(arbitration_id=SYNC_COB_ID, is_extended_id=False, data=number) for number in data]
    try:
        task = bus.send_periodic(messages, period_s)
        if isinstance(task, can.broadcastmanager.ThreadBasedCyclicSendTask):
            task.on_error = lambda _error: True  # it goes on when the bus does
    except (can.CanError, OSError) as error:
        raise EnvironmentLackError(f"SYNC by the kernel's broadcast manager: {error}; `modprobe can-bcm`") from error

    def stop() -> None:
        with suppress(can.CanError, OSError):  # a removed interface has removed its tasks too
            task.stop()

    return stop


class ThreadSync:
    """Send SYNCs with ``data`` in turn from a thread at fixed times: a late one does not delay the following ones."""

    def __init__(self, send: Callable[[bytes], None], period_s: float, data: Sequence[bytes] = (b"",)) -> None:
        self._send, self._period_s, self._data = send, period_s, cycle(data)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="SYNC", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop sending; returns when the thread has ended."""
        self._stopped.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stopped.is_set():
            try:
                self._send(next(self._data))
            except EnvironmentLackError:  # the receiver raises it, too
                return
            due_s += self._period_s
            # More than half a period late: omitted, because two SYNCs close together leave no time for the first.
            due_s += max(int((time.monotonic() - due_s) / self._period_s + 0.5), 0) * self._period_s
            if self._stopped.wait(max(due_s - time.monotonic() - _LAST_SLEEP_S, 0.0)):
                return
            # A wait on the event would wake later than a sleep.
            time.sleep(max(due_s - time.monotonic(), 0.0))


_LISTEN_S = 0.5  # for the SYNC of another device


def wanted_overflow(link: Link, file: HandFile, nodes: set[int] | None) -> int | None:
    """Return 1019h for the fingers: LARGEST to number, 0 not to; None where no SYNC of another device is received.
    ``nodes``: node-ids of all nodes on the bus; None: they are searched."""
    plan = file.hand
    if not plan.sync_hz:
        deadline_s, left_s = time.monotonic() + _LISTEN_S, _LISTEN_S
        while left_s > 0.0:
            left_s = max(deadline_s - time.monotonic(), 0.0)  # the last look is after the deadline
            frames = link.receive(left_s)
            lengths = frames["length"][frames["can_id"] == SYNC_COB_ID]
            if len(lengths):
                return LARGEST if lengths[-1] == 1 else 0
        return None
    if plan.numbered_sync != "auto":
        return LARGEST if plan.numbered_sync else 0
    for node_id in (responding_nodes(link.connection) if nodes is None else nodes) - set(file.node_ids):
        try:
            if link.connection.sdo(node_id).read(objects.SYNC_COUNTER_OVERFLOW) <= 1:
                return 0
        except TipforceError:
            return 0
    return LARGEST


_BIN_NS, _BINS = 1000, 50_001  # up to 50 ms; the last bin is for larger ones


@dataclass(frozen=True, slots=True)
class JitterFigures:
    """Deviations of SYNC periods from the nominal one, microseconds; NaN before the first period."""

    periods: int
    mean_period_us: float
    p50_us: float
    p99_us: float
    largest_us: float


class Jitter:
    """Collect the receive times of SYNCs with the nominal period ``period_ns`` (0: unknown, the mean is used)."""

    def __init__(self, period_ns: int = 0) -> None:
        self._period_ns = period_ns
        self._histogram = [0] * _BINS
        self._last_ns: int | None = None
        self._sum_ns = self._largest_ns = 0
        self._periods = 0

    def add(self, sync_ns: Sequence[int]) -> None:
        """Add the times of further SYNCs, in order."""
        times = [*([] if self._last_ns is None else [self._last_ns]), *sync_ns]
        periods = [after - before for before, after in pairwise(times)]
        if times:
            self._last_ns = times[-1]
        if periods:
            self._period_ns = self._period_ns or int(median(periods))
        for period in periods:
            deviation = abs(period - self._period_ns)
            self._histogram[min(deviation // _BIN_NS, _BINS - 1)] += 1
            self._sum_ns += period
            self._largest_ns = max(self._largest_ns, deviation)
        self._periods += len(periods)

    def skip(self) -> None:
        """Restart with the next SYNC after a deliberate interruption."""
        self._last_ns = None

    def figures(self) -> JitterFigures:
        """Return the results so far; percentiles to a microsecond, rounded up."""
        if not self._periods:
            return JitterFigures(0, *[float("nan")] * 4)
        least = (0.50 * self._periods, 0.99 * self._periods)  # before the histogram, which another thread may extend
        ends_ns = (np.searchsorted(np.cumsum(self._histogram), least) + 1) * _BIN_NS
        p50, p99 = (np.minimum(ends_ns, self._largest_ns) / 1e3).tolist()
        return JitterFigures(self._periods, self._sum_ns / self._periods / 1e3, p50, p99, self._largest_ns / 1e3)
