"""A running Hand, its fingers and another master on one bus in simulated time, in one thread.

The nodes respond after ``LATENCY_US``, the hand looks every millisecond, and what its other threads do is done in
between. Loads are known for each SYNC, so that every row can be compared with what pressed on the fingers."""

import contextlib
import heapq
import itertools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest

from canopen_device.core.node import Device
from canopen_device.testing import MemoryStore
from host.bus_with_nodes import beam_calibration
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.host.frames.frame_array import FrameArray, frame_array
from tipforce.host.hand import bring_up as bring_up_module
from tipforce.host.hand import hand as hand_module
from tipforce.host.hand.events import Event
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand
from tipforce.host.network.bus import Bus, Dispatcher, Heartbeats
from tipforce.host.network.lss import LssMaster
from tipforce.host.network.sdo import Exchange, Request, SdoChannel
from tipforce.samples.reasons import PRESENT
from tipforce.samples.record import Rows
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources.simulated import SimulatedSource

LATENCY_US, LOOK_US, REQUEST_US = 150, 1000, 200
SYNC_HZ, HEARTBEAT_MS = 100, 100
FIRST_NEWTONS = {1: 1.5, 2: 3.4}
TOLERANCE_NEWTONS, TOLERANCE_DEG = 0.02, 1.0
NODE_IDS = (1, 2)
_BEGIN_NS = 1_700_000_000_000_000_000


def force_newtons(t_us: int, node_id: int) -> float:
    """What presses on a finger at a SYNC: 40 mN more than at the one before, over 0.25 s."""
    return FIRST_NEWTONS[node_id] + 4e-6 * (t_us % 250_000)


class Line:
    """The bus, in microseconds: nodes, the host's frames, and what is due."""

    def __init__(self, node_ids: Sequence[int]) -> None:
        self.now_us = 1_000_000
        self.stores = {n: MemoryStore() for n in node_ids}
        self.devices: dict[int, Device] = {}
        self.sources: dict[int, SimulatedSource] = {}
        self.host: list[tuple[int, int, bytes]] = []
        self.echo = True  # the host receives its own frames, as a SocketCAN receiver does
        self.ears: list[Callable[[int, bytes], None]] = []
        self.look: Callable[[], None] = lambda: None
        self.jobs: list[Callable[[], Any]] = []
        self._working = False
        self._numbers = itertools.count()
        self._queue: list[tuple[int, int, Callable[[], None]]] = []
        self._due_us: dict[int, int] = {}
        for n in node_ids:
            self.switch_on(n)
        self._next_look_us = self.now_us

    def switch_on(self, serial: int, node_id: int | None = None) -> None:
        """Power a node of this serial, with what it stored."""
        source = SimulatedSource(strain_matrix(FABRICATED, "I").tolist())
        store = self.stores[serial]
        node = fingertip_node(node_id or serial, source, serial=serial, save=store.save, load=store.load)
        self.devices[serial], self.sources[serial] = node, source
        self._step(serial, [])

    def switch_off(self, serial: int) -> None:
        del self.devices[serial], self._due_us[serial]

    def now_s(self) -> float:
        return 1e-6 * self.now_us

    def now_ns(self) -> int:
        return _BEGIN_NS + 1000 * self.now_us

    def at(self, after_us: int, act: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (self.now_us + after_us, next(self._numbers), act))

    def put(self, can_id: int, data: bytes, sender: object = None, seen: bool = True) -> None:
        """A frame on the bus: each node takes it, and responds later."""
        if seen:
            self.host.append((self.now_ns(), can_id, bytes(data)))
        for ear in self.ears:
            ear(can_id, data)
        for serial in self.devices:
            if serial is not sender and serial != sender:
                if can_id == 0x080:
                    self.sources[serial].load = (force_newtons(self.now_us, serial), 10.0, 30.0)
                self._step(serial, [(can_id, bytes(data))])

    def _step(self, serial: int, frames: list[tuple[int, bytes]]) -> None:
        sent, due_us = self.devices[serial].step(self.now_us, frames)
        self._due_us[serial] = due_us
        for can_id, data in sent:
            self.at(LATENCY_US, partial(self.put, can_id, bytes(data), serial))

    def advance(self, until_us: int) -> None:
        while True:
            next_us = min([self._next_look_us, *self._due_us.values(), *[one[0] for one in self._queue[:1]]])
            if next_us > until_us:
                self.now_us = max(self.now_us, until_us)  # a job may have taken longer
                return
            self.now_us = max(self.now_us, next_us)
            if self._queue and self._queue[0][0] <= self.now_us:
                heapq.heappop(self._queue)[2]()
            elif self._next_look_us <= self.now_us:
                self._next_look_us = self.now_us + LOOK_US
                self.look()
                if self.jobs and not self._working:
                    self._working = True
                    try:
                        self.jobs.pop(0)()
                    finally:
                        self._working = False
            else:
                for serial, due_us in list(self._due_us.items()):
                    if due_us <= self.now_us:
                        self._step(serial, [])

    def run(self, seconds: float) -> None:
        self.advance(self.now_us + round(1e6 * seconds))


class Channel(SdoChannel):
    def __init__(self, line: Line, network: Any, node_id: int) -> None:
        super().__init__(network, node_id, clock=line.now_s)
        self._line = line

    async def _transfer(self, request: Request, *, blocks: bool) -> bytes:  # noqa: ARG002
        self._exchange = exchange = Exchange(self, request)
        try:
            while True:
                exchange.step()
                if exchange.done.done():
                    return exchange.done.result()
                self._line.run(1e-6 * REQUEST_US)
        finally:
            self._exchange = None


class Connection(Bus):
    def __init__(self, line: Line, echo: bool = True) -> None:
        def send(message: can.Message) -> None:
            line.put(message.arbitration_id, bytes(message.data), seen=echo)

        self._line, self._sdo = line, dict[int, Channel]()
        self._lock, self._fingers = threading.Lock(), {}
        self.dispatcher = Dispatcher(SimpleNamespace(send=send))  # type: ignore[arg-type]
        self.heartbeats, self.duplicates = Heartbeats(), DuplicateNodes()
        self.heartbeats._arrived.wait = self._let_time_pass  # type: ignore[method-assign, assignment]
        line.ears.append(self._hear)

    def _let_time_pass(self, _timeout_s: float | None = None) -> bool:
        self._line.run(1e-3)
        return True

    def _hear(self, can_id: int, data: bytes) -> None:
        self.dispatcher.notify(can_id, bytearray(data), 0.0)
        if can_id > 0x700:
            self.heartbeats.on_message_received(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def sdo(self, node_id: int) -> SdoChannel:
        if node_id not in self._sdo:
            self._sdo[node_id] = Channel(self._line, self.dispatcher, node_id)
        return self._sdo[node_id]

    def close(self) -> None:
        """Nothing is open."""


class _Link:
    dropped, owned = 0, True

    def __init__(self, line: Line, echo: bool) -> None:
        self._line, self.connection = line, Connection(line, echo)
        self._on = False

    def receive(self, _timeout_s: float) -> FrameArray:
        frames, self._line.host = self._line.host, []
        return frame_array(frames)

    def start_sync(self, period_s: float, data: Sequence[bytes]) -> Callable[[], None]:
        self._on, numbers = True, itertools.cycle(data)

        def sync() -> None:
            if self._on:
                self._line.put(0x080, next(numbers))
                self._line.at(round(1e6 * period_s), sync)

        self._line.at(0, sync)
        return lambda: setattr(self, "_on", False)

    def close(self) -> None:
        """Nothing is open."""


class _Pool:
    def __init__(self, line: Line) -> None:
        self._line = line

    def submit(self, act: Callable[..., Any], *words: Any) -> None:
        self._line.jobs.append(lambda: act(*words))

    def shutdown(self, **_options: Any) -> None:
        """Nothing runs."""


class SimulatedHand:
    """The hand, its events and rows, and another master."""

    def __init__(self, line: Line, hand: Hand) -> None:
        self.line, self.hand = line, hand
        self.master = Connection(line)
        self.events: list[Event] = []
        self.rows: list[Rows] = []
        self.shown = 0
        self.wrongs: list[str] = []
        hand.on_event(self.events.append)
        hand.on_rows(self._check)

    def kinds(self, node_id: int) -> list[str]:
        return [event.kind for event in self.events if event.node_id == node_id]

    def _check(self, rows: Rows) -> None:
        self.rows.append(rows)
        for row in range(len(rows)):
            t_us = (int(rows.sync_ns[row]) - _BEGIN_NS) // 1000
            for k, node_id in enumerate(NODE_IDS):
                if rows.reason[row, k] != PRESENT or np.isnan(rows.columns["P"][row, k]):
                    continue
                P, phi, theta = (float(rows.columns[name][row, k]) for name in ("P", "phi", "theta"))
                self.shown += 1
                accepted = any(
                    event.kind == "accepted" and event.node_id == node_id and event.text.startswith("by another")
                    for event in self.events
                )
                off = abs(P - force_newtons(t_us, node_id)) > TOLERANCE_NEWTONS
                off |= abs(phi - 10.0) > TOLERANCE_DEG or abs(theta - 30.0) > TOLERANCE_DEG
                if off and not accepted:
                    self.wrongs.append(f"{t_us * 1e-6:.3f} s: finger {node_id} shows {P:.3f} N, {phi:.1f}, {theta:.1f}")

    def is_shown(self, node_id: int, seconds: float = 0.1) -> bool:
        """Let time pass; return whether the finger was in every row."""
        self.rows.clear()
        self.line.run(seconds)
        k = NODE_IDS.index(node_id)
        return bool(self.rows) and all((rows.reason[:, k] == PRESENT).all() for rows in self.rows)


@contextlib.contextmanager
def simulated_hand(
    policy: str = "refuse", echo: bool = True, numbered: bool = True, folder: Path | None = None
) -> Iterator[SimulatedHand]:
    """A hand of fingers 1 and 2 that runs; with ``folder`` its file names their calibration."""
    with pytest.MonkeyPatch.context() as patch:
        line = Line(NODE_IDS)
        patch.setattr(time, "monotonic", line.now_s)
        patch.setattr(time, "time_ns", line.now_ns)

        def ask(self: LssMaster, service: int, payload: bytes, expected: int, timeout_s: float | None = None) -> Any:
            answers: list[bytes] = []
            done = SimpleNamespace(done=lambda: bool(answers), set_result=answers.append)
            self._awaited = expected, done  # type: ignore[assignment]
            self._send(service, payload)
            until_us = line.now_us + round(1e6 * (0.1 if timeout_s is None else timeout_s))
            while not answers and line.now_us < until_us:
                line.run(5e-4)
            return answers[0] if answers else None

        patch.setattr(LssMaster, "_ask", ask)
        for module in (hand_module, bring_up_module):
            patch.setattr(module, "side_by_side", lambda act, of: [act(one) for one in of])
        link = _Link(line, echo)
        calibration = "" if folder is None else "cal.toml"
        if folder is not None:
            write_calibration(folder / calibration, beam_calibration())
        file = HandFile(
            finger=tuple(FingerPlan(node_id=n, serial=n, calibration=calibration) for n in NODE_IDS),
            hand=HandPlan(sync_hz=SYNC_HZ, heartbeat_ms=HEARTBEAT_MS, foreign_changes=policy, numbered_sync=numbered),  # type: ignore[arg-type]
            bus={}, folder=str(folder or ""),
        )  # fmt: skip
        hand = Hand(file, link)  # type: ignore[arg-type]
        hand._queue._pool = _Pool(line)  # type: ignore[assignment]
        thread = SimpleNamespace(start=lambda: setattr(line, "look", lambda: hand._step(0.0)), join=lambda: None)
        patch.setattr(threading, "Thread", lambda **_options: thread)
        line.run(0.01)
        for n in NODE_IDS:
            link.connection.finger(n).apply_calibration(beam_calibration(), store=True)
        _bring_up(hand)
        hand.start()
        seen = SimulatedHand(line, hand)
        line.run(0.3)
        yield seen
        line.look = lambda: None


def _bring_up(hand: Hand) -> None:
    for plan in hand.file.finger:
        report = bring_up_module.FingerReport(plan)
        wanted = bring_up_module.wanted_settings(hand.file, plan)
        bring_up_module.set_up(hand.connection, hand.file, report, wanted, lambda _event: None)
        assert report.ok, report
    hand._nodes = set(hand.node_ids)
