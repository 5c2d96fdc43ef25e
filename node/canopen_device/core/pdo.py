"""PDOs (CiA 301, 7.2.2, 7.5.2.35 to 7.5.2.38): RPDOs, and TPDOs sent on SYNC, on an event, or by the event timer."""

import struct

from . import codes, communication
from .emcy import COMMUNICATION, PDO_LENGTH, RPDO_TIMEOUT
from .object_dictionary import RPDO, SIZES, TPDO, encode
from .timed import Timed

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import Device
    from .object_dictionary import ObjectDictionary, Value

_OTHER_BITS = codes.COB_ID_RESERVED & ~codes.NO_RTR
MAX_BYTES = 8


class Pdo:
    """One PDO, its contents compiled for speed. ``direction``: flag of mapped objects; ``changed()``: after an accepted
    write; ``valid``: bit 31 of the COB-ID; ``active``: with a mapping; ``widths``: bits if not whole values."""

    def __init__(
        self, od: "ObjectDictionary", communication: int, mapping: int, direction: int, changed: "Callable[[], None]"
    ) -> None:
        self._od = od
        self._changed = changed
        self.communication = communication
        self.mapping = mapping
        self.direction = direction
        self.valid = self.active = False
        self.can_id, self.transmission, self.length = 0, 255, 0
        self.letters: "list[str]" = []
        self.widths: "list[int] | None" = None
        self.keys: "list[tuple[int, int]]" = []
        od.writers[communication] = self._write_communication
        od.writers[mapping] = self._write_mapping

    def load(self) -> None:
        """Compile the present parameter objects; a PDO with an invalid mapping stays inactive."""
        cob_id = self._od.integer(self.communication, 1)
        self.can_id = cob_id & codes.STANDARD_MASK
        self.transmission = self._od.integer(self.communication, 2)
        count = self._od.integer(self.mapping, 0)
        words = [self._od.integer(self.mapping, sub) for sub in range(1, count + 1)]
        usable = self._compile(words) == 0 and self.length > 0
        self.valid = not cob_id & codes.COB_ID_INVALID
        # Bit 29, a 29-bit identifier, may come from an EDS; a write of it is rejected.
        self.active = self.valid and usable and not cob_id & codes.EXTENDED_COB_ID and not codes.restricted(self.can_id)

    def _compile(self, words: "list[int]") -> int:
        """Apply a mapping; return the abort code of a rejected one, which changes nothing."""
        letters, keys, bits, plain = [], [], 0, True
        for word in words:
            letter = self._letter(word)
            if isinstance(letter, int):
                return letter
            letters.append(letter)
            keys.append((word >> 16, word >> 8 & 0xFF))
            bits += word & 0xFF
            plain = plain and SIZES.get(letter, 0) * 8 == word & 0xFF
        if bits > 8 * MAX_BYTES:
            return codes.PDO_LENGTH
        self.letters, self.keys, self.length = letters, keys, (bits + 7) // 8
        self.widths = None if plain else [word & 0xFF for word in words]
        return 0

    def _letter(self, word: int) -> "str | int":
        """Return struct's letter of a mapped entry, or the abort code of an entry that cannot be mapped here."""
        index, sub, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
        if self.direction == RPDO and index in self._od.dummies and not sub:
            letter = self._od.dummies[index]
        else:
            entry = self._od.find(index, sub)
            if isinstance(entry, int):
                return entry
            if not entry[2] & self.direction:
                return codes.NOT_MAPPABLE
            letter = entry[0]
        size = SIZES.get(letter)
        if size is None:  # a string or DOMAIN has no length of its own: whole bytes, cut or filled up
            return letter if bits and bits % 8 == 0 else codes.NOT_MAPPABLE
        return letter if size * 8 == bits or (letter == "?" and bits == 1) else codes.NOT_MAPPABLE

    def _write_communication(self, sub: int, value: "Value") -> int:
        number, abort = int(value), 0
        if sub == 1:
            abort = self._check_cob_id(number)
        elif sub == 2 and codes.LAST_SYNCHRONOUS < number < codes.EVENT_DRIVEN:
            # 241-251 are reserved; 252 and 253 (sent on RTR) are rejected because TPDOs do not support RTR.
            abort = codes.INVALID_VALUE
        elif sub in (3, 6) and self.valid:
            abort = codes.DEVICE_STATE
        elif sub == 6 and number > codes.LAST_SYNCHRONOUS:  # the start value; an EDS may have no limit for it
            abort = codes.TOO_HIGH
        return abort or self._store_and_reload(self.communication, sub, number)

    def _check_cob_id(self, cob_id: int) -> int:
        can_id = cob_id & codes.STANDARD_MASK
        # Bit 30, no remote request, must be set where the default has it: a device without RTR.
        no_rtr = self.direction != RPDO and int(self._od.default(self.communication, 1)) & codes.NO_RTR
        # A valid PDO keeps its identifier; it must be made invalid first (7.5.2.35).
        wrong = codes.restricted(can_id) or (self.valid and can_id != self.can_id)
        if cob_id & _OTHER_BITS or (no_rtr and not cob_id & codes.NO_RTR):
            return codes.INVALID_VALUE
        return codes.INVALID_VALUE if wrong and not cob_id & codes.COB_ID_INVALID else 0

    def _write_mapping(self, sub: int, value: "Value") -> int:
        word = int(value)
        if self.valid or (sub and self._od.integer(self.mapping, 0)):
            # 7.5.2.36: make the PDO invalid, set sub-index 0 to 0, write the entries, set sub-index 0.
            return codes.DEVICE_STATE
        if sub:
            letter = self._letter(word) if word else "B"
            abort = letter if isinstance(letter, int) else 0
        else:
            room = self._od.subs(self.mapping)[-1]
            words = [self._od.integer(self.mapping, k) for k in range(1, min(word, room) + 1)]
            abort = self._compile(words) if word <= room else codes.PDO_LENGTH
        return abort or self._store_and_reload(self.mapping, sub, word)

    def _store_and_reload(self, index: int, sub: int, value: int) -> int:
        self._od.values[index << 8 | sub] = value
        self.load()
        self._changed()
        return 0


class ReceivePdo(Pdo):
    """One RPDO; ``waiting`` holds the data of a synchronous one until the SYNC, ``deadline_us`` is the next one's."""

    def load(self) -> None:
        """Compile the parameters and discard data that waits for a SYNC."""
        Pdo.load(self)
        self.forget()

    def forget(self) -> None:
        """Discard data that waits for a SYNC, so that a later start does not apply it; stop monitoring the deadline."""
        self.waiting = b""
        self.deadline_us = codes.NEVER_US


class ReceivePdos(Timed):
    """All RPDOs of a device. ``due_us`` is when one is overdue (event timer, 7.5.2.35)."""

    def __init__(self, device: "Device") -> None:
        super().__init__(device)
        self.is_waiting = False  # data of one of them, for the next SYNC
        self._pdos = [
            ReceivePdo(device.od, index, index + communication.MAPPING, RPDO, self._changed)
            for index in device.od.indices(communication.RPDO, communication.LAST_RPDO)
        ]

    def reset(self) -> None:
        """Apply the present parameter objects after a boot-up."""
        for pdo in self._pdos:
            pdo.load()
        self._schedule()

    def _changed(self) -> None:
        for code in (PDO_LENGTH, RPDO_TIMEOUT):
            self._device.emcy.cure_all_but(code, self.can_ids())
        self._schedule()
        self._device.routes_changed()

    def can_ids(self) -> "list[int]":
        """Return the identifiers of the RPDOs that this device receives."""
        return [pdo.can_id for pdo in self._pdos if pdo.active]

    def receive(self, can_id: int, data: bytes) -> None:
        """Process the frame of an RPDO. A frame shorter than the mapping changes nothing (7.2.2.5.1)."""
        emcy = self._device.emcy
        for pdo in self._pdos:
            if not pdo.active or pdo.can_id != can_id:
                continue
            if len(data) < pdo.length:
                emcy.raise_error(PDO_LENGTH, COMMUNICATION, can_id)
                continue
            emcy.cure(PDO_LENGTH, can_id)
            event_ms = self._device.od.integer(pdo.communication, 5)
            pdo.deadline_us = self._device.now_us + 1000 * event_ms if event_ms else codes.NEVER_US
            emcy.cure(RPDO_TIMEOUT, can_id)
            if pdo.transmission > codes.LAST_SYNCHRONOUS:
                self._apply(pdo, data)
            elif self._device.sync.in_window():
                pdo.waiting, self.is_waiting = bytes(data), True
        self._schedule()

    def expire(self, now_us: int) -> None:
        """Report each RPDO that is overdue."""
        for pdo in self._pdos:
            if pdo.deadline_us <= now_us:
                pdo.deadline_us = codes.NEVER_US
                self._device.emcy.raise_error(RPDO_TIMEOUT, COMMUNICATION, pdo.can_id)
        self._schedule()

    def on_sync(self) -> None:
        """Apply the data that synchronous RPDOs received since the last SYNC."""
        self.is_waiting = False
        for pdo in self._pdos:
            if pdo.waiting:
                data, pdo.waiting = pdo.waiting, b""
                self._apply(pdo, data)

    def forget(self) -> None:
        """Stop all RPDOs when the device leaves OPERATIONAL."""
        for pdo in self._pdos:
            pdo.forget()
        self._schedule()

    def _schedule(self) -> None:
        self.due_us = min([pdo.deadline_us for pdo in self._pdos], default=codes.NEVER_US)

    def _apply(self, pdo: ReceivePdo, data: bytes) -> None:
        if pdo.widths is None:
            parts, offset = [], 0
            for letter in pdo.letters:
                parts.append(data[offset : offset + SIZES[letter]])
                offset += SIZES[letter]
        else:
            from .wide_types import unpack  # a device without mapped bits does without

            parts = unpack(pdo.widths, data)
        for (index, sub), part in zip(pdo.keys, parts):  # noqa: B905
            if index > 0x1F:  # below are the dummy types, placeholders without a value
                self._device.od.download(index, sub, part)


class TransmitPdo(Pdo):
    """One TPDO with its counters and due times."""

    def load(self) -> None:
        """Compile the parameters, resolve the source of each mapped value, and restart the counters."""
        Pdo.load(self)
        if codes.LAST_SYNCHRONOUS < self.transmission < codes.EVENT_DRIVEN:
            self.active = False  # reserved, or sent on RTR: only an EDS can have it
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
        """Send each event-driven TPDO that maps an object at once, or as its type and inhibit time allow."""
        for k, pdo in enumerate(self._pdos):
            if (index, 0) in pdo.keys:
                if self._is_timed(pdo) and pdo.free_us <= self._device.now_us:
                    self._send(pdo, self._device.now_us)
                    self._reschedule()
                else:
                    self.request(k + 1)

    def started(self) -> None:
        """Start when the device enters OPERATIONAL: count SYNCs from here, send all event-driven TPDOs."""
        for pdo in self._pdos:
            pdo.syncs = 0
            pdo.pending = False
            if pdo.transmission > codes.LAST_SYNCHRONOUS:
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
        operational = self._device.nmt.state == codes.OPERATIONAL
        return operational and pdo.active and pdo.transmission > codes.LAST_SYNCHRONOUS

    def _changed(self) -> None:
        self._synchronous = [pdo for pdo in self._pdos if pdo.active and pdo.transmission <= codes.LAST_SYNCHRONOUS]
        self._device.settings_changed()
        self._device.routes_changed()  # another node may use an identifier that is no longer used here
        for pdo in self._pdos:
            if self._is_timed(pdo) and pdo.due_us == codes.NEVER_US and pdo.event_us:
                pdo.due_us = self._device.now_us + pdo.event_us
        self._reschedule()

    def _reschedule(self) -> None:
        self.due_us = min([pdo.due_us for pdo in self._pdos if self._is_timed(pdo)], default=codes.NEVER_US)
