"""A hand that runs in its own threads, its parts with threads, its benches; in simulated time: test_changes.py."""

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from bench.hand import HEADER, measure
from bench.soak import Soak

from host.bus_with_nodes import ROUNDING_STRAIN2, apply_load, beam_calibration, finger, new_channel, running
from tipforce.errors import EnvironmentLackError, InputError
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.frames.frame_array import FrameArray, frame_array
from tipforce.host.hand import hand as hand_module
from tipforce.host.hand import link as link_module
from tipforce.host.hand import recovery as module
from tipforce.host.hand.events import Event
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand
from tipforce.host.hand.link import Jitter, Link, ThreadSync
from tipforce.host.hand.recovery import RecoveryQueue
from tipforce.samples.sync_numbers import LARGEST
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix
from tipforce.watching.feeds import HandFeed, hand_fingers
from tools.rig import Clock, until

WAIT_S = 60.0


@pytest.fixture
def hand(tmp_path: Path) -> Iterator[Hand]:
    """Fingers 1 and 2, which a hand brought up and reads."""
    channel = new_channel()
    write_calibration(tmp_path / "cal.toml", beam_calibration())
    file = HandFile(
        finger=tuple(FingerPlan(node_id=n, serial=n, calibration="cal.toml") for n in (1, 2)),
        hand=HandPlan(sync_hz=100.0, heartbeat_ms=50, foreign_changes="accept"),
        bus={"interface": "virtual", "channel": channel},
        folder=str(tmp_path),
    )
    with running([finger(n, serial=n) for n in (1, 2)], channel), Hand(file) as hand:
        for n in (1, 2):
            apply_load(hand.connection, n, 1.0 + n, 0.0, 0.0)
        assert [str(report) for report in hand.bring_up()] == ["finger 1: up", "finger 2: up"]
        hand.start()
        yield hand


def test_every_sync_gives_a_row_with_every_finger(hand: Hand) -> None:
    whole, number = 0, None
    for rows in hand.blocks(WAIT_S):
        assert number in (None, rows.first)
        number = rows.first + len(rows)
        known = rows.columns["P"][~rows.missing.any(axis=1) & ~rows.columns["stale"].any(axis=1)]
        assert known == pytest.approx(np.tile([2.0, 3.0], (len(known), 1)), abs=5e-3)
        whole = 0 if rows.missing.any() else whole + len(rows)
        if whole >= 30:  # a busy machine may lose some at the start
            break
    statistics = hand.statistics()
    assert statistics.tally.rows >= whole
    assert statistics.tally.mixed.tolist() == [0, 0]
    assert (statistics.dropped, statistics.overrun) == (0, 0)
    assert statistics.sync.periods >= whole - 1
    until(hand.settled)
    with pytest.raises(InputError, match="already started"):
        hand.start()
    iterator = hand.blocks()
    hand.stop()
    assert sum(1 for _ in iterator) < 1000
    with pytest.raises(InputError, match="was stopped"):
        hand.start()
    with pytest.raises(InputError, match="node_id = 1 is a duplicate"):
        Hand.open([1, 1])


def test_an_accepted_calibration_gives_the_uncertainties_of_a_feed(hand: Hand) -> None:
    feed = HandFeed(hand, hand_fingers(hand))

    def exceeds(u_newtons: float) -> bool:
        return any(np.nanmax(block.u[:, 0, 0], initial=0) > u_newtons for block in feed.take(0.1)[0])

    u_newtons = float(np.sqrt(ROUNDING_STRAIN2) * np.linalg.norm(calibration_matrix(FABRICATED, "I")))  # the most
    until(lambda: exceeds(0.0))
    assert not exceeds(u_newtons)
    doubled = beam_calibration(C=20.0 * calibration_matrix(FABRICATED, "I"))
    hand.connection.finger(1).apply_calibration(doubled, store=False)
    until(lambda: exceeds(u_newtons))


def test_a_dead_receiver_is_an_event(hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    feed, events = HandFeed(hand, hand_fingers(hand)), list[Event]()
    hand.on_event(events.append)
    monkeypatch.setattr("threading.excepthook", lambda _args: None)

    def broken(_timeout_s: float) -> None:
        raise ZeroDivisionError("receiver")

    monkeypatch.setattr(hand._link, "receive", broken)
    until(lambda: any(event.kind == "failed" for event in events))
    assert not hand.settled()
    assert hand.state(1) == "unknown: reception has ended"
    assert "ended: ZeroDivisionError" in next(event.text for event in events if event.kind == "failed")
    assert feed.take(0.0)[1][-1].kind == "failed"  # all that came before the error, and then that
    with pytest.raises(ZeroDivisionError, match="receiver"):
        feed.take(0.0)


def test_a_bus_that_opens_again_while_the_hand_stops_is_left_without_a_sync(
    hand: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, ended, reopen = threading.Event(), threading.Event(), link_module.open_link

    def start_sync(_period_s: float, _data: object) -> Callable[[], None]:
        begun.set()
        assert hand._stopped.wait(WAIT_S)
        return ended.set

    def reopened(options: Mapping[str, object]) -> Link:
        link = reopen(options)
        monkeypatch.setattr(link, "start_sync", start_sync)
        return link

    monkeypatch.setattr(hand_module, "open_link", reopened)
    monkeypatch.setattr(hand._link, "receive", Mock(side_effect=EnvironmentLackError("unplugged")))
    assert begun.wait(WAIT_S)
    hand.stop()
    assert ended.is_set()


def test_a_sync_that_comes_before_a_late_end_of_the_wait_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, looks = Clock(), iter([[], [(0, 0x80, b"\x01")]])

    def receive(timeout_s: float) -> FrameArray:
        clock.sleep(timeout_s + 1.0)
        return frame_array(next(looks))

    monkeypatch.setattr(link_module, "time", SimpleNamespace(monotonic=clock))
    file = HandFile(finger=(FingerPlan(node_id=1),), hand=HandPlan(sync_hz=0.0))
    assert link_module.wanted_overflow(Mock(receive=receive), file, None) == LARGEST


# --- the recovery queue ---------------------------------------------------------------------------------------------


def wait_until_idle(queue: RecoveryQueue) -> None:
    """Tick as the hand's thread does."""
    deadline_s = time.monotonic() + WAIT_S
    while queue.waiting():
        assert time.monotonic() < deadline_s
        queue.tick()
        time.sleep(0.001)
    queue.close()


def test_it_tries_until_it_succeeds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RETRY_S", 0.005)
    tries: list[int] = []

    def recover(node_id: int) -> bool:
        tries.append(node_id)
        return tries.count(node_id) == 3

    queue = RecoveryQueue(recover)
    queue.need([5, 6])
    wait_until_idle(queue)
    assert sorted(tries) == [5, 5, 5, 6, 6, 6]


def test_a_need_during_a_recovery_is_met_afterwards() -> None:
    begun, go_on, running = threading.Semaphore(0), threading.Event(), threading.Lock()

    def recover(_node_id: int) -> bool:
        assert running.acquire(blocking=False)
        begun.release()
        go_on.wait(WAIT_S)
        running.release()
        return True

    queue = RecoveryQueue(recover)
    queue.need([5])
    assert begun.acquire(timeout=WAIT_S)
    queue.need([5])
    go_on.set()
    wait_until_idle(queue)
    assert begun.acquire(timeout=WAIT_S)


def test_a_finger_that_is_lost_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RETRY_S", 1000.0)
    queue = RecoveryQueue(lambda _node_id: False)
    queue.need([5])
    until(lambda: not queue._busy)
    assert queue.waiting()
    queue.drop(5)
    assert not queue.waiting()
    queue.close()


# --- the times of SYNCs ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nominal_ns", [1_000_000, 0])
def test_percentiles_are_those_of_the_deviations(nominal_ns: int) -> None:
    generator = np.random.default_rng(5)
    times = np.cumsum(1_000_000 + generator.normal(0, 20_000, 5000).astype(np.int64))
    jitter = Jitter(nominal_ns)
    for block in np.array_split(times, 37):
        jitter.add(block.tolist())
    jitter.add([])
    periods = np.diff(times)
    deviations = np.abs(periods - (nominal_ns or np.median(periods[:136]))) / 1e3
    found = jitter.figures()
    assert found.periods == len(periods)
    assert found.mean_period_us == pytest.approx(periods.mean() / 1e3)
    assert found.largest_us == pytest.approx(deviations.max(), abs=1.0)
    assert found.p50_us == pytest.approx(np.percentile(deviations, 50), abs=2.0)
    assert found.p99_us == pytest.approx(np.percentile(deviations, 99), abs=3.0)


def test_an_interruption_is_no_jitter_and_a_gap_is() -> None:
    jitter = Jitter(1000)
    jitter.add([0, 1000])
    jitter.skip()
    jitter.add([900_000_000])
    jitter.add([900_001_000, 980_001_000])
    found = jitter.figures()
    assert (found.periods, found.largest_us) == (3, 79_999.0)
    assert np.isnan(Jitter().figures().p50_us)


def test_the_thread_sends_as_many_as_it_should() -> None:
    sent = threading.Semaphore(0)
    sync = ThreadSync(lambda _data: sent.release(), 0.002)
    assert all(sent.acquire(timeout=10) for _ in range(20))
    sync.stop()
    while sent.acquire(blocking=False):
        pass
    assert not sent.acquire(timeout=0.02)
    ThreadSync(lambda _data: None, 3600.0).stop()


def test_a_bus_that_refuses_ends_it_and_a_slow_one_loses_syncs() -> None:
    calls: list[float] = []

    def slow(_data: bytes) -> None:
        calls.append(time.monotonic())
        time.sleep(0.05)
        if len(calls) == 4:
            raise EnvironmentLackError("no bus")

    sync = ThreadSync(slow, 0.005)
    sync._thread.join(60)
    sync.stop()
    assert len(calls) == 4
    assert np.diff(calls).min() >= 0.05  # two close together leave no time for the first


# --- short parts of the benches; how many rows come late on a busy machine is not asserted ----------------------------


def test_rows_over_loopback_sockets() -> None:
    found = measure(3, 50.0, 1.5)
    tally = found.statistics.tally
    assert tally.rows > 10
    assert tally.mixed.sum() == 0
    assert found.statistics.dropped == 0
    assert tally.missing.sum() < tally.rows * 3
    assert found.statistics.sync.periods >= tally.rows - 2
    assert 0.0 < found.latency_ms[0] <= found.latency_ms[1] <= found.latency_ms[2]
    assert len(found.row) == len(HEADER)


def test_trouble_breaks_nothing() -> None:
    outcome = Soak(3, seed=7).run(15.0)
    assert outcome.breaks == []
    assert outcome.checked > 2000
    assert outcome.counts["boot_up"] > 0
    assert outcome.counts["frames: delay"] > 0
