"""What every live receiver is, whatever bus it listens to."""

from __future__ import annotations

from typing import Protocol, Self

from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.frames.frame_block import CandumpBlock

TICK_S = 0.001
"""The least time between two batches: frames that come faster are handed over together, at most this much later."""


class InterfaceDownError(EnvironmentLackError):
    """The interface went down while it was listened to; when it comes up again, the receiver goes on."""


class Receiver(Protocol):
    """A bus that is listened to. A context manager; ``names`` are the interfaces that frames came from."""

    @property
    def dropped(self) -> int:
        """Frames that the kernel dropped because nobody took them in time, as far as it tells."""

    def receive(self, timeout_s: float | None = None) -> FrameArray:
        """The classic frames that have come, FRAME (n,), as soon as there is one; n is 0 after ``timeout_s``.

        ``channel`` indexes the names of the block. Raises EnvironmentLackError when the bus fails, and then
        InterfaceDownError if it may recover.
        """
        return self.receive_block(timeout_s).frames

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """The same with interface names and CAN FD frames."""

    def fileno(self) -> int:
        """A file descriptor to wait on; -1: there is none."""

    def close(self) -> None:
        """Stop listening."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
