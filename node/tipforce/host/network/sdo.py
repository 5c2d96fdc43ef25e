"""The SDO client of the host: one channel to each node, for threads and for asyncio, with retries and a deadline.
``canopen_device.core.sdo_client`` does the transfer; the thread that receives a response processes it."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import can

from canopen_device.core import codes
from canopen_device.core.sdo_client import SWITCH_BYTES, BlockDownload, BlockUpload, Download, Transfer, Upload
from canopen_device.types import Value
from tipforce.arrays import real
from tipforce.dictionary import objects as od
from tipforce.dictionary.entries import Entry, gauges_of
from tipforce.dictionary.table import MIN_GAUGES
from tipforce.errors import DuplicateNodeError, EnvironmentLackError, InputError, NoResponseError, SdoAbortError
from tipforce.host.decoding.duplicates import PRODUCT, SERIAL, DuplicateNodes

if TYPE_CHECKING:
    import canopen

    from tipforce.host.network.bus import Dispatcher

T = TypeVar("T", bound=Value)
R = TypeVar("R")

DEFAULT_TIMEOUT_S = 0.5
DEFAULT_RETRIES = 2
DEFAULT_DEADLINE_S = 20.0
SECOND_RESPONSE_S = 0.05
"""A second node responds to a request at most so much later than the first, unless its processor is overloaded."""
_STEP_S = 0.002
_MOST_PROBES = 16
_DOMAIN = "D"  # the only type of objects that are long on a fingertip
LONGEST_WAIT_S = 10.0
_FULL_QUEUE_US = 2000  # pause after the bus refused a segment of a block: its transmit queue is full
_REFUSALS = (can.CanError, OSError, RuntimeError)  # the last for a closed bus


@dataclass(frozen=True, slots=True)
class Request:
    """A read of an entry, in blocks if it is ``long``; or with ``data`` a write."""

    index: int
    sub: int
    long: bool = False
    data: bytes | None = None
    progress: Callable[[int], None] | None = None
    deadline_s: float = 0.0


def checked_time(name: str, time_s: float) -> float:
    """Return a time limit. Raises InputError naming it where it is not 0 s or more; NaN would wait for ever."""
    if not real(time_s) >= 0.0:
        raise InputError(f"{name} = {time_s!r}: allowed is 0 s or more")
    return min(real(time_s), 0.5 * threading.TIMEOUT_MAX)  # no lock waits for an infinite time


class SdoChannel:
    """SDO transfers with one node, for any number of threads and asyncio tasks.

    ``timeout_s`` bounds each response, ``deadline_s`` a transfer with its ``retries`` after invalid or no responses; an
    abort is never retried. Long data goes in blocks, unless refused (``has_blocks``). ``clock``: seconds. Raises
    DuplicateNodeError if two nodes respond: ``duplicates`` gets the frames, and the serial number is read."""

    def __init__(
        self, network: Dispatcher | canopen.Network, node_id: int, timeout_s: float = DEFAULT_TIMEOUT_S,
        retries: int = DEFAULT_RETRIES, deadline_s: float = DEFAULT_DEADLINE_S,
        clock: Callable[[], float] = time.monotonic, duplicates: DuplicateNodes | None = None,
    ) -> None:  # fmt: skip
        self.node_id = node_id
        self._duplicates = DuplicateNodes() if duplicates is None else duplicates
        self._ended_s = time.monotonic()
        self.timeout_s = checked_time("timeout_s", timeout_s)
        self.retries = retries
        self.has_blocks = True
        self._deadline_s = deadline_s
        self._clock = clock
        self.network = network
        self._lock = threading.Lock()
        self._turns: deque[Future[None]] = deque()
        """Of the transfers that were requested; the first is done: it has the channel."""
        self._exchange: Exchange | None = None
        self._gauges: int | None = None
        network.subscribe(codes.SDO_RESPONSE_BASE + node_id, self._on_response)

    def close(self) -> None:
        """Stop listening to the node's responses."""
        with suppress(KeyError, ValueError):
            self.network.unsubscribe(codes.SDO_RESPONSE_BASE + self.node_id, self._on_response)

    def read(self, entry: Entry[T]) -> T:
        """Return the value of an entry. Raises NoResponseError, SdoAbortError, or InputError for a wrong length."""
        return finished(self.read_async(entry, blocks=True))

    def write(self, entry: Entry[T], value: T) -> None:
        """Write a value. Raises as ``read``, and InputError for a value that the type cannot hold."""
        finished(self.write_async(entry, value, blocks=True))

    async def read_async(self, entry: Entry[T], *, blocks: bool = False) -> T:
        """Read for asyncio; ``blocks``: the thread waits, for ``finished``. Raises as ``read``."""
        return entry.decode(await self._transfer(Request(*entry.key, entry.type == _DOMAIN), blocks=blocks))

    async def write_async(self, entry: Entry[T], value: T, *, blocks: bool = False) -> None:
        """Write for asyncio, as ``read_async`` reads. Raises as ``write``."""
        await self._transfer(Request(*entry.key, data=entry.encode(value)), blocks=blocks)

    def __getitem__(self, name: str) -> Value:
        """Return the value of the object called ``name``: ``sdo["calibration.serial"]``, ``sdo["0x2102:01"]``. Raises
        as ``read``, and InputError with the nearest names for a name that is not in the dictionary."""
        return self.read(self._entry(name))

    def __setitem__(self, name: str, value: Value) -> None:
        """Write the object called ``name``. Raises as ``write``, and as reading it by name."""
        self.write(self._entry(name), value)

    def upload(self, index: int, sub: int, long: bool = False) -> bytes:
        """Return the bytes of an entry (an SDO upload). ``long``: in blocks, except data too short for them."""
        return finished(self._transfer(Request(index, sub, long), blocks=True))

    def download(
        self, index: int, sub: int, data: bytes, *, progress: Callable[[int], None] | None = None,
        deadline_s: float = 0.0,
    ) -> None:  # fmt: skip
        """Write bytes to an entry (an SDO download). ``progress`` receives the number of bytes acknowledged, in the
        thread that receives frames; ``deadline_s`` is the time for a transfer that takes longer than the channel's."""
        finished(self._transfer(Request(index, sub, False, data, progress, deadline_s), blocks=True))

    def check_duplicates(self, wait: bool = False) -> None:
        """Raise DuplicateNodeError if two nodes respond with this node-id. Without a suspicion nothing is sent.
        ``wait``: for the second response to the last request."""
        watch, node_id = self._duplicates, self.node_id
        while wait and time.monotonic() < self._ended_s + SECOND_RESPONSE_S and not watch.suspected(node_id):
            time.sleep(_STEP_S)
        if not watch.suspected(node_id):
            return
        watch.retry(node_id)
        for number in range(_MOST_PROBES):
            try:
                finished(self._in_turn(Request(*(SERIAL if number else PRODUCT)), blocks=True))
            except SdoAbortError:  # a response, too
                pass
            except NoResponseError:
                break
            end_s = time.monotonic() + SECOND_RESPONSE_S
            while time.monotonic() < end_s and len(set(watch.responses(node_id))) > 1:
                time.sleep(_STEP_S)
            if watch.decided(node_id):
                break
        duplicate = watch.found.get(node_id)
        if duplicate is not None:
            raise DuplicateNodeError(str(duplicate))

    @property
    def deadline_s(self) -> float:
        """The longest time for a transfer with its retries; a long time-out extends it."""
        return max(self._deadline_s, 2.0 * self.timeout_s * (self.retries + 1))

    def now_us(self) -> int:
        """Return the time of the channel's clock in microseconds."""
        return int(1e6 * self._clock())

    def send(self, request: bytes) -> None:
        """Send a request. Raises can.CanError, or RuntimeError for a closed bus."""
        can_id = codes.SDO_REQUEST_BASE + self.node_id
        self._duplicates.frame(can_id, request, time.time_ns())
        self.network.send_message(can_id, request)

    def _entry(self, name: str) -> Entry[Value]:
        if not isinstance(name, str):
            raise InputError(f"object {name!r}: allowed is a name such as 'calibration.serial', or '0x2102:01'")
        if self._gauges is None:
            self._gauges = gauges_of(self.read(od.IDENTITY_PRODUCT)) or MIN_GAUGES
        from tipforce.dictionary.names import resolve

        return resolve(name, self._gauges)

    async def _transfer(self, request: Request, *, blocks: bool) -> bytes:
        await self._check(blocks)
        try:
            return await self._in_turn(request, blocks=blocks)
        except NoResponseError:  # responses of two nodes among each other are valid for neither
            await self._check(blocks)
            raise

    async def _check(self, blocks: bool) -> None:
        if blocks:
            self.check_duplicates()
        elif self._duplicates.suspected(self.node_id):
            await asyncio.to_thread(self.check_duplicates)

    async def _in_turn(self, request: Request, *, blocks: bool) -> bytes:
        """Transfer after all earlier requests of threads and tasks, in their order."""
        turn: Future[None] = Future()
        turn.set_running_or_notify_cancel()  # a task that is cancelled does not cancel it
        with self._lock:
            self._turns.append(turn)
            if self._turns[0] is turn:
                turn.set_result(None)
        try:
            turn.result() if blocks else await asyncio.wrap_future(turn)
            return await self._exchanged(Exchange(self, request), blocks=blocks)
        finally:
            with self._lock:
                had_turn = self._turns[0] is turn
                self._turns.remove(turn)
                if had_turn and self._turns:
                    self._turns[0].set_result(None)

    async def _exchanged(self, exchange: Exchange, *, blocks: bool) -> bytes:
        self._exchange = exchange
        try:
            done = exchange.done if blocks else asyncio.wrap_future(exchange.done)
            while not done.done():
                exchange.step()
                if isinstance(done, asyncio.Future):
                    await asyncio.wait({done}, timeout=exchange.left_s)
                else:
                    with suppress(TimeoutError):
                        done.exception(exchange.left_s)
            return done.result()
        finally:
            self._exchange, self._ended_s = None, time.monotonic()
            exchange.cancel()

    def _on_response(self, _can_id: int, data: bytearray, _t_s: float) -> None:
        exchange = self._exchange
        if exchange is not None:
            exchange.step(bytes(data))


class Exchange:
    """A transfer with its retries. ``done`` gets the data or the error, in whichever thread steps it last."""

    def __init__(self, channel: SdoChannel, request: Request) -> None:
        self._channel, self._request = channel, request
        verb = "read" if request.data is None else "write"
        self._place = (
            f"node {channel.node_id} (0x{channel.node_id:02X}), {verb} of 0x{request.index:04X}:{request.sub:02X}"
        )
        self._attempts = 0
        self._lock = threading.Lock()
        self._unsent: deque[bytes] = deque()
        self._deadline_us = channel.now_us() + round(1e6 * max(request.deadline_s, channel.deadline_s))
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
        of = self._request
        what = of.index, of.sub, round(1e6 * self._channel.timeout_s), self._deadline_us
        long = of.long if of.data is None else len(of.data) > SWITCH_BYTES
        in_blocks = long and self._channel.has_blocks and self._attempts == 1
        if of.data is None:
            return (BlockUpload if in_blocks else Upload)(*what)
        return (BlockDownload if in_blocks else Download)(*what, of.data, of.progress)

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
            self._transfer.nameless = isinstance(transfer, BlockUpload)
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
        notifier = self._channel.network.notifier
        if notifier is not None and notifier.exception is not None:  # python-can's receiving thread has ended
            return EnvironmentLackError(f"{self._place}: the bus failed: {notifier.exception}; open it again")
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


def finished(work: Coroutine[Any, Any, R]) -> R:
    """Run a coroutine that never waits for an event loop, and return its result. Raises what it raises."""
    try:
        work.send(None)
    except StopIteration as end:
        result: R = end.value
        return result
    raise AssertionError("the coroutine waits for an event loop")
