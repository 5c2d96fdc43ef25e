"""What is shown at a moment. Nothing stale is ever live."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tipforce.samples.reasons import NO_ANSWER, Status
from tipforce.sensor.contact.scalar import CALIBRATED, CONTACT_PRESENT, FRONT_END_FAULT, MISSES_TIP, SATURATED, STALE
from tipforce_tools.view.history import History
from tipforce_tools.view.model import FingerState, finger_states
from tools.view.support import MS, START_NS, block, with_status

NAN = float("nan")


def filled(count: int = 50, period_ms: int = 10, fingers: int = 2) -> History:
    history = History(fingers, 3, 1000)
    P = np.arange(count)[:, np.newaxis] + np.zeros(fingers)
    history.append(block(period_ms * np.arange(count), P))
    return history


def at(history: History, t_ms: float, fingers: int = 2) -> list[FingerState]:
    return finger_states(history, START_NS + round(t_ms * MS), fingers)


def test_the_newest_sample_is_live() -> None:
    state = at(filled(), 490)[0]
    assert (state.word, state.contact[0]) == ("live", 49.0)
    assert at(filled(), 255)[0].contact[0] == 25.0  # any moment of the past


@pytest.mark.parametrize(("t_ms", "word"), [(589, "live"), (591, "stale"), (2480, "stale"), (2500, "silent")])
def test_a_stream_that_stops_is_stale_then_silent(t_ms: float, word: str) -> None:
    state = at(filled(), t_ms)[1]
    assert state.word == word
    if word == "stale":
        assert state.since_ms == (START_NS + 490 * MS) / 1e6
    assert bool(state.contact) == (word != "silent")


def test_a_slow_sync_has_a_longer_limit() -> None:
    history = filled(10, 400)
    assert at(history, 3600 + 999)[0].word == "live"
    assert at(history, 3600 + 1001)[0].word == "stale"


@given(st.lists(st.booleans(), min_size=40, max_size=120))
def test_a_finger_that_misses_rows_is_live_for_two_and_a_half_periods(answers: list[bool]) -> None:
    history = filled(40, 10)
    rows = block(400 + 10 * np.arange(len(answers)), np.ones((len(answers), 2)))
    for row, answered in enumerate(answers):
        if not answered:
            with_status(rows, row, 0, NO_ANSWER)
    history.append(rows)
    for row in range(len(answers)):
        back = next((k for k in range(row + 1) if answers[row - k]), row + 1)
        first, second = at(history, 400 + 10 * row)
        assert (first.word == "live") == (back <= 2)
        assert second.word == "live"


def test_never_heard_is_no_answer() -> None:
    history = History(2, 3, 100)
    assert [state.word for state in at(history, 0)] == ["silent", "silent"]
    rows = block(10 * np.arange(30), np.ones((30, 2)))
    rows.status[:, 1] = NO_ANSWER
    history.append(rows)
    first, second = at(history, 290)
    assert (first.word, second.word, second.since_ms) == ("live", "silent", 0)


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        (CALIBRATED | FRONT_END_FAULT, "front-end fault"), (CALIBRATED | SATURATED, "gauge saturated"),
        (0, "not calibrated"), (CALIBRATED | FRONT_END_FAULT | Status.CONTRADICTION, "gauges contradict each other"),
        (CALIBRATED | SATURATED | Status.OVERLOAD, "overload"), (CALIBRATED | STALE, "no new sample"),
    ],
)  # fmt: skip
def test_unknown_says_why(status: int, reason: str) -> None:
    history = History(1, 3, 100)
    history.append(block(10 * np.arange(30), np.full((30, 1), NAN), status))
    (state,) = at(history, 290, 1)
    assert (state.word, state.reason) == ("unknown", reason)


def test_a_repeated_sample_does_not_hide_the_one_before_while_it_is_young() -> None:
    history = filled(30, 10, 1)
    rows = block([300, 310, 320, 330], np.full((4, 1), NAN), CALIBRATED | STALE)
    history.append(rows)
    assert at(history, 300, 1)[0].contact[0] == 29.0
    assert at(history, 310, 1)[0].contact[0] == 29.0
    assert at(history, 330, 1)[0].word == "unknown"


@pytest.mark.parametrize(
    ("status", "reason"),
    [(CALIBRATED, "no contact"), (CALIBRATED | CONTACT_PRESENT | MISSES_TIP, "line of action misses the tip")],
)
def test_an_angle_that_is_unknown_says_why(status: int, reason: str) -> None:
    history = History(1, 3, 100)
    rows = block(10 * np.arange(30), np.ones((30, 1)), status)
    rows.contact[..., 2] = np.nan
    history.append(rows)
    (state,) = at(history, 290, 1)
    assert (state.word, state.angle_reason) == ("live", reason)


def test_what_is_to_be_known_of_a_force_is_in_its_flags() -> None:
    history = History(1, 3, 100)
    status = CALIBRATED | CONTACT_PRESENT | SATURATED | Status.BEYOND_CALIBRATED | Status.TEMPERATURE
    history.append(block(10 * np.arange(30), np.ones((30, 1)), status))
    (state,) = at(history, 290, 1)
    assert (state.word, state.reason) == ("live", "")
    assert state.flags == (
        "a gauge is left out", "beyond the calibrated force", "temperature outside the calibration or unknown",
    )  # fmt: skip
