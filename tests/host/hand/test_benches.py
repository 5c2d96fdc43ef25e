"""Short parts of `bench.hand` and `bench.soak`. How many rows come late on a busy machine is not asserted."""

from __future__ import annotations

import pytest
from bench.hand import HEADER, JITTER_HEADER, jitter_row, measure, row
from bench.soak import Soak, stored_fingers

from tipforce.host.hand.rows import Collector
from tipforce.host.network.faulty_bus import Faults


@pytest.mark.parametrize("sync", ["process", "thread"])
def test_rows_over_loopback_sockets(sync: str) -> None:
    found = measure(3, 50.0, 1.5, sync)
    tally = found.statistics.tally
    assert tally.rows > 10
    assert tally.mixed.sum() == 0
    assert found.statistics.dropped == 0
    assert tally.missing.sum() < tally.rows * 3
    assert found.statistics.sync.periods >= tally.rows - 2
    assert 0.0 < found.latency_us[0] <= found.latency_us[1] <= found.latency_us[2]
    assert found.fingers_cpu > 0.0
    assert len(row(found)) == len(HEADER)
    assert len(jitter_row(found)) == len(JITTER_HEADER)


def test_a_minute_of_trouble_breaks_nothing() -> None:
    outcome = Soak(stored_fingers(3, 7), seed=7).run(40.0)
    assert outcome.breaks == []
    assert outcome.checked > 5000
    assert outcome.counts["boot_up"] > 0
    assert outcome.counts["frames: delay"] > 0


def test_without_faults_nothing_is_missing() -> None:
    soak = Soak(stored_fingers(2, 8), seed=8, faults=Faults())
    for tick in range(300):
        soak._tick(tick * 0.01)
        soak._trouble_s = 0.0
    assert soak.outcome.breaks == []


def test_a_value_in_another_row_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    faults = Faults(drop=0.05, delay=0.2, delay_s=0.025)
    fingers = stored_fingers(3, 7)
    assert Soak(fingers, seed=7, faults=faults).run(20.0).breaks == []
    monkeypatch.setattr(Collector, "_row_of", lambda self, _counter, _number: self._last)
    assert Soak(stored_fingers(3, 7), seed=7, faults=faults).run(20.0).breaks
