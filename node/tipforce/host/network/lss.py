"""LSS master (CiA 305): find nodes without a node-id, assign one, store it. That of the ``canopen`` package sleeps 0.2
s in each part of an identity and half a second for each bit of a fastscan: a minute for five fingers."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from canopen_device.core import codes
from tipforce.errors import InputError, NoResponseError, RefusedError
from tipforce.host.network.finger import Identity

if TYPE_CHECKING:
    from tipforce.host.network.bus import Bus

DEFAULT_TIMEOUT_S = 0.1
STORE_TIMEOUT_S = 2.0  # a node responds after its memory is written

_STORE_ERRORS = {1: "it has no memory for node-id and bit rate", 2: "its memory failed"}


class LssMaster(AbstractContextManager["LssMaster"]):
    """LSS master of a bus. Use it as a context manager: all nodes are left in the waiting state."""

    def __init__(self, connection: Bus, timeout_s: float = DEFAULT_TIMEOUT_S) -> None:
        self._connection = connection
        self._timeout_s = timeout_s
        self._timeouts_s = (timeout_s, 4.0 * timeout_s)  # of what may be asked again: a response may be late, or lost
        self._awaited: tuple[int, Future[bytes]] | None = None
        connection.dispatcher.subscribe(codes.LSS_RESPONSE_COB_ID, self._on_answer)

    def __exit__(self, *_: object) -> None:
        self.release()
        self._connection.dispatcher.unsubscribe(codes.LSS_RESPONSE_COB_ID, self._on_answer)

    def release(self) -> None:
        """Set all nodes to the waiting state; one with its first node-id boots with it now (CiA 305, 6.3.2). Every
        search begins so: a node whose response was late is selected, and would take the node-id of the next."""
        self._send(codes.LSS_SWITCH_GLOBAL, b"\x00")

    def any_unconfigured(self) -> bool:
        """Return whether a node without a node-id responds."""
        return self._ask(codes.LSS_IDENTIFY_UNCONFIGURED, b"", codes.LSS_UNCONFIGURED_RESPONSE) is not None

    def fastscan(self, known: Sequence[int] = ()) -> Identity | None:
        """Find one node without a node-id, in configuration state then; None if there is none. ``known`` starts the
        address (vendor, product, ...): a request for each part instead of each bit (CiA 305, 6.7)."""
        self.release()
        if not self._matches(0, codes.LSS_START_FASTSCAN, 0, 0):
            return None
        parts = [0, 0, 0, 0]
        for sub in range(4):
            part = self._scanned(sub) if sub >= len(known) else known[sub] if self._ends(known[sub], sub) else None
            if part is None:
                return None
            parts[sub] = part
        return Identity(*parts)

    def _scanned(self, sub: int) -> int | None:
        """Return a part of the address, bit by bit; None if no node has it. Silence is a bit of 1, and so is a late
        response: then the part is not confirmed, and is scanned again with more patience, unless only the last response
        was late: a node that is selected says its serial number."""
        for timeout_s in self._timeouts_s:
            part = 0
            for bit in range(31, -1, -1):
                if not self._matches(part, bit, sub, sub, timeout_s):
                    part |= 1 << bit
            if self._ends(part, sub, timeout_s) or (sub == 3 and self._selected_serial() == part):
                return part
        return None

    def _selected_serial(self) -> int | None:
        service = codes.LSS_INQUIRE_FIRST + 3
        answer = self._ask(service, b"", service, self._timeouts_s[-1])
        return None if answer is None else int.from_bytes(answer[1:5], "little")

    def _ends(self, part: int, sub: int, timeout_s: float | None = None) -> bool:
        return self._matches(part, 0, sub, (sub + 1) % 4, timeout_s)

    def select(self, address: Identity) -> bool:
        """Set the node with this address to the configuration state, node-id or not; False without a response."""
        self.release()
        for k, part in enumerate((address.vendor, address.product, address.revision)):
            self._send(codes.LSS_SELECT_FIRST + k, struct.pack("<I", part))
        return self._ask(codes.LSS_SELECT_LAST, struct.pack("<I", address.serial), codes.LSS_SELECTED) is not None

    def node_id(self) -> int:
        """Return the node-id of the selected node; 255 for none. Raises NoResponseError."""
        return self._required(codes.LSS_INQUIRE_NODE_ID, b"", "its node-id")[1]

    def configure_node_id(self, node_id: int) -> None:
        """Assign a node-id, valid from the next reset, to the selected node. Raises NoResponseError, RefusedError."""
        if not 1 <= node_id <= 127:
            raise InputError(f"node-id {node_id}: allowed are 1 to 127")
        answer = self._required(codes.LSS_NODE_ID, bytes((node_id,)), f"node-id {node_id}")
        if answer[1]:
            raise RefusedError(f"LSS: the node rejected node-id {node_id} (error {answer[1]})")

    def store(self) -> None:
        """Let the selected node store node-id and bit rate. Raises NoResponseError, RefusedError."""
        answer = self._required(codes.LSS_STORE, b"", "storing", (STORE_TIMEOUT_S,))
        if answer[1]:
            raise RefusedError(f"LSS: the node did not store: {_STORE_ERRORS.get(answer[1], f'error {answer[1]}')}")

    def _matches(self, number: int, bit_check: int, sub: int, following: int, timeout_s: float | None = None) -> bool:
        payload = struct.pack("<IBBB", number, bit_check, sub, following)
        return self._ask(codes.LSS_FASTSCAN, payload, codes.LSS_IDENTIFIED, timeout_s) is not None

    def _required(self, service: int, payload: bytes, what: str, timeouts_s: Sequence[float] = ()) -> bytes:
        for timeout_s in timeouts_s or self._timeouts_s:
            answer = self._ask(service, payload, service, timeout_s)
            if answer is not None:
                return answer
        raise NoResponseError(f"LSS: no response to {what} within {timeout_s:g} s")

    def _ask(self, service: int, payload: bytes, expected: int, timeout_s: float | None = None) -> bytes | None:
        answer: Future[bytes] = Future()
        self._awaited = expected, answer  # other traffic neither ends nor extends the wait
        try:
            self._send(service, payload)
            return answer.result(self._timeout_s if timeout_s is None else timeout_s)
        except TimeoutError:
            return None
        finally:
            self._awaited = None

    def _send(self, service: int, payload: bytes) -> None:
        self._connection.send(codes.LSS_REQUEST_COB_ID, (bytes((service,)) + payload).ljust(8, b"\0"))

    def _on_answer(self, _can_id: int, data: bytearray, _time_s: float) -> None:
        awaited = self._awaited
        if awaited is not None and len(data) == 8 and data[0] == awaited[0] and not awaited[1].done():
            awaited[1].set_result(bytes(data))
