"""A whole hand that runs: rows, a finger that dies and comes back, one that forgets who it is, a bus that fails."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import numpy as np
import pytest

from canopen_device.core.node import Device
from canopen_device.running import loop
from canopen_device.running.ports import PythonCanPort
from canopen_device.running.store import FileStore
from host.bus_with_nodes import beam_calibration, new_channel
from tipforce.errors import InputError
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.hand.events import Event
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import strain_matrix
from tipforce.sources.simulated import SimulatedSource

WAIT_S = 60.0


class Fingers:
    """Simulated nodes on a bus of their own, each in its own thread, so that one can be switched off and on."""

    def __init__(self, channel: str, folder: Path) -> None:
        self.channel, self.folder = channel, folder
        self.devices: dict[int, Device] = {}
        self.sources: dict[int, SimulatedSource] = {}
        self._powered: dict[int, contextlib.ExitStack] = {}

    def switch_on(self, serial: int, node_id: int, forget: bool = False) -> None:
        """Power a node: its parameters come from its store, unless it forgets."""
        files = FileStore(self.folder / f"{serial}.json")
        source = SimulatedSource(strain_matrix(FABRICATED, "I").tolist())
        source.load = (1.0 + serial, 0.0, 0.0)
        save, load = (None, None) if forget else (files.save, files.load)
        self.devices[serial] = fingertip_node(node_id, source, serial=serial, save=save, load=load)
        self.sources[serial] = source
        self._powered[serial] = power = contextlib.ExitStack()
        bus = power.enter_context(can.Bus(interface="virtual", channel=self.channel))
        power.enter_context(loop.running([self.devices[serial]], PythonCanPort(bus)))

    def switch_off(self, serial: int) -> None:
        """Cut its power."""
        self._powered.pop(serial).close()

    def close(self) -> None:
        """All off."""
        for serial in list(self._powered):
            self.switch_off(serial)


@pytest.fixture
def fingers(tmp_path: Path) -> Iterator[Fingers]:
    """Fingers 1 and 2, serials 1 and 2."""
    found = Fingers(new_channel(), tmp_path)
    found.switch_on(1, 1)
    found.switch_on(2, 2)
    yield found
    found.close()


@contextlib.contextmanager
def running(fingers: Fingers, sync_hz: float = 100.0, store: bool = True) -> Iterator[Hand]:
    """A hand that is up."""
    write_calibration(fingers.folder / "cal.toml", beam_calibration())
    file = HandFile(
        finger=tuple(FingerPlan(node_id=n, serial=n, calibration="cal.toml") for n in (1, 2)),
        hand=HandPlan(sync_hz=sync_hz, heartbeat_ms=50, store=store),
        bus={"interface": "virtual", "channel": fingers.channel},
        folder=str(fingers.folder),
    )
    with Hand(file) as hand:
        assert [str(report) for report in hand.bring_up()] == ["finger 1: up", "finger 2: up"]
        hand.start()
        yield hand


def until(condition: Callable[[], bool], what: str) -> None:
    """Wait for it."""
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s, what
        time.sleep(0.005)


def latest(hand: Hand, fingers: int = 1) -> np.ndarray:
    """P of the next row in which the first ``fingers`` responded in time: a busy machine may be late for a while."""
    deadline_s = time.monotonic() + WAIT_S
    for rows in hand.blocks(WAIT_S):
        known = rows.columns["P"][~np.isnan(rows.columns["P"][:, :fingers]).any(axis=1)]
        if len(known):
            return np.asarray(known[-1])
        assert time.monotonic() < deadline_s, "a finger is unknown in every row"
    raise AssertionError("no row")


def kinds(hand: Hand, node_id: int) -> list[str]:
    """What happened to a finger since the last call."""
    return [event.kind for event in hand.events() if event.node_id == node_id]


def test_every_sync_gives_a_row_with_every_finger(fingers: Fingers) -> None:
    with running(fingers) as hand:
        whole, number = 0, None
        for rows in hand.blocks(WAIT_S):
            assert number in (None, rows.first)
            number = rows.first + len(rows)
            known = rows.columns["P"][~rows.missing.any(axis=1) & ~rows.columns["stale"].any(axis=1)]
            assert known == pytest.approx(np.tile([2.0, 3.0], (len(known), 1)), abs=5e-3)
            whole = 0 if rows.missing.any() else whole + len(rows)
            if whole >= 30:  # a busy machine may lose some at the start
                break
        found = hand.statistics()
        assert found.tally.rows >= whole
        assert found.tally.mixed.tolist() == [0, 0]
        assert (found.dropped, found.overrun) == (0, 0)
        assert found.sync.periods >= whole - 1
        assert hand.settled()


def test_a_finger_that_dies_and_comes_back_is_set_up_again(fingers: Fingers) -> None:
    with running(fingers) as hand:
        hand.events()
        fingers.switch_off(2)
        until(lambda: hand.state(2) == "silent", "its heartbeat should be missed")
        row = latest(hand)
        assert row[0] == pytest.approx(2.0, abs=5e-3)
        assert np.isnan(row[1])  # never what it said last
        assert kinds(hand, 2) == ["heartbeat_lost"]
        fingers.switch_on(2, 2)
        until(lambda: hand.settled() and not np.isnan(latest(hand)).any(), "it should come back")
        assert latest(hand, 2) == pytest.approx([2.0, 3.0], abs=5e-3)
        found = kinds(hand, 2)
        assert found[0] == "boot_up"
        assert "started" in found
        assert "failed" not in found


def test_a_finger_that_forgot_everything_gets_its_id_and_calibration_back(fingers: Fingers) -> None:
    with running(fingers, store=False) as hand:
        hand.events()
        fingers.switch_off(1)
        until(lambda: hand.state(1) == "silent", "its heartbeat should be missed")
        fingers.switch_on(1, 255, forget=True)
        until(lambda: hand.settled() and not np.isnan(latest(hand)).any(), "it should come back")
        assert latest(hand, 2) == pytest.approx([2.0, 3.0], abs=5e-3)
        # Each may happen again where heartbeats are late on a busy machine; the order in which they begin stands.
        began = dict.fromkeys(kinds(hand, 1))
        assert [kind for kind in began if kind in ("heartbeat_lost", "assigned", "calibrated", "started")] == [
            "heartbeat_lost", "assigned", "calibrated", "started",
        ]  # fmt: skip


def test_a_front_end_fault_is_an_event_and_no_number(fingers: Fingers) -> None:
    with running(fingers) as hand:
        hand.events()
        fingers.sources[2].fault = 4  # silent converter
        until(lambda: "emcy" in kinds(hand, 2), "EMCY should come")
        assert np.isnan(latest(hand)[1])
        fingers.sources[2].fault = 0
        until(lambda: "emcy_reset" in kinds(hand, 2), "EMCY reset should come")
        until(lambda: not np.isnan(latest(hand)).any(), "the force should be known again")


def test_callbacks(fingers: Fingers) -> None:
    seen: list[int] = []
    with running(fingers) as hand:
        hand.on_rows(lambda rows: seen.append(len(rows)))
        until(lambda: sum(seen) >= 10, "rows should come")
        with pytest.raises(InputError, match="already started"):
            hand.start()


def test_a_stopped_hand_sends_nothing_more(fingers: Fingers) -> None:
    with running(fingers) as hand:
        iterator = hand.blocks()
        next(iterator)
        hand.stop()
        assert sum(1 for _ in iterator) < 1000
        with can.Bus(interface="virtual", channel=fingers.channel) as bus:
            heard = []
            deadline_s = time.monotonic() + 0.2
            while time.monotonic() < deadline_s:
                message = bus.recv(0.05)
                if message is not None and message.arbitration_id < 0x700:
                    heard.append(message)
        assert heard == []


def test_a_dead_receiver_is_told(fingers: Fingers, monkeypatch: pytest.MonkeyPatch) -> None:
    with running(fingers) as hand:
        events: list[Event] = []
        hand.on_event(events.append)
        monkeypatch.setattr("threading.excepthook", lambda _args: None)

        def broken(_timeout_s: float) -> None:
            raise ZeroDivisionError("receiver")

        monkeypatch.setattr(hand._link, "receive", broken)
        until(lambda: hand.error is not None, "it should be noticed")
        assert not hand.settled()
        assert hand.state(1) == "unknown: reception has ended"
        until(lambda: any(e.kind == "failed" for e in events), "it should be an event")
        assert "ended: ZeroDivisionError" in next(e.text for e in events if e.kind == "failed")
