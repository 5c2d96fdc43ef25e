"""The SDO client of the host: one channel to each node, for threads and for asyncio, with retries and a deadline.

``canopen_device.core.sdo_client`` does the transfer; the thread that receives a response processes it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, TypeVar

import canopen

from canopen_device.core import codes
from canopen_device.core.sdo_client import SWITCH_BYTES, BlockDownload, BlockUpload, Download, Transfer, Upload
from canopen_device.types import Value
from tipforce.dictionary import objects as od
from tipforce.dictionary.entries import Entry, gauges_of, resolve
from tipforce.dictionary.table import MIN_GAUGES
from tipforce.errors import DuplicateNodeError, InputError, NoResponseError, SdoAbortError
from tipforce.host.decoding.duplicates import PRODUCT, SERIAL, DuplicateNodes
from tipforce.host.network.sdo_exchange import Attempt, Exchange, Turns

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


def checked_time(name: str, time_s: float) -> float:
    """Return a time limit. Raises InputError naming it where it is not 0 s or more; NaN would wait for ever."""
    if not time_s >= 0.0:
        raise InputError(f"{name} = {time_s!r}: allowed is 0 s or more")
    return time_s


class SdoChannel:
    """SDO transfers with one node; any number of threads and of asyncio tasks may use it.

    ``timeout_s`` bounds the wait for each response, ``retries`` is the number of further attempts after an attempt
    without a valid response, ``deadline_s`` bounds a transfer with all its attempts. An abort by the node is a
    response: it is never retried. Long data goes in blocks, unless the node has refused a block transfer
    (``has_blocks``). ``clock`` returns seconds.

    A transfer raises DuplicateNodeError if two nodes respond. ``duplicates`` receives the frames of the bus: after a
    second response the channel reads the serial number until it is decided whether there are two.
    """

    def __init__(
        self,
        network: canopen.Network,
        node_id: int,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        retries: int = DEFAULT_RETRIES,
        deadline_s: float = DEFAULT_DEADLINE_S,
        clock: Callable[[], float] = time.monotonic,
        duplicates: DuplicateNodes | None = None,
    ) -> None:
        self.node_id = node_id
        self._duplicates = DuplicateNodes() if duplicates is None else duplicates
        self._ended_s = time.monotonic()
        self.timeout_s = checked_time("timeout_s", timeout_s)
        self.retries = retries
        self.has_blocks = True
        self._deadline_s = deadline_s
        self._clock = clock
        self._network = network
        self._turns = Turns()
        self._exchange: Exchange | None = None
        self._gauges: int | None = None
        network.subscribe(codes.SDO_RESPONSE_BASE + node_id, self._on_response)

    def close(self) -> None:
        """Stop listening to the node's responses."""
        with suppress(KeyError, ValueError):
            self._network.unsubscribe(codes.SDO_RESPONSE_BASE + self.node_id, self._on_response)

    def read(self, entry: Entry[T]) -> T:
        """Return the value of an entry. Raises NoResponseError, SdoAbortError, or InputError for a wrong length."""
        return entry.decode(self.upload(*entry.key, entry.type == _DOMAIN))

    def write(self, entry: Entry[T], value: T) -> None:
        """Write a value. Raises as ``read``, and InputError for a value that the type cannot hold."""
        self.download(*entry.key, entry.encode(value))

    async def read_async(self, entry: Entry[T]) -> T:
        """Read for asyncio. Raises as ``read``."""
        return entry.decode(await self.upload_async(*entry.key, entry.type == _DOMAIN))

    async def write_async(self, entry: Entry[T], value: T) -> None:
        """Write for asyncio. Raises as ``write``."""
        await self.download_async(*entry.key, entry.encode(value))

    def __getitem__(self, name: str) -> Value:
        """Return the value of the object called ``name``: ``sdo["calibration.serial"]``, ``sdo["0x2102:01"]``.

        Raises as ``read``, and InputError with the nearest names for a name that is not in the dictionary.
        """
        return self.read(self._entry(name))

    def __setitem__(self, name: str, value: Value) -> None:
        """Write the object called ``name``. Raises as ``write``, and as reading it by name."""
        self.write(self._entry(name), value)

    def upload(self, index: int, sub: int, long: bool = False) -> bytes:
        """Return the bytes of an entry (an SDO upload). ``long``: in blocks, except data too short for them."""
        return finished(self._wait(*self._attempt(index, sub, long), blocks=True))

    def download(
        self,
        index: int,
        sub: int,
        data: bytes,
        *,
        progress: Callable[[int], None] | None = None,
        deadline_s: float = 0.0,
    ) -> None:
        """Write bytes to an entry (an SDO download).

        ``progress`` receives the number of bytes that the node has acknowledged, in the thread that receives frames;
        ``deadline_s`` is the time for a transfer that takes longer than that of the channel.
        """
        long = len(data) > SWITCH_BYTES
        finished(self._wait(*self._attempt(index, sub, long, data, progress), deadline_s, blocks=True))

    async def upload_async(self, index: int, sub: int, long: bool = False) -> bytes:
        """Upload for asyncio."""
        return await self._wait(*self._attempt(index, sub, long), blocks=False)

    async def download_async(self, index: int, sub: int, data: bytes) -> None:
        """Download for asyncio."""
        await self._wait(*self._attempt(index, sub, len(data) > SWITCH_BYTES, data), blocks=False)

    def check_duplicates(self, wait: bool = False) -> None:
        """Raise DuplicateNodeError if two nodes respond with this node-id. Without a suspicion nothing is sent.

        ``wait``: for the second response to the last request.
        """
        while wait and time.monotonic() < self._ended_s + SECOND_RESPONSE_S and not self._suspected:
            time.sleep(_STEP_S)
        if not self._suspected:
            return
        watch, node_id = self._duplicates, self.node_id
        watch.retry(node_id)
        for number in range(_MOST_PROBES):
            try:
                finished(self._transferred(*self._attempt(*(SERIAL if number else PRODUCT)), blocks=True))
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
    def _suspected(self) -> bool:
        return self._duplicates.suspected(self.node_id)

    # --- for Exchange ----------------------------------------------------------------------------------------

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
        self._network.send_message(can_id, request)

    def bus_failure(self) -> Exception | None:
        """Return the error with which python-can's receiving thread has ended; no frame is received from then on."""
        notifier = self._network.notifier
        return None if notifier is None else notifier.exception

    # --- transfers -------------------------------------------------------------------------------------------

    def _entry(self, name: str) -> Entry[Value]:
        if not isinstance(name, str):
            raise InputError(f"object {name!r}: allowed is a name such as 'calibration.serial', or '0x2102:01'")
        if self._gauges is None:
            self._gauges = gauges_of(self.read(od.IDENTITY_PRODUCT)) or MIN_GAUGES
        return resolve(name, self._gauges)

    def _attempt(
        self, index: int, sub: int, long: bool = False, data: bytes | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> tuple[str, Attempt]:  # fmt: skip
        """Return the name of an upload, or of a download of ``data``, and what makes its transfers."""

        def attempt(number: int, timeout_us: int, deadline_us: int) -> Transfer:
            in_blocks = long and self.has_blocks and number == 1
            if data is None:
                return (BlockUpload if in_blocks else Upload)(index, sub, timeout_us, deadline_us)
            return (BlockDownload if in_blocks else Download)(index, sub, timeout_us, deadline_us, data, progress)

        return f"{'read' if data is None else 'write'} of 0x{index:04X}:{sub:02X}", attempt

    async def _wait(self, what: str, attempt: Attempt, deadline_s: float = 0.0, *, blocks: bool) -> bytes:
        """Do a transfer. ``blocks``: without an event loop, this thread waits; see ``finished``."""
        await self._check(blocks)
        try:
            return await self._transferred(what, attempt, deadline_s, blocks=blocks)
        except NoResponseError:  # responses of two nodes among each other are valid for neither
            await self._check(blocks)
            raise

    async def _check(self, blocks: bool) -> None:
        if blocks:
            self.check_duplicates()
        elif self._suspected:
            await asyncio.to_thread(self.check_duplicates)

    async def _transferred(self, what: str, attempt: Attempt, deadline_s: float = 0.0, *, blocks: bool) -> bytes:
        turn = self._turns.request()
        try:
            turn.result() if blocks else await asyncio.wrap_future(turn)
        except BaseException:
            self._turns.withdraw(turn)
            raise
        self._exchange = exchange = Exchange(self, what, attempt, deadline_s)
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
            self._turns.release()

    def _on_response(self, _can_id: int, data: bytearray, _t_s: float) -> None:
        exchange = self._exchange
        if exchange is not None:
            exchange.step(bytes(data))


class Blocking:
    """The transfers of a channel for a coroutine without an event loop: its thread waits; see ``finished``."""

    def __init__(self, sdo: SdoChannel) -> None:
        self._sdo = sdo

    async def read_async(self, entry: Entry[T]) -> T:
        """As ``SdoChannel.read``."""
        return self._sdo.read(entry)

    async def write_async(self, entry: Entry[T], value: T) -> None:
        """As ``SdoChannel.write``."""
        self._sdo.write(entry, value)


def finished(work: Coroutine[Any, Any, R]) -> R:
    """Run a coroutine that never waits for an event loop, and return its result. Raises what it raises."""
    try:
        work.send(None)
    except StopIteration as end:
        result: R = end.value
        return result
    raise AssertionError("the coroutine waits for an event loop")
