"""`tipforce monitor`: the state machine on a clock of the test's own, what is shown, and the command."""

import io
import itertools
import math
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.host.frames.frame_array import FRAME, FrameArray, frame_array
from tipforce.host.logs.reader import open_log
from tipforce.watching.bus_monitor import BusView, Monitor, NodeView, Window
from tipforce.watching.frame_sources import LogSource, PipeSource
from tipforce_tools.monitor import session
from tools.hand_log import START_S, contact_pdo
from tools.rig import Clock, Printed, message, process, sending

MS = 1_000_000
T0 = START_S * 1_000_000_000
CALIBRATED, CONTACT = 2, 1
NAN = math.nan


def fed(frames: Iterable[tuple[int, int, bytes]], **options: object) -> Monitor:
    """A monitor that has seen (milliseconds, identifier, data)."""
    monitor = Monitor(**options)  # type: ignore[arg-type]
    monitor.feed(frame_array([(T0 + t * MS, can_id, data) for t, can_id, data in frames]), ["can0"])
    return monitor


def bus(monitor: Monitor, t_ms: float = 0) -> BusView:
    (found,) = monitor.views(T0 + round(t_ms * MS))
    return found


def node(monitor: Monitor, t_ms: float = 0) -> NodeView:
    (found,) = bus(monitor, t_ms).nodes
    return found


def contacts(count: int, period_ms: int = 10, status: int = 3) -> list[tuple[int, int, bytes]]:
    return [(k * period_ms, *contact_pdo(5, 1.5, 90.0, -45.0, status, k)) for k in range(count)]


def test_values_rate_and_age() -> None:
    found = node(fed(contacts(101)), 1002)
    assert found.node_id == 5
    assert [found.readings[name].value for name in ("P", "phi", "theta")] == [1.5, 90.0, -45.0]
    assert found.rate_hz == pytest.approx(100.0)
    assert found.periods is not None
    assert (found.periods.p50_ms, found.periods.p99_ms, found.periods.max_ms) == pytest.approx((10.0, 10.0, 10.0))
    assert found.age_s == pytest.approx(0.002)
    assert (found.stale, found.status, found.lost) == (False, ("contact", "calibrated"), 0)

    # One late sample shows in the longest period.
    frames = [(t + (7 if k == 50 else 0), can_id, data) for k, (t, can_id, data) in enumerate(contacts(100))]
    periods = node(fed(frames), 990).periods
    assert periods is not None
    assert (periods.p50_ms, periods.max_ms) == pytest.approx((10.0, 17.0))


@pytest.mark.parametrize(
    ("period_ms", "age_ms", "stale"),
    [(10, 0, False), (10, 499, False), (10, 501, True), (10, 60_000, True), (1000, 2900, False), (1000, 3100, True)],
)
def test_an_old_value_is_never_shown_as_live(period_ms: int, age_ms: int, stale: bool) -> None:
    found = node(fed(contacts(11, period_ms)), 10 * period_ms + age_ms)
    assert found.stale == stale
    cells = session.cells(found)
    assert ("1.500 N" in cells) != stale
    assert any("STALE" in cell for cell in cells) == stale
    for reading in found.readings.values():
        assert (reading.value is None) == stale


def test_the_rate_of_a_node_that_stops_falls() -> None:
    monitor = fed(contacts(301))
    rates = [node(monitor, 3000 + age).rate_hz for age in (0, 20, 500, 1000, 1999, 2001)]
    assert rates[0] == rates[1] == pytest.approx(100.0)
    assert sorted(rates, reverse=True) == rates
    assert rates[-1] == 0.0


@pytest.mark.parametrize(
    ("status", "reasons"),
    [
        (0, ("not calibrated",) * 3),
        (CALIBRATED, ("unknown to the node", "no contact", "no contact")),
        (CALIBRATED | 0x80, ("front-end fault",) * 3),
        (CALIBRATED | 0x08, ("no new sample",) * 3),
        (CALIBRATED | CONTACT | 0x04, ("gauge saturated",) * 3),
        (CALIBRATED | CONTACT | 0x10, ("unknown to the node", "unknown to the node", "theta unresolved")),
        (CALIBRATED | CONTACT | 0x20, ("unknown to the node", "unknown to the node", "line of action misses the tip")),
    ],
)
def test_the_unknown_says_why(status: int, reasons: tuple[str, ...]) -> None:
    found = node(fed([(0, *contact_pdo(5, NAN, NAN, NAN, status))]))
    assert tuple(found.readings[name].reason for name in ("P", "phi", "theta")) == reasons
    assert session.shown(found.readings["theta"]) == f"unknown: {reasons[2]}"


def test_what_the_calibration_says_of_a_sample_comes_from_tpdo4_and_emcy() -> None:
    contradiction = (0, 0x085, struct.pack("<HBHHx", 0x5030, 0x81, 12, 0))
    found = node(fed([contradiction, (1, *contact_pdo(5, NAN, NAN, NAN, CALIBRATED | 0x80))]))
    assert found.readings["P"].reason == "gauges contradict each other"
    assert found.status == ("calibrated", "fault", "contradiction")
    health = (1, 0x485, struct.pack("<hHHBB", 2300, 0xFFFF, 0xA000, 0, 0))
    found = node(fed([contradiction, health, (2, *contact_pdo(5, NAN, NAN, NAN, CALIBRATED | 0x04))]))
    assert found.readings["P"].reason == "overload"
    assert found.status == ("calibrated", "saturated", "beyond_calibrated", "overload")
    assert node(fed([(0, *contact_pdo(5, 32.767, 0.0, 0.0, CALIBRATED))])).status == ("calibrated", "overload")


def test_a_known_value_needs_no_reason() -> None:
    found = node(fed([(0, *contact_pdo(5, 0.01, NAN, NAN, CALIBRATED | 0x10))]))
    shown = [session.shown(found.readings[name]) for name in ("P", "phi", "theta")]
    assert shown == ["0.010 N", "unknown: no contact", "unknown: no contact"]


def test_samples_are_counted_once_whatever_pdos_carry_them() -> None:
    gauges = [(t, 0x185, struct.pack("<hhhBB", 10, 20, 30, 3, k)) for k, (t, _, _) in enumerate(contacts(101))]
    both = [frame for pair in zip(gauges, contacts(101), strict=True) for frame in pair]
    assert [node(fed(frames), 1000).rate_hz for frames in (gauges, both)] == pytest.approx([100.0] * 2)
    assert session.shown(node(fed(gauges), 1000).readings["P"]) == "unknown: not sent"


def test_lost_samples() -> None:
    assert node(fed([frame for k, frame in enumerate(contacts(300)) if k not in {100, 101, 250}]), 3000).lost == 3


def test_heartbeat_and_its_loss() -> None:
    beats = [(t, 0x705, b"\x05") for t in range(0, 3001, 500)]
    assert [node(fed(beats), t).nmt_lost for t in (3000, 4400, 4600)] == [False, False, True]
    assert node(fed(beats), 3000).nmt == "operational"
    assert node(fed([(0, 0x705, b"\x00"), (1, 0x705, b"\x7f")]), 1).nmt == "pre-operational"
    assert "operational, heartbeat lost" in session.cells(node(fed(beats), 4600))
    assert "no heartbeat" in session.cells(node(fed([*contacts(2), (9, 0x705, b"")]), 10))


def test_a_boot_up_message_is_no_state_that_lasts() -> None:
    boot_up = (0, 0x705, b"\x00")
    assert node(fed([boot_up]), 10).nmt == "boot-up"
    later = [(t + 1, can_id, data) for t, can_id, data in contacts(2)]
    for monitor, t_ms in ((fed([boot_up, *later]), 11), (fed([boot_up]), 501), (fed([boot_up]), 60_000)):
        found = node(monitor, t_ms)
        assert (found.nmt, found.nmt_lost) == ("boot-up, no heartbeat", False)
    assert node(fed([boot_up, *later, (20, 0x705, b"\x05")]), 20).nmt == "operational"
    beats = [(1000 * k, 0x705, b"\x05") for k in range(3)]
    assert node(fed([*beats, (2500, 0x705, b"\x00")]), 9000).nmt == "boot-up, no heartbeat"


def test_emergency() -> None:
    emcy = [(5 * k, 0x85, bytes.fromhex(data)) for k, data in enumerate(("1050810100000000", "3050810100000000"))]
    found = node(fed(emcy), 2005)
    assert found.emergency is not None
    assert (found.emergency.code, found.emergency.register, found.emergency.text) == (0x5030, 0x81, "front end")
    assert "5030h front end, 2.0 s ago" in session.cells(found)
    assert fed([(0, 0x85, b"\x10")]).views(T0)[0].nodes[0].emergency is None


def test_sync_is_no_emergency_of_node_0() -> None:
    found = bus(fed([(10 * k, 0x80, b"") for k in range(101)]), 1000)
    assert found.sync_hz == pytest.approx(100.0)
    assert found.nodes == ()


def test_other_nodes_are_left_out() -> None:
    frames = [(0, *contact_pdo(5, 1, 2, 3)), (1, *contact_pdo(6, 1, 2, 3)), (2, 0x706, b"\x05"), (3, 0x86, bytes(8))]
    assert [found.node_id for found in bus(fed(frames, node_ids=[5])).nodes] == [5]
    assert [found.node_id for found in bus(fed(frames)).nodes] == [5, 6]


def test_error_and_remote_frames_are_no_values() -> None:
    data = contact_pdo(5, 1, 2, 3)[1]
    frames = [(0, 0x285 | REMOTE_FLAG, b""), (1, 0x705 | ERROR_FLAG, b"\x05"), (2, 0x285 | EXTENDED_FLAG, data)]
    found = bus(fed(frames))
    assert (found.nodes, found.errors) == ((), 1)


def test_the_load_of_frames() -> None:
    """The figures for standard frames of 8 bytes are those of the text books: 111 bits at least, 135 at most."""
    found = bus(fed([(k, 0x123, bytes(8)) for k in range(2001)]), 2000)
    assert (found.frames_hz, found.least_bits_hz) == pytest.approx((1000.0, 111e3), rel=1e-2)
    assert found.worst_bits_hz == pytest.approx(135e3, rel=1e-2)


def test_the_same_node_on_two_buses() -> None:
    monitor = Monitor()
    frames = frame_array([(T0, *contact_pdo(5, 1.0, 2, 3)), (T0 + 1, *contact_pdo(5, 2.0, 2, 3))])
    frames["channel"] = [0, 1]
    monitor.feed(frames, ["can0", "can1"])
    views = monitor.views()
    assert [(view.name, view.nodes[0].readings["P"].value) for view in views] == [("can0", 1.0), ("can1", 2.0)]


def test_a_clock_that_was_set_back_starts_anew() -> None:
    monitor = fed(contacts(101))
    frames = [(T0 - 3600_000 * MS + 20 * k * MS, *contact_pdo(5, 1, 2, 3)) for k in range(51)]
    monitor.feed(frame_array(frames), ["can0"])
    found = monitor.views()[0].nodes[0]
    assert found.rate_hz == pytest.approx(50.0)
    assert found.age_s == 0.0


def test_nothing_has_come() -> None:
    monitor = Monitor()
    monitor.feed(np.zeros(0, dtype=FRAME), [])
    assert monitor.views() == ()
    assert Window().periods() is None
    assert Window(columns=2).sums(0) == [0.0, 0.0]


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_a_log_in_its_own_time(hand_log: Path, speed: float) -> None:
    clock = Clock()
    with open_log(hand_log) as reader:
        source = LogSource(reader, speed, 250 * MS, clock, clock.sleep)
        count = 0
        while not source.ended:
            frames, _ = source.take(0.1)
            count += len(frames)
            now_ns = source.now_ns()
            assert now_ns is not None
            if len(frames):
                assert int(frames["t_ns"].max()) <= now_ns
                assert now_ns - T0 <= (clock.now_s - 100.0) * speed * 1e9 + MS
    assert count == len(hand_log.read_text().splitlines())
    assert clock.now_s - 100.0 == pytest.approx(2.0 / speed, abs=0.02)


@pytest.mark.parametrize("speed", [1e3, 1e300])
def test_a_late_step_does_not_pass_the_end_of_a_log(hand_log: Path, speed: float) -> None:
    with open_log(hand_log) as reader:
        source = LogSource(reader, speed, 250 * MS, itertools.count(0.0).__next__, lambda _wait_s: None)
        while not source.ended:
            source.take(0.1)
    assert source.now_ns() == T0 + 2_000 * MS


def test_a_log_as_fast_as_it_is_read(hand_log: Path) -> None:
    clock = Clock()
    with open_log(hand_log) as reader:
        source = LogSource(reader, math.inf, 250 * MS, clock, clock.sleep)
        steps: list[FrameArray] = []
        while not source.ended:
            steps.append(source.take(0.1)[0])
    assert clock.now_s == 100.0
    assert len(steps) in {9, 10}
    assert all(int(step["t_ns"].max() - step["t_ns"].min()) <= 251 * MS for step in steps[:-1])


def test_a_pipe_that_goes_quiet_grows_old(hand_log: Path) -> None:
    clock = Clock()
    with open_log(hand_log) as reader:
        source = PipeSource(reader, clock)
        monitor = Monitor()
        while not source.ended:
            monitor.feed(*source.take(5.0))
    clock.sleep(3.0)
    (view,) = monitor.views(source.now_ns())
    assert view.nodes[0].stale
    assert view.nodes[0].age_s == pytest.approx(3.0, abs=0.02)


def test_a_table_at_the_end_of_a_log(hand_log: Path, tmp_path: Path, printed: Printed) -> None:
    out, err = printed(0, f"monitor {hand_log}")
    lines = out.splitlines()
    assert lines[0].startswith("sim0: ")
    assert "SYNC 100.0 Hz" in lines[0]
    assert lines[1].split()[:2] == ["node", "Hz"]
    assert lines[2].startswith("5 (0x05)  ")
    assert " operational " in lines[2]
    assert (len(lines), err) == (3, "")
    assert "no node found yet" in printed(0, f"monitor {hand_log} --nodes 6").out
    (tmp_path / "bad.log").write_text(hand_log.read_text() + "nonsense\n")
    assert "tipforce monitor: 1 bad line left out" in printed(0, f"monitor {tmp_path}/bad.log").err


def test_a_json_line_for_each_interval_of_the_log(hand_log: Path, printed: Printed) -> None:
    found = printed(0, f"monitor {hand_log} --json --interval 0.5").records
    assert [record["t"] for record in found] == pytest.approx([START_S + t for t in (0.5, 1.0, 1.5, 2.0)], abs=0.01)


def test_once(hand_log: Path, printed: Printed) -> None:
    (record,) = printed(0, f"monitor {hand_log} --once 1.55 --json").records
    assert record["t"] == pytest.approx(START_S + 1.55, abs=0.01)
    (view,) = record["buses"]
    (of_node,) = view["nodes"]
    assert "stale" in of_node["status"]
    assert of_node["readings"]["P"] == {"value": None, "unit": "N", "reason": "no new sample", "stale": False}


def test_from_stdin(hand_log: Path) -> None:
    done = process("monitor -", input=hand_log.read_text())
    assert (done.returncode, done.stderr) == (0, "")
    assert "5 (0x05)" in done.stdout


def test_on_a_bus(printed: Printed) -> None:
    words = ["monitor", "-i", "virtual", "--once"]
    assert printed(0, [*words, "0.1", "-c", "monitor2"]).out == "no frames received\n"
    with sending("monitor1", lambda number: [message(*contact_pdo(5, 1.5, 90.0, -45.0, counter=number))]):
        (record,) = printed(0, [*words, "0.2", "--json", "-c", "monitor1"]).records
    (of_node,) = record["buses"][0]["nodes"]
    assert (of_node["node_id"], of_node["readings"]["P"]["value"], of_node["lost"]) == (5, 1.5, 0)


@pytest.mark.parametrize("width", [250, 80, 40])
def test_the_screen_shows_what_the_text_shows(width: int, hand_log: Path) -> None:
    from rich.console import Console

    watched = Monitor()
    with open_log(hand_log) as reader:
        for frames in reader:
            watched.feed(frames, reader.channels)
    views, stream = watched.views(), io.StringIO()
    tables = session.tables(views, 1_000_000, ["what is missing"], "the foot", min(width, session.WIDE))
    Console(file=stream, width=width, no_color=True).print(tables)
    lines = stream.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    (node,) = views[0].nodes
    row = session.cells(node)
    if width == 250:
        for cell in (*row, session.headline(views[0], 1_000_000), "what is missing", "the foot"):
            assert cell in stream.getvalue()
        assert " ".join("\n".join(session.plain(views, 1_000_000)).split()).startswith("sim0: ")
        return
    assert "\u2026" not in stream.getvalue()
    header, line = (next(line for line in lines if line.startswith(start)) for start in ("node", row[0]))
    below = f"status {row[7]}, NMT {row[8]}, last EMCY {row[9]}, lost {row[-1]}" in " ".join(stream.getvalue().split())
    assert below if width == 40 else (header.split()[-1], line.split()[-1]) == ("lost", row[-1])
    assert f"{node.readings['P'].value:.3f} N" in line


def test_it_ends_when_told(hand_log: Path) -> None:
    with open_log(hand_log) as reader:
        source, watched = LogSource(reader, math.inf, 10 * MS), Monitor()
        assert not session.run(watched, source, lambda: watched.frames > 20, 0.25, None)
        assert 20 < watched.frames < 100
