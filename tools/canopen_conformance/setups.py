"""Set-ups shared by the cases of several services: PDOs, and a SYNC of wrong length."""

from __future__ import annotations

from canopen_conformance.case import NotApplicableError
from canopen_conformance.dut import LAST_DATA_TYPE, Dut

INVALID = 0x80000000
TPDO1 = ((0x1800, 1), (0x1800, 2), (0x1A00, 0))
RPDO1 = ((0x1400, 1), (0x1400, 2), (0x1600, 0))


def disable_pdo(dut: Dut, communication: int) -> int:
    """Set bit 31 of a PDO's COB-ID; return the COB-ID without it."""
    cob_id = dut.integer("I", communication, 1) & ~INVALID
    dut.put("I", communication, 1, cob_id | INVALID)
    return cob_id


def remap(dut: Dut, mapping: int, *words: int) -> None:
    """Map ``words`` by the procedure of 7.5.2.36; the PDO is disabled."""
    dut.put("B", mapping, 0, 0)
    for sub, word in enumerate(words, 1):
        dut.put("I", mapping, sub, word)
    dut.put("B", mapping, 0, len(words))


def enable_tpdo1(dut: Dut, transmission: int, *words: int, **others: int) -> int:
    """Set up TPDO1 with this type and mapping (none: unchanged); return its CAN-ID.

    ``others``: inhibit_100us, event_ms, sync_start. A TPDO1 without mapped objects is not applicable.
    """
    cob_id = disable_pdo(dut, 0x1800)
    if words:
        remap(dut, 0x1A00, *words)
    else:
        check_mapped(dut)
    dut.put("B", 0x1800, 2, transmission)
    for name, sub, kind in (("inhibit_100us", 3, "H"), ("event_ms", 5, "H"), ("sync_start", 6, "B")):
        if name in others:
            dut.put(kind, 0x1800, sub, others[name])
        elif dut.exists(0x1800, sub):
            dut.put(kind, 0x1800, sub, 0)
    dut.put("I", 0x1800, 1, cob_id)
    return cob_id & 0x7FF


def check_mapped(dut: Dut) -> None:
    """End a case about a TPDO1 that maps nothing, or what the device does not have: it sends no frame."""
    count = dut.integer("B", 0x1A00, 0)
    if not count:
        raise NotApplicableError("TPDO1 maps no object")
    for sub in range(1, count + 1):
        word = dut.integer("I", 0x1A00, sub)
        index, bits = word >> 16, word & 0xFF
        data = dut.try_read(index, word >> 8 & 0xFF) if index > LAST_DATA_TYPE else 0
        if isinstance(data, int) or bits not in (8 * len(data), 1):
            raise NotApplicableError(f"TPDO1 maps {word:08X}h, which no object of the device fits")


def mapped_rpdo1(dut: Dut, *words: int, transmission: int = 255, event_ms: int = 0) -> int:
    """Set up a valid RPDO1 with this mapping; return its CAN-ID."""
    cob_id = disable_pdo(dut, 0x1400)
    remap(dut, 0x1600, *words)
    dut.put("B", 0x1400, 2, transmission)
    if event_ms:
        dut.put("H", 0x1400, 5, event_ms)
    dut.put("I", 0x1400, 1, cob_id)
    return cob_id & 0x7FF


def break_sync(dut: Dut) -> None:
    """Send a SYNC of wrong length: EMCY 8240h, if the device checks it."""
    dut.send(0x080, "01 02 03")


def make_error(dut: Dut) -> bytes:
    """Cause an error that ``cure_error`` clears and that each call can repeat; return its EMCY."""
    break_sync(dut)
    frame = dut.heard(0x80 + dut.node_id)
    if frame is None:
        raise NotApplicableError("no EMCY for a SYNC of wrong length")
    return frame.data


def cure_error(dut: Dut) -> bytes:
    """Clear the error of ``make_error``; return the EMCY that reports it."""
    dut.send(0x080)
    return dut.expect(0x80 + dut.node_id, "00 00 *").data
