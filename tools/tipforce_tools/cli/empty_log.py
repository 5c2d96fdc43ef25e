"""What is said of a file that was given as a log and holds not one frame."""

from __future__ import annotations

from collections.abc import Iterable

from tipforce.errors import InputError
from tipforce.host.logs.reader import MESSAGE_SUFFIXES

TEXT = "candump's text (candump -L, tipforce log)"
PACKED = "gzip and zstd of it"
MESSAGES = "python-can's " + " ".join(sorted(MESSAGE_SUFFIXES))
PCAP = "pcap and pcapng"


def no_frame(name: str, formats: Iterable[str], first_bad: object = None) -> InputError:
    """The error for a log called ``name``; ``first_bad`` tells where the first bad line is and what was expected."""
    place = "stdin" if name == "-" else name
    found = "" if first_bad is None else f" {first_bad};"
    return InputError(f"{place}: not one frame in it; is it a log?{found} known are {', '.join(formats)}")
