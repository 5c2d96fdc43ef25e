"""What a user sees of another master: reasons of rows, texts of events, what the hand undoes; in simulated time."""

import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from canopen_device.core.codes import OPERATIONAL
from host.bus_with_nodes import beam_calibration
from host.hand.simulated_hand import SimulatedHand, simulated_hand
from tipforce.dictionary import objects as od
from tipforce.errors import InputError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.hand.meaning import write_back
from tipforce.host.hand.recovery import Recovery
from tipforce.host.network.bus import Bus
from tipforce.samples.reasons import OF_ROW


def told(hand: SimulatedHand, kind: str) -> str:
    """Let time pass until finger 2 has an event of a kind; return its text."""
    for _ in range(100):
        texts = [event.text for event in hand.events if event.node_id == 2 and event.kind == kind]
        if texts:
            return texts[-1]
        hand.line.run(0.05)
    raise AssertionError(f"{kind}: {hand.events}")


def tare(master: Bus) -> None:
    master.finger(2).tare()


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
    master.finger(2).apply_calibration(beam_calibration("I", C=2.0 * beam_calibration().C), store=False)


@pytest.mark.parametrize(("policy", "outcome"), [("refuse", "refused"), ("restore", "restored")])
@pytest.mark.parametrize(
    ("change", "text"),
    [(tare, "tare.F"), (offset, "0.0 -> 50.0"), (remap, "tpdo2.mapping:1"), (replaced, "calibration.active_crc")],
)
def test_a_foreign_change_is_refused_or_undone(
    tmp_path: Path, policy: str, outcome: str, change: Callable[[Bus], None], text: str
) -> None:
    with simulated_hand(policy, folder=tmp_path) as hand:
        change(hand.master)
        assert text in told(hand, outcome)
        assert hand.kinds(2) == ["changed", outcome]  # not each write, whether the other's or the hand's
        hand.line.run(0.3)
        rows = hand.hand.rows(5.0)
        assert hand.is_shown(1)
        assert hand.is_shown(2) == (policy == "restore")
        row = next(rows)
        assert row["finger 2"].reason == (OF_ROW[4] if policy == "refuse" else "")
        assert np.isnan(row["finger 2"].P_newtons) == (policy == "refuse")
        assert not row["finger 1"].reason
        assert not hand.wrongs


@pytest.mark.parametrize("change", [replaced, remap, offset])
def test_frames_that_wait_while_the_hand_restores_are_not_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Bus], None]
) -> None:
    """On a busy machine the answers before the restoration are processed after it."""
    with simulated_hand("restore", folder=tmp_path) as hand:
        receive, waiting = hand.hand._link.receive, deque[tuple[float, FrameArray]]()

        def late(timeout_s: float) -> FrameArray:
            waiting.append((time.monotonic(), receive(timeout_s)))
            return waiting.popleft()[1] if waiting[0][0] < time.monotonic() - 0.4 else np.zeros(0, dtype=FRAME)

        monkeypatch.setattr(hand.hand._link, "receive", late)
        change(hand.master)
        told(hand, "restored")
        hand.line.run(1.5)
        assert hand.is_shown(2)
        assert not hand.wrongs


def test_a_change_while_the_hand_restores_is_undone_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with simulated_hand("restore", folder=tmp_path) as hand:
        others = [remap]

        def and_again(*words: Any) -> None:
            write_back(*words)
            while others:
                others.pop()(hand.master)

        monkeypatch.setattr("tipforce.host.hand.meaning.write_back", and_again)
        offset(hand.master)
        assert "tpdo2.mapping:1" in told(hand, "restored")
        hand.line.run(0.3)
        assert hand.is_shown(2)
        assert not hand.wrongs


def test_a_foreign_tare_is_accepted_and_another_mapping_is_not() -> None:
    with simulated_hand("accept") as hand:
        tare(hand.master)
        assert "tare.F" in told(hand, "accepted")
        hand.line.run(0.3)
        assert hand.is_shown(2)
        remap(hand.master)
        assert "tpdo2.mapping:1" in told(hand, "refused")
        assert not hand.is_shown(2)


def test_what_is_undone_by_the_other_is_shown_again() -> None:
    with simulated_hand() as hand:
        tare(hand.master)
        told(hand, "refused")
        hand.master.finger(2).clear_tare()
        assert "as before" in told(hand, "accepted")
        hand.line.run(0.3)
        assert hand.is_shown(2)
        assert not hand.wrongs


def test_the_hands_own_tare_is_no_foreign_change() -> None:
    with simulated_hand() as hand:
        assert hand.hand.tare(2).startswith("tare: F1 ")
        hand.line.run(0.3)
        assert hand.is_shown(2)
        assert hand.kinds(2) == []
        with pytest.raises(InputError, match="the hand has finger 1"):
            hand.hand.tare("ring")


def test_an_accepted_calibration_gives_the_uncertainties(tmp_path: Path) -> None:
    """Not the one of the hand file, which the finger no longer has; also of rows that are open."""
    with simulated_hand("accept", folder=tmp_path) as hand:
        rows = hand.hand.rows(5.0)
        hand.line.run(0.1)
        u_newtons = next(rows)["finger 2"].u_P_newtons
        replaced(hand.master)
        told(hand, "accepted")
        hand.line.run(0.3)
        for later in (hand.hand.rows(5.0), rows):
            hand.line.run(0.1)
            number = hand.hand.statistics().tally.rows - 1
            last = next(row for row in later if row.number == number)
            assert last["finger 2"].u_P_newtons == pytest.approx(2.0 * u_newtons, rel=1e-3)


def test_the_hands_own_tare_does_not_accept_a_foreign_change() -> None:
    with simulated_hand() as hand:
        offset(hand.master)
        told(hand, "refused")
        hand.hand.tare(2)
        hand.line.run(1.0)
        assert hand.kinds(2).count("refused") >= 2
        assert hand.is_shown(1)
        assert not hand.is_shown(2)


def test_a_change_between_bring_up_and_start_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare, done = Recovery.prepare, list[int]()

    def changed_before(self: Recovery, node_id: int) -> None:
        if node_id == 2 and not done:
            done.append(node_id)
            replaced(self._connection())
        prepare(self, node_id)

    monkeypatch.setattr(Recovery, "prepare", changed_before)
    with simulated_hand(folder=tmp_path) as hand:
        hand.line.run(1.0)
        assert hand.is_shown(2)
        assert not hand.wrongs


@pytest.mark.parametrize("command", ["preop", "stop"])
def test_a_finger_that_another_stops_is_started_again(command: str) -> None:
    with simulated_hand() as hand:
        hand.master.nmt(command, 2)
        assert told(hand, "started") in ("was pre-operational", "was stopped")
        hand.line.run(0.5)
        assert hand.hand.state(2) == "operational"
        assert hand.hand.settled()
        assert hand.is_shown(2)
        assert "changed" not in hand.kinds(2)


def test_1019h_is_restored_and_set_again_after_a_reboot() -> None:
    with simulated_hand() as hand:
        overflow = hand.master.sdo(2)
        assert overflow.read(od.SYNC_COUNTER_OVERFLOW) == 240
        hand.master.nmt("reset-node", 2)
        told(hand, "boot_up")
        hand.line.run(2.0)
        assert hand.is_shown(2)
        assert overflow.read(od.SYNC_COUNTER_OVERFLOW) == 240
        hand.hand.stop()
        assert overflow.read(od.SYNC_COUNTER_OVERFLOW) == 0
        assert hand.line.devices[1].nmt.state != OPERATIONAL


def test_without_numbers_the_rows_say_so(tmp_path: Path) -> None:
    with simulated_hand(numbered=False, folder=tmp_path) as hand:
        assert hand.master.sdo(2).read(od.SYNC_COUNTER_OVERFLOW) == 0
        rows = hand.hand.rows(5.0)
        hand.line.run(0.1)
        assert next(rows).pairing == "assumed"


@pytest.mark.parametrize("forgets", [False, True])
def test_a_finger_that_loses_power_is_set_up_again(tmp_path: Path, forgets: bool) -> None:
    """Also one that comes back without its node-id and its calibration; it never shows what it sent last."""
    with simulated_hand(folder=tmp_path) as hand:
        hand.line.switch_off(2)
        hand.line.run(1.0)
        assert (hand.kinds(2), hand.hand.state(2)) == (["heartbeat_lost"], "silent")
        assert hand.is_shown(1)
        assert all(rows.reason[:, 1].all() and np.isnan(rows.columns["P"][:, 1]).all() for rows in hand.rows)
        if forgets:
            hand.line.stores[2].groups.clear()
        hand.line.switch_on(2, 255 if forgets else 2)
        hand.line.run(5.0)
        steps = ["boot_up", *(["assigned"] if forgets else []), "calibrated", "started"]
        assert [kind for kind in hand.kinds(2) if kind in (*steps, "failed", "refused")] == steps
        assert hand.is_shown(1)
        assert hand.is_shown(2)
        assert hand.hand.settled()
        assert not hand.wrongs


def test_a_front_end_fault_is_an_event_and_no_number() -> None:
    with simulated_hand() as hand:
        hand.line.sources[2].fault = 4  # silent converter
        told(hand, "emcy")
        hand.rows.clear()
        hand.line.run(0.1)
        assert all(np.isnan(rows.columns["P"][:, 1]).all() for rows in hand.rows)
        hand.line.sources[2].fault = 0
        told(hand, "emcy_reset")
        hand.line.run(0.1)
        assert not np.isnan(hand.rows[-1].columns["P"]).any()


def test_a_stopped_hand_sends_nothing_more() -> None:
    with simulated_hand() as hand:
        hand.line.look = lambda: None  # its thread has ended
        hand.hand.stop()
        hand.line.run(0.01)
        sent: list[int] = []
        hand.line.ears.append(lambda can_id, _data: sent.append(can_id))
        hand.line.run(0.3)
        assert {can_id for can_id in sent if can_id < 0x700} == set()
