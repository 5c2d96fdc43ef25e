"""The error for a file given as a log that contains no frame."""

from __future__ import annotations

from collections.abc import Iterable

from tipforce.errors import InputError
from tipforce.host.logs.reader import MESSAGE_SUFFIXES

TEXT = "candump text (candump -L, tipforce log)"
PACKED = "that text packed with gzip or zstd"
MESSAGES = "python-can's " + " ".join(sorted(MESSAGE_SUFFIXES))
PCAP = "pcap and pcapng"


def no_frame(name: str, formats: Iterable[str], first_bad: object = None) -> InputError:
    """Return the error for the log ``name``; ``first_bad``: place of the first bad line and what was expected."""
    place = "stdin" if name == "-" else name
    found = "" if first_bad is None else f" {first_bad};"
    return InputError(f"{place}: no frames in it; is it a log?{found} known formats: {', '.join(formats)}")
