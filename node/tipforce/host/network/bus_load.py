"""Bus load: the calculated budget of a hand, and the least and most bits of received frames (ISO 11898-1, 10.5)."""

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from canopen_device.can_frame import least_bits, most_bits
from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.dictionary.signals import tpdo_messages
from tipforce.errors import InputError
from tipforce.host.frames.frame_array import FRAME, FrameArray

DEFAULT_BIT_RATE = 1_000_000
HEALTH_MS = 300
"""Event timer of the health PDO in a hand: 2126h comes at least so often."""
LIMIT = 0.8
"""Share of the bit rate with worst-case stuffing: above it the lowest priority may miss a SYNC period."""

_WINDOW_S = 1.0  # of the load of a live bus
_FEW, _WAIT_S = 256, 0.02  # frames of a batch that waits for others, and how long


class Traffic(NamedTuple):
    """One kind of frame: its rate per second on the whole bus, and its number of data bytes."""

    name: str
    per_second: float
    data_bytes: int


@dataclass(frozen=True, slots=True)
class Budget:
    """Bus load of a hand. Loads are fractions of the bit rate."""

    traffic: tuple[Traffic, ...]
    bit_rate: int

    @property
    def least_load(self) -> float:
        """Without stuffing."""
        return sum(each.per_second * least_bits(each.data_bytes) for each in self.traffic) / self.bit_rate

    @property
    def most_load(self) -> float:
        """With worst-case stuffing."""
        return sum(each.per_second * most_bits(each.data_bytes) for each in self.traffic) / self.bit_rate


def hand_budget(
    nodes: int, sync_hz: float, pdos: Sequence[str] = ("Contact",), gauges: int = 3, bit_rate: int = DEFAULT_BIT_RATE,
    heartbeat_s: float = 1.0,
) -> Budget:  # fmt: skip
    """Return the bus load of ``nodes`` fingers whose ``pdos`` (names of ``tpdo_messages``) answer ``sync_hz`` SYNCs/s.
    Health is sent by its event timer. ``heartbeat_s`` 0 means none. Raises InputError."""
    if not (1 <= nodes <= 127 and sync_hz > 0 and bit_rate > 0 and heartbeat_s >= 0):
        raise InputError(
            f"{nodes} nodes, {sync_hz:g} Hz, {bit_rate} bit/s, heartbeat {heartbeat_s:g} s: allowed are "
            "1 to 127 nodes, and rates over 0"
        )
    lengths = {message.name: message.length_bytes for message in tpdo_messages(gauges)}
    unknown = [name for name in pdos if name not in lengths]
    if unknown or not pdos:
        raise InputError(f"PDO {', '.join(unknown) or 'none'}: allowed are {', '.join(lengths)}")
    traffic = [Traffic("SYNC", sync_hz, 0)]
    for name in dict.fromkeys(pdos):
        traffic.append(Traffic(name, nodes * (1e3 / HEALTH_MS if name == "Health" else sync_hz), lengths[name]))
    if heartbeat_s:
        traffic.append(Traffic("heartbeat", nodes / heartbeat_s, 1))
    return Budget(tuple(traffic), bit_rate)


def highest_rate_hz(
    nodes: int, pdos: Sequence[str], gauges: int = 3, bit_rate: int = DEFAULT_BIT_RATE, heartbeat_s: float = 1.0,
    limit: float = LIMIT,
) -> float:  # fmt: skip
    """Return the SYNC rate at which the worst case reaches ``limit``; 0 if the other traffic alone exceeds it."""
    at_one, at_two = (hand_budget(nodes, hz, pdos, gauges, bit_rate, heartbeat_s).most_load for hz in (1.0, 2.0))
    each = at_two - at_one
    return max(0.0, (limit - (at_one - each)) / each)


_KINDS = [(length, extended) for extended in (False, True) for length in range(9)]
LEAST_BITS = np.array([least_bits(*kind) for kind in _KINDS])
MOST_BITS = np.array([most_bits(*kind) for kind in _KINDS])


def kinds(frames: FrameArray) -> npt.NDArray[np.int64]:
    """Return the kind of each of FRAME (n,) but the error frames: an index of LEAST_BITS and of MOST_BITS."""
    flags = frames["can_id"] >> 29
    kind: npt.NDArray[np.int64] = np.minimum(frames["length"], 8).astype(np.int64)
    if flags.any():
        kind[(flags & REMOTE_FLAG >> 29) != 0] = 0
        kind[(flags & EXTENDED_FLAG >> 29) != 0] += 9
        kind = kind[(flags & ERROR_FLAG >> 29) == 0]
    return kind


def range_of_bits(frames: FrameArray) -> tuple[int, int]:
    """Return the bits of all of FRAME (n,) together, without stuff bits and with their maximum; fast."""
    counts = np.bincount(kinds(frames), minlength=len(_KINDS))
    return int(counts @ LEAST_BITS), int(counts @ MOST_BITS)


class LoadMeter:
    """Load of a live bus over the last second, at negligible cost for a receive loop: small batches wait."""

    def __init__(self, bit_rate: int = DEFAULT_BIT_RATE) -> None:
        self._bit_rate, self._lock = bit_rate, threading.Lock()
        self._counted: deque[tuple[float, int, int]] = deque()  # time, and bits without and with stuffing
        self._waiting: list[bytes] = []  # of FRAME; numpy joins bytes ten times as fast as structured arrays
        self._waiting_since_s = 0.0

    def add(self, frames: FrameArray, now_s: float) -> None:
        """Add received frames, FRAME (n,), and a monotonic time."""
        if not len(frames):
            return
        with self._lock:
            if now_s - self._waiting_since_s > _WAIT_S:
                self._count()
            if not self._waiting:
                self._waiting_since_s = now_s
            self._waiting.append(frames.tobytes())
            if len(frames) > _FEW:
                self._count()

    def _count(self) -> None:
        if self._waiting:
            frames = np.frombuffer(b"".join(self._waiting), dtype=FRAME)
            self._counted.append((self._waiting_since_s, *range_of_bits(frames)))
            self._waiting = []
        while self._counted and self._counted[0][0] < self._waiting_since_s - _WINDOW_S:
            self._counted.popleft()

    def load(self, now_s: float) -> tuple[float, float]:
        """Return the fraction of the bit rate, without stuff bits and with their maximum. From any thread."""
        with self._lock:
            self._count()
            recent = [batch for batch in self._counted if batch[0] >= now_s - _WINDOW_S]
        bits = self._bit_rate * _WINDOW_S
        return sum(least for _, least, _ in recent) / bits, sum(most for _, _, most in recent) / bits


def budget_lines(budget: Budget) -> list[str]:
    """Return a line per kind of frame, and the sum."""
    lines = [f"  {'frame':12} {'each s':>10} {'bytes':>6} {'no stuffing':>12} {'worst case':>11}"]
    for name, per_second, data_bytes in budget.traffic:
        least, most = (100 * per_second * bits(data_bytes) / budget.bit_rate for bits in (least_bits, most_bits))
        lines.append(f"  {name:12} {per_second:10g} {data_bytes:6} {least:10.1f} % {most:9.1f} %")
    lines.append(f"  {'together':12} {'':10} {'':6} {100 * budget.least_load:10.1f} % {100 * budget.most_load:9.1f} %")
    return lines


def what_fits(
    nodes: int, rate_hz: float, pdos: Sequence[str], gauges: int, bit_rate: int, heartbeat_s: float
) -> list[str]:
    """Return lines with the rate and the number of nodes that fit under LIMIT, for all PDOs and for each of them."""
    lines = []
    for choice in (pdos, *([name] for name in pdos if len(pdos) > 1)):
        sent = (*choice, "Health"), gauges, bit_rate, heartbeat_s
        rate = highest_rate_hz(nodes, *sent)
        most = sum(hand_budget(n, rate_hz, *sent).most_load <= LIMIT for n in range(1, 128))
        names = " + ".join(name.lower() for name in choice)
        lines.append(f"  {names:24} {nodes} nodes up to {rate:.0f} Hz; at {rate_hz:g} Hz up to {most} nodes")
    return lines
