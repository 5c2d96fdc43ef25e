"""The errors for a file given as a log that contains no frame, or no sample."""

from __future__ import annotations

from collections.abc import Iterable

from tipforce.errors import LogError
from tipforce.host.logs.reader import MESSAGE_SUFFIXES

TEXT = "candump text (candump -L, tipforce log)"
PACKED = "that text packed with gzip or zstd"
MESSAGES = "python-can's " + " ".join(sorted(MESSAGE_SUFFIXES))
PCAP = "pcap and pcapng"


def no_frame(name: str, first_bad: object = None, formats: Iterable[str] = (TEXT, PACKED, MESSAGES, PCAP)) -> LogError:
    """Return the error for the log ``name``; ``first_bad``: place of the first bad line and what was expected."""
    place = "stdin" if name == "-" else name
    bad = "" if first_bad is None else f" {first_bad};"
    return LogError(f"{place}: no frames in it; is it a log?{bad} known formats: {', '.join(formats)}")


def no_sample(name: str, frames: int, extended: int) -> LogError:
    """Return the error for a log of other devices; ``extended`` of its ``frames`` have 29-bit identifiers."""
    place = "stdin" if name == "-" else name
    if not frames:
        return no_frame(name)
    if extended == frames:
        why = "all have 29-bit identifiers, which CANopen does not use (SAE J1939, ISO 11783?)"
    else:
        why = "`tipforce dump --decode` shows what they are; PDOs of other COB-IDs: --dcf, --dbc"
    return LogError(f"{place}: no PDO of a fingertip in {frames} frames: {why}")
