"""Short parts of `bench.hand` and `bench.soak`. How many rows come late on a busy machine is not asserted."""

from __future__ import annotations

from bench.hand import HEADER, measure, row
from bench.soak import Soak


def test_rows_over_loopback_sockets() -> None:
    found = measure(3, 50.0, 1.5)
    tally = found.statistics.tally
    assert tally.rows > 10
    assert tally.mixed.sum() == 0
    assert found.statistics.dropped == 0
    assert tally.missing.sum() < tally.rows * 3
    assert found.statistics.sync.periods >= tally.rows - 2
    assert 0.0 < found.latency_us[0] <= found.latency_us[1] <= found.latency_us[2]
    assert found.fingers_cpu > 0.0
    assert len(row(found)) == len(HEADER)


def test_trouble_breaks_nothing() -> None:
    outcome = Soak(3, seed=7).run(15.0)
    assert outcome.breaks == []
    assert outcome.checked > 2000
    assert outcome.counts["boot_up"] > 0
    assert outcome.counts["frames: delay"] > 0
