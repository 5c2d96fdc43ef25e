"""Describe SocketCAN error frames in words, as candump -e does (linux/can/error.h; can-utils 2020.11)."""

from __future__ import annotations

from collections.abc import Iterable

from tipforce.device.codes import EXTENDED_MASK

ERROR_CLASSES = (
    "tx-timeout",
    "lost-arbitration",
    "controller-problem",
    "protocol-violation",
    "transceiver-status",
    "no-acknowledgement-on-tx",
    "bus-off",
    "bus-error",
    "restarted-after-bus-off",
)
"""Meaning of the bits of an error frame's identifier, from bit 0."""

CONTROLLER = (
    "rx-overflow",
    "tx-overflow",
    "rx-error-warning",
    "tx-error-warning",
    "rx-error-passive",
    "tx-error-passive",
    "back-to-error-active",
)
PROTOCOL = (
    "single-bit-error",
    "frame-format-error",
    "bit-stuffing-error",
    "tx-dominant-bit-error",
    "tx-recessive-bit-error",
    "bus-overload",
    "active-error",
    "error-on-tx",
)
LOCATIONS = {
    0x02: "id.28-to-id.21",
    0x03: "start-of-frame",
    0x04: "bit-srtr",
    0x05: "bit-ide",
    0x06: "id.20-to-id.18",
    0x07: "id.17-to-id.13",
    0x08: "crc-sequence",
    0x09: "reserved-bit-0",
    0x0A: "data-field",
    0x0B: "data-length-code",
    0x0C: "bit-rtr",
    0x0D: "reserved-bit-1",
    0x0E: "id.4-to-id.0",
    0x0F: "id.12-to-id.5",
    0x11: "active-error-flag",
    0x12: "intermission",
    0x13: "tolerate-dominant-bits",
    0x16: "passive-error-flag",
    0x17: "error-delimiter",
    0x18: "crc-delimiter",
    0x19: "acknowledge-slot",
    0x1A: "end-of-frame",
    0x1B: "acknowledge-delimiter",
    0x1C: "overload-flag",
}
_LAST_LOCATION = 0x1F


def error_text(can_id: int, data: bytes) -> str:
    """Return the text of an error frame, one class a line, the counters last; ``data`` may be shorter than 8 bytes.

    A class that candump does not know is given by its number (candump repeats the previous line instead).
    """
    data = data.ljust(8, b"\0")
    error_class = can_id & EXTENDED_MASK
    if error_class > 1 << len(ERROR_CLASSES):
        return f"error class 0x{error_class:X} is unknown"
    parts = [name + _details(name, data) for name in _set(error_class, ERROR_CLASSES)]
    text = "\n".join(parts)
    if data[6] or data[7]:
        text += f"\nerror-counter-tx-rx{{{{{data[6]}}}{{{data[7]}}}}}"
    return text


def _details(name: str, data: bytes) -> str:
    if name == "lost-arbitration":
        return f"{{at bit {data[0]}}}"
    if name == "controller-problem":
        return f"{{{','.join(_set(data[1], CONTROLLER))}}}"
    if name == "protocol-violation":
        place = LOCATIONS.get(data[3], "unspecified") if 0 < data[3] <= _LAST_LOCATION else ""
        return f"{{{{{','.join(_set(data[2], PROTOCOL))}}}{{{place}}}}}"
    return ""


def _set(bits: int, names: Iterable[str]) -> list[str]:
    return [name for position, name in enumerate(names) if bits >> position & 1]
