"""Samples of one finger as they arrive: PDOs of one SYNC joined, repeats dropped, own SYNCs if no node sends them."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from tipforce.device import codes
from tipforce.device.codes import OPERATIONAL, STOPPED
from tipforce.dictionary import objects
from tipforce.dictionary.signals import Message, tpdo_messages
from tipforce.errors import DuplicateNodeError, InputError, NoNewSampleError, SdoAbortError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.columns import columns_of
from tipforce.host.decoding.contacts import Contact, Status, contact_values, status_of, uncertainties
from tipforce.host.decoding.health import NAMES, Health, packed
from tipforce.host.decoding.pdo_layout import layout_decoder, node_layout
from tipforce.host.decoding.sync_modulus import SAMPLES

if TYPE_CHECKING:
    from tipforce.host.network.bus import Bus

DEFAULT_RATE_HZ = 100.0
_LISTEN_S = 0.12  # wait for another producer's SYNC before the first own one
_FRESH_S = 0.1  # an older unread sample is stale, unless the SYNC period is longer
_MOST_WAITING = 10_000
_STEP_S = 0.2  # the longest wait for a frame: the delay until a close() is noticed
_SETS = (("P", "phi", "theta"), ("F1", "F2", "F3"))

Raw = tuple[float, Message, bytes]  # receive time, PDO, its data


class ContactReader:
    """Subscribe to the PDOs of one finger and convert each new sample to a Contact.

    ``calibration`` is used for the uncertainties. Raises InputError for a finger whose PDOs carry no contact, no force
    and not all gauges, each with status and counter.
    """

    def __init__(
        self,
        connection: Bus,
        node_id: int,
        gauges: int,
        pdos: dict[int, Message],
        calibration: Calibration | None,
        passive: bool = False,
    ) -> None:
        self._passive = passive
        self._connection, self._node_id, self._gauges = connection, node_id, gauges
        self._calibration = calibration
        self._needed = _needed(node_id, gauges, pdos)
        self._pdos = pdos
        self._arrived = threading.Condition()
        self._waiting: deque[Raw] = deque(maxlen=_MOST_WAITING)
        self._last: dict[str, dict[str, float]] = {}
        self._received = self._repeated = 0
        self._last_status = Status(0)
        self._since_s = time.monotonic()
        self._health = Health()
        self._services = (codes.EMCY_BASE + node_id, codes.HEARTBEAT_BASE + node_id)
        for can_id in pdos:
            connection.network.subscribe(can_id, self._on_frame)
        for can_id in self._services:
            connection.network.subscribe(can_id, self._on_service)

    def close(self) -> None:
        """Stop receiving."""
        for can_id in self._pdos:
            with suppress(KeyError, ValueError):
                self._connection.network.unsubscribe(can_id, self._on_frame)
        for can_id in self._services:
            with suppress(KeyError, ValueError):
                self._connection.network.unsubscribe(can_id, self._on_service)

    def next(self, deadline_s: float, period_s: float | None) -> Contact:
        """Return the next new sample. ``period_s``: of own SYNCs if no other node sends them; None: send none.

        Raises NoNewSampleError at ``deadline_s`` (monotonic), whose text gives the reason; DuplicateNodeError if two
        nodes use its node-id.
        """
        while True:
            self._check_duplicates()
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

    def newest(self, deadline_s: float, period_s: float | None) -> Contact:
        """Return the newest sample that was not returned yet, if it is fresh; else the next one. Raises as ``next``."""
        found = None
        while (contact := self._take()) is not None:
            found = contact
        if found is not None and time.time() - found.t_s <= _FRESH_S:
            return found
        return self.next(deadline_s, period_s)

    def _check_duplicates(self) -> None:
        duplicate = self._connection.duplicates.found.get(self._node_id)
        if duplicate is not None:
            if not self._passive:
                self._connection.sdo(self._node_id).check_duplicates()
            raise DuplicateNodeError(str(duplicate))

    def _on_frame(self, can_id: int, data: bytearray, t_s: float) -> None:
        """Store a frame; called by the receiving thread."""
        with self._arrived:
            self._waiting.append((t_s or time.time(), self._pdos[can_id], bytes(data)))
            self._arrived.notify_all()

    def _on_service(self, can_id: int, data: bytearray, t_s: float) -> None:
        """An EMCY or a heartbeat; called by the receiving thread."""
        time_ns = int(1e9 * t_s)
        if can_id == self._services[0]:
            self._health.emcy(self._node_id, time_ns, bytes(data))
        elif data and data[0] & codes.NODE_ID_MASK == codes.INITIALISING:
            self._health.boot(self._node_id, time_ns)

    def _take(self) -> Contact | None:
        while self._waiting:
            t_s, message, data = self._waiting.popleft()
            if len(data) < message.length_bytes:
                continue
            words = np.frombuffer(data.ljust(8, b"\0")[:8], dtype="<u8")
            columns = columns_of(words, message.signals)
            self._last[message.name] = values = {name: column[0] for name, column in columns.items()}
            if "counter" in values and not values.get("stale"):
                overflow = self._connection.sync_overflow
                self._connection.duplicates.sample(
                    self._node_id,
                    message.name,
                    int(values["counter"]),
                    data,
                    overflow if overflow > 1 else SAMPLES,
                    int(1e9 * t_s),
                )
            faults = packed(columns)
            if faults is not None:
                self._health.pdo(self._node_id, int(1e9 * t_s), int(faults[0]))
            self._received += 1
            if message.name == self._needed[-1]:
                found = self._joined(t_s)
                if found is not None:
                    return found
        return None

    def _joined(self, t_s: float) -> Contact | None:
        """Return the sample that this PDO completes; None if a PDO of it is missing, or if it is a repeat."""
        counter = self._last[self._needed[-1]]["counter"]
        same = [values for values in self._last.values() if values.get("counter") == counter]
        if any(self._last.get(name, {}).get("counter") != counter for name in self._needed):
            return None
        columns = {name: np.array([value]) for values in same for name, value in values.items()}
        faults, _ = self._health.now(self._node_id)
        columns |= {name: np.array([faults >> bit & 1]) for name, bit in NAMES.items()}
        status = status_of(columns, (1,))
        self._last_status = Status(int(status[0]))
        if Status.STALE in self._last_status:
            self._repeated += 1
            return None
        names = [f"SG{k + 1}" for k in range(self._gauges)]
        gauges = np.array([[float(columns[name][0]) if name in columns else math.nan for name in names]])
        values = contact_values(columns, gauges * 1e-6, status, self._calibration)
        P, phi, theta = values[0].tolist()
        u_P, u_phi, u_theta = uncertainties(values[:, np.newaxis], [self._calibration])[0, 0].tolist()
        microstrain = tuple(gauges[0].tolist()) if set(names) & set(columns) else ()
        return Contact(
            self._node_id, t_s, int(counter), P, phi, theta, u_P, u_phi, u_theta, self._last_status, microstrain
        )

    def _why(self) -> str:
        if Status.STALE in self._last_status and self._repeated:
            return f": it repeats sample {int(self._last[self._needed[-1]]['counter'])}: its converter has no new one"
        if self._received:
            return ""
        state = self._connection.heartbeats.state(self._node_id)
        if state == STOPPED:
            return f": it is STOPPED (NMT); start it: bus.nmt('start', {self._node_id})"
        if state not in (None, OPERATIONAL):
            return f": it is not operational (NMT); start it: bus.nmt('start', {self._node_id})"
        identifiers = ", ".join(f"0x{can_id:03X}" for can_id in self._pdos)
        return f": no frame with identifier {identifiers}; check that it receives a SYNC"


class ContactStream(Iterator[Contact], AsyncIterator[Contact]):
    """New samples of one finger in order: for ``for`` and for ``async for``. Only an error ends the iteration."""

    def __init__(self, reader: ContactReader, timeout_s: float, period_s: float | None) -> None:
        self._reader, self._timeout_s, self._period_s = reader, timeout_s, period_s

    def __next__(self) -> Contact:
        """Return the next sample. Raises NoNewSampleError if none arrives in time."""
        return self._reader.next(time.monotonic() + self._timeout_s, self._period_s)

    def __aiter__(self) -> ContactStream:
        return self

    async def __anext__(self) -> Contact:
        """Return the next sample; the event loop runs meanwhile."""
        return await asyncio.to_thread(self.__next__)


def open_reader(connection: Bus, node_id: int, calibration: Calibration | None) -> ContactReader:
    """Return a reader of a node whose PDOs are read over SDO. Raises as SdoChannel does, and InputError."""
    sdo = connection.sdo(node_id)
    layout = node_layout(sdo)
    with suppress(SdoAbortError):
        connection.sync_overflow = sdo.read(objects.SYNC_COUNTER_OVERFLOW)
    pdos = {can_id: message for can_id, message in layout_decoder([layout]).messages().values() if can_id}
    return ContactReader(connection, node_id, layout.gauges, pdos, calibration)


def passive_reader(connection: Bus, node_id: int, gauges: int) -> ContactReader:
    """Return a reader of the default PDOs of a node with ``gauges`` gauges; it sends nothing."""
    pdos = {one.cob_id_base + node_id: one for one in tpdo_messages(gauges) if one.cob_id_base}
    return ContactReader(connection, node_id, gauges, pdos, None, passive=True)


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
