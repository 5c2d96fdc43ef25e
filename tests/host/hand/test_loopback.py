"""A short part of `python -m bench.hand`: a Hand over the sockets of the live path, fingers and SYNC in processes.

For function alone: how many rows come late on a busy machine is not asserted.
"""

from __future__ import annotations

import pytest
from bench.hand import measure, report, report_jitter


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
    assert report(found).count("|") == 19
    assert report_jitter(found).count("|") == 9
