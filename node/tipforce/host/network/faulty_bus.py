"""A bus with injected faults, for tests of programs that use a CAN bus.

    bus = FaultyBus(can.Bus(interface="virtual", channel="hand"), Faults(drop=0.01, delay=0.05), seed=1)

Each fault of a received frame has its probability. Random numbers depend only on the seed and on the frames, never on
the clock, so that a run can be repeated. ``Injector`` does the same without a bus, at any time."""

import heapq
import itertools
import random
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import can

from canopen_device.can_frame import raw_can_id
from canopen_device.core import codes
from tipforce.errors import InputError
from tipforce.host.live.python_can import message

RawFrame = tuple[int, bytes]  # can_id with SocketCAN's flags, data
_PROBABILITIES = ("drop", "duplicate", "corrupt", "reorder", "delay")


@dataclass(frozen=True, slots=True)
class Faults:
    """Probabilities per frame, 0 to 1; ``only``: for these identifiers. ``corrupt`` flips one bit, which CAN's CRC
    would reject, but not a fault of an adapter, a gateway or memory: 0 tests only faults that CAN passes."""

    drop: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0
    reorder: float = 0.0
    delay: float = 0.0
    delay_s: float = 0.005
    """The longest delay; uniformly distributed from 0."""
    only: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        for name in _PROBABILITIES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"faults: {name} = {getattr(self, name)!r}, allowed are probabilities 0 to 1")
        if not 0.0 <= self.delay_s < 3600.0:
            raise InputError(f"faults: delay_s = {self.delay_s!r}, allowed are 0 to 3600 s")


class Injector:
    """Inject faults: frames in, frames out when due; ``counts`` has the number of each fault so far."""

    def __init__(self, faults: Faults, seed: int = 0) -> None:
        self.faults = faults
        self.counts: Counter[str] = Counter()
        self._random = random.Random(seed)
        self._due: list[tuple[float, int, RawFrame]] = []
        self._order = itertools.count()
        self._held: RawFrame | None = None

    def put(self, frame: RawFrame, now_s: float) -> None:
        """Add a frame that arrives at ``now_s``."""
        faults = self.faults
        if faults.only and frame[0] & codes.STANDARD_MASK not in faults.only:
            self._push(frame, now_s)
            return
        # Every number is drawn for every frame: enabling one fault does not move the others.
        drop, twice, corrupt, swap, late, by, bit = (self._random.random() for _ in range(7))
        if drop < faults.drop:
            self.counts["drop"] += 1
            return
        if corrupt < faults.corrupt and frame[1]:
            self.counts["corrupt"] += 1
            place = int(bit * 8 * len(frame[1]))
            data = bytearray(frame[1])
            data[place // 8] ^= 1 << place % 8
            frame = frame[0], bytes(data)
        due_s = now_s
        if late < faults.delay:
            self.counts["delay"] += 1
            due_s += by * faults.delay_s
        if swap < faults.reorder and self._held is None:
            self.counts["reorder"] += 1
            self._held = frame
            return
        self._push(frame, due_s)
        if twice < faults.duplicate:
            self.counts["duplicate"] += 1
            self._push(frame, due_s)
        if self._held is not None:
            held, self._held = self._held, None
            self._push(held, due_s)

    def take(self, now_s: float) -> RawFrame | None:
        """Return the next frame that is due, None if there is none yet."""
        if self._due and self._due[0][0] <= now_s:
            return heapq.heappop(self._due)[2]
        return None

    def next_due_s(self) -> float | None:
        """Return the due time of the next frame."""
        return self._due[0][0] if self._due else None

    def _push(self, frame: RawFrame, due_s: float) -> None:
        heapq.heappush(self._due, (due_s, next(self._order), frame))


class FaultyBus(Injector, can.BusABC):
    """An Injector of what a python-can bus receives; it owns the bus. ``faults`` and ``bus_off`` may be changed at any
    time. While ``bus_off`` is True, ``send`` and ``recv`` raise can.CanOperationError, and frames are lost."""

    def __init__(self, bus: can.BusABC, faults: Faults, seed: int = 0, **options: Any) -> None:
        Injector.__init__(self, faults, seed)
        self.bus, self.bus_off = bus, False
        self.channel_info = f"faulty {bus.channel_info}"
        self._can_protocol = bus.protocol
        can.BusABC.__init__(self, channel="", **options)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send; raises can.CanOperationError during bus-off."""
        self._check()
        self.bus.send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            self._check()
            now_s = time.monotonic()
            frame = self.take(now_s)
            if frame is not None:
                return message(time.time_ns(), frame[0], len(frame[1]), frame[1], "", False), False
            waits_s = [t - now_s for t in (deadline_s, self.next_due_s()) if t is not None]
            received = self.bus.recv(max(0.0, min(waits_s)) if waits_s else 0.05)
            if received is not None:
                self.put((raw_can_id(received), bytes(received.data)), time.monotonic())
            elif deadline_s is not None and now_s >= deadline_s:  # after a look at what was due by then
                return None, False

    def _check(self) -> None:
        if self.bus_off:
            while self.bus.recv(0.0) is not None:
                pass
            raise can.CanOperationError("bus-off (injected)")

    def shutdown(self) -> None:
        """Close the wrapped bus too."""
        super().shutdown()
        self.bus.shutdown()


class Babbler:
    """A babbling node: ``step``, called from your own loop, sends ``frame`` at ``rate_hz`` from ``next_due_s`` on."""

    def __init__(self, frame: RawFrame, rate_hz: float = 5000.0) -> None:
        if not rate_hz > 0:
            raise InputError(f"babbler: rate_hz = {rate_hz!r}, allowed is a rate over 0")
        self.frame, self._period_s = frame, 1.0 / rate_hz
        self.next_due_s = 0.0

    def step(self, now_s: float) -> list[RawFrame]:
        """Return the frames due by now; at most those of a tenth of a second."""
        if now_s - self.next_due_s > 0.1:
            self.next_due_s = now_s - 0.1
        frames = []
        while self.next_due_s <= now_s:
            frames.append(self.frame)
            self.next_due_s += self._period_s
        return frames


def quiet(faults: Faults) -> Faults:
    """Return the same without faults, for tests of the recovery."""
    return Faults(delay_s=faults.delay_s, only=faults.only)
