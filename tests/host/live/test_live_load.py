"""The runs of bench/live.py, short: that nothing is lost, in what order it comes, that each way really receives."""

from __future__ import annotations

import numpy as np
import pytest
from bench import live_costs, live_load
from bench.live_loopback import contact_frames, running_numbers

from tipforce.host.frames.frame_array import frame_array
from tipforce.host.live import recvmmsg

pytestmark = pytest.mark.skipif(not recvmmsg.AVAILABLE, reason="this system has no recvmmsg of 64 bits")


@pytest.mark.parametrize("busy", [False, True])
def test_nothing_is_lost_at_a_steady_rate(busy: bool) -> None:
    load = live_load.run_load(5000, 1.0, busy=busy)
    assert (load.received, load.dropped, load.sent) == (5000, 0, 5000)
    assert load.in_order
    assert load.stamps_rise
    assert 0 <= load.lag_median_ms <= load.lag_p99_ms <= load.lag_max_ms
    assert load.frames_a_batch >= 1


def test_the_way_by_hand_receives_all() -> None:
    load = live_load.run_struct(1000, 0.5)
    assert (load.received, load.in_order, load.stamps_rise) == (500, True, True)


def test_every_way_takes_every_frame() -> None:
    """Each raises if a frame is missing, or a PDO does not reach canopen's callback."""
    found = live_costs.measure(1)
    assert len(found) == 8
    assert all(len(figures) == 1 and figures[0] > 0 for figures in found.values())
    assert len(live_costs.table(found)) == 2 + 8


def test_both_loggers_record() -> None:
    shares = live_load.log_shares(1000, 1.0)
    assert set(shares) == {"tipforce log", "python-can's logger"}
    assert all(frames > 300 and share > 0 for share, frames in shares.values())


def test_the_running_number_is_in_the_frames() -> None:
    raw = [(0, int.from_bytes(frame[:4], "little"), frame[8:]) for frame in contact_frames(300, 1 << 20)]
    frames = frame_array(raw)
    assert running_numbers(frames).tolist() == list(range(1 << 20, (1 << 20) + 300))
    assert np.unique(frames["can_id"]).tolist() == [0x281, 0x282, 0x283, 0x284, 0x285]
