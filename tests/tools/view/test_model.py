"""The model of a page: newest rows, envelopes, states that are never falsely live; what a slow browser gets."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tipforce.samples.reasons import NO_ANSWER, Status
from tipforce.sensor.contact.scalar import CALIBRATED, CONTACT_PRESENT, FRONT_END_FAULT, MISSES_TIP, SATURATED, STALE
from tipforce_tools.page.connection import MAX_BINS, Cursor
from tipforce_tools.page.model import MAX_BYTES, FingerState, Model, row_bytes
from tools.rig import Clock
from tools.view.support import MS, START_NS, block, fingers, with_status

NAN = float("nan")
GOOD = CALIBRATED | CONTACT_PRESENT


def holding(count: int = 1, capacity: int = 100, gauges: int = 3) -> Model:
    return Model(fingers(count), gauges, capacity=capacity)


@given(st.lists(st.integers(0, 25), max_size=30), st.integers(1, 20))
def test_the_newest_rows_stay(sizes: list[int], capacity: int) -> None:
    model, total = holding(1, capacity), 0
    for size in sizes:
        number = np.arange(total, total + size)
        model.add(block(number, number[:, np.newaxis]))
        total += size
    kept = np.arange(max(0, total - capacity), total)
    assert model.rows.contact[:, 0, 0].tolist() == kept.tolist()
    assert model.rows.t_ns.tolist() == (START_NS + kept * MS).tolist()


@given(st.lists(st.floats(-5, 5, width=32) | st.none(), min_size=1, max_size=80), st.integers(1, 30))
def test_an_envelope_keeps_extremes_and_gaps(values: list[float | None], width_ms: int) -> None:
    P = np.array([[np.nan if value is None else value] for value in values])
    model = holding()
    model.add(block(np.arange(len(P)), P))
    width_ns = width_ms * MS
    first, last = START_NS // width_ns, (START_NS + len(P) * MS) // width_ns
    index, bins = model.envelope(first, last, width_ns)
    numbers = (START_NS + np.arange(len(P)) * MS) // width_ns
    assert index.tolist() == np.unique(numbers).tolist()
    for number, (low, high, unknown) in zip(index, bins[:, 0, [0, 3, 9]], strict=True):
        inside = P[numbers == number, 0]
        assert unknown == np.isnan(inside).sum()
        extremes = (np.fmin.reduce(inside), np.fmax.reduce(inside))
        assert (low, high) == pytest.approx(extremes, nan_ok=True)


def test_a_missing_finger_is_a_gap_of_the_envelope_and_nothing_an_empty_one() -> None:
    model = holding(2)
    assert len(model.envelope(0, 10, MS)[0]) == 0
    model.add(with_status(block([0, 1, 2], np.ones((3, 2))), 1, 1, NO_ANSWER))
    _, bins = model.envelope(START_NS // (10 * MS), START_NS // (10 * MS), 10 * MS)
    assert bins[..., -1].tolist() == [[0, 1]]
    assert len(model.envelope(0, 10, MS)[0]) == 0


@pytest.mark.parametrize("blocks", [([0, 10, 20], [-5000, -4990], [-4980]), ([0, 10, 20, -5000, -4990], [-4980])])
def test_a_clock_that_is_set_back_does_not_disorder_rows(blocks: Sequence[list[int]]) -> None:
    model = holding()
    for t_ms in blocks:
        model.add(block(t_ms, np.ones((len(t_ms), 1))))
    assert ((model.rows.t_ns - START_NS) // MS).tolist() == [0, 10, 20, 20, 30, 40]


def test_more_fingers_find_their_places() -> None:
    first, _, third = fingers(3)
    model = Model([first, third], 3, capacity=10)
    model.add(block([0, 1], [[1.0, 3.0], [1.5, 3.5]]))
    model.set_fingers(fingers(3))
    assert model.rows.contact[:, [0, 2], 0].tolist() == [[1.0, 3.0], [1.5, 3.5]]
    assert (model.rows.status[:, 1] == NO_ANSWER).all()
    assert np.isnan(model.rows.contact[:, 1]).all()


@pytest.mark.parametrize("count", [1, 32])
def test_memory_is_bounded(count: int) -> None:
    assert 2 * holding(count, 0).capacity * row_bytes(count, 3) <= MAX_BYTES


@pytest.mark.parametrize("phi", [(179.0, 181.0), (-90.0, 89.0), (-179.0, -178.0)])
def test_an_envelope_of_angles_goes_the_shorter_way_around(phi: tuple[float, float]) -> None:
    model, rows = holding(), block([0.0, 1.0], [[400.0], [400.0]])
    rows.contact[:, 0, 1] = [degrees - 360.0 * (degrees > 180.0) for degrees in phi]
    model.add(rows)
    assert tuple(model.envelope(START_NS // MS // 10, START_NS // MS // 10, 10 * MS)[1][0, 0, [1, 4]]) == phi


@pytest.mark.parametrize("status", [CALIBRATED | FRONT_END_FAULT, CALIBRATED | STALE, CONTACT_PRESENT])
def test_a_number_that_its_own_status_says_to_be_unknown_is_not_shown(status: int) -> None:
    model = holding()
    model.add(block([0.0], [[1.0]], status))
    (state,) = model.picture(START_NS).states
    assert (state.word, *np.isnan(state.contact)) == ("unknown", True, True, True)


def test_envelopes_of_gauges_and_forces() -> None:
    model = holding(2, 10, gauges=4)
    rows = block([0, 1], [[1.0, 2.0], [3.0, np.nan]], gauges=4)
    rows.gauges[1, 0] = [-250.0, 1.0, 2.0, np.nan]
    model.add(rows)
    first = START_NS // (10 * MS)
    (gauges,) = model.envelope(first, first, 10 * MS, "gauges")[1]
    assert gauges[0, :8].tolist() == [-250.0, 1.0, 2.0, 100.0, 100.0, 100.0, 100.0, 100.0]
    assert np.isnan(gauges[:, 8:-1]).all()
    (forces,) = model.envelope(first, first, 10 * MS, "forces")[1]  # phi -90, theta 90 degrees: F1 = -P, F2 = F3 = 0
    assert forces[:, 0].tolist() == pytest.approx([-3.0, -2.0])
    assert forces[0, 3:6].tolist() == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)
    assert forces[:, -1].tolist() == [0, 1]
    assert model.largest() == (3.0, 250.0)
    assert holding().largest() == (0.0, 0.0)


def filled(count: int = 50, period_ms: int = 10, fingers: int = 2) -> Model:
    model = holding(fingers, 1000)
    P = np.arange(count)[:, np.newaxis] + np.zeros(fingers)
    model.add(block(period_ms * np.arange(count), P))
    return model


def at(model: Model, t_ms: float) -> list[FingerState]:
    return model.picture(START_NS + round(t_ms * MS)).states


@pytest.mark.parametrize(("t_ms", "word"), [(589, "live"), (591, "stale"), (2480, "stale"), (2500, "silent")])
def test_a_stream_that_stops_is_stale_then_silent(t_ms: float, word: str) -> None:
    state = at(filled(), t_ms)[1]
    assert state.word == word
    if word == "stale":
        assert state.since_ms == (START_NS + 490 * MS) / 1e6
    assert bool(state.contact) == (word != "silent")


def test_a_slow_sync_has_a_longer_limit() -> None:
    model = filled(10, 400)
    assert [at(model, t_ms)[0].word for t_ms in (3600 + 999, 3600 + 1001)] == ["live", "stale"]


@given(st.lists(st.booleans(), min_size=40, max_size=120))
def test_a_finger_that_misses_rows_is_live_for_two_and_a_half_periods(answers: list[bool]) -> None:
    model = filled(40, 10)
    rows = block(400 + 10 * np.arange(len(answers)), np.ones((len(answers), 2)))
    for row, answered in enumerate(answers):
        if not answered:
            with_status(rows, row, 0, NO_ANSWER)
    model.add(rows)
    for row in range(len(answers)):
        back = next((k for k in range(row + 1) if answers[row - k]), row + 1)
        first, second = at(model, 400 + 10 * row)
        assert (first.word == "live") == (back <= 2)
        assert second.word == "live"


def test_never_heard_is_no_answer() -> None:
    model = holding(2)
    assert [state.word for state in at(model, 0)] == ["silent", "silent"]
    rows = block(10 * np.arange(30), np.ones((30, 2)))
    rows.status[:, 1] = NO_ANSWER
    model.add(rows)
    first, second = at(model, 290)
    assert (first.word, second.word, second.since_ms) == ("live", "silent", 0)


@pytest.mark.parametrize(
    ("status", "contact", "word", "reason", "angle_reason", "flags"),
    [
        *((CALIBRATED | bits, (NAN, NAN, NAN), "unknown", reason, "", None) for bits, reason in (
            (FRONT_END_FAULT, "front-end fault"), (STALE, "no new sample"),
            (FRONT_END_FAULT | Status.CONTRADICTION, "gauges contradict each other"),
            (SATURATED, "gauge saturated"), (SATURATED | Status.OVERLOAD, "overload"),
        )),
        (0, (NAN, NAN, NAN), "unknown", "not calibrated", "", None),
        (CALIBRATED, (1.0, NAN, NAN), "live", "", "no contact", ()),
        (GOOD | MISSES_TIP, (1.0, 90.0, NAN), "live", "", "line of action misses the tip", None),
        (GOOD | SATURATED | Status.BEYOND_CALIBRATED | Status.TEMPERATURE, (1.0, 90.0, 90.0), "live", "", "", (
            "a gauge is left out", "beyond the calibrated force", "temperature outside the calibration or unknown",
        )),
    ],
)  # fmt: skip
def test_what_is_unknown_or_doubtful_says_why(
    status: int, contact: tuple[float, ...], word: str, reason: str, angle_reason: str, flags: tuple[str, ...] | None
) -> None:
    model = holding()
    rows = block(10 * np.arange(30), np.ones((30, 1)), status)
    rows.contact[:] = contact
    model.add(rows)
    (state,) = at(model, 290)
    assert (state.word, state.reason, state.angle_reason) == (word, reason, angle_reason)
    assert flags is None or state.flags == flags


def test_a_repeated_sample_does_not_hide_the_one_before_while_it_is_young() -> None:
    model = filled(30, 10, 1)
    model.add(block([300, 310, 320, 330], np.full((4, 1), NAN), CALIBRATED | STALE))
    assert [at(model, t_ms)[0].contact[0] for t_ms in (300, 310)] == [29.0, 29.0]
    assert at(model, 330)[0].word == "unknown"


def model_of(live: bool = True) -> tuple[Model, Clock]:
    """100 rows, one every 10 ms."""
    clock = Clock()
    model = Model(fingers(2), 3, live=live, clock=clock)
    model.add(block(10 * np.arange(100), np.ones((100, 2))))
    return model, clock


@pytest.mark.parametrize("pause", [1, 7, 60])
def test_a_slow_browser_gets_every_extreme(pause: int) -> None:
    model, clock = model_of()
    cursor = Cursor(model, 20 * MS, clock=clock)
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
    model, clock = model_of()
    cursor = Cursor(model, MS, clock=clock)
    model.add(block(1000 + np.arange(20_000), np.ones((20_000, 2))))
    message = cursor.message()
    assert message.bins is not None
    assert len(message.bins["i"]) <= MAX_BINS
    assert message.bins["i"][-1] == (START_NS + 20_999 * MS) // MS


def test_the_present_moves_with_the_clock_when_no_row_comes_and_late_rows_are_as_old_as_they_are() -> None:
    model, clock = model_of()
    cursor = Cursor(model, MS, clock=clock)
    assert cursor.now_ns() == (START_NS + 990 * MS, False)
    clock.now_s += 3.0
    assert cursor.now_ns() == (START_NS + 3990 * MS, False)
    assert [state.word for state in model.picture(cursor.now_ns()[0]).states] == ["silent", "silent"]
    clock.now_s += 2.0
    model.add(block([1000], np.ones((1, 2))), clock.now_s - 1.0)
    assert [state.word for state in model.picture().states] == ["stale", "stale"]


def test_a_log_plays_at_its_speed_to_its_end_and_a_replay_catches_up_with_the_present() -> None:
    model, clock = model_of(live=False)
    cursor = Cursor(model, MS, START_NS, 0.5, clock=clock)
    clock.now_s += 1.0
    assert cursor.now_ns() == (START_NS + 500 * MS, False)
    clock.now_s += 9.0
    assert cursor.now_ns() == (START_NS + 990 * MS, True)
    model, clock = model_of()
    cursor = Cursor(model, MS, START_NS - 10_000 * MS, 4.0, clock=clock)
    assert cursor.now_ns()[0] == START_NS  # not before the first row
    clock.now_s += 60.0
    assert cursor.now_ns() == (model.now_ns(), False)
