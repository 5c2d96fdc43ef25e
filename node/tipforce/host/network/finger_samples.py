"""Samples of one finger as they arrive: PDOs of one SYNC joined, repeats dropped, own SYNCs if no node sends them."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from canopen_device.core import codes, communication
from tipforce.dictionary import objects
from tipforce.dictionary.signals import Message, tpdo_messages
from tipforce.errors import DuplicateNodeError, InputError, NoNewSampleError, SdoAbortError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.pdo_layout import layout_decoder, node_layout
from tipforce.host.decoding.sample_rule import SAMPLES
from tipforce.host.frames.frame_array import RawFrame, frame_array
from tipforce.samples.assembler import Assembler
from tipforce.samples.contact import Contact
from tipforce.samples.reasons import Status

if TYPE_CHECKING:
    from tipforce.host.network.bus import Bus

_LISTEN_S = 0.12  # wait for another producer's SYNC before the first own one
_FRESH_S = 0.1  # an older unread sample is stale, unless the SYNC period is longer
_MOST_WAITING = 10_000
_STEP_S = 0.2  # the longest wait for a frame: the delay until a close() is noticed
_CHANGED_S = 0.25  # from the last write of another master to the reading: a node has one SDO server
_DOWNLOAD = 1  # client command specifier
_SETS = (("P", "phi", "theta"), ("F1", "F2", "F3"))


class ContactReader:
    """Convert each new sample of a finger to a Contact, with ``calibrations``, by node-id. Its PDOs are read over SDO;
    ``passive``: the default ones of ``gauges`` gauges, and nothing is sent. Raises as ``Finger.read``. It is not
    valid after ``end_s`` (monotonic): the node booted, or a master wrote its PDOs or its calibration."""

    def __init__(
        self, connection: Bus, node_id: int, calibrations: Mapping[int, Calibration | None], passive: bool, gauges: int
    ) -> None:
        self._passive, self._connection, self._node_id = passive, connection, node_id
        if passive:
            default = tpdo_messages(gauges)
            pdos = {message.cob_id_base + node_id: message for message in default if message.cob_id_base}
        else:
            sdo = connection.sdo(node_id)
            layout = node_layout(sdo)
            with suppress(SdoAbortError):
                connection.sync_overflow = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
            pdos = {can_id: message for can_id, message in layout_decoder([layout]).messages().values() if can_id}
            gauges = layout.gauges
        needed = _needed(node_id, gauges, pdos)
        layouts = {can_id: (node_id, message) for can_id, message in pdos.items()}
        self._assembler = Assembler(layouts, needed, gauges, calibrations)
        self._arrived, self._taking = threading.Condition(), threading.Lock()
        self._waiting: deque[RawFrame] = deque(maxlen=_MOST_WAITING)
        self._joined: deque[Contact] = deque()
        self._received = self._repeated = False
        self._last: Contact | None = None
        self._since_s, self.end_s = time.monotonic(), math.inf
        self._can_ids = (*pdos, *self._assembler.services, codes.SDO_REQUEST_BASE + node_id)
        for can_id in self._can_ids:
            connection.dispatcher.subscribe(can_id, self._on_frame)

    def close(self) -> None:
        """Stop receiving."""
        for can_id in self._can_ids:
            self._connection.dispatcher.unsubscribe(can_id, self._on_frame)

    def next(self, deadline_s: float, period_s: float | None) -> Contact | None:
        """Return the next new sample; None after ``end_s``. ``period_s``: of own SYNCs if no other node sends them
        (None: send none). Raises NoNewSampleError at ``deadline_s`` (monotonic), with the reason; DuplicateNodeError if
        two nodes answer."""
        while not self.end_s <= time.monotonic() < deadline_s:
            duplicate = self._connection.duplicates.found.get(self._node_id)
            if duplicate is not None:
                if not self._passive:
                    self._connection.sdo(self._node_id).check_duplicates()
                raise DuplicateNodeError(str(duplicate))
            contact = self._take()
            if contact is not None:
                return contact
            now_s = time.monotonic()
            if now_s >= deadline_s:
                raise NoNewSampleError(f"finger {self._node_id}: no new sample{self._why()}")
            due_s = math.inf
            if period_s is not None:
                due_s = max(self._connection.sync_due_s(period_s), self._since_s + _LISTEN_S)
                if now_s >= due_s:
                    self._connection.sync()
                    continue
            with self._arrived:
                if not self._waiting:
                    self._arrived.wait(min(deadline_s, due_s, now_s + _STEP_S) - now_s)
        return None

    def newest(self, deadline_s: float, period_s: float | None) -> Contact | None:
        """Return the newest sample that was not returned yet, if it is fresh and of what holds now; else the next one.
        Raises as ``next``."""
        newest = None
        while (contact := self._take()) is not None:
            newest = contact
        if newest is not None and self.end_s == math.inf and time.time() - newest.t_s <= _FRESH_S:
            return newest
        return self.next(deadline_s, period_s)

    def _on_frame(self, can_id: int, data: bytearray, t_s: float) -> None:
        frame = int(1e9 * (t_s or time.time())), can_id, bytes(data[:8])
        if can_id in self._assembler.services:  # at once: samples that wait too long are dropped
            self._assembler.service(can_id, frame[0], frame[2])
        if can_id not in self._assembler.pdos:
            if not self._passive and _changes(can_id, data):  # another master may still write, or read back
                self.end_s = time.monotonic() + _CHANGED_S if t_s and can_id < codes.HEARTBEAT_BASE else 0.0
            return
        if self.end_s < math.inf:  # perhaps not what it was
            return
        with self._arrived:
            self._waiting.append(frame)
            self._arrived.notify_all()

    def _take(self) -> Contact | None:
        """Return the next sample that is not a repeat of the one before; None if no more has arrived. Several threads
        may read one finger: each sample goes to one of them."""
        with self._taking:
            while self._waiting or self._joined:
                if self._joined:
                    self._last = contact = self._joined.popleft()
                    if Status.STALE not in contact.status:
                        return contact
                    self._repeated = True
                    continue
                frames = [self._waiting.popleft() for _ in range(len(self._waiting))]
                for frame in frames:
                    self._watch(*frame)
                self._joined += self._assembler.feed(frame_array(frames)).contacts()
            return None

    def _watch(self, t_ns: int, can_id: int, data: bytes) -> None:
        _, pdo = self._assembler.pdos.get(can_id, (0, None))
        if pdo is None or len(data) < pdo.message.length_bytes:
            return
        self._received, word = True, int.from_bytes(data, "little")
        if pdo.counter_shift >= 0 and not word & pdo.stale_mask:
            overflow, counter = self._connection.sync_overflow, word >> pdo.counter_shift & 0xFF
            modulus = overflow if overflow > 1 else SAMPLES
            self._connection.duplicates.sample(self._node_id, pdo.message.name, counter, data, modulus, t_ns)

    def _why(self) -> str:
        if self._repeated and self._last is not None and Status.STALE in self._last.status:
            return f": it repeats sample {self._last.counter}: its converter has no new one"
        if self.end_s < math.inf:
            return ": it booted, or its PDOs or its calibration are written now"
        if self._received:
            return ""
        state = self._connection.heartbeats.state(self._node_id)
        if state not in (None, codes.OPERATIONAL):
            name = "STOPPED" if state == codes.STOPPED else "not operational"
            return f": it is {name} (NMT); start it: bus.nmt('start', {self._node_id})"
        identifiers = ", ".join(f"0x{can_id:03X}" for can_id in self._assembler.pdos)
        return f": no frame with identifier {identifiers}; check that it receives a SYNC"


def _changes(can_id: int, data: bytearray) -> bool:
    """Return whether a node boots, or its PDOs or its calibration are written."""
    if can_id < codes.SDO_REQUEST_BASE or len(data) != 8:
        return can_id >= codes.HEARTBEAT_BASE and data == b"\0"
    index = int.from_bytes(data[1:3], "little")
    is_pdo = communication.TPDO <= index <= communication.LAST_TPDO_MAPPING
    return data[0] >> 5 == _DOWNLOAD and (is_pdo or index == objects.CALIBRATION_COMMIT.index)


class ContactStream(Iterator[Contact], AsyncIterator[Contact]):
    """New samples of one finger in order: for ``for`` and for ``async for``. Only an error ends the iteration."""

    def __init__(self, opened: Callable[[], ContactReader], timeout_s: float, period_s: float | None) -> None:
        self._opened, self._reader, self._timeout_s, self._period_s = opened, opened(), timeout_s, period_s

    def __next__(self) -> Contact:
        """Return the next sample. Raises NoNewSampleError if none arrives in time."""
        deadline_s = time.monotonic() + self._timeout_s
        while (contact := self._reader.next(deadline_s, self._period_s)) is None:
            self._reader = self._opened()
        return contact

    async def __anext__(self) -> Contact:
        """Return the next sample; the event loop runs meanwhile."""
        return await asyncio.to_thread(self.__next__)


def _needed(node_id: int, gauges: int, pdos: dict[int, Message]) -> list[str]:
    """Return the PDOs of a sample in the order in which a node sends them: contact, else force, else all gauges."""
    carried = {message.name: {signal.name for signal in message.signals} for message in pdos.values()}
    counted = {name: signals for name, signals in carried.items() if {"counter", "calibrated"} <= signals}
    for wanted in _SETS:
        for name, signals in counted.items():
            if set(wanted) <= signals:
                return [name]
    missing = {f"SG{k + 1}" for k in range(gauges)}
    chosen = []
    for name, signals in counted.items():
        if signals & missing:
            chosen.append(name)
            missing -= signals
    if chosen and not missing:
        return chosen
    cob_id = codes.NO_RTR | codes.TPDO_BASES[1] + node_id
    raise InputError(
        f"finger {node_id}: no PDO carries P, phi, theta, or F1, F2, F3, or all gauges, with status and counter; "
        f"enable TPDO2: bus.finger({node_id}).sdo['tpdo2.cob_id'] = 0x{cob_id:08X}"
    )
