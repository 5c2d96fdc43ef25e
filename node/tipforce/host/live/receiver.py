"""Interface of every live receiver, independent of the bus."""

from __future__ import annotations

from typing import Protocol, Self

from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.frames.frame_block import CandumpBlock

TICK_S = 0.001
"""The minimum time between two batches: it delays faster frames, which are returned together, at most this much."""


class InterfaceDownError(EnvironmentLackError):
    """The interface went down during reception; the receiver continues when it is up again."""


class Receiver(Protocol):
    """A receiver on a bus. A context manager; ``names`` are the interfaces of the received frames."""

    @property
    def dropped(self) -> int:
        """Frames that the kernel dropped because they were not read in time, as far as it is known."""

    def receive(self, timeout_s: float | None = None) -> FrameArray:
        """Return the classic frames received, FRAME (n,), as soon as there is one; n is 0 after ``timeout_s``.

        ``channel`` indexes the names of the block. Raises EnvironmentLackError if the bus fails,
        InterfaceDownError if it may recover.
        """
        return self.receive_block(timeout_s).frames

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """Return the same frames with interface names and CAN FD frames."""

    def fileno(self) -> int:
        """Return a file descriptor to wait on; -1 if there is none."""

    def close(self) -> None:
        """Stop receiving."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
