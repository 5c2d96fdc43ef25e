"""The runs of bench/live.py, short: that nothing is lost, in what order it comes, that each way really receives."""

import pytest
from bench import live

from tipforce.host.live import receive

pytestmark = pytest.mark.skipif(not receive.AVAILABLE, reason="needs the sockets of Linux")


@pytest.mark.parametrize("busy", [False, True])
def test_nothing_is_lost_at_a_steady_rate(busy: bool) -> None:
    load = live.run_load(5000, 1.0, busy=busy)
    assert (len(load.number), load.dropped, load.sent) == (5000, 0, 5000)
    assert load.in_order
    assert (load.lag_ms >= 0.0).all()
    assert 1 <= load.batches <= 5000
    assert load.row("alone")[:5] == ["5,000 Hz, alone", "5000", "5000", "0", "yes"]


def test_the_way_by_hand_receives_all() -> None:
    load = live.run_struct(1000, 0.5)
    assert (len(load.number), load.in_order) == (500, True)


def test_every_way_takes_every_frame() -> None:
    """Each raises if a frame is missing, or a PDO does not reach canopen's callback."""
    figures = live.costs(1)
    assert len(figures) == len(live.cost_rows(figures)) == 8
    assert all(len(us) == 1 and us[0] > 0 for us in figures.values())


def test_both_loggers_record() -> None:
    shares = live.log_shares(1000, 1.0)
    assert set(shares) == {"tipforce log", "python-can's logger"}
    assert all(frames > 300 and share > 0 for share, frames in shares.values())
