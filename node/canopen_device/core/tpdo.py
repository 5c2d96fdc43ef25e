"""Transmit PDOs (CiA 301, 7.2.2): sent on SYNC, on an event, or when the event timer elapses."""

import struct

from . import codes, communication
from .codes import EVENT_DRIVEN, LAST_SYNCHRONOUS
from .object_dictionary import TPDO, encode
from .pdo import Pdo
from .timed import Timed

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import Device


class TransmitPdo(Pdo):
    """One TPDO with its counters and due times."""

    def load(self) -> None:
        """Compile the parameters, resolve the source of each mapped value, and restart the counters."""
        Pdo.load(self)
        if LAST_SYNCHRONOUS < self.transmission < EVENT_DRIVEN:  # reserved or on RTR; only an EDS can have it
            self.active = False
        self.pack = self._od.packer(self.keys) or self._packer()
        self.inhibit_us = 100 * self._od.integer(self.communication, 3)
        self.event_us = 1000 * self._od.integer(self.communication, 5)
        self.sync_start = self._od.integer(self.communication, 6)
        self.each_sync = self.transmission == 1 and not self.sync_start
        self.syncs = self.free_us = 0
        self.pending = False
        self.due_us = codes.NEVER_US

    def _packer(self) -> "Callable[[], bytes]":
        """Return what gives the present data of this PDO: one call, one sample, so that no PDO mixes two samples."""
        od, letters, widths = self._od, self.letters, self.widths
        stored, getters = od.values, [(od.readers.get(index), sub, index << 8 | sub) for index, sub in self.keys]
        # struct packs what it can: no REAL32, which may be beyond its range, and no type without a letter.
        packing = "<" + "".join(letters) if widths is None and not [k for k in letters if k not in "BbHhIi"] else ""

        def pack() -> bytes:
            values = [reader(sub) if reader else stored[key] for reader, sub, key in getters]
            if packing:
                return struct.pack(packing, *values)
            if widths is not None:
                from . import wide_types  # a device without mapped bits does without

                return wide_types.pack(letters, widths, values)
            return b"".join([encode(k, v) for k, v in zip(letters, values)])  # noqa: B905

        return pack

    def on_sync(self, counter: int) -> bool:
        """Count a SYNC; return True if this PDO is due on it."""
        if self.transmission == 0:
            due, self.pending = self.pending, False
            return due
        if self.sync_start and counter:  # if the SYNC has no counter, the start value has no meaning
            if self.syncs == 0 and counter != self.sync_start:
                return False
            # The SYNC with the start value counts as the first (7.5.2.37), and the PDO is sent on it.
            due = self.syncs % self.transmission == 0
            self.syncs = self.syncs % self.transmission + 1
            return due
        self.syncs += 1
        if self.syncs < self.transmission:
            return False
        self.syncs = 0
        return True


class TransmitPdos(Timed):
    """All TPDOs of a device. ``due_us`` is the earliest time at which an event-driven one may be due."""

    def __init__(self, device: "Device") -> None:
        super().__init__(device)
        self._pdos = [
            TransmitPdo(device.od, index, index + communication.MAPPING, TPDO, self._changed)
            for index in device.od.indices(communication.TPDO, communication.LAST_TPDO)
        ]
        self._synchronous: "list[TransmitPdo]" = []

    def reset(self) -> None:
        """Apply the present parameter objects after a boot-up."""
        for pdo in self._pdos:
            pdo.load()
        self._changed()

    def can_ids(self) -> "list[int]":
        """Return the identifiers of the TPDOs that this device sends."""
        return [pdo.can_id for pdo in self._pdos if pdo.active]

    def mapped(self) -> "list[tuple[int, int, list[tuple[int, int]]]]":
        """Return (number, transmission type, mapped (index, sub)) of each TPDO that is active at present."""
        return [(k + 1, pdo.transmission, pdo.keys) for k, pdo in enumerate(self._pdos) if pdo.active]

    def on_sync(self, counter: int) -> None:
        """Send every synchronous TPDO that is due on this SYNC."""
        outbox = self._device.outbox()
        for pdo in self._synchronous:
            if pdo.each_sync or pdo.on_sync(counter):
                outbox.append((pdo.can_id, pdo.pack()))

    def request(self, number: int, earliest_us: int = 0) -> None:
        """Handle an event of the application: send TPDO ``number`` as its type and inhibit time allow, not earlier."""
        pdo = self._pdos[number - 1]
        pdo.pending = True
        if self._is_timed(pdo):
            pdo.due_us = min(pdo.due_us, max(self._device.now_us, pdo.free_us, earliest_us))
            self._reschedule()

    def announce(self, index: int) -> None:
        """Send each event-driven TPDO that maps an object at once, or as soon as its inhibit time allows."""
        for k, pdo in enumerate(self._pdos):
            if self._is_timed(pdo) and (index, 0) in pdo.keys:
                if pdo.free_us <= self._device.now_us:
                    self._send(pdo, self._device.now_us)
                    self._reschedule()
                else:
                    self.request(k + 1)

    def started(self) -> None:
        """Start when the device enters OPERATIONAL: count SYNCs from here, send all event-driven TPDOs."""
        for pdo in self._pdos:
            pdo.syncs = 0
            pdo.pending = False
            if pdo.transmission > LAST_SYNCHRONOUS:
                pdo.due_us = max(self._device.now_us, pdo.free_us)
        self._reschedule()

    def expire(self, now_us: int) -> None:
        """Send the event-driven TPDOs that are due."""
        if self._device.application is not None:
            self._device.application.refresh(now_us)
        for pdo in self._pdos:
            if pdo.due_us <= now_us and self._is_timed(pdo):
                self._send(pdo, now_us)
        self._reschedule()

    def _send(self, pdo: TransmitPdo, now_us: int) -> None:
        self._device.send(pdo.can_id, pdo.pack())
        pdo.pending = False
        pdo.free_us = now_us + pdo.inhibit_us
        pdo.due_us = now_us + max(pdo.event_us, pdo.inhibit_us) if pdo.event_us else codes.NEVER_US

    def _is_timed(self, pdo: TransmitPdo) -> bool:
        """Return whether a PDO is event-driven and may be sent now."""
        operational = self._device.nmt.state == codes.OPERATIONAL
        return operational and pdo.active and pdo.transmission > LAST_SYNCHRONOUS

    def _changed(self) -> None:
        self._synchronous = [pdo for pdo in self._pdos if pdo.active and pdo.transmission <= LAST_SYNCHRONOUS]
        self._device.settings_changed()
        self._device.routes_changed()  # another node may use an identifier that is no longer used here
        for pdo in self._pdos:
            if self._is_timed(pdo) and pdo.due_us == codes.NEVER_US and pdo.event_us:
                pdo.due_us = self._device.now_us + pdo.event_us
        self._reschedule()

    def _reschedule(self) -> None:
        due = [pdo.due_us for pdo in self._pdos if self._is_timed(pdo)]
        self.due_us = min(due) if due else codes.NEVER_US
