"""SYNC producers of a hand: the kernel on SocketCAN (its broadcast manager), a thread on every other bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import cycle

import can

from tipforce.device.codes import SYNC_COB_ID
from tipforce.errors import EnvironmentLackError
from tipforce.host.hand.sync_numbers import LARGEST


def sync_data(first: int, overflow: int = LARGEST) -> list[bytes]:
    """Return the data of SYNCs to send in turn: numbers from ``first`` up to ``overflow`` and on from 1; 0: without."""
    return [bytes(((first + k - 1) % overflow + 1,)) for k in range(overflow)] if first else [b""]


def kernel_sync(bus: can.BusABC, period_s: float, data: Sequence[bytes]) -> Callable[[], None]:
    """Send SYNCs with ``data`` in turn by CAN_BCM on python-can's SocketCAN bus, until the returned function is called.

    Raises EnvironmentLackError.
    """
    messages = [can.Message(arbitration_id=SYNC_COB_ID, is_extended_id=False, data=one) for one in data]
    try:
        task = bus.send_periodic(messages, period_s)
    except (can.CanError, OSError) as error:
        raise EnvironmentLackError(f"SYNC by the kernel's broadcast manager: {error}; `modprobe can-bcm`") from error

    def stop() -> None:
        with suppress(can.CanError, OSError):  # a removed interface has removed its tasks too
            task.stop()

    return stop


class ThreadSync:
    """Send SYNCs with ``data`` in turn from a thread at fixed times: a late one does not delay the following ones."""

    def __init__(self, send: Callable[[bytes], None], period_s: float, data: Sequence[bytes] = (b"",)) -> None:
        self._send, self._period_s, self._data = send, period_s, cycle(data)
        self._stopped = threading.Event()
        self.error: Exception | None = None
        """The error that ended it."""
        self.skipped = 0
        """SYNCs that were omitted because their time had passed."""
        self._thread = threading.Thread(target=self._run, name="SYNC", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop sending; returns when the thread has ended."""
        self._stopped.set()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stopped.is_set():
            try:
                self._send(next(self._data))
            except EnvironmentLackError as error:
                self.error = error
                return
            due_s += self._period_s
            # More than half a period late: omitted, because two SYNCs close together leave no time for the first.
            behind = int((time.monotonic() - due_s) / self._period_s + 0.5)
            if behind > 0:
                self.skipped += behind
                due_s += behind * self._period_s
            # A wait on the event would wake later than a sleep; stop() takes at most a period.
            time.sleep(max(due_s - time.monotonic(), 0.0))
