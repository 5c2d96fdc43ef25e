"""What another master does to a hand: tare, offsets, PDOs, NMT; what the hand shows meanwhile, and what it does."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from canopen_device.core.codes import OPERATIONAL
from host.bus_with_nodes import beam_calibration, new_channel
from host.hand.test_hand import Fingers, kinds, latest, until
from tipforce.dictionary import objects as od
from tipforce.errors import InputError, SdoAbortError
from tipforce.host.configuration.calibration_file import write_calibration
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.hand.events import Event
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand
from tipforce.host.hand.meaning import write_back
from tipforce.host.hand.recovery import Recovery
from tipforce.host.network.bus import Bus
from tipforce.host.network.finger import FingertipClient
from tipforce.samples.reasons import OF_ROW
from tipforce.samples.record import Rows


class Watched:
    """A running hand of fingers 1 and 2, its events and rows, and another master on its bus."""

    def __init__(self, hand: Hand, master: Bus) -> None:
        self.hand, self.master = hand, master
        self.events: list[Event] = []
        self.rows: list[Rows] = []
        hand.on_event(self.events.append)
        hand.on_rows(self.rows.append)

    def told(self, *wanted: str) -> str:
        """Wait for an event of finger 2 of one of these kinds; return its text."""
        until(lambda: any(e.kind in wanted and e.node_id == 2 for e in self.events), f"{wanted}: {self.events}")
        return next(e.text for e in self.events if e.kind in wanted and e.node_id == 2)

    def kinds(self) -> list[str]:
        """What happened to finger 2; a busy machine may also miss heartbeats, and start the finger again."""
        mine = [event.kind for event in self.events if event.node_id == 2]
        return [kind for kind in mine if not kind.startswith(("heartbeat", "started"))]

    def shown(self) -> list[float]:
        """Every P of finger 2 so far."""
        return [value for rows in list(self.rows) for value in rows.columns["P"][:, 1].tolist() if not np.isnan(value)]


@contextlib.contextmanager
def watched(folder: Path, policy: str = "refuse", numbered: bool = True) -> Iterator[tuple[Watched, Fingers]]:
    fingers = Fingers(new_channel(), folder)
    write_calibration(folder / "cal.toml", beam_calibration())
    file = HandFile(
        finger=tuple(FingerPlan(node_id=n, serial=n, calibration="cal.toml") for n in (1, 2)),
        hand=HandPlan(sync_hz=100, heartbeat_ms=50, foreign_changes=policy, numbered_sync=numbered),  # type: ignore[arg-type]
        bus={"interface": "virtual", "channel": fingers.channel}, folder=str(folder),
    )  # fmt: skip
    with contextlib.ExitStack() as stack:
        stack.callback(fingers.close)
        for n in (1, 2):
            fingers.switch_on(n, n)
        hand = stack.enter_context(Hand(file))
        assert [str(report) for report in hand.bring_up()] == ["finger 1: up", "finger 2: up"]
        hand.start()
        master = stack.enter_context(Bus(can.Bus(interface="virtual", channel=fingers.channel)))
        found = Watched(hand, master)
        latest(hand, 2)
        yield found, fingers


def tare(master: Bus) -> None:
    """Until it is accepted: on a loaded machine the finger's sample may be stale, and it refuses."""

    def accepted() -> bool:
        with contextlib.suppress(SdoAbortError):
            FingertipClient(master.sdo(2)).tare()
            return True
        return False

    until(accepted, "the finger should take the tare")


def offset(master: Bus) -> None:
    master.sdo(2).write(od.PROCESS_OFFSET[2], 50.0)


def remap(master: Bus) -> None:
    sdo = master.sdo(2)
    sdo.write(od.TPDO2_COB_ID, 0xC0000282)
    sdo.write(od.TPDO2_MAPPED, 0)
    sdo.write(od.TPDO2_MAPPING[1], 0x71300810)
    sdo.write(od.TPDO2_MAPPING[2], 0x71300710)
    sdo.write(od.TPDO2_MAPPED, 5)
    sdo.write(od.TPDO2_COB_ID, 0x40000282)


def replaced(master: Bus) -> None:
    FingertipClient(master.sdo(2)).apply_calibration(beam_calibration("I", C=2.0 * beam_calibration().C), store=False)


CHANGES = [(tare, "tare.F"), (offset, "0.0 -> 50.0"), (remap, "tpdo2.mapping:1"), (replaced, "calibration.active_crc")]


@pytest.mark.parametrize(("change", "text"), CHANGES)
def test_a_foreign_change_is_refused(tmp_path: Path, change: Callable[[Bus], None], text: str) -> None:
    with watched(tmp_path) as (seen, _):
        change(seen.master)
        assert text in seen.told("refused")
        assert seen.kinds()[0] == "changed"
        assert set(np.round(seen.shown(), 1)) == {3.0}  # never what it means now
        rows = next(seen.hand.blocks(5.0))
        assert np.isnan(rows.columns["P"][:, 1]).all()
        found = list(itertools.islice(seen.hand.rows(5.0), 20))
        reasons = {row["finger 2"].reason for row in found}
        assert OF_ROW[4] in reasons
        assert reasons <= {OF_ROW[1], OF_ROW[4]}  # on a loaded machine an answer may be missing
        known = [row["finger 1"].P_newtons for row in found if not row["finger 1"].reason]
        assert known == pytest.approx([2.0] * len(known), abs=5e-3)
        assert known


@pytest.mark.parametrize(("change", "text"), CHANGES)
def test_a_foreign_change_is_undone(tmp_path: Path, change: Callable[[Bus], None], text: str) -> None:
    with watched(tmp_path, "restore") as (seen, _):
        change(seen.master)
        assert text in seen.told("restored")
        assert latest(seen.hand, 2) == pytest.approx([2.0, 3.0], abs=5e-3)
        assert set(np.round(seen.shown(), 1)) == {3.0}
        assert seen.kinds()[:2] == ["changed", "restored"]  # not each write, whether the other's or the hand's


@pytest.mark.parametrize("change", [replaced, remap, offset])
def test_frames_that_wait_while_the_hand_restores_are_not_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Bus], None]
) -> None:
    """On a busy machine the answers before the restoration are processed after it."""
    with watched(tmp_path, "restore") as (seen, _):
        receive, waiting = seen.hand._link.receive, deque[tuple[float, FrameArray]]()

        def late(timeout_s: float) -> FrameArray:
            waiting.append((time.monotonic(), receive(timeout_s)))
            due = len(waiting) and waiting[0][0] < time.monotonic() - 0.4
            return waiting.popleft()[1] if due else np.zeros(0, dtype=FRAME)

        monkeypatch.setattr(seen.hand._link, "receive", late)
        change(seen.master)
        seen.told("restored")
        count = len(seen.shown())
        until(lambda: len(seen.shown()) > count + 60, "its values should be shown again")
        assert set(np.round(seen.shown(), 1)) == {3.0}


def test_a_change_while_the_hand_restores_is_undone_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with watched(tmp_path, "restore") as (seen, _):
        others = [remap]

        def and_again(*words: Any) -> None:
            write_back(*words)
            while others:
                others.pop()(seen.master)

        monkeypatch.setattr("tipforce.host.hand.recovery.write_back", and_again)
        offset(seen.master)
        assert "tpdo2.mapping:1" in seen.told("restored")
        assert latest(seen.hand, 2) == pytest.approx([2.0, 3.0], abs=5e-3)
        assert set(np.round(seen.shown(), 1)) == {3.0}


def test_a_health_pdo_that_is_switched_off_is_missed(tmp_path: Path) -> None:
    """Nothing that the node sends says so; 2126h is read within a second."""
    with watched(tmp_path) as (seen, _):
        seen.master.sdo(2).write(od.TPDO4_COB_ID, 0xC0000482)
        assert "tpdo4.cob_id" in seen.told("refused")
        assert seen.kinds() == ["changed", "refused"]
        latest(seen.hand, 1)
        assert np.isnan(next(seen.hand.blocks(5.0)).columns["P"][:, 1]).all()


def test_a_foreign_tare_is_accepted_and_another_mapping_is_not(tmp_path: Path) -> None:
    with watched(tmp_path, "accept") as (seen, _):
        tare(seen.master)
        assert "tare.F" in seen.told("accepted")
        until(lambda: latest(seen.hand, 2)[1] < 0.1, "the tare should be shown")
        remap(seen.master)
        assert "tpdo2.mapping:1" in seen.told("refused")
        assert set(np.round(seen.shown(), 1)) == {3.0, 0.0}


def test_what_is_undone_by_the_other_is_shown_again(tmp_path: Path) -> None:
    with watched(tmp_path) as (seen, _):
        tare(seen.master)
        seen.told("refused")
        FingertipClient(seen.master.sdo(2)).clear_tare()
        assert "as before" in seen.told("accepted")
        assert latest(seen.hand, 2) == pytest.approx([2.0, 3.0], abs=5e-3)


def test_the_hands_own_tare_is_no_foreign_change(tmp_path: Path) -> None:
    with watched(tmp_path) as (seen, _):
        assert seen.hand.tare(2).startswith("tare: F1 ")
        until(lambda: latest(seen.hand, 2)[1] < 0.1, "the tare should be shown")
        assert "changed" not in seen.kinds()
        with pytest.raises(InputError, match="the hand has finger 1"):
            seen.hand.tare("ring")


def test_the_hands_own_tare_does_not_accept_a_foreign_change(tmp_path: Path) -> None:
    with watched(tmp_path) as (seen, _):
        offset(seen.master)
        seen.told("refused")
        seen.hand.tare(2)
        until(lambda: seen.kinds().count("refused") >= 2, "it should be refused again")
        latest(seen.hand, 1)
        assert np.isnan(next(seen.hand.blocks(5.0)).columns["P"][:, 1]).all()


def test_a_change_between_bring_up_and_start_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare, done = Recovery.prepare, list[int]()

    def changed_before(self: Recovery, node_id: int) -> None:
        if node_id == 2 and not done:
            done.append(node_id)
            replaced(self._connection())
        prepare(self, node_id)

    monkeypatch.setattr(Recovery, "prepare", changed_before)
    with watched(tmp_path) as (seen, _):
        assert latest(seen.hand, 2) == pytest.approx([2.0, 3.0], abs=5e-3)
        assert set(np.round(seen.shown(), 1)) == {3.0}


@pytest.mark.parametrize("command", ["preop", "stop"])
def test_a_finger_that_another_stops_is_started_again(tmp_path: Path, command: str) -> None:
    with watched(tmp_path) as (seen, _):
        seen.master.nmt(command, 2)
        assert "pre-operational" in seen.told("started") or "stopped" in seen.told("started")
        until(lambda: seen.hand.state(2) == "operational" and seen.hand.settled(), "it should be operational")
        assert latest(seen.hand, 2) == pytest.approx([2.0, 3.0], abs=5e-3)
        assert "changed" not in seen.kinds()


def test_1019h_is_restored_and_set_again_after_a_reboot(tmp_path: Path) -> None:
    with watched(tmp_path) as (seen, fingers):
        overflow = seen.master.sdo(2)
        assert overflow.read(od.SYNC_COUNTER_OVERFLOW) == 240
        seen.master.nmt("reset-node", 2)
        seen.told("boot_up")
        until(seen.hand.settled, "it should be set up")
        assert latest(seen.hand, 2) == pytest.approx([2.0, 3.0], abs=5e-3)
        assert overflow.read(od.SYNC_COUNTER_OVERFLOW) == 240
        seen.hand.stop()
        assert overflow.read(od.SYNC_COUNTER_OVERFLOW) == 0
        assert fingers.devices[1].nmt.state != OPERATIONAL


def test_without_numbers_the_rows_say_so(tmp_path: Path) -> None:
    with watched(tmp_path, numbered=False) as (seen, _):
        assert seen.master.sdo(2).read(od.SYNC_COUNTER_OVERFLOW) == 0
        assert next(seen.hand.rows(5.0)).pairing == "assumed"


def test_a_dead_receiver_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with watched(tmp_path) as (seen, _):
        monkeypatch.setattr("threading.excepthook", lambda _args: None)

        def broken(_timeout_s: float) -> None:
            raise ZeroDivisionError("receiver")

        monkeypatch.setattr(seen.hand._link, "receive", broken)
        until(lambda: seen.hand.error is not None, "it should be noticed")
        assert not seen.hand.settled()
        assert seen.hand.state(1) == "unknown: reception has ended"
        until(lambda: any(e.kind == "failed" for e in seen.events), "it should be an event")
        assert "ended: ZeroDivisionError" in next(e.text for e in seen.events if e.kind == "failed")
        assert kinds(seen.hand, 0)
