"""The SDO client of the host: thread-safe, with time-outs and retries set by the caller, and explicit errors.

The ``canopen`` package's client does the transfer; it is not thread-safe and does not retry, so both are added.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

import can
import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from tipforce.device import codes
from tipforce.dictionary import objects as od
from tipforce.dictionary import table
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import resolve
from tipforce.dictionary.types import Value
from tipforce.errors import EnvironmentLackError, InputError, NoResponseError, SdoAbortError

T = TypeVar("T", bound=Value)
R = TypeVar("R")

DEFAULT_TIMEOUT_S = 0.5
DEFAULT_RETRIES = 2
_TIMED_OUT = "No SDO response"
"""Start of canopen's error text for a silent node."""


class SdoChannel:
    """SDO transfers with one node; any number of threads may use it.

    ``timeout_s`` bounds the wait for each response, ``retries`` is the number of further attempts after an attempt
    without a response. An abort by the node is a response: it is never retried.
    """

    def __init__(
        self,
        network: canopen.Network,
        node_id: int,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        retries: int = DEFAULT_RETRIES,
    ) -> None:
        self.node_id = node_id
        self.retries = retries
        self._lock = threading.Lock()
        # An empty dictionary: with one, the client would cut responses to the length that it expects.
        request, response = codes.SDO_REQUEST_BASE + node_id, codes.SDO_RESPONSE_BASE + node_id
        self._client = SdoClient(request, response, canopen.ObjectDictionary())
        self._client.RESPONSE_TIMEOUT = timeout_s
        self._client.network = self._network = network
        self._gauges: int | None = None
        network.subscribe(response, self._client.on_response)

    def close(self) -> None:
        """Stop listening to the node's responses."""
        with suppress(KeyError, ValueError):
            self._network.unsubscribe(codes.SDO_RESPONSE_BASE + self.node_id, self._client.on_response)

    @property
    def timeout_s(self) -> float:
        """The time-out of each response in seconds."""
        return self._client.RESPONSE_TIMEOUT

    def read(self, entry: Entry[T]) -> T:
        """Return the value of an entry. Raises NoResponseError, SdoAbortError, or InputError for a wrong length."""
        return entry.decode(self.upload(entry.index, entry.sub))

    def write(self, entry: Entry[T], value: T) -> None:
        """Write a value. Raises as ``read``, and InputError for a value that the type cannot hold."""
        self.download(entry.index, entry.sub, entry.encode(value))

    def __getitem__(self, name: str) -> Value:
        """Return the value of the object called ``name``: ``sdo["calibration.serial"]``, ``sdo["0x2102:01"]``.

        Raises as ``read``, and InputError with the nearest names for a name that is not in the dictionary.
        """
        return self.read(self._entry(name))

    def __setitem__(self, name: str, value: Value) -> None:
        """Write the object called ``name``. Raises as ``write``, and as reading it by name."""
        self.write(self._entry(name), value)

    def _entry(self, name: str) -> Entry[Value]:
        if not isinstance(name, str):
            raise InputError(f"object {name!r}: allowed is a name such as 'calibration.serial', or '0x2102:01'")
        if self._gauges is None:
            product = self.read(od.IDENTITY_PRODUCT)
            self._gauges = product & 0xF if table.MIN_GAUGES <= product & 0xF <= table.MAX_GAUGES else table.MIN_GAUGES
        return resolve(name, self._gauges)

    def upload(self, index: int, sub: int) -> bytes:
        """Return the bytes of an entry (an SDO upload)."""
        return self._try(lambda: bytes(self._client.upload(index, sub)), f"read of 0x{index:04X}:{sub:02X}")

    def download(self, index: int, sub: int, data: bytes) -> None:
        """Write bytes to an entry (an SDO download)."""
        self._try(lambda: self._download(index, sub, data), f"write of 0x{index:04X}:{sub:02X}")

    def _download(self, index: int, sub: int, data: bytes) -> None:
        """Download expedited for one to four bytes, otherwise segmented (CiA 301, 7.2.4.3.3 and 7.2.4.3.4).

        canopen's own is a stream: after a failure its close() or its finalizer, in any thread, sends one more segment,
        which the node aborts; that abort ends the retry.
        """
        place = struct.pack("<HB", index, sub)
        if 1 <= len(data) <= 4:
            self._exchange(bytes((0x23 | (4 - len(data)) << 2,)) + place + data.ljust(4, b"\0"), b"\x60" + place)
            return
        self._exchange(b"\x21" + place + struct.pack("<I", len(data)), b"\x60" + place)
        toggle = 0
        for start in range(0, len(data) or 1, 7):
            part = data[start : start + 7]
            command = toggle | (7 - len(part)) << 1 | (start + 7 >= len(data))
            self._exchange(bytes((command,)) + part.ljust(7, b"\0"), bytes((0x20 | toggle,)))
            toggle ^= 0x10

    def _exchange(self, request: bytes, expected: bytes) -> None:
        response = self._client.request_response(request)
        if not response.startswith(expected):
            self._client.abort(codes.UNKNOWN_COMMAND)
            raise SdoCommunicationError(f"unexpected response {response.hex(' ')}")

    def _try(self, transfer: Callable[[], R], what: str) -> R:
        place = f"node {self.node_id} (0x{self.node_id:02X}), {what}"
        wrong = ""
        with self._lock:
            for attempt in range(self.retries + 1):
                try:
                    return transfer()
                except SdoAbortedError as error:
                    raise SdoAbortError(f"{place}: {_meaning(error)}", error.code) from None
                except (SdoCommunicationError, struct.error) as error:
                    # canopen unpacks a response as eight bytes: a shorter frame is a struct.error.
                    wrong = "" if str(error).startswith(_TIMED_OUT) else str(error)
                    if attempt == self.retries:
                        break
                except (can.CanError, RuntimeError) as error:  # canopen raises it for a closed bus
                    raise EnvironmentLackError(f"{place}: the bus refused the frame: {error}") from None
        notifier = self._network.notifier
        if notifier is not None and notifier.exception is not None:
            # python-can's receiving thread ends at a bus error; from then on no frame would be received.
            raise EnvironmentLackError(f"{place}: the bus failed: {notifier.exception}; open it again")
        tries = f"{self.retries + 1} tries" if self.retries else "1 try"
        if wrong:
            raise NoResponseError(
                f"{place}: no valid response in {tries}, the last: {wrong}; check for another SDO client of this node "
                "and for another node with its node-id"
            )
        raise NoResponseError(
            f"{place}: no response after {tries} of {self.timeout_s:g} s; "
            "check its power, bus, bit rate and node-id; `tipforce scan` lists nodes"
        )


def _meaning(error: SdoAbortedError) -> str:
    text = SdoAbortedError.CODES.get(error.code, "abort code without a standard meaning")
    return f"abort 0x{error.code:08X}, {text}"
