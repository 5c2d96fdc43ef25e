"""One SDO transfer on a network, with its retries and its deadline; and the turns of the users of a channel."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, TypeAlias

import can

from canopen_device.core import codes
from canopen_device.core.sdo_client import BlockDownload, BlockUpload, Transfer
from tipforce.errors import EnvironmentLackError, NoResponseError, SdoAbortError

if TYPE_CHECKING:
    from tipforce.host.network.sdo import SdoChannel

Attempt: TypeAlias = Callable[[int, int, int], Transfer]
"""``attempt(number, timeout_us, deadline_us)`` returns the transfer of each attempt; numbers start at 1."""

LONGEST_WAIT_S = 10.0
_FULL_QUEUE_US = 2000  # pause after the bus refused a segment of a block: its transmit queue is full
_REFUSALS = (can.CanError, OSError, RuntimeError)  # canopen raises the last for a closed bus


class Turns:
    """The right to use a channel, given to one transfer at a time in the order of the requests."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[Future[None]] = deque()
        self._taken = False

    def request(self) -> Future[None]:
        """Return a future that is done when the turn has come."""
        turn: Future[None] = Future()
        with self._lock:
            if self._taken:
                self._waiting.append(turn)
            else:
                self._taken = True
                turn.set_result(None)
        return turn

    def withdraw(self, turn: Future[None]) -> None:
        """Cancel a request, also one whose turn has just come."""
        if not turn.cancel():
            self.release()

    def release(self) -> None:
        """Give the turn to the next request."""
        with self._lock:
            while self._waiting:
                turn = self._waiting.popleft()
                if turn.set_running_or_notify_cancel():
                    turn.set_result(None)
                    return
            self._taken = False


class Exchange:
    """A transfer with its retries. ``done`` gets the data or the error, in whichever thread steps it last."""

    def __init__(self, channel: SdoChannel, what: str, attempt: Attempt, deadline_s: float = 0.0) -> None:
        self._channel = channel
        self._place = f"node {channel.node_id} (0x{channel.node_id:02X}), {what}"
        self._attempt = attempt
        self._attempts = 0
        self._lock = threading.Lock()
        self._unsent: deque[bytes] = deque()
        self._deadline_us = channel.now_us() + round(1e6 * max(deadline_s, channel.deadline_s))
        self._due_us = 0
        self._transfer = self._next_attempt()
        self.done: Future[bytes] = Future()
        self.done.set_running_or_notify_cancel()  # a waiter that is cancelled does not cancel it

    @property
    def left_s(self) -> float:
        """The time until ``step`` is due, which a transfer that ends meanwhile never is: LONGEST_WAIT_S at most."""
        return min(max(0.0, (self._due_us - self._channel.now_us()) * 1e-6), LONGEST_WAIT_S)

    def step(self, response: bytes | None = None) -> None:
        """Start the transfer, process a response, or the time that has passed."""
        with self._lock:
            if not self.done.done():
                try:
                    self._step(response)
                except BaseException as error:  # also of a receiving thread: it belongs to the waiting one
                    self.done.set_exception(error)

    def cancel(self) -> None:
        """End a transfer for which nobody waits any more."""
        with self._lock:
            if not self.done.done():
                self.done.set_result(b"")
                for request in self._transfer.cancel():
                    with suppress(*_REFUSALS):
                        self._channel.send(request)

    def _next_attempt(self) -> Transfer:
        self._attempts += 1
        return self._attempt(self._attempts, round(1e6 * self._channel.timeout_s), self._deadline_us)

    def _step(self, response: bytes | None) -> None:
        now_us = self._channel.now_us()
        requests, self._due_us = self._transfer.step(now_us, response)
        if requests:
            self._unsent = deque(requests)
        self._flush(now_us)
        transfer = self._transfer
        if not transfer.ended:
            return
        code, block = transfer.abort_code, isinstance(transfer, BlockUpload | BlockDownload)
        if block and code == codes.UNKNOWN_COMMAND:  # the node has no block transfers: this was no attempt
            self._channel.has_blocks = False
            self._transfer = self._next_attempt()
            self._attempts -= 1
            self._step(None)
        elif code is not None:
            from tipforce.dictionary.service_texts import abort_text

            raise SdoAbortError(f"{self._place}: abort 0x{code:08X}, {abort_text(code)}", code)
        elif transfer.failure is None:
            self.done.set_result(transfer.data)
        elif self._attempts <= self._channel.retries and now_us < self._deadline_us:
            self._transfer = self._next_attempt()
            self._step(None)
        else:
            raise self._no_response(transfer)

    def _flush(self, now_us: int) -> None:
        """Send the requests; of a block for which the transmit queue is too short, the rest after a pause."""
        while self._unsent:
            try:
                self._channel.send(self._unsent[0])
            except _REFUSALS as error:
                if isinstance(error, RuntimeError) or len(self._unsent) == 1:
                    raise EnvironmentLackError(f"{self._place}: the bus refused the frame: {error}") from None
                self._due_us = min(self._due_us, now_us + _FULL_QUEUE_US)
                return
            self._unsent.popleft()

    def _no_response(self, transfer: Transfer) -> Exception:
        failed = self._channel.bus_failure()
        if failed is not None:
            return EnvironmentLackError(f"{self._place}: the bus failed: {failed}; open it again")
        tries = f"{self._attempts} tries" if self._attempts > 1 else "1 try"
        wrong = transfer.failure
        if not wrong and transfer.ignored is not None:
            wrong = f"unexpected response {transfer.ignored.hex(' ') or 'without data'}"
        if wrong:
            return NoResponseError(
                f"{self._place}: no valid response in {tries}, the last: {wrong}; check for another SDO client of this "
                "node and for another node with its node-id"
            )
        return NoResponseError(
            f"{self._place}: no response after {tries} of {self._channel.timeout_s:g} s; "
            "check its power, bus, bit rate and node-id; `tipforce scan` lists nodes"
        )
