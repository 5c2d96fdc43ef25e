"""Counts and notes of a log reader besides the frames."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.errors import InputError
from tipforce.host.frames.frame_array import MAX_CHANNELS, FrameArray
from tipforce.visible_text import visible

FD, ERROR, REMOTE, DROPPED = "CAN FD frame", "error frame", "remote frame", "frame dropped by candump"
UNREADABLE = "unreadable"


@dataclass(slots=True)
class LogNotes:
    """Notes on a log: its ``channels`` by number, and counts of everything that is not a data frame.

    ``bad`` counts unusable lines or records by reason, ``first_bad`` gives the first one and the expected
    text. ``skipped`` counts frames without data for a decoder: CAN FD frames (left out), error and remote frames
    (delivered, with their flags), frames that candump itself dropped. ``timed`` is False after a frame without
    timestamp; its ``t_ns`` is 0.
    """

    strict: bool = False
    channels: list[str] = field(default_factory=list)
    bad: dict[str, int] = field(default_factory=dict)
    first_bad: str | None = None
    skipped: dict[str, int] = field(default_factory=dict)
    timed: bool = True
    extended: int = 0
    """Frames with a 29-bit identifier, which CANopen does not use."""

    def skip(self, what: str, count: int = 1) -> None:
        """Count a frame without data for a decoder."""
        if count:
            self.skipped[what] = self.skipped.get(what, 0) + count

    def note_bad(self, reason: str, text: str) -> None:
        """Count an unusable line. Raises InputError with ``text`` if the log is read strictly."""
        if self.strict:
            raise InputError(text)
        self.bad[reason] = self.bad.get(reason, 0) + 1
        if self.first_bad is None:
            self.first_bad = text

    def channel(self, name: str) -> int | None:
        """Return the number of an interface; None if there are already too many."""
        name = visible(name)
        if name in self.channels:
            return self.channels.index(name)
        if len(self.channels) >= MAX_CHANNELS:
            return None
        self.channels.append(name)
        return len(self.channels) - 1

    def count_special(self, frames: FrameArray) -> None:
        """Count the error and remote frames of a block, and those with 29-bit identifiers."""
        self.extended += int(np.count_nonzero(frames["can_id"] & np.uint32(EXTENDED_FLAG)))
        special = frames["can_id"] & np.uint32(ERROR_FLAG | REMOTE_FLAG)
        if special.any():
            error: npt.NDArray[np.bool_] = special & np.uint32(ERROR_FLAG) != 0
            self.skip(ERROR, int(error.sum()))
            self.skip(REMOTE, int((special[~error] != 0).sum()))
