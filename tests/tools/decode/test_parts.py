"""A recording in parts, decoded by workers in any order, some of which die: the rows are those of one pass."""

import os
import random
import struct
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.host.dataset.reader import tables_of_logs
from tipforce.host.decoding import recording as recordings
from tipforce.host.decoding.log_part import Piece, Reading
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.decoding.recording import DecodedPart, Passed, Recording, State
from tipforce.host.decoding.sample_table import NODE_BITS, Table, is_missing
from tipforce_tools.decode.workers import Event, InOrder, Work
from tipforce_tools.writing.text_rows import TIME
from tipforce_tools.writing.writers import Shape
from tools.decode.logs import decode, log_lines, write_log
from tools.rig import Printed

READING = Reading(Layouts(4, (1, 2)))
KINDS = ["gauges", "contact"] * 2 + ["health", "emcy", "heartbeat", "boot", "sync", "read", "serial", "bad"]
EMCY_CODES = (0x5000, 0xFF10, 0x0000, 0x4200)
COUNTER_STEPS, MS = st.sampled_from([0, 0, 0, 1, 1, 2, 254]), st.sampled_from([0, 1, 1, 20, 100, 210, 700])
STEPS = st.tuples(st.sampled_from(KINDS), st.integers(0, 2), COUNTER_STEPS, MS)  # the second: node and bus


@pytest.fixture(autouse=True)
def short_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the head of a part end after few frames."""
    monkeypatch.setattr(recordings, "_STEP_FRAMES", 10)


def lines_of(steps: list[tuple[str, int, int, int]], modulus: int) -> list[str]:
    """Lines of candump -L. ``modulus`` of the SYNC numbers; 0: none, or from the middle of the log on."""
    t_us, counters, numbers, lines = 1_700_000_000_000_000, [7, 7, 250], {"can0": 0, "can1": 0}, list[str]()
    for place, (kind, which, step, ms) in enumerate(steps):
        t_us += 1000 * ms + 1
        node, bus = (1, 2, 1)[which], ("can0", "can0", "can1")[which]
        counters[which] = (counters[which] + step) % 256
        count, value = numbers[bus] or counters[which], place % 3000  # a SYNC with a number is what its answers count
        frame = {
            "gauges": f"{0x180 + node:03X}#{struct.pack('<hhhBB', value, -value, 5, 3, count).hex()}",
            "contact": f"{0x280 + node:03X}#{struct.pack('<hhhBB', value, 100, -32768, 3, count).hex()}",
            "health": f"{0x480 + node:03X}#{struct.pack('<hhhBB', value, 20, 0x1001 * (place % 2), count, 0).hex()}",
            "emcy": f"{0x080 + node:03X}#{struct.pack('<HBHHB', EMCY_CODES[place % 4], 1, 1 + place % 3, 0, 0).hex()}",
            "heartbeat": f"{0x700 + node:03X}#{(5, 127)[place % 2]:02X}",
            "boot": f"{0x700 + node:03X}#00",
            "sync": "080#",
            "read": f"{0x600 + node:03X}#4018100400000000",
            "serial": f"{0x580 + node:03X}#43181004{1 + place % 2:02X}000000",
            "bad": "28Z#",
        }[kind]
        if kind == "sync" and modulus and (modulus > 3 or place > len(steps) // 2):
            numbers[bus] = numbers[bus] % modulus + 1
            frame += f"{numbers[bus]:02X}"
        lines.append(f"({t_us // 1_000_000}.{t_us % 1_000_000:06d}) {bus} {frame}")
    return lines


class Rows:
    def write(self, number: int, tables: Iterable[Table], shape: Shape) -> list[str]:
        del number
        return [
            text for table in tables if shape.take(table.columns, table.channels) is not None for text in texts(table)
        ]


def texts(table: Table) -> list[str]:
    """Each row by its values, without those that are missing."""
    found = [
        f"{table.channels[key >> NODE_BITS]} {key & 127} {t_ns} {counter}"
        for t_ns, key, counter in zip(table.t_ns.tolist(), table.key.tolist(), table.counter.tolist(), strict=True)
    ]
    for column in sorted(table.columns, key=lambda column: column.name):
        values = table.values[column.name]
        for row, (missing, value) in enumerate(zip(is_missing(column, values), values.tolist(), strict=True)):
            found[row] += "" if missing else f" {column.name}={value}"
    return found


class Shuffled:
    """Workers of this process whose events come in any order; some of them die once, and their work is repeated."""

    def __init__(self, slots: int, order: random.Random, sink: Rows) -> None:
        self._slots, self._order, self._sink = slots, order, sink
        self._works: dict[int, Work] = {}
        self._events: list[Event] = []
        self._pieces: dict[int, Piece] = {}
        self.apart = 0

    @property
    def free(self) -> int:
        return self._slots - len(self._works)

    def decode(self, number: int, piece: Piece) -> None:
        self._pieces[number] = piece
        self._works[number] = Work(number, piece, READING)

    def write(self, number: int, before: State, shape: Shape, last: bool) -> None:
        passed = self._works[number].follow(before, last)
        assert isinstance(passed, Passed)
        part = self._works[number]._part
        self.apart += isinstance(part, DecodedPart) and any(map(len, part.kept))
        if self._order.random() < 0.3:  # the worker dies
            self._works[number] = Work(number, self._pieces[number], READING)
        written = self._works.pop(number).write(self._sink, passed, before, shape, last)
        self._events += [(number, passed), (number, written)]

    def next(self) -> Event:
        return self._events.pop(self._order.randrange(len(self._events)))

    def close(self) -> None: ...


def in_parts(log: Path, cuts: list[int], slots: int, order: random.Random) -> tuple[list[str], Recording, int]:
    """The rows, the recording, and how many parts were decoded before the ones in front were known."""
    text = log.read_bytes()
    starts = [0, *(k + 1 for k, byte in enumerate(text) if byte == 10 and k + 1 < len(text))]
    edges = sorted({0, *(starts[cut % len(starts)] for cut in cuts), len(text)})
    pieces = [Piece(str(log), start, end) for start, end in pairwise(edges)]
    recording, workers = Recording(READING), Shuffled(slots, order, Rows())
    parts = [*InOrder(pieces, recording, Shape((TIME,)), workers)]
    assert [part.piece for part in parts] == pieces
    return [row for part in parts for row in part.written.record], recording, workers.apart


def one_pass(log: Path) -> tuple[list[str], Recording]:
    recording = Recording(READING)
    return [row for table in tables_of_logs(recording, [str(log)]) for row in texts(table)], recording


@given(
    st.lists(STEPS, min_size=20, max_size=160), st.sampled_from([0, 0, 3, 20, 240]),
    st.lists(st.integers(0, 159), max_size=5), st.integers(1, 4), st.randoms(use_true_random=False),
)  # fmt: skip
@settings(max_examples=25, deadline=None)
def test_the_rows_are_those_of_one_pass(
    tmp_path_factory: pytest.TempPathFactory, steps: list[Any], modulus: int, cuts: list[int], slots: int,
    order: random.Random,
) -> None:  # fmt: skip
    log = write_log(tmp_path_factory.getbasetemp() / f"any-{os.getpid()}.log", lines_of(steps, modulus))
    expected, whole = one_pass(log)
    found, joined, _ = in_parts(log, cuts, slots, order)
    assert sorted(found) == sorted(expected)
    assert joined.tally == whole.tally
    assert joined.bus.found == whole.bus.found
    assert joined.unseen == whole.unseen
    assert [(note.bad, note.first_bad, note.frames) for note in joined.notes] == [
        (note.bad, note.first_bad, note.frames) for note in whole.notes
    ]


@pytest.mark.parametrize("in_memory_bytes", [recordings._IN_MEMORY_BYTES, 1])
def test_parts_are_decoded_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_memory_bytes: int) -> None:
    """The test above would prove nothing if each part waited for the ones in front."""
    monkeypatch.setattr(recordings, "_IN_MEMORY_BYTES", in_memory_bytes)
    order = random.Random(3)
    steps = [(order.choice(KINDS), order.randrange(3), order.choice([0, 0, 1, 1, 2]), 30) for _ in range(1200)]
    for modulus in (0, 4):
        log = write_log(tmp_path / "run.log", lines_of(steps, modulus))
        expected, _ = one_pass(log)
        found, _, apart = in_parts(log, [200, 400, 600, 800, 1000], 3, order)
        assert apart >= (4 if modulus else 6)
        assert sorted(found) == sorted(expected)


def test_a_log_that_grows_while_a_part_is_decoded_again_is_read_once_more(tmp_path: Path) -> None:
    lines = log_lines(30, (1, 2))  # shorter than a head
    log = write_log(tmp_path / "run.log", lines[:60])
    part, before = DecodedPart(Piece(str(log)), READING), Recording(READING).state()
    expected, _ = one_pass(write_log(log, lines[:90]))
    passed = part.follow(before, last=True)
    write_log(log, lines)
    assert part._rows is not None
    assert passed.notes.frames == 90
    assert [row for table in part.rows(before, last=True) for row in texts(table)] == expected


def test_rows_that_were_taken_are_decoded_again(tmp_path: Path) -> None:
    log = write_log(tmp_path / "run.log", log_lines(3000, (1, 2)))
    part, before = DecodedPart(Piece(str(log)), READING), Recording(READING).state()
    assert part.behind_head is not None
    first, again = ([row for table in part.rows(before, last=True) for row in texts(table)] for _ in range(2))
    assert first == again == one_pass(log)[0]


def test_a_worker_that_is_killed_is_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    from tipforce_tools.decode import session
    from tipforce_tools.writing import writers

    monkeypatch.setattr(session, "_LEAST_PIECE_BYTES", 100_000)
    monkeypatch.setattr(session, "_PIECE_BYTES", 100_000)
    monkeypatch.setattr(session, "_SMALL_BYTES", 0)
    log = write_log(tmp_path / "run.log", log_lines(3000, (1, 5)))
    assert decode(log, "-j", 1, "-o", tmp_path / "one.csv") == 0
    write = writers.JoinedFile.write

    def dies(self: writers.JoinedFile, number: int, *rest: Any) -> Any:
        marker = tmp_path / "died"
        if number == 2 and (always or not marker.exists()):
            marker.touch()
            os._exit(9)
        return write(self, number, *rest)

    monkeypatch.setattr(writers.JoinedFile, "write", dies)
    always = False
    assert decode(log, "-j", 2, "-o", tmp_path / "two.csv") == 0
    assert (tmp_path / "died").exists()
    assert (tmp_path / "two.csv").read_bytes() == (tmp_path / "one.csv").read_bytes()
    always = True
    before = sorted(path.name for path in tmp_path.iterdir())
    assert "3 times" in printed(2, f"decode {log} -j 2 -o {tmp_path}/two.csv").err
    assert sorted(path.name for path in tmp_path.iterdir()) == before
