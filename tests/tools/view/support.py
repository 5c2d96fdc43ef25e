"""Pages without a bus: rows by hand, a source that a test moves, a running server."""

import contextlib
import http.client
import json
import time
from collections.abc import Iterator
from typing import Any, Self

import numpy as np
from websockets.sync.client import connect

from host.bus_with_nodes import beam_calibration
from tipforce.errors import RefusedError
from tipforce.samples.columns import Block
from tipforce.samples.reasons import NO_ANSWER
from tipforce.sensor.contact.scalar import CALIBRATED, CONTACT_PRESENT, FRONT_END_FAULT
from tipforce.watching.feeds import Finger, with_layout
from tipforce_tools.page.guard import Guard
from tipforce_tools.page.model import Model
from tipforce_tools.page.server import ViewServer
from tipforce_tools.page.sources import Source

WAIT_S = 60.0
START_NS = 1_700_000_000_000_000_000
MS = 1_000_000


def fingers(count: int = 2, pull: bool = False) -> tuple[Finger, ...]:
    """Calibrated fingers of case I."""
    calibration = beam_calibration(pull=pull)
    return tuple(with_layout(Finger(n + 1, f"f{n + 1}", calibration), "I", None) for n in range(count))


def block(t_ms: Any, P: Any, status: int = CONTACT_PRESENT | CALIBRATED, gauges: int = 3) -> Block:
    """Rows at times (m,) with P (m, k); NaN means that P and the angles are unknown."""
    t = np.asarray(t_ms, dtype=np.float64)
    force = np.asarray(P, dtype=np.float32)
    m, k = force.shape
    contact = np.stack([force, np.full_like(force, -90.0), np.full_like(force, 90.0)], axis=-1)
    contact[np.isnan(force)] = np.nan
    return Block(
        START_NS + np.round(t * MS).astype(np.int64), contact, np.full((m, k, 3), 0.01, dtype=np.float32),
        np.full((m, k, gauges), 100.0, dtype=np.float32), np.full((m, k), status, dtype=np.uint16),
    )  # fmt: skip


def with_status(rows: Block, row: int, finger: int, status: int) -> Block:
    """The same rows with another status of one finger; NO_ANSWER and FRONT_END_FAULT make its values unknown."""
    rows.status[row, finger] = status
    if status & (NO_ANSWER | FRONT_END_FAULT):
        rows.contact[row, finger] = np.nan
        rows.u[row, finger] = np.nan
    return rows


class MovingSource(Source):
    """A source that makes a row every 10 ms of real time: P is 1 N + the finger's number, rising slowly."""

    def __init__(self, count: int = 3, no_tare: str = "") -> None:
        super().__init__("test hand", no_tare, Model(fingers(count), 3))
        self.status = [CONTACT_PRESENT | CALIBRATED] * count
        self.stopped = False
        self.tared: list[int] = []
        self.P = [1.0 + k for k in range(count)]
        self._begun_s = time.monotonic()
        self._rows = 0

    def pump(self) -> None:
        """Rows up to now."""
        due = int((time.monotonic() - self._begun_s) / 0.01)
        if self.stopped:
            self._rows = due
        if due <= self._rows:
            return
        t_ms = 10.0 * np.arange(self._rows, due)
        P = np.array(self.P) + 0.05 * np.sin(t_ms / 300.0)[:, np.newaxis]
        rows = block(t_ms, P)
        for k, status in enumerate(self.status):
            for row in range(len(rows)):
                with_status(rows, row, k, status)
        self._rows = due
        self.model.add(rows)
        self.model.counters.rows += len(rows)
        self.model.counters.missing = [0] * len(self.P)

    def tare(self, node_id: int) -> str:
        """Note it; node 3 refuses."""
        if node_id == 3:
            raise RefusedError("node 3: the force is unknown")
        self.tared.append(node_id)
        return "tared"


@contextlib.contextmanager
def serving(source: Any, port: int = 0, **rules: Any) -> Iterator[ViewServer]:
    """A running server on 127.0.0.1, on a free port unless one is given."""
    server = ViewServer(source, Guard(**rules), ("127.0.0.1",), port)
    server.start()
    try:
        yield server
    finally:
        server.close()


def get(server: ViewServer, path: str, method: str = "GET", **headers: str | None) -> tuple[int, dict[str, str], bytes]:
    """One request; headers by their names with _ for -, None leaves one out. Status, headers in lower case, body."""
    connection = http.client.HTTPConnection("127.0.0.1", server.guard.port, timeout=WAIT_S)
    sent: dict[str, str | None] = {"Host": f"127.0.0.1:{server.guard.port}"}
    sent |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    for name, value in sent.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    connection.close()
    return found


class Page:
    """A page as a browser has it; it reads what it asks for, and no more than websockets' queue beside."""

    def __init__(self, server: ViewServer, **options: Any) -> None:
        port = server.guard.port
        usual: dict[str, Any] = {"origin": f"http://127.0.0.1:{port}", "open_timeout": WAIT_S, "ping_interval": None}
        usual |= {"close_timeout": 1.0}  # a flooded connection is not closed in good order
        self._connecting = connect(
            f"ws://127.0.0.1:{port}/live", compression=None, max_size=None, max_queue=1, **(usual | options)
        )
        self._number = 0

    def send(self, do: str, **request: Any) -> int:
        """Send a request; its number."""
        self._number += 1
        self.socket.send(json.dumps({"id": self._number, "do": do} | request))
        return self._number

    def receive(self) -> dict[str, Any]:
        """The next message."""
        found: dict[str, Any] = json.loads(self.socket.recv(WAIT_S))
        return found

    def ask(self, do: str, **request: Any) -> Any:
        """The answer of a request, or its error as text."""
        number = self.send(do, **request)
        while (message := self.receive())["id"] != number:
            pass
        return message.get("answer", message.get("error"))

    def stream(self, count: int, **request: Any) -> list[dict[str, Any]]:
        """The first messages of a new stream."""
        number = self.send("stream", **request)
        messages: list[dict[str, Any]] = []
        while len(messages) < count:
            message = self.receive()
            if message["id"] == number:
                messages.append(message["answer"])
        return messages

    def __enter__(self) -> Self:
        self.socket = self._connecting.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._connecting.__exit__(None, None, None)
