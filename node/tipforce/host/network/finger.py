"""One fingertip node, seen from the host: its identity, its calibration, its stored parameters."""

from __future__ import annotations

import binascii
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from canopen_device.core import codes
from canopen_device.types import Value
from tipforce.dictionary import objects as od
from tipforce.dictionary import table
from tipforce.dictionary.entries import Entry, gauges_of
from tipforce.errors import InputError, RefusedError, SdoAbortError
from tipforce.host.configuration.calibration import Calibration, difference
from tipforce.host.network.sdo import checked_time

if TYPE_CHECKING:
    from tipforce.host.network.bus import Bus
    from tipforce.host.network.finger_samples import ContactReader, ContactStream
    from tipforce.samples.contact import Contact

T = TypeVar("T", bound=Value)

DEFAULT_RATE_HZ, HIGHEST_RATE_HZ = 100.0, 10_000.0
_START_AGAIN_S = 2.0  # time-out of a heartbeat with the new state

_REFUSALS = {
    codes.DEVICE_STATE: "it is locked (2105h:2); unlock it: `tipforce sdo write ID calibration.unlock 0x6E65706F`",
    codes.INCOMPATIBLE: "the CRC-32 of the received data is wrong; nothing was activated, try again",
    codes.INVALID_VALUE: "a value is not finite, or not allowed: theta minimum over maximum, contact-off over "
    "contact-on, a noise covariance with a negative variance or a correlation over 1, a validity (2112h to 2116h) "
    "below zero or a lowest temperature above the highest",
    codes.TOO_HIGH: "the condition number of C exceeds the limit 2105h:1, or its 2-norm exceeds 1e7 N per unit strain",
    codes.TOO_LOW: "the 2-norm of C is below 10 N per unit strain; check whether it is in newtons per microstrain",
}


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 1018h, which identifies a device in LSS (CiA 305, 5.2), and the information in the product code."""

    vendor: int
    product: int
    revision: int
    serial: int

    def __str__(self) -> str:
        numbers = f"vendor 0x{self.vendor:08X} product 0x{self.product:08X} revision 0x{self.revision:08X}"
        return f"{numbers} serial {self.serial}"

    @property
    def is_fingertip(self) -> bool:
        """True for a node of this dictionary."""
        return gauges_of(self.product) > 0

    @property
    def gauges(self) -> int:
        """Number of gauges."""
        return self.product & table.PRODUCT_GAUGES

    @property
    def simulated(self) -> bool:
        """True for a node without hardware."""
        return bool(self.product & table.PRODUCT_SIMULATED)


@dataclass(frozen=True, slots=True)
class Tare:
    """The tare of a node (2111h): F1, F2, F3 in newtons subtracted from its force, and its age."""

    force_newtons: tuple[float, float, float]
    age_s: int


class Finger:
    """One finger: its samples, its objects (``sdo``), its calibration. Created by ``Bus.finger``. Every method raises
    NoResponseError and SdoAbortError as ``SdoChannel`` does."""

    def __init__(self, connection: Bus, node_id: int, *, passive: bool = False, default_gauges: int = 3) -> None:
        self.sdo = connection.sdo(node_id)
        self.node_id = self.sdo.node_id
        self._connection, self._passive, self._default_gauges = connection, passive, default_gauges
        self._lock = threading.Lock()
        self._reader: ContactReader | None = None
        self._started_s = -math.inf

    def read(self, timeout_s: float = 1.0) -> Contact:
        """Return the newest unread sample, or the next; sends a SYNC if no node does. Raises NoNewSampleError after
        ``timeout_s``, as ``SdoChannel``, and InputError without a PDO of contact, force or all gauges."""
        timeout_s = checked_time("timeout_s", timeout_s)
        period_s = None if self._passive or not timeout_s else 1.0 / DEFAULT_RATE_HZ
        reader = self._opened()  # its reading of the node is no part of the wait for a sample
        deadline_s = time.monotonic() + timeout_s
        while (contact := reader.newest(deadline_s, period_s)) is None:
            reader = self._opened()
        return contact

    def samples(self, timeout_s: float = 1.0, rate_hz: float = DEFAULT_RATE_HZ) -> ContactStream:
        """Yield each new sample as it arrives, for ``for`` and ``async for``. If no node sends SYNCs, they are sent at
        ``rate_hz``. Raises as ``read``; NoNewSampleError after ``timeout_s`` without a sample."""
        from tipforce.host.network.finger_samples import ContactStream

        timeout_s = checked_time("timeout_s", timeout_s)
        if not 0.0 < rate_hz <= HIGHEST_RATE_HZ:
            raise InputError(f"rate_hz = {rate_hz!r}: allowed is above 0, up to {HIGHEST_RATE_HZ:g}")
        return ContactStream(self._opened, timeout_s, None if self._passive else 1.0 / rate_hz)

    def close(self) -> None:
        """Stop receiving its PDOs. ``Bus.close`` also does it."""
        with self._lock:
            if self._reader is not None:
                self._reader.close()
            self._reader = None

    def _opened(self) -> ContactReader:
        from tipforce.host.network.finger_samples import ContactReader

        with self._lock:
            if self._reader is not None and time.monotonic() >= self._reader.end_s:
                self._reader.close()
                self._reader, self._started_s = None, -math.inf
            if self._reader is None:
                calibrations = {self.node_id: None if self._passive else self.calibration()}
                bus, gauges = self._connection, self._default_gauges
                self._reader = ContactReader(bus, self.node_id, calibrations, self._passive, gauges)
            state, now_s = self._connection.heartbeats.state(self.node_id), time.monotonic()
            to_start = not self._passive and state not in (codes.OPERATIONAL, codes.STOPPED)
            if to_start and now_s - self._started_s > _START_AGAIN_S:
                self._started_s = now_s
                self._connection.nmt("start", self.node_id)
            return self._reader

    def identity(self) -> Identity:
        """Return the identity of the node; 0 for each part that it lacks: the vendor alone is mandatory (CiA 301)."""
        vendor, parts = self.sdo.read(od.IDENTITY_VENDOR), list[int]()
        for part in (od.IDENTITY_PRODUCT, od.IDENTITY_REVISION, od.IDENTITY_SERIAL):
            try:
                parts.append(self.sdo.read(part))
            except SdoAbortError as error:
                if error.code != codes.NO_SUB:
                    raise
                parts.append(0)
        return Identity(vendor, *parts)

    def calibration(self) -> Calibration | None:
        """Return the active calibration, read back over SDO; None if the node has none. Raises RefusedError if the
        CRC-32 of the record differs from that of the node (2103h:3), or for version 1."""
        expected = self.sdo.read(od.CALIBRATION_ACTIVE_CRC)
        if not expected:
            return None
        record = self.sdo.read(od.CALIBRATION_ACTIVE_RECORD)
        if binascii.crc32(record) != expected:
            raise RefusedError(
                f"node {self.node_id}: the calibration record read back (2140h) has CRC-32 "
                f"0x{binascii.crc32(record):08X}, the node says 0x{expected:08X} (2103h:3): read it again; if it stays "
                "so, commit the calibration again"
            )
        try:
            return Calibration.from_record(record)
        except InputError as error:
            raise RefusedError(f"node {self.node_id}: {error}") from None

    def apply_calibration(
        self, calibration: Calibration, store: bool = True, on_step: Callable[[str], None] = lambda _step: None
    ) -> int:
        """Stage, commit, read back, compare, store; return the generation (2103h:4). Raises RefusedError if the node
        rejects it or holds another (the active one stays), InputError for other gauges and as ``Calibration.check``."""
        calibration.check()
        identity = self.identity()
        if not identity.is_fingertip or identity.gauges != calibration.gauges:
            raise InputError(
                f"node {self.node_id}: product code 0x{identity.product:08X} has {identity.gauges} gauges, "
                f"the calibration has {calibration.gauges}"
            )
        record, crc = calibration.record(), calibration.crc32()
        self._write_refusable(od.CALIBRATION_STAGED_RECORD, record)
        self._write_refusable(od.CALIBRATION_EXPECTED_CRC, crc)
        on_step(f"staged {len(record)} bytes, CRC-32 0x{crc:08X}")
        self._write_refusable(od.CALIBRATION_COMMIT, table.SIGNATURE_COMMIT)
        generation = self.sdo.read(od.CALIBRATION_GENERATION)
        on_step(f"committed, generation {generation}")
        if lines := self.verify_calibration(calibration):
            raise RefusedError(
                f"node {self.node_id}: the active calibration differs from the one sent: " + "; ".join(lines[:3])
            )
        on_step("read back: equal byte for byte")
        if store:
            self.store(calibration=True)
            on_step("stored")
        return generation

    def verify_calibration(self, calibration: Calibration) -> list[str]:
        """Return the differences between a calibration and the node's active one, a line per field; empty if equal."""
        record = self.sdo.read(od.CALIBRATION_ACTIVE_RECORD)
        active_crc, expected = self.sdo.read(od.CALIBRATION_ACTIVE_CRC), calibration.crc32()
        if not active_crc:
            return ["the node has no active calibration"]
        lines = difference(calibration.record(), record)
        if active_crc != expected and not lines:
            lines.append(f"active CRC-32 is 0x{active_crc:08X}, expected 0x{expected:08X}")
        return lines

    def store(self, calibration: bool = False) -> None:
        """Store all parameters (1010h:1), or the calibration alone (1010h:4). Raises SdoAbortError, with a remedy."""
        try:
            self.sdo.write(od.STORE[4 if calibration else 1], codes.SIGNATURE_SAVE)
        except SdoAbortError as error:
            if error.code != codes.HARDWARE:
                raise
            raise SdoAbortError(
                f"{error}: the node has no store, or its store fails; the values are active until its next "
                "reset (`tipforce node` stores with --store FILE)", error.code,
            ) from None  # fmt: skip

    def tare(self) -> None:
        """Take the force of the latest sample as zero (6139h). Raises SdoAbortError, with a remedy, without one."""
        try:
            self.sdo.write(od.AUTOTARE[self.identity().gauges + 1], table.SIGNATURE_TARA)
        except SdoAbortError as error:
            if error.code != codes.DEVICE_STATE:
                raise
            if not self.sdo.read(od.CALIBRATION_ACTIVE_CRC):
                step = f"the node is not calibrated: `tipforce calibrate apply CAL.toml --node {self.node_id}` first"
            else:
                step = f"it has no valid force now: `tipforce read {self.node_id}` gives the reason"
            raise SdoAbortError(f"{error}; {step}", error.code) from None

    def clear_tare(self) -> None:
        """Clear the tare (2130h)."""
        self.sdo.write(od.COMMAND, table.COMMAND_CLEAR_TARE)

    def tare_state(self) -> Tare:
        """Return the active tare."""
        read = self.sdo.read
        return Tare((read(od.TARE_F1), read(od.TARE_F2), read(od.TARE_F3)), read(od.TARE_AGE_S))

    def _write_refusable(self, entry: Entry[T], value: T) -> None:
        try:
            self.sdo.write(entry, value)
        except SdoAbortError as error:
            reason = _REFUSALS.get(error.code)
            if reason is None:
                raise
            raise RefusedError(f"node {self.node_id} rejected the calibration (0x{error.code:08X}): {reason}") from None
