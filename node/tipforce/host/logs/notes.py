"""What a log tells besides its frames: counts, its first bad line, and the errors of a file without frames."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from canopen_device.visible_text import shortened, visible
from tipforce.errors import InputError, LogError
from tipforce.host.frames.frame_array import MAX_CHANNELS, FrameArray

FD, ERROR, REMOTE, DROPPED = "CAN FD frame", "error frame", "remote frame", "frame dropped by candump"
UNREADABLE, NO_LINE = "unreadable", "not a candump line"
EXPECTED = {
    NO_LINE: "expected candump text, as `(1700000000.123456) can0 181#0102` or `  can0  181   [2]  01 02`",
    "timestamp": "expected (seconds.microseconds) or (YYYY-MM-DD hh:mm:ss.microseconds)",
    "interface": f"expected at most {MAX_CHANNELS} different interface names",
    "identifier": "expected 3 hexadecimal digits to 7FF or 8 to 1FFFFFFF (error frames: 20000000 plus their class)",
    "length": "expected 0 to 8 data bytes, as many as [the length] says",
    "data": "expected two hexadecimal digits per data byte, or a remote request",
}
"""Reasons for bad lines, and the expected text."""


class BadLineError(InputError):
    """The first bad line or record of a log that is read strictly."""


@dataclass(frozen=True, slots=True)
class BadLine:
    """A line that cannot be used: ``reason`` is a key of EXPECTED, ``number`` counts from 1."""

    number: int
    text: str
    reason: str

    def __str__(self) -> str:
        return f"line {self.number}: {shortened(self.text)!r}: {self.reason}: {EXPECTED[self.reason]}"

    def moved(self, lines: int) -> BadLine:
        """Return the bad line of a part with ``lines`` lines before it."""
        return replace(self, number=lines + self.number)


@dataclass(slots=True)
class LogNotes:
    """Notes on a log: ``channels`` by number; ``bad`` lines or records by reason, ``first_bad``; ``skipped``: CAN FD
    (left out), error and remote frames, dropped. ``timed``: False after a frame without time, whose ``t_ns`` is 0."""

    strict: bool = False
    source: str = ""
    frames: int = 0
    channels: list[str] = field(default_factory=list)
    bad: dict[str, int] = field(default_factory=dict)
    first_bad: BadLine | str | None = None
    skipped: dict[str, int] = field(default_factory=dict)
    timed: bool = True
    extended: int = 0
    """Frames with a 29-bit identifier, which CANopen does not use."""
    lines: int = 0
    goes_on: bool = False

    def copy(self) -> LogNotes:
        """Return the notes until now, which do not change and can be sent to another process."""
        values = {each.name: getattr(self, each.name) for each in fields(LogNotes)}
        own = {"channels": [*self.channels], "bad": {**self.bad}, "skipped": {**self.skipped}}
        return LogNotes(**values | own)

    def append(self, other: LogNotes) -> None:
        """Add the notes of the next part of the same log."""
        if self.first_bad is None:
            bad = other.first_bad
            self.first_bad = bad.moved(self.lines) if isinstance(bad, BadLine) else bad
        self.frames += other.frames
        self.extended += other.extended
        self.lines += other.lines
        for mine, more in ((self.bad, other.bad), (self.skipped, other.skipped)):
            for reason, count in more.items():
                mine[reason] = mine.get(reason, 0) + count
        self.channels += [name for name in other.channels if name not in self.channels]
        self.timed = self.timed and other.timed

    def skip(self, what: str, count: int = 1) -> None:
        """Count a frame without data for a decoder."""
        if count:
            self.skipped[what] = self.skipped.get(what, 0) + count

    def note_bad(self, reason: str, text: BadLine | str) -> None:
        """Count an unusable line. Raises BadLineError with its text if the log is read strictly."""
        if self.first_bad is None:
            self.first_bad = text
        if self.strict:
            raise BadLineError(str(text))
        self.bad[reason] = self.bad.get(reason, 0) + 1

    def channel(self, name: str, place: object = "") -> int | None:
        """Return the number of an interface; None if there are already too many, noted as bad of the log ``place``."""
        name = visible(name)
        if name not in self.channels:
            if len(self.channels) >= MAX_CHANNELS:
                self.note_bad("interface", f"{place}: more than {MAX_CHANNELS} different channels")
                return None
            self.channels.append(name)
        return self.channels.index(name)

    def count_special(self, frames: FrameArray) -> None:
        """Count the error and remote frames of a block, and those with 29-bit identifiers."""
        special = frames["can_id"] & np.uint32(EXTENDED_FLAG | ERROR_FLAG | REMOTE_FLAG)
        if special.any():
            self.extended += int(np.count_nonzero(special & np.uint32(EXTENDED_FLAG)))
            error = special & np.uint32(ERROR_FLAG) != 0
            self.skip(ERROR, int(error.sum()))
            self.skip(REMOTE, int((special[~error] & np.uint32(REMOTE_FLAG) != 0).sum()))


MESSAGE_SUFFIXES = (".asc", ".blf", ".csv", ".db", ".mf4", ".trc")
"""Formats that python-can reads; each may be followed by .gz."""


def suffix_of(path: Path) -> tuple[str, bool]:
    """Return `.log` and True for run.LOG.gz: the suffix in lower case, and whether .gz follows it."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    zipped = suffixes[-1:] == [".gz"]
    return "".join(suffixes[:-1][-1:] if zipped else suffixes[-1:]), zipped


_FORMATS = (
    "candump text (candump -L, tipforce log), that text packed with gzip or zstd, python-can's "
    f"{' '.join(MESSAGE_SUFFIXES)}, MCAP, pcap and pcapng"
)


def no_frame(name: str, first_bad: object = None) -> LogError:
    """Return the error for the log ``name``; ``first_bad``: place of the first bad line and what was expected."""
    place = "stdin" if name == "-" else name
    bad = "" if first_bad is None else f" {first_bad};"
    return LogError(f"{place}: no frames in it; is it a log?{bad} known formats: {_FORMATS}")


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
