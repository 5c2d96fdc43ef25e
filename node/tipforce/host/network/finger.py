"""One fingertip node as the host uses it: who it is, its calibration, its stored parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from tipforce.device import codes
from tipforce.dictionary import objects as od
from tipforce.dictionary import table
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.types import Value
from tipforce.errors import InputError, RefusedError, SdoAbortError
from tipforce.host.configuration.calibration import Calibration, difference
from tipforce.host.network.sdo import SdoChannel

T = TypeVar("T", bound=Value)

_REFUSALS = {
    0x08000022: "it is locked (2105h:2); unlock it: `tipforce sdo write ID calibration.unlock 0x6E65706F`",
    0x06040043: "the CRC-32 of what it received is not the expected one; nothing was activated, try again",
    0x06090030: "a value is not finite, or not allowed: theta minimum over maximum, contact-off over contact-on, "
    "a noise covariance with a negative variance or a correlation over 1",
    0x06090031: "the condition number of C is over the limit 2105h:1",
}


def _silent(_step: str) -> None:
    """Report nowhere."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 1018h, and what the product code says."""

    vendor: int
    product: int
    revision: int
    serial: int

    @property
    def is_fingertip(self) -> bool:
        """True for a node of this dictionary."""
        return self.product & 0xFFFFFCF0 == 0x54500000 and table.MIN_GAUGES <= self.gauges <= table.MAX_GAUGES

    @property
    def gauges(self) -> int:
        """Number of gauges."""
        return self.product & 0xF

    @property
    def simulated(self) -> bool:
        """True for a node without hardware."""
        return bool(self.product & 0x100)


@dataclass(frozen=True, slots=True)
class Tare:
    """What a node takes off its force (2111h): F1, F2, F3 in newtons, and for how long it has done so."""

    force_newtons: tuple[float, float, float]
    age_s: int


class FingertipClient:
    """The host's handle on one node. Every method raises NoResponseError and SdoAbortError as ``SdoChannel`` does."""

    def __init__(self, sdo: SdoChannel) -> None:
        self.sdo = sdo
        self.node_id = sdo.node_id

    def identity(self) -> Identity:
        """Who the node says it is."""
        return Identity(
            self.sdo.read(od.IDENTITY_VENDOR),
            self.sdo.read(od.IDENTITY_PRODUCT),
            self.sdo.read(od.IDENTITY_REVISION),
            self.sdo.read(od.IDENTITY_SERIAL),
        )

    def calibration(self) -> Calibration | None:
        """The active calibration, read back over SDO; None on a node that has none."""
        if not self.sdo.read(od.CALIBRATION_ACTIVE_CRC):
            return None
        return Calibration.from_record(self.sdo.read(od.CALIBRATION_ACTIVE_RECORD))

    def apply_calibration(
        self, calibration: Calibration, store: bool = True, on_step: Callable[[str], None] = _silent
    ) -> int:
        """Stage, commit, read back and compare, store; returns the generation (2103h:4).

        Raises RefusedError when the node refuses the commit (what was active stays active) or when what it holds
        afterwards is not what was sent, InputError when the number of gauges is another.
        """
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
        self._compare(record)
        on_step("read back: equal byte for byte")
        if store:
            self.store(calibration=True)
            on_step("stored")
        return generation

    def verify_calibration(self, calibration: Calibration) -> list[str]:
        """What differs between a calibration and the node's active one, one line a field; empty when all is equal."""
        found = self.sdo.read(od.CALIBRATION_ACTIVE_RECORD)
        active_crc, expected = self.sdo.read(od.CALIBRATION_ACTIVE_CRC), calibration.crc32()
        if not active_crc:
            return ["the node has no active calibration"]
        lines = difference(calibration.record(), found)
        if active_crc != expected and not lines:
            lines.append(f"active CRC-32 is 0x{active_crc:08X}, expected 0x{expected:08X}")
        return lines

    def store(self, calibration: bool = False) -> None:
        """Store all parameters (1010h:1), or the calibration alone (1010h:4).

        Raises SdoAbortError; where the node has no store that works, the text says what to do.
        """
        try:
            self.sdo.write(od.STORE[4 if calibration else 1], table.SIGNATURE_SAVE)
        except SdoAbortError as error:
            if error.code != codes.HARDWARE:
                raise
            raise SdoAbortError(
                f"{error}: the node has nowhere to store, or its store fails; what was written works until its next "
                "reset (`tipforce node` stores with --store FILE)", error.code,
            ) from None  # fmt: skip

    def tare(self) -> None:
        """Take the force of the latest sample as zero (6139h); SdoAbortError when there is no force to take."""
        self.sdo.write(od.AUTOTARE[self.identity().gauges + 1], table.SIGNATURE_TARA)

    def clear_tare(self) -> None:
        """End the tare (2130h)."""
        self.sdo.write(od.COMMAND, table.COMMAND_CLEAR_TARE)

    def tare_state(self) -> Tare:
        """What is taken off now."""
        read = self.sdo.read
        return Tare((read(od.TARE_F1), read(od.TARE_F2), read(od.TARE_F3)), read(od.TARE_AGE_S))

    def _write_refusable(self, entry: Entry[T], value: T) -> None:
        try:
            self.sdo.write(entry, value)
        except SdoAbortError as error:
            reason = _REFUSALS.get(error.code)
            if reason is None:
                raise
            raise RefusedError(f"node {self.node_id} refused the calibration (0x{error.code:08X}): {reason}") from None

    def _compare(self, record: bytes) -> None:
        lines = difference(record, self.sdo.read(od.CALIBRATION_ACTIVE_RECORD))
        if lines:
            raise RefusedError(
                f"node {self.node_id}: the active calibration is not what was sent: " + "; ".join(lines[:3])
            )
