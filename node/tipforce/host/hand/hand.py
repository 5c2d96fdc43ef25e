"""A running hand: brought up from its file, read row by row, monitored, and recovered when a finger reboots.

    with Hand.open("hand.toml") as hand:
        for row in hand.rows():
            print(row["thumb"].P_newtons)

``blocks`` returns the same as arrays, many rows at a time; both also exist for asyncio, blocks also by callback. One
thread receives; a consumer that is too slow loses the oldest rows, counted in ``overrun``."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from canopen_device.core import emcy
from canopen_device.core.codes import OPERATIONAL
from tipforce.errors import EnvironmentLackError, InputError, RefusedError, TipforceError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.frames.frame_array import FRAME, FrameArray, frame_array
from tipforce.host.hand.bring_up import FingerReport, bring_up, side_by_side
from tipforce.host.hand.events import BabbleWatch, Event, Supervisor, waited_s
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan, hand_of, read_hand
from tipforce.host.hand.link import Jitter, JitterFigures, Link, open_link, wanted_overflow
from tipforce.host.hand.recovery import LOST, Recovery, RecoveryQueue
from tipforce.host.hand.rows import Collector, Delivery, HandRow, HandRows, rows_one_by_one
from tipforce.host.hand.trust import COUNTER
from tipforce.host.network.bus import Bus
from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, HEALTH_MS, LoadMeter
from tipforce.samples.record import RowContacts, Rows
from tipforce.samples.rows import RowTally
from tipforce.samples.sync_numbers import LARGEST

HEARTBEATS_MISSED = 2.5  # heartbeat time-out in periods
REOPEN_S = 0.1
_TICK_S = 0.01
_SUPERVISE_S = 0.005  # without a frame that says something of a finger
_MOST_OLD_BATCHES = 1000
_RECOVERED_BY_HAND = (emcy.BUS_OFF_RECOVERED, emcy.SYNC_LENGTH)
_HEALTH_SILENT_S = 1.5e-3 * HEALTH_MS  # then 2126h is read
_UNANSWERED_S = 1.0  # a finger that is off is noticed by its heartbeat before
_LOST_PROBE_S = 1.0  # interval of LSS searches for a lost finger


@dataclass(frozen=True, slots=True)
class Statistics:
    """Counts of a hand since ``start``."""

    tally: RowTally
    sync: JitterFigures
    dropped: int
    """Frames that the kernel or the buffer dropped."""
    overrun: int
    """Rows that were dropped because consumers were too slow."""
    load: tuple[float, float]
    """Share of the bus's bit rate in the last second, without stuff bits and with the maximum."""


class Hand:
    """See the module. Raises InputError for an invalid file, EnvironmentLackError for a bus that does not open."""

    def __init__(self, file: HandFile, link: Link | None = None) -> None:
        self.file = file
        self._own_link = link is None
        self._link = open_link(file.bus) if link is None else link
        plan = file.hand
        gauges = file.finger[0].gauges
        self._collector = Collector(file.node_ids, file.messages, gauges, plan.wait_s, plan.sync_hz > 0)
        self._supervisor = Supervisor(file.node_ids, HEARTBEATS_MISSED * plan.heartbeat_ms * 1e-3)
        self._jitter = Jitter(round(1e9 / plan.sync_hz) if plan.sync_hz else 0)
        self._load = LoadMeter(int(file.bus.get("bitrate", DEFAULT_BIT_RATE)))
        self._delivery = Delivery()
        self._recovery = Recovery(
            file, lambda: self._link.connection, self._supervisor, self._collector, self._recovered
        )
        self._accepted: set[int] = set()  # fingers that may have another calibration than the file's
        self.calibrations: list[Calibration | None] = [None] * len(self.node_ids)
        """For the uncertainties, in the order of ``node_ids``; from ``calibration``, and from an accepted change on."""
        self._queue = RecoveryQueue(self._recovery.recover)
        self._babbling = BabbleWatch(plan.sync_hz, 1000.0 / plan.heartbeat_ms)
        self._probe_s = self._heard_s = 0.0  # of the next LSS search; all frames up to then were read
        self._supervise_s = 0.0  # of the next look at what did not come
        self._nodes: set[int] | None = None  # all on the bus, by the bring-up
        self._end_sync: Callable[[], None] = lambda: None
        self._thread: threading.Thread | None = None
        self._stopped = threading.Event()
        self._dropped = self._dropped_before = 0  # on links that were lost; of all at the last step

    @classmethod
    def open(
        cls, fingers: str | Path | Mapping[str, int] | Sequence[int], *, bus: Bus | None = None,
        need_all: bool = True, plan: HandPlan | None = None, **bus_options: Any,
    ) -> Hand:  # fmt: skip
        """Return a running hand: every finger is found, configured, calibrated and started, and SYNCs are sent.

        ``fingers``: the path of a hand file, node-ids, or these by name. ``bus``: an open one, which stays open; or
        ``bus_options`` of ``can.Bus``, before the file's [bus]. ``plan``: [hand] without a file. Raises RefusedError
        naming the fingers that failed and why, unless ``need_all`` is False; InputError for an invalid file,
        EnvironmentLackError for a bus that does not open."""
        file = read_hand(fingers) if isinstance(fingers, str | Path) else hand_of(fingers, plan or HandPlan())
        hand = cls.from_file(file, bus=bus, **bus_options)
        try:
            failed = [str(report) for report in hand.bring_up() if not report.ok]
            if failed and need_all:
                raise RefusedError("; ".join(failed))
            hand.start()
        except BaseException:
            hand.close()
            raise
        return hand

    @classmethod
    def from_file(cls, file: str | Path | HandFile, *, bus: Bus | None = None, **bus_options: Any) -> Hand:
        """Return a hand with only its bus open: call ``bring_up`` and ``start``. Arguments as in ``open``."""
        content = file if isinstance(file, HandFile) else read_hand(file)
        if bus is not None:
            return cls(content, Link(bus, owned=False))
        given = content.bus | {key: value for key, value in bus_options.items() if value is not None}
        return cls(HandFile(finger=content.finger, hand=content.hand, bus=given, folder=content.folder))

    @property
    def connection(self) -> Any:
        """The Bus: SDO, NMT. Replaced after the loss of the bus."""
        return self._link.connection

    @property
    def node_ids(self) -> tuple[int, ...]:
        """In the order of the file and of the columns of every row."""
        return self.file.node_ids

    def bring_up(self) -> list[FingerReport]:
        """Find, number, configure, verify, calibrate and start every finger; return a report for each."""
        reports, self._nodes = bring_up(self._link.connection, self.file, self._delivery.event)
        return reports

    def start(self) -> None:
        """Start to receive, to send SYNCs (unless sync_hz is 0), and to monitor."""
        if self._thread is not None or self._stopped.is_set():
            raise InputError("the hand is already started, or was stopped: open another")
        self._recovery.overflow = wanted_overflow(self._link, self.file, self._nodes)
        self._begin()
        self._thread = threading.Thread(target=self._run, name="hand", daemon=True)
        self._thread.start()
        # While no SYNC comes: number it where all nodes can take the numbers; learn what each finger's values mean.
        self._each(self._recovery.prepare)
        for node_id, state in self._supervisor.states.items():
            if state >= 0 and (state != OPERATIONAL or not self._collector.trust.known(node_id)):
                self._queue.need([node_id])
        self._start_sync()

    def rows(self, timeout_s: float | None = None) -> HandRows[HandRow]:
        """Return rows as they are completed, each with a Contact by name of finger; for ``for`` and ``async for``. They
        end when the hand stops, or after ``timeout_s`` without a row (None: never; not with ``async for``)."""
        for finger in self.file.finger:
            self.calibration(finger)
        names = [finger.name for finger in self.file.finger]
        made = RowContacts(self.node_ids, names, self.calibrations)
        return self._delivery.rows(partial(rows_one_by_one, contacts=made), timeout_s)

    def calibration(self, finger: FingerPlan) -> Calibration | None:
        """Return the calibration for the uncertainties: the file's, else the node's own; None if it is unknown."""
        calibration = None if finger.node_id in self._accepted else self.file.calibration(finger)
        if calibration is None:
            with suppress(TipforceError):  # a finger that does not respond now
                calibration = self._link.connection.finger(finger.node_id).calibration()
        self.calibrations[self.node_ids.index(finger.node_id)] = calibration
        return calibration

    def blocks(self, timeout_s: float | None = None) -> HandRows[Rows]:
        """Return blocks of rows as arrays, as they come; for ``for`` and ``async for``. They end as ``rows``."""
        return self._delivery.rows(lambda rows: (rows,), timeout_s)

    def on_rows(self, callback: Callable[[Rows], None]) -> None:
        """Register a callback for each block of rows. It runs in the receiving thread and must return quickly."""
        self._delivery.row_callbacks.append(callback)

    def on_event(self, callback: Callable[[Event], None]) -> None:
        """Register a callback for each event. It runs in the thread of the event."""
        self._delivery.event_callbacks.append(callback)

    def events(self) -> list[Event]:
        """Return the events since the last call; at most the last 10 000."""
        return self._delivery.take_events()

    def state(self, finger: str | int) -> str:
        """Return the NMT state of a finger, by name or node-id, as text; "silent" for one whose heartbeat is lost.
        Raises InputError for a finger that the hand does not have."""
        node_id = self._node_id(finger)
        return "unknown: reception has ended" if self.error is not None else self._supervisor.state_name(node_id)

    def settled(self) -> bool:
        """Return whether every finger is operational and in the rows that come, and no recovery is active."""
        states = self._supervisor.states.values()
        well = self.error is None and all(state == OPERATIONAL for state in states)
        return well and not self._queue.waiting() and self._collector.trust.settled(time.monotonic())

    @property
    def error(self) -> BaseException | None:
        """The error that ended the reception of frames; None while they are received."""
        return self._delivery.error

    def tare(self, finger: str | int) -> str:
        """Take the present force of a finger as zero; return its tare as text. ``foreign_changes`` decides on a tare by
        others or ``connection``. Raises InputError, NoResponseError, SdoAbortError without a force now."""
        return self._recovery.tare(self._node_id(finger))

    def _node_id(self, finger: str | int) -> int:
        for plan in self.file.finger:
            if finger in (plan.node_id, plan.name):
                return plan.node_id
        known = ", ".join(plan.label for plan in self.file.finger)
        raise InputError(f"finger {finger!r}: the hand has {known}")

    def statistics(self) -> Statistics:
        """Return the counts so far."""
        return Statistics(
            self._collector.tally, self._jitter.figures(), self._dropped + self._link.dropped, self._delivery.overrun,
            self._load.load(time.monotonic()),
        )  # fmt: skip

    def stop(self) -> None:
        """Stop SYNCs and rows; return the fingers to pre-operational."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
        self._end_sync()  # not before: the thread may just begin another on a bus that it has opened again
        self._queue.close()
        self._delivery.close()
        if self._thread is not None:
            with suppress(TipforceError):  # a bus that failed
                for node_id in self.node_ids:
                    self._link.connection.nmt("preop", node_id)
                self._each(self._recovery.restore)
        self._thread = None

    def close(self) -> None:
        """Stop, and close the bus unless it was open before."""
        self.stop()
        if self._own_link or not self._link.owned:
            self._link.close()

    def __enter__(self) -> Hand:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _recovered(self, event: Event) -> None:
        if event.kind == "accepted":  # before its values are shown
            self._accepted.add(event.node_id)
            self.calibration(self.file.finger[self.node_ids.index(event.node_id)])
        self._delivery.event(event)

    def _each(self, act: Callable[[int], None]) -> None:
        """Do something with every finger that responds, in parallel; a failure is an event."""

        def attempt(node_id: int) -> None:
            try:
                act(node_id)
            except TipforceError as error:
                self._delivery.event(Event(time.monotonic(), node_id, "failed", str(error)))

        side_by_side(attempt, [n for n in self.node_ids if self._link.connection.heartbeats.state(n) is not None])

    def _begin(self) -> None:
        """Discard frames of the bring-up; the present state of each finger is known from the connection."""
        for _ in range(_MOST_OLD_BATCHES):
            if not len(self._link.receive(0.0)):
                break
        for node_id in self.node_ids:
            self._collector.trust.hide(node_id)
            state = self._link.connection.heartbeats.state(node_id)
            if state is not None:
                self._supervisor.know(node_id, state, time.monotonic())

    # --- the receiving thread -----------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._stopped.is_set():
                try:
                    self._step(_TICK_S)
                except EnvironmentLackError as error:
                    self._lost(error)
        except BaseException as error:
            self._delivery.close(error)
            text = f"reception has ended: {type(error).__name__}: {error}"
            self._delivery.event(Event(time.monotonic(), 0, "failed", text))
            raise

    def _step(self, timeout_s: float) -> None:
        frames = self._link.receive(timeout_s)
        now_s = time.monotonic()
        self._load.add(frames, now_s)
        if self._dropped + self._link.dropped != self._dropped_before:
            self._dropped_before = self._dropped + self._link.dropped
            self._collector.trust.suspect(self.node_ids, [COUNTER])
        rows = self._collector.add(frames, now_s)
        if rows.raw:
            self._collector.trust.count_rows([reasons for _, _, _, reasons, _ in rows.raw], now_s)
            self._jitter.add([sync_ns for sync_ns, *_ in rows.raw])
            self._delivery.put(rows)
        self._supervise(frames, now_s)

    def _supervise(self, frames: FrameArray, now_s: float) -> None:
        """Judge what frames say of the fingers, also that none came: events, and the recoveries they call for."""
        events, others = self._babbling.add(frames, now_s), self._collector.others
        if others or now_s >= self._supervise_s:
            self._supervise_s = now_s + _SUPERVISE_S
            self._heard_s = max(self._heard_s, now_s - waited_s(frames, time.time_ns()))
            events = self._supervisor.add(frame_array(others), self._heard_s) + events
            others.clear()
        elif not events:
            return
        for event in events:
            self._delivery.event(event)
            self._react(event)
        trust, states = self._collector.trust, self._supervisor.states
        for node_id in trust.take_changes():
            text = "it was changed by another master: its values are unknown until they are verified"
            self._delivery.event(Event(time.monotonic(), node_id, "changed", text))
        for node_id in trust.take_unanswered(now_s, max(_UNANSWERED_S, 1.5 * self._supervisor.timeout_s)):
            if states[node_id] == OPERATIONAL:
                self._delivery.event(Event(time.monotonic(), node_id, "failed", "operational, but it answers no SYNC"))
                trust.ask(node_id, self._recovery.needed_places(node_id))
                self._queue.need([node_id])
        due, asked = trust.due(now_s, _HEALTH_SILENT_S)
        self._queue.need([n for n in due if states[n] == OPERATIONAL or trust.changed(n)])  # starts what waits, too
        self._queue.need(asked, quiet=True)
        # Search by LSS: a finger that lost its node-id at power-off sends no boot-up message.
        if now_s >= self._probe_s:
            self._probe_s = now_s + _LOST_PROBE_S
            if any(state < 0 for state in states.values()):
                self._queue.need([LOST])

    def _react(self, event: Event) -> None:
        node_id = event.node_id
        if event.kind == "boot_up":
            self._recovery.booted(node_id)
            self._queue.need([node_id])
        elif event.kind == "heartbeat_lost":
            self._recovery.silent(node_id)
            self._queue.drop(node_id)
        elif event.kind in ("state", "heartbeat_back"):
            self._collector.expect(node_id, event.code == OPERATIONAL)
            if event.kind == "heartbeat_back" or event.code != OPERATIONAL:
                self._queue.need([node_id])
        elif event.kind == "duplicate":
            self._collector.trust.suspect([node_id])  # until SDO shows what it is, and that one node responds
            self._queue.need([node_id])
        elif event.kind == "emcy" and event.code in _RECOVERED_BY_HAND:
            self._collector.trust.suspect([node_id], (COUNTER,))
            self._queue.need([node_id])

    def _start_sync(self) -> None:
        self._jitter.skip()
        if self.file.hand.sync_hz and not self._stopped.is_set():
            data = [b""]
            if self._recovery.overflow:  # numbers up to the largest, and on from 1
                first = self._collector.restart()
                data = [bytes(((first + k - 1) % LARGEST + 1,)) for k in range(LARGEST)]
            self._end_sync = self._link.start_sync(1.0 / self.file.hand.sync_hz, data)

    def _lost(self, error: EnvironmentLackError) -> None:
        """Reopen the bus as soon as that works after a fault, and check every finger."""
        self._supervisor.forget()  # before the event: whoever sees it finds the hand not settled
        self._delivery.event(Event(time.monotonic(), 0, "bus_down", str(error)))
        self._end_sync()
        if not self._own_link:
            raise error
        self._dropped += self._link.dropped
        self._link.close()
        # The open row ends here: frames after the recovery of the bus do not belong to its SYNC.
        rows = self._collector.add(np.zeros(0, dtype=FRAME), math.inf)
        for node_id in self.node_ids:
            self._recovery.silent(node_id)
        self._collector.trust.suspect(self.node_ids, [COUNTER])
        if len(rows):
            self._delivery.put(rows)
        while not self._stopped.wait(REOPEN_S):
            try:
                self._link = open_link(self.file.bus)
            except EnvironmentLackError:
                continue
            break
        else:
            return
        self._delivery.event(Event(time.monotonic(), 0, "bus_up", "open again"))
        self._start_sync()
