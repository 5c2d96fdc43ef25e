"""Samples out of frames: the same rows however a log is cut into blocks, files or parts, and whoever decodes them."""

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.host.decoding.counters import Tally
from tipforce.host.decoding.decoder import lost_samples
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.decoding.sample_merger import SampleMerger
from tipforce.host.decoding.sample_table import Table
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.samples.reasons import Status
from tools.decode.logs import decode, log_lines, rows_of, write_log

Row = tuple[object, ...]
BASES = {"gauges": 0x180, "contact": 0x280, "health": 0x480}


def frames_of(made: list[tuple[str, int, int, int]]) -> FrameArray:
    """Frames of (PDO, node, counter, milliseconds since the one before)."""
    frames = np.zeros(len(made), dtype=FRAME)
    t_ns = 0
    for row, (name, node, counter, step_ms) in zip(frames, made, strict=True):
        t_ns += step_ms * 1_000_000
        row["t_ns"], row["can_id"], row["length"] = t_ns, BASES[name] + node, 8
        row["data"][:2] = [len(made) & 0xFF, t_ns // 1_000_000 & 0x7F]
        row["data"][6 if name == "health" else 7] = counter
    return frames


def tables_of(frames: FrameArray, cuts: Iterable[int] = ()) -> tuple[list[Table], Tally]:
    """The samples of frames that come in blocks, and their counts."""
    merger = SampleMerger(Layouts().decoder, ["can0"], None)
    edges = [0, *sorted(min(cut, len(frames)) for cut in cuts), len(frames)]
    tables = [table for start, end in pairwise(edges) for table in merger.tables(frames[start:end])]
    return [*tables, *merger.finish()], merger.tally


def rows(frames: FrameArray, cuts: Iterable[int] = ()) -> list[Row]:
    """All rows in a form that compares."""
    found: list[Row] = []
    for table in tables_of(frames, cuts)[0]:
        columns = [(c.name, table.values[c.name].tolist()) for c in sorted(table.columns, key=lambda c: c.name)]
        for k in range(len(table)):
            cells = [(name, repr(v[k])) for name, v in columns]
            values = tuple(cell for cell in cells if cell[1] not in {"nan", "-1", str(-(1 << 63))})
            found.append((int(table.t_ns[k]), int(table.key[k]), int(table.counter[k]), values))
    return found


KINDS = st.sampled_from(["gauges", "contact", "contact", "gauges", "health"])
STREAMS = st.lists(
    st.tuples(
        KINDS, st.sampled_from([1, 2]), st.sampled_from([254, 255, 0, 1]), st.sampled_from([0, 0, 0, 1, 150, 250])
    ),
    max_size=30,
)


@given(STREAMS, st.lists(st.integers(0, 30), max_size=5))
@settings(max_examples=120, deadline=None)
def test_blocks_do_not_matter_and_each_frame_is_in_one_row(
    made: list[tuple[str, int, int, int]], cuts: list[int]
) -> None:
    frames = frames_of(made)
    assert rows(frames, cuts) == rows(frames)
    tables, tally = tables_of(frames)
    assert tables_of(frames, cuts)[1] == tally
    columns = [
        table.values.get(name, np.zeros(0)) for table in tables for name in ("SG1_ue", "P_N", "temperature_degC")
    ]
    values = sum(np.count_nonzero(~np.isnan(column)) for column in columns)
    assert values == sum(count.frames for count in tally.messages.values()) == len(made)


@pytest.mark.parametrize(
    ("made", "count"),
    [
        ([(name, 1, k, 0 if name == "contact" else 1) for k in range(5) for name in ("gauges", "contact")], 5),
        ([("gauges", 1, 7, 0), ("contact", 1, 7, 201)], 2),
        ([(name, 1, 9, 0) for _ in range(4) for name in ("gauges", "contact")], 4),  # a repeated counter
    ],
)
def test_a_sample_is_one_row(made: list[tuple[str, int, int, int]], count: int) -> None:
    assert len(rows(frames_of(made))) == count


@pytest.mark.parametrize("cut", [1, 2, 3])
def test_samples_before_the_first_number_of_a_sync_count_modulo_256_in_any_blocks(cut: int) -> None:
    frames = frames_of([("gauges", 1, 250, 1), ("gauges", 1, 254, 1), ("gauges", 1, 1, 1), ("gauges", 1, 1, 0)])
    frames["can_id"][2], frames["length"][2], frames["data"][2, 0] = 0x080, 1, 1
    tally = tables_of(frames, [cut])[1]
    assert tally == tables_of(frames)[1]
    assert tally.messages["can0", 1, "Gauges"][1:] == (3, 250, 1, 256, 240)


def test_health_has_no_sample_counter_and_is_a_row_of_its_own() -> None:
    made = [("gauges", 1, 3, 1), ("contact", 1, 3, 0), ("health", 1, 3, 1), ("health", 1, 3, 1), ("gauges", 1, 4, 1)]
    found = rows(frames_of(made))
    assert [row[2] for row in found] == [3, -1, -1, 4]
    names = [repr(row[3]) for row in found]
    assert ["('P_N'" in name for name in names] == [True, False, False, False]
    assert ["temperature_degC" in name for name in names] == [False, True, True, False]


@pytest.mark.parametrize("names", [("gauges", "contact"), ("contact", "gauges")])
def test_of_a_sample_the_first_pdo_that_has_a_value_counts(names: tuple[str, str]) -> None:
    """Both PDOs carry the status: that of the gauges counts, which a node sends first; late ones are another sample."""
    frames = frames_of([(name, 1, 3, 0) for name in names])
    frames["data"][frames["can_id"] == BASES["gauges"] + 1, 6] = Status.STALE
    frames["data"][frames["can_id"] == BASES["contact"] + 1, 6] = Status.FAULT
    tables, _ = tables_of(frames)
    stale, fault = (np.concatenate([table.values[name] for table in tables]).tolist() for name in ("stale", "fault"))
    assert (stale, fault) == (([1], [0]) if names[0] == "gauges" else ([0, 1], [1, 0]))


@given(st.lists(st.integers(0, 255), max_size=40), st.lists(st.integers(0, 40), max_size=4))
@settings(max_examples=100, deadline=None)
def test_lost_samples_over_borders(counters: list[int], cuts: list[int]) -> None:
    frames = frames_of([("contact", 1, counter, 1) for counter in counters])
    assert sum(tables_of(frames, cuts)[1].lost().values()) == lost_samples(counters)


@pytest.mark.parametrize("jobs", [1, 3])
def test_many_files_equal_one(tmp_path: Path, jobs: int) -> None:
    lines = log_lines(1500, (1, 5), health=70)
    write_log(tmp_path / "whole.log", lines)
    for number, start in enumerate(range(0, len(lines), 1777)):
        write_log(tmp_path / f"part-{number}.log", lines[start : start + 1777])
    write_log(tmp_path / "part-10.log", [])  # behind part-9 and not behind part-1
    assert decode(tmp_path / "whole.log", "-o", tmp_path / "whole.csv") == 0
    assert decode(tmp_path / "part-*.log", "-o", tmp_path / "parts.csv", "--jobs", jobs) == 0
    assert (tmp_path / "parts.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()


def test_nodes_of_two_buses_stay_apart(tmp_path: Path) -> None:
    first, second = log_lines(50, (5,), bus="can0"), log_lines(50, (5,), seed=2, bus="can1")
    both = sorted(first + second, key=lambda line: line.split()[0])
    log = write_log(tmp_path / "both.log", both)
    assert decode(log, "-o", tmp_path / "both.csv") == 0
    for name, lines in (("can0", first), ("can1", second)):
        assert decode(write_log(tmp_path / f"{name}.log", lines), "-o", tmp_path / f"{name}.csv") == 0
        alone = rows_of(tmp_path / f"{name}.csv")
        mixed = [dict(row) for row in rows_of(tmp_path / "both.csv") if row.pop("channel") == name]
        assert mixed == alone
        assert decode(log, "--bus", name, "-o", tmp_path / "chosen.csv") == 0
        chosen = [dict(row) for row in rows_of(tmp_path / "chosen.csv")]
        for row in chosen:
            row.pop("channel", None)
        assert chosen == alone
