"""Rows: which SYNC each answer belongs to, by its number, and without numbers; against what was sent."""

import os
import random
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from host.hand import row_model
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.hand.rows import Collector
from tipforce.host.hand.trust import COUNTER
from tipforce.samples.reasons import CHANGED, DOUBTFUL, NO_RESPONSE, PRESENT
from tipforce.samples.record import Rows
from tipforce.samples.sync_numbers import LARGEST, RESTARTED, SyncNumbers

SYNC = (0x80, b"")
PERIOD_NS = 1_000_000


def sync(number: int) -> tuple[int, bytes]:
    return 0x80, bytes((number,))


def answer(
    node_id: int, counter: int, P_mN: int = 1000, message: str = "Contact", stale: bool = False
) -> tuple[int, bytes]:
    """A contact or gauge PDO of a calibrated finger in contact."""
    base = {"Contact": 0x280, "Gauges": 0x180}[message]
    return base + node_id, struct.pack("<hhhBB", P_mN, 4500, 3000, 11 if stale else 3, counter % 256)


def health(node_id: int, changes: int) -> tuple[int, bytes]:
    """TPDO4 with the configuration counter."""
    return 0x480 + node_id, struct.pack("<hHHBB", 2300, 1, 0, changes, 0)


class Stream:
    """Gives frames to a collector, with a SYNC every millisecond, and keeps the rows that come out."""

    def __init__(
        self, *node_ids: int, messages: tuple[str, ...] = ("Contact",), wait_s: float = 0.02, own: bool = False
    ) -> None:
        self.collector = Collector(node_ids, messages, wait_s=wait_s, own_sync=own)
        self.rows: list[tuple[int, list[float]]] = []
        self.reasons: list[list[int]] = []
        self.numbered: list[bool] = []
        self.now_s = 0.0
        self.periods = 0

    def add(self, *frames: tuple[int, bytes]) -> list[list[float]]:
        timed = []
        for can_id, data in frames:
            self.periods += can_id == 0x80
            timed.append((PERIOD_NS * self.periods, can_id, data))
        rows: Rows = self.collector.add(frame_array(timed), self.now_s)
        column = rows.columns.get("P", rows.columns.get("SG1"))
        assert column is not None
        assert column.shape == rows.missing.shape == (len(rows), len(self.collector.node_ids))
        assert (np.isnan(column) >= rows.missing).all()
        self.rows += [(rows.first + k, column[k].tolist()) for k in range(len(rows))]
        self.reasons += rows.reason.tolist()
        self.numbered += rows.numbered.tolist()
        return [[round(value, 3) for value in row] for row in column.tolist()]

    def feed(self, frames: list[tuple[int, bytes]], sizes: list[int]) -> None:
        """Add frames in parts of these sizes, and what is left at once."""
        place = 0
        for size in [*sizes, len(frames)]:
            self.add(*frames[place : place + size])
            place += size


def test_a_row_is_out_as_soon_as_it_is_whole() -> None:
    stream = Stream(1, 2)
    assert stream.add(answer(1, 7)) == []  # before any SYNC
    assert stream.add(sync(239), answer(2, 239, 200)) == []
    assert stream.add(answer(1, 239, 100)) == [[0.1, 0.2]]
    assert stream.add() == []
    assert stream.add(sync(240), answer(1, 240, 110), answer(2, 240, 210), sync(1), answer(1, 1, 120)) == [[0.11, 0.21]]
    assert stream.add(answer(2, 1, 220)) == [[0.12, 0.22]]
    assert [number for number, _ in stream.rows] == [0, 1, 2]
    assert stream.numbered == [True] * 3
    tally = stream.collector.tally
    assert (tally.rows, tally.missing.tolist(), tally.late.tolist()) == (3, [0, 0], [0, 0])


def unnumbered(*counters: int | None, P_mN: int = 1000) -> list[tuple[int, bytes]]:
    return [frame for c in counters for frame in ([SYNC] if c is None else [SYNC, answer(1, c, P_mN)])]


CASES: dict[str, tuple[list[tuple[int, bytes]], list[list[int]], dict[str, list[int]]]] = {
    "a late answer is in its own row": (
        [sync(1), answer(1, 1), sync(2), answer(1, 2), answer(2, 1), answer(2, 2)],
        [[PRESENT, PRESENT], [PRESENT, PRESENT]], {"delayed": [0, 1], "late": [0, 0]},
    ),
    "a lost answer is not waited for": (
        [sync(1), answer(1, 1), sync(2), answer(1, 2), answer(2, 2)],
        [[PRESENT, NO_RESPONSE], [PRESENT, PRESENT]], {"missing": [0, 1]},
    ),
    "two values of one number are both doubtful": (
        [sync(1), answer(1, 1), answer(1, 1), answer(1, 1, 101), answer(2, 1)], [[DOUBTFUL, PRESENT]], {"late": [0, 0]},
    ),
    "a duplicate is not": (
        [sync(2), answer(1, 2), answer(1, 2), answer(2, 2), answer(2, 2)], [[PRESENT, PRESENT]], {"late": [0, 0]},
    ),
    "an answer before its SYNC is not its answer": (
        [sync(1), answer(1, 1), answer(1, 2, 20), sync(2)], [[PRESENT], [DOUBTFUL]], {},
    ),
    "one conversion for two SYNCs is repeated": (
        [sync(1), answer(1, 1), sync(2), answer(1, 2, -0x8000, stale=True)], [[PRESENT], [PRESENT]], {"repeated": [1]},
    ),
    "without numbers a late duplicate is not the next answer": (
        unnumbered(1, 2, 2), [[PRESENT], [PRESENT], [DOUBTFUL]], {},
    ),
    "without numbers a missing answer is no counter 0, and of three equal ones two are duplicates": (
        [*unnumbered(254, 255, None, 0, 1, 1, 1), SYNC],
        [[PRESENT], [PRESENT], [NO_RESPONSE], [PRESENT], [PRESENT], [DOUBTFUL], [DOUBTFUL]], {},
    ),
    "without numbers an answer after the next SYNC is missing, and doubtful in the row of that": (
        [SYNC, answer(1, 1), answer(2, 1), SYNC, answer(1, 2), SYNC, answer(2, 2), answer(1, 3), answer(2, 3), SYNC],
        [[PRESENT, PRESENT], [PRESENT, NO_RESPONSE], [PRESENT, DOUBTFUL]], {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("cut", [1, 20])
@pytest.mark.parametrize("case", CASES)
def test_what_is_in_a_row(case: str, cut: int) -> None:
    frames, reasons, tally = CASES[case]
    stream = Stream(*range(1, len(reasons[0]) + 1))
    stream.feed(frames, [cut] * len(frames))
    assert stream.reasons[: len(reasons)] == reasons
    assert set(stream.numbered) == {not case.startswith("without")}
    assert {name: getattr(stream.collector.tally, name).tolist() for name in tally} == tally


def test_a_finger_that_does_not_answer_is_missing_in_time() -> None:
    stream = Stream(1, 2, wait_s=0.01)
    stream.add(sync(1), answer(1, 1, 100))
    stream.now_s = 0.009
    assert stream.add() == []
    stream.now_s = 0.010
    (row,) = stream.add()
    assert row[0] == 0.1
    assert stream.reasons == [[PRESENT, NO_RESPONSE]]
    # It comes after all: too late for its row, and not taken for the next.
    assert stream.add(answer(2, 1, 200)) == []
    assert stream.add(sync(2), answer(1, 2, 110), answer(2, 2, 210)) == [[0.11, 0.21]]
    assert stream.collector.tally.late.tolist() == [0, 1]


def test_no_row_waits_for_a_finger_that_is_not_operational() -> None:
    stream = Stream(1, 2)
    stream.collector.expect(2, False)
    (row,) = stream.add(sync(1), answer(1, 1))
    assert np.isnan(row[1])
    stream.collector.expect(2, True)
    assert stream.add(sync(2), answer(1, 2)) == []


def test_a_babbler_whose_number_comes_is_not_shown() -> None:
    """It speaks before the finger in each row, with a number that is that of the SYNC at some time."""
    stream = Stream(1)
    shown = []
    for number in [*range(200, 241), *range(1, 60)]:
        shown += stream.add(sync(number), answer(1, 42, 9000))
        shown += stream.add(answer(1, number))
    assert len(shown) == 100
    assert sum(row == [1.0] for row in shown) == 99
    assert stream.reasons[82] == [DOUBTFUL]


def test_a_sync_that_was_not_received_has_its_row_too() -> None:
    stream = Stream(1, own=True)
    stream.add(sync(1), answer(1, 1, 10))
    stream.add(answer(1, 2, 20))
    stream.periods += 2
    assert stream.add(sync(4), answer(1, 3, 30), answer(1, 4, 40)) == [[0.02], [0.03], [0.04]]
    assert stream.collector.tally.unreceived == 2
    assert stream.collector.tally.doubtful.tolist() == [0]


def test_random_sequences_of_faults() -> None:
    """`make long` runs 10,000."""
    assert row_model.failures(int(os.environ.get("TIPFORCE_SEQUENCES", "12"))) == []


@pytest.mark.parametrize("seed", [461, 578, 586, 1699, 1721])
def test_a_count_that_restarts_among_lost_syncs(seed: int) -> None:
    """Sequences of another producer, in which the number alone does not tell a restart from lost SYNCs."""
    assert row_model.failures(1, first_seed=seed) == []


def test_a_value_that_may_be_that_of_a_restarted_count_waits_for_the_next_sync() -> None:
    stream = Stream(1)
    stream.add(sync(238), answer(1, 238), sync(239), answer(1, 239), sync(240), answer(1, 240))
    stream.add(sync(1))
    stream.periods += 1  # SYNC 2, or 1 of a restarted count, is not received
    assert stream.add(answer(1, 1, 10)) == []
    assert stream.add(answer(1, 2, 20), sync(3), answer(1, 3, 30)) == [[0.01], [0.02], [0.03]]
    stream.periods += 1
    assert stream.add(sync(2), answer(1, 2, 40)) == []  # 1 and 2 of a new count: 2 may also be a late one from before
    assert stream.collector.tally.doubtful.tolist() == [1]


def test_the_model_sees_a_value_in_another_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Collector, "_row_of", lambda self, _counter, _number: self._last)
    assert row_model.failures(2)


@pytest.mark.parametrize(
    ("own", "steps"),
    [
        (False, [(7, 0, RESTARTED), (8, 1, 1), (9, 1, 1), (12, 3, 3), (13, 1, 1), (1, 1, RESTARTED), (2, 1, 1)]),
        (False, [(239, 0, RESTARTED), (240, 1, 1), (1, 1, 1), (2, 1, 1), (0, 1, RESTARTED), (0, 1, 1)]),
        (False, [(9, 0, RESTARTED), (10, 1, 1), (150, 1, RESTARTED)]),
        (True, [(9, 0, RESTARTED), (10, 1, 1), (1, 1, 231), (150, 1, 149)]),
        (False, [(9, 0, RESTARTED), (10, 1, 1), (30, 2, RESTARTED)]),  # 19 SYNCs do not fit in that time
        (False, [(0, 0, 1), (0, 1, 1), (241, 1, 1)]),
    ],
)
def test_distances_between_numbers(own: bool, steps: list[tuple[int, int, int]]) -> None:
    numbers, t_ns = SyncNumbers(own), 0
    for number, periods, distance in steps:
        t_ns += periods * PERIOD_NS
        assert numbers.step(number, t_ns) == distance


def test_the_count_of_a_foreign_producer_is_learnt() -> None:
    stream = Stream(1)
    for k in range(400):
        number = k % 10 + 1
        stream.add(sync(number), answer(1, number, number))
    # At the first end of its count these could be late answers to the numbers before.
    shown = [row[0] for _, row in stream.rows]
    assert len(shown) == 400
    assert shown[:10] + shown[-150:] == [(k % 10 + 1) / 1000 for k in [*range(10), *range(250, 400)]]
    assert stream.collector.tally.unreceived == 0


def test_pdos_of_two_samples_are_mixed_and_not_shown() -> None:
    stream = Stream(1, messages=("Contact", "Gauges"))
    stream.add(SYNC, answer(1, 1), answer(1, 1, message="Gauges"), SYNC, answer(1, 2), answer(1, 3, message="Gauges"))
    assert stream.collector.tally.mixed.tolist() == [1]
    assert np.isnan(stream.rows[1][1][0])


# --- changes of what values mean


READ = bytes.fromhex("4f262100")  # an SDO response: 2126h:00, one byte


def test_values_after_a_change_are_not_shown_until_it_is_verified() -> None:
    stream = Stream(1, 2)
    trust = stream.collector.trust
    trust.learn(1, {COUNTER: 3})
    stream.add(health(1, 3), sync(1), answer(1, 1), answer(2, 1))
    stream.add(sync(2), answer(1, 2), health(1, 4), sync(3), answer(1, 3), answer(2, 2), answer(2, 3))
    assert stream.reasons == [[PRESENT, PRESENT], [PRESENT, PRESENT], [CHANGED, PRESENT]]
    assert trust.take_changes() == [1]
    stream.add(health(1, 4), sync(4), answer(1, 4), answer(2, 4))
    assert not trust.take_changes()
    trust.learn(1, {COUNTER: 4})
    stream.add(health(1, 4), sync(5), answer(1, 5), answer(2, 5))
    assert stream.reasons[3:] == [[CHANGED, PRESENT], [PRESENT, PRESENT]]
    assert stream.collector.tally.changed.tolist() == [2, 0]


def test_a_change_during_a_verification_is_not_overlooked() -> None:
    stream = Stream(1)
    trust = stream.collector.trust
    trust.learn(1, {COUNTER: 255})
    stream.add(health(1, 0), sync(1), answer(1, 1))
    trust.learn(1, {COUNTER: 255})  # what was read before that change
    assert trust.unsure(1) == [COUNTER]
    stream.add(health(1, 0), sync(2), answer(1, 2))
    assert trust.take_changes() == [1]
    assert stream.reasons == [[CHANGED], [CHANGED]]


def test_answers_before_the_verification_are_not_shown_when_they_are_processed_after_it() -> None:
    stream = Stream(1)
    stream.collector.trust.learn(1, {COUNTER: 3})
    stream.add(health(1, 3), sync(1), answer(1, 1), health(1, 4), sync(2), answer(1, 2))
    stream.collector.trust.learn(1, {COUNTER: 6})
    stream.add(sync(3), answer(1, 3), health(1, 5), sync(4), answer(1, 4))
    stream.add((0x581, READ + bytes((6, 0, 0, 0))), sync(5), answer(1, 5))
    assert stream.reasons == [[PRESENT], [CHANGED], [CHANGED], [CHANGED], [PRESENT]]


OFFSET = (0x6124, 2)
DOWNLOAD, DONE, VALUE = "23246102 0000a040", "60246102 00000000", "43246102 0000a040"
OTHER = "43246102 0000b040"
KNOWN = {OFFSET: 0x40A00000, COUNTER: 3}


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        ([], PRESENT),
        ([(0x601, "40246102 00000000"), (0x581, VALUE)], PRESENT),  # a read
        ([(0x602, DOWNLOAD)], PRESENT),  # to another node
        ([(0x601, DOWNLOAD)], CHANGED),
        ([(0x601, DOWNLOAD), (0x581, VALUE), (0x581, READ.hex() + "03000000")], CHANGED),  # responses to before
        ([(0x601, DOWNLOAD), (0x581, DONE), (0x581, READ.hex() + "03000000")], CHANGED),  # the counter alone
        ([(0x601, DOWNLOAD), (0x581, DONE), (0x581, VALUE), (0x581, READ.hex() + "03000000")], PRESENT),
        ([(0x601, DOWNLOAD), (0x581, DONE), (0x581, OTHER), (0x581, READ.hex() + "03000000")], CHANGED),
        ([(0x601, "c2246102 04000000"), (0x581, "a4246102 7f000000"), (0x601, "81000000a0400000")], CHANGED),
        ([(0x701, "00")], CHANGED),  # it booted
        ([(0x000, "0101")], CHANGED),
        ([(0x000, "0102")], PRESENT),
        ([(0x7E5, "1105000000000000")], CHANGED),
        ([(0x7E5, "4c00000000000000")], PRESENT),  # LSS: who has no node-id?
        ([(0x201, "0100")], CHANGED),
        ([(0x201, "0000")], PRESENT),  # command 0
        ([(0x601, "2301220200000000")], PRESENT),  # the load on a simulated finger
    ],
)
def test_requests_by_anybody_make_values_unsure(frames: list[tuple[int, str]], reason: int) -> None:
    stream = Stream(1)
    stream.collector.trust.learn(1, KNOWN)
    stream.add((0x581, bytes.fromhex(VALUE)), (0x581, READ + bytes((3, 0, 0, 0))))
    stream.add(*[(can_id, bytes.fromhex(data)) for can_id, data in frames])
    stream.add(sync(1), answer(1, 1))
    assert stream.reasons == [[reason]]


def test_a_finger_that_may_send_anothers_pdo_hides_the_other() -> None:
    known = {(0x1801, 1): 0x40000281, COUNTER: 3}
    stream = Stream(1, 2, 3)
    for node_id in (1, 2, 3):
        stream.collector.trust.learn(node_id, known if node_id == 1 else {})
    stream.add((0x581, bytes.fromhex("4301180181020040")), (0x581, READ + bytes((3, 0, 0, 0))))
    stream.add((0x601, bytes.fromhex("2301180182020040")), sync(1), answer(1, 1), answer(2, 1), answer(3, 1))
    assert stream.reasons == [[CHANGED, CHANGED, PRESENT]]


def faulty_frames(seed: int, numbered: bool) -> list[tuple[int, bytes]]:
    """SYNCs and answers of two fingers with lost, doubled, late, stale and foreign ones; the counters wrap."""
    pick = random.Random(seed)
    number, sample = pick.randint(1, 240), pick.randint(0, 255)
    frames: list[tuple[int, bytes]] = []
    for _ in range(pick.randint(1, 25)):
        number = (number + (pick.randint(0, 3) if pick.random() < 0.1 else 0)) % 240 + 1
        sample += 1
        counter = number if numbered else sample
        if pick.random() > 0.15:
            frames.append(sync(number) if numbered else SYNC)
        for node_id in (1, 2):
            if pick.random() < 0.2:
                continue
            frames.append(answer(node_id, counter, 10 * sample + node_id, stale=pick.random() < 0.05))
            if pick.random() < 0.1:
                frames.append(pick.choice((frames[-1], answer(node_id, counter, 9))))
        if frames and pick.random() < 0.1:
            frames.append(pick.choice(frames[-8:]))
    return frames


@pytest.mark.parametrize("numbered", [True, False])
@given(st.integers(0, 1 << 32), st.lists(st.integers(1, 9), max_size=60), st.booleans())
def test_faults_have_the_same_rows_however_the_stream_is_cut(
    numbered: bool, seed: int, cuts: list[int], absent: bool
) -> None:
    frames = faulty_frames(seed, numbered)
    results = []
    for sizes in ([], [1] * len(frames), cuts):
        stream = Stream(1, 2, messages=("Contact",), wait_s=1e6)
        stream.collector.expect(2, not absent)
        stream.feed(frames, sizes)
        stream.now_s = 2e6
        stream.add()
        tally = stream.collector.tally
        counts = [count.tolist() for count in (tally.missing, tally.doubtful, tally.late, tally.repeated)]
        results.append((repr(stream.rows), stream.reasons, stream.numbered, counts))
    assert results[0] == results[1] == results[2]


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_syncs_with_random_numbers_make_no_flood_of_rows(own: bool, seed: int) -> None:
    """Rows of SYNCs that were not received are at most as many as SYNCs were, and one count; the tally has them all."""
    pick, syncs = random.Random(seed), 3000
    collector = Collector((1, 2), wait_s=1e-3, own_sync=own)
    t_ns = rows = 0
    for _ in range(syncs):
        t_ns += pick.choice((1, 1, 20, 60, 110)) * PERIOD_NS
        rows += len(collector.add(frame_array([(t_ns, 0x80, bytes((pick.randint(1, 255),)))]), 1e-9 * t_ns))
    assert syncs - 1 <= rows <= 2 * syncs + LARGEST
    assert not own or collector.tally.unreceived > 10 * rows
    number = 0
    for number in range(1, 400):  # an orderly count follows: shown after half of the numbers
        t_ns += PERIOD_NS
        frames = [(t_ns, 0x80, bytes((number % 240 + 1,)))]
        frames += [(t_ns, 0x280 + k, answer(k, number % 240 + 1)[1]) for k in (1, 2)]
        found = collector.add(frame_array(frames), 1e-9 * t_ns)
    assert len(found) == 1
    assert not found.missing.any()


def test_columns_are_there_although_nobody_answers() -> None:
    stream = Stream(1, 2)
    (row, _) = stream.add(SYNC, SYNC, SYNC)
    assert np.isnan(row).all()
    rows = stream.collector.add(frame_array([]), 1.0)
    assert set(rows.columns) >= {"P", "phi", "theta", "contact", "stale", "fault"}
    assert rows.columns["stale"].dtype == np.bool_
