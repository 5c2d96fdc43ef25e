"""Pages without a bus: rows by hand, a source that a test moves, a running server."""

from __future__ import annotations

import contextlib
import http.client
import json
import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from host.bus_with_nodes import beam_calibration
from tipforce.errors import RefusedError
from tipforce_tools.view.blocks import CALIBRATED, CONTACT, FAULT, MISSING, Block
from tipforce_tools.view.fingers import Finger, with_layout
from tipforce_tools.view.guard import Guard
from tipforce_tools.view.model import Model
from tipforce_tools.view.server import ViewServer

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000


def fingers(count: int = 2, pull: bool = False) -> tuple[Finger, ...]:
    """Calibrated fingers of case I."""
    calibration = beam_calibration(pull=pull)
    return tuple(with_layout(Finger(n + 1, f"f{n + 1}", calibration), "I", None) for n in range(count))


def block(t_ms: Any, P: Any, status: int = CONTACT | CALIBRATED, gauges: int = 3) -> Block:
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
    """The same rows with another status of one finger; MISSING and FAULT make its values unknown."""
    rows.status[row, finger] = status
    if status & (MISSING | FAULT):
        rows.contact[row, finger] = np.nan
        rows.u[row, finger] = np.nan
    return rows


class MovingSource:
    """A source that makes a row every 10 ms of real time: P is 1 N + the finger's number, rising slowly."""

    title = "test hand"

    def __init__(self, count: int = 3, no_tare: str = "") -> None:
        self.no_tare = no_tare
        self.model = Model(fingers(count), 3)
        self.status = [CONTACT | CALIBRATED] * count
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

    def close(self) -> None:
        """Nothing."""


@contextlib.contextmanager
def serving(source: Any, **rules: Any) -> Iterator[ViewServer]:
    """A running server on a free port of 127.0.0.1."""
    server = ViewServer(source, Guard(**rules), ("127.0.0.1",))
    server.start()
    try:
        yield server
    finally:
        server.close()


def ask(
    server: ViewServer, path: str, method: str = "GET", body: str | None = None, **headers: str | None
) -> tuple[int, dict[str, str], bytes]:
    """One request; headers by their names with _ for -, None leaves one out. Status, headers in lower case, body."""
    connection = http.client.HTTPConnection("127.0.0.1", server.guard.port, timeout=10)
    sent: dict[str, str | None] = {"Host": f"127.0.0.1:{server.guard.port}"}
    sent |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    for name, value in sent.items():
        if value is not None:
            connection.putheader(name, value)
    if body is not None:
        connection.putheader("Content-Length", str(len(body)))
    connection.endheaders(body.encode() if body is not None else None)
    answer = connection.getresponse()
    found = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    connection.close()
    return found


def first_messages(server: ViewServer, path: str, count: int) -> list[dict[str, Any]]:
    """The first server-sent events of a stream."""
    connection = http.client.HTTPConnection("127.0.0.1", server.guard.port, timeout=10)
    connection.request("GET", path)
    answer = connection.getresponse()
    assert answer.status == 200
    found: list[dict[str, Any]] = []
    while len(found) < count:
        line = answer.readline()
        if not line:
            break
        if line.startswith(b"data: "):
            found.append(json.loads(line[6:]))
    connection.close()
    return found


def known(value: float) -> bool:
    """Not NaN."""
    return not math.isnan(value)
