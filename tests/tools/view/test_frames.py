"""What a browser gets: however slowly it takes it, no extreme and no event is lost; the playhead keeps its pace."""

from __future__ import annotations

import numpy as np
import pytest

from tipforce.errors import InputError
from tipforce_tools.view.messages import MAX_BINS, Cursor, Playhead
from tipforce_tools.view.model import Model
from tools.view.support import MS, START_NS, block, fingers


class Clock:
    """Seconds, set by the test."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def live_model(clock: Clock, rows: int = 100, live: bool = True) -> Model:
    model = Model(fingers(2), 3, live=live, clock=clock)
    model.add(block(10 * np.arange(rows), np.ones((rows, 2))))
    return model


@pytest.mark.parametrize("pause", [1, 7, 60])
def test_a_slow_browser_gets_every_extreme(pause: int) -> None:
    clock = Clock()
    model = live_model(clock)
    cursor = Cursor(model, Playhead(model, clock=clock), 20 * MS)
    generator = np.random.default_rng(3)
    highest, bins, sent = 0.0, dict[int, float](), []
    for step in range(120):
        P = generator.uniform(1, 9, (1, 2))
        highest = max(highest, float(P[0, 1]))
        model.add(block([1000 + 10 * step], P))
        model.add_event(START_NS, 1, "emcy", str(step))
        if step % pause == 0 or step == 119:
            message = cursor.message()
            assert message.bins is not None
            bins |= {i: row[13] for i, row in zip(message.bins["i"], message.bins["v"], strict=True)}
            sent += [event.text for event in message.events or ()]
            assert len(message.bins["i"]) <= MAX_BINS
    assert max(bins.values()) == pytest.approx(highest, abs=1e-4)
    assert sorted(bins) == list(range(min(bins), max(bins) + 1))
    assert sent == [str(step) for step in range(120)]


def test_a_browser_that_was_away_for_long_gets_a_bounded_message() -> None:
    clock = Clock()
    model = live_model(clock)
    cursor = Cursor(model, Playhead(model, clock=clock), MS)
    model.add(block(1000 + np.arange(20_000), np.ones((20_000, 2))))
    message = cursor.message()
    assert message.bins is not None
    assert len(message.bins["i"]) <= MAX_BINS
    assert message.bins["i"][-1] == (START_NS + 20_999 * MS) // MS


def test_the_present_moves_with_the_clock_when_no_row_comes() -> None:
    clock = Clock()
    model = live_model(clock)
    playhead = Playhead(model, clock=clock)
    assert playhead.now_ns() == (START_NS + 990 * MS, False)
    clock.now_s += 3.0
    assert playhead.now_ns() == (START_NS + 3990 * MS, False)
    assert [state.word for state in model.picture(playhead.now_ns()[0]).states] == ["silent", "silent"]


def test_rows_that_were_put_in_late_are_as_old_as_they_are() -> None:
    clock = Clock()
    model = live_model(clock)
    clock.now_s += 5.0
    model.add(block([1000], np.ones((1, 2))), clock.now_s - 1.0)
    assert [state.word for state in model.picture().states] == ["stale", "stale"]


def test_a_log_plays_at_its_speed_to_its_end() -> None:
    clock = Clock()
    model = live_model(clock, live=False)
    playhead = Playhead(model, START_NS, 0.5, clock)
    clock.now_s += 1.0
    assert playhead.now_ns() == (START_NS + 500 * MS, False)
    clock.now_s += 9.0
    assert playhead.now_ns() == (START_NS + 990 * MS, True)


def test_a_replay_of_the_past_catches_up_with_the_present() -> None:
    clock = Clock()
    model = live_model(clock)
    playhead = Playhead(model, START_NS - 10_000 * MS, 4.0, clock)
    assert playhead.now_ns()[0] == START_NS  # not before the first row
    clock.now_s += 60.0
    present = model.now_ns()
    assert playhead.now_ns() == (present, False)


@pytest.mark.parametrize("speed", [0.0, -1.0, 1e9, float("nan")])
def test_a_speed_has_limits(speed: float) -> None:
    with pytest.raises(InputError):
        Playhead(live_model(Clock()), START_NS, speed)
