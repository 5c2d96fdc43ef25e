"""`tipforce plot`: bins that lose no peak, angles without jumps, gaps for the unknown, bands, and the command."""

import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.dataset.reader import tables_of_logs
from tipforce.scene import beam_calibration
from tipforce_tools.cli.main import main
from tipforce_tools.plot.figure import broken, wrapped
from tipforce_tools.plot.fingers import BINS, COVERAGE, Bins, Finger, Flags, Line, Lost, Trace
from tools.hand_log import START_S, contact_pdo, write_hand_log
from tools.rig import Printed

T0 = 1_700_000_000_000_000_000
MS = 1_000_000
NAN = math.nan


def times(count: int, step_ns: int = MS) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return T0 + step_ns * np.arange(count)


def line_of(trace: Trace) -> Line:
    line = trace.line()
    assert line is not None
    return line


def traced(values: list[float], *, angle: bool = False, parts: int = 1, u: list[float] | None = None) -> Line:
    """One sample per bin: the line has a point for each known value."""
    trace = Trace(T0, angle=angle)
    t_ns, x = times(len(values)), np.array(values)
    given_u = None if u is None else np.array(u)
    for rows in np.array_split(np.arange(len(x)), parts):
        trace.add(t_ns[rows], x[rows], None if given_u is None else given_u[rows])
    return line_of(trace)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 4000), st.integers(1, 50_000_000), st.integers(1, 9), st.integers(0, 2**32 - 1), st.booleans())
def test_bins_keep_extremes_sums_and_ends(count: int, longest_ns: int, parts: int, seed: int, disorder: bool) -> None:
    """However samples come in blocks and over whatever time: nothing is lost, and every bin agrees with its samples."""
    rng = np.random.default_rng(seed)
    t_ns = T0 + np.cumsum(rng.integers(0, longest_ns, count))
    if disorder:
        t_ns = t_ns - rng.integers(0, 3 * longest_ns, count)
    x = rng.normal(size=count)
    how = {
        "low": (np.minimum, np.inf),
        "high": (np.maximum, -np.inf),
        "total": (np.add, 0.0),
        "set": (np.bitwise_or, 0),
    }
    bins, bits = Bins(T0, how), 1 << np.arange(count) % 60
    for rows in np.array_split(np.arange(count), parts):
        bins.add(t_ns[rows], low=x[rows], high=x[rows], total=x[rows], set=bits[rows])
    found = bins.filled()
    assert len(found["count"]) <= BINS
    assert found["count"].sum() == count
    assert (found["low"].min(), found["high"].max()) == (x.min(), x.max())
    assert np.bitwise_or.reduce(found["set"]) == np.bitwise_or.reduce(bits)
    assert found["total"].sum() == pytest.approx(x.sum())
    assert (found["first_ns"].min(), found["last_ns"].max()) == (t_ns.min(), t_ns.max())
    if not disorder:
        number = (t_ns - T0) // bins.width_ns
        assert found["low"].tolist() == [x[number == one].min() for one in np.unique(number)]


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_the_unknown_is_a_gap(parts: int) -> None:
    line = traced([1, 2, NAN, 3, 4, NAN, NAN, 5], parts=parts)
    assert line.y[0].tolist() == [1, 2, 3, 4, 5]
    assert line.starts.tolist() == [True, False, True, False, True]
    t, (y, *_) = broken(line.starts, line.t_ns.astype(np.float64), line.y)
    assert np.isnan(y).tolist() == [False, False, True, False, False, True, False]
    assert np.isnan(t).tolist() == np.isnan(y).tolist()


def test_silence_is_a_gap() -> None:
    trace = Trace(T0)
    t_ns = np.concatenate((times(50), times(50) + 200 * MS))
    for rows in (slice(0, 50), slice(50, 100)):
        trace.add(t_ns[rows], np.ones(50))
    assert np.flatnonzero(line_of(trace).starts).tolist() == [0, 50]


def test_a_gap_survives_the_growth_of_bins() -> None:
    x = np.ones(40_000)
    x[20_000:20_100] = NAN
    trace = Trace(T0)
    trace.add(times(len(x)), x)
    starts = line_of(trace).starts
    assert 0 < len(starts) <= BINS
    assert np.count_nonzero(starts) == 2


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1.0, 120.0), st.integers(1, 5))
def test_an_angle_never_jumps(seed: int, step_deg: float, parts: int) -> None:
    """A walk round the circle: what is drawn is the angle (but for full turns), and no segment is a jump."""
    rng = np.random.default_rng(seed)
    true = np.cumsum(rng.uniform(-step_deg, step_deg, 150)) + rng.uniform(-180, 180)
    sent = (true + 180.0) % 360.0 - 180.0
    line = traced(sent.tolist(), angle=True, parts=parts)
    off = (line.y[0] - true) / 360.0
    assert off == pytest.approx(np.round(off), abs=1e-9)
    assert np.abs(np.diff(line.y[0])).max() <= step_deg + 1e-9
    x, (y, *_) = wrapped(line.starts, (line.t_ns - T0).astype(np.float64), line.y)
    steps = np.abs(np.diff(y))
    assert steps[np.isfinite(steps)].max() <= step_deg + 1e-9
    # Each sample is drawn where it belongs, within the axis.
    for t, v in zip((line.t_ns - T0).tolist(), sent.tolist(), strict=True):
        here = y[x == t]
        off = (here - v) / 360.0
        assert (np.abs(off - np.round(off)) < 1e-9).all()
        assert np.abs(here).min() <= 180.0 + 1e-9


def test_an_angle_that_crosses_180_leaves_and_comes_back() -> None:
    line = traced([170.0, 178.0, -174.0, -166.0], angle=True)
    assert line.y[0].tolist() == [170.0, 178.0, 186.0, 194.0]
    x, (y, *_) = wrapped(line.starts, np.arange(4.0), line.y)
    assert np.nan_to_num(y, nan=999).tolist() == [170.0, 178.0, 186.0, 999, -182.0, -174.0, -166.0]
    assert np.nan_to_num(x, nan=999).tolist() == [0.0, 1.0, 2.0, 999, 1.0, 2.0, 3.0]


def test_behind_a_gap_an_angle_starts_within_the_circle() -> None:
    line = traced([170.0, -170.0, NAN, -170.0, -160.0], angle=True)
    assert line.y[0].tolist() == [170.0, 190.0, -170.0, -160.0]


def test_a_band_is_two_standard_uncertainties() -> None:
    line = traced([1.0, 2.0, 3.0], u=[0.1, NAN, 0.2])
    assert COVERAGE == 2.0
    assert np.nan_to_num(line.y[3], nan=-1).tolist() == [0.8, -1, 2.6]
    assert np.nan_to_num(line.y[4], nan=-1).tolist() == [1.2, -1, 3.4]


def test_flags_become_bars() -> None:
    flags = Flags(T0)
    stale = np.zeros(100, dtype=np.bool_)
    stale[10:20] = stale[50] = True
    flags.add(times(100), {"contact": ~stale, "stale": stale, "fault": np.zeros(100, dtype=np.bool_)})
    bars = flags.bars()
    assert set(bars) == {"contact", "stale"}
    assert [((a - T0) // MS, (b - T0) // MS) for a, b in bars["stale"]] == [(10, 20), (50, 51)]
    assert [((a - T0) // MS, (b - T0) // MS) for a, b in bars["contact"]] == [(0, 10), (20, 50), (51, 99)]
    # A bar ends where the samples end.
    flags, on = Flags(T0), np.ones(50, dtype=np.bool_)
    flags.add(times(50), {"stale": on})
    flags.add(times(50) + 1000 * MS, {"stale": on})
    assert [((a - T0) // MS, (b - T0) // MS) for a, b in flags.bars()["stale"]] == [(0, 49), (1000, 1049)]


def test_lost_samples_are_marked_and_counted() -> None:
    lost = Lost(T0)
    counter = np.array([250, 251, 254, 255, 256, 256, 260])
    lost.add(times(4), counter[:4])
    lost.add(times(3) + 4 * MS, counter[4:])
    assert lost.total == 2 + 3
    assert ((lost.times_ns() - T0) // MS).tolist() == [2, 6]


Plotted = Callable[..., list[dict[str, Any]]]


@pytest.fixture
def plotted(printed: Printed) -> Plotted:
    """What --json says of each node."""
    return lambda *words: json.loads(printed(0, ["plot", *words, "--json"]).out)["nodes"]


def words_of(path: Path) -> str:
    """The text in an SVG: matplotlib leaves it as comments beside the glyphs."""
    return "\n".join(re.findall(r"<!-- (.*?) -->", path.read_text()))


@pytest.mark.parametrize(("suffix", "start"), [(".svg", b"<?xml"), (".pdf", b"%PDF-"), (".PNG", b"\x89PNG\r\n")])
def test_the_formats(suffix: str, start: bytes, hand_log: Path, tmp_path: Path, plotted: Plotted) -> None:
    path = tmp_path / f"run{suffix}"
    plotted(hand_log, "-o", path)
    first = path.read_bytes()
    (node,) = plotted(hand_log, "-o", path)
    assert first.startswith(start)
    assert path.read_bytes() == first, "equal data give equal files"
    assert node["node"] == "node 5 (0x05)"
    assert node["signals"] == ["P", "phi", "theta", "SG1", "SG2", "SG3"]
    assert node["lost"] == 5


def test_everything_is_written_on_it(hand_log: Path, tmp_path: Path, plotted: Plotted) -> None:
    path = tmp_path / "run.svg"
    plotted(hand_log, "-o", path)
    text = words_of(path)
    for words in (
        "node 5 (0x05), 5 samples lost", "P (N)", "phi (deg)", "theta (deg)", "strain (microstrain)", "SG3", "time (s)",
        "contact", "gauge saturated", "no new sample", "theta unresolved", "front-end fault", "lost samples",
        "from 2023-11-14 22:13:20.000 UTC", "grey: two standard uncertainties to either side (95 %)",
    ):  # fmt: skip
        assert words in text, words


@pytest.mark.parametrize(
    ("start", "title"),
    [("0000000000.000000", "from 0 s of the log's clock"), ("0000000012.250000", "from 12.25 s of the log's clock")],
)
def test_a_log_whose_clock_is_no_date(start: str, title: str, tmp_path: Path, plotted: Plotted) -> None:
    log, path = tmp_path / "run.log", tmp_path / "run.svg"
    later = f"{float(start) + 1.0:017.6f}"
    log.write_text("".join(f"({t}) can0 285#E803282394110300\n" for t in (start, later)))
    plotted(log, "-o", path)
    assert title in words_of(path)


@pytest.mark.parametrize("signals", ["P,gauges,status", "gauges"])
def test_a_legend_lies_on_no_trace_and_no_title(signals: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gauge at its limit runs along the edge of the panel: the names are outside, and the title above them."""
    from tipforce_tools.plot import figure as figures

    log = tmp_path / "run.log"
    pdos = {0x185: "FF7F0180000007", 0x285: "E8032823941107"}
    lines = [f"({t:017.6f}) can0 {cob_id:03X}#{data}{t:02X}\n" for t in range(1, 9) for cob_id, data in pdos.items()]
    log.write_text("".join(lines))
    drawn: list[Any] = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, *_, **__: drawn.append(figure))
    assert main(["plot", str(log), "--signals", signals, "-o", str(tmp_path / "run.png")]) == 0
    (figure,) = drawn
    figure.canvas.draw()
    (axes,) = [axes for axes in figure.axes if axes.get_legend() is not None]
    legend = axes.get_legend().get_window_extent()
    assert legend.y0 >= axes.get_window_extent().y1 - 1.0
    assert not any(legend.overlaps(other.title.get_window_extent()) for other in figure.axes if other.get_title())
    assert not any(legend.overlaps(other.get_window_extent()) for other in figure.axes if other is not axes)


def test_choice_of_signals_times_and_size(hand_log: Path, tmp_path: Path, plotted: Plotted) -> None:
    path = tmp_path / "part.png"
    words = ["--signals", "P,temperature", "--from", "1", "--to", "1.1", "--size", "127x76.2mm"]
    (node,) = plotted(hand_log, "-o", path, *words)
    assert node["signals"] in (["P"], ["P", "temperature"])
    assert path.read_bytes()[16:24] == (650).to_bytes(4, "big") + (390).to_bytes(4, "big")
    svg = tmp_path / "part.svg"
    plotted(hand_log, "-o", svg, *words)
    assert "contact" not in words_of(svg)


def test_with_a_calibration_the_contact_comes_from_the_gauges(hand_log: Path, tmp_path: Path, plotted: Plotted) -> None:
    """The host's contact is as often unknown as the node's, and has bands of its own."""
    cal = tmp_path / "cal.toml"
    write_calibration(cal, beam_calibration("I"))
    no_contact = tmp_path / "gauges.log"
    no_contact.write_text("".join(line for line in hand_log.read_text().splitlines(True) if " 285#" not in line))
    (from_node,) = plotted(hand_log, "-o", tmp_path / "a.svg")
    (from_gauges,) = plotted(no_contact, "-o", tmp_path / "b.svg", "--calibration", f"5={cal}")
    assert set(from_gauges["signals"]) == set(from_node["signals"])
    for signal, slack in (("P", 0), ("phi", 4), ("theta", 4)):
        difference = from_gauges["unknown"][signal] - from_node["unknown"][signal]
        assert abs(difference) <= slack, signal
    assert "grey: two standard uncertainties" in words_of(tmp_path / "b.svg")


def test_five_fingers_share_a_row(tmp_path: Path, plotted: Plotted) -> None:
    log, path = write_hand_log(tmp_path / "five.log", (1, 2, 3, 4, 5), 1.0), tmp_path / "five.svg"
    assert len(plotted(log, "-o", path)) == 5
    text = words_of(path)
    assert text.count("P (N)") == text.count("theta unresolved") == 1
    assert all(f"node {k} (0x0{k})" in text for k in range(1, 6))
    nodes = [node["node"] for node in plotted(log, "-o", path, "--nodes", "2-3")]
    assert nodes == ["node 2 (0x02)", "node 3 (0x03)"]


def test_several_logs_are_one_recording(hand_log: Path, tmp_path: Path, plotted: Plotted) -> None:
    lines = hand_log.read_text().splitlines(True)
    halves = [tmp_path / "1.log", tmp_path / "2.log"]
    for path, part in zip(halves, (lines[: len(lines) // 2], lines[len(lines) // 2 :]), strict=True):
        path.write_text("".join(part))
    whole = plotted(hand_log, "-o", tmp_path / "a.png")
    assert plotted(*map(str, halves), "-o", tmp_path / "b.png") == whole
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_single_sample_is_a_point(tmp_path: Path, plotted: Plotted) -> None:
    can_id, data = contact_pdo(5, 1.5, 90.0, NAN)
    log = tmp_path / "point.log"
    log.write_text(f"({START_S}.000000) can0 {can_id:03X}#{data.hex()}\n")
    (node,) = plotted(log, "-o", tmp_path / "point.svg")
    assert node["unknown"] == {"P": 0, "phi": 0, "theta": 1}
    assert "always unknown" in words_of(tmp_path / "point.svg")


def test_uncertainty_of_tpdo4_is_held(hand_log: Path) -> None:
    """u_P comes with TPDO4 a few times a second; each P between has the last of them."""
    from tipforce.host.decoding.log_part import Reading
    from tipforce.host.decoding.pdo_layout import Layouts
    from tipforce.host.decoding.recording import Recording

    finger: Finger | None = None
    for table in tables_of_logs(Recording(Reading(Layouts())), [str(hand_log)]):
        finger = finger or Finger(int(table.t_ns[0]), ("P",), ())
        finger.add(table)
    assert finger is not None
    line = line_of(finger.traces["P"])
    known = np.isfinite(line.y[3])
    assert known.mean() > 0.8
    width = (line.y[4] - line.y[3])[known] / (2 * COVERAGE)
    assert 0.001 <= width.min() <= width.max() <= 0.1


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("plot LOG -o FOLDER/x.png", "tipforce: a plot needs matplotlib: pip install 'tipforce[plot]'\n"),
        ("design table 1 -o FOLDER", 'pip install "tipforce[plot]"'),  # its table is printed
    ],
)
def test_without_matplotlib_it_says_what_to_install(
    line: str, said: str, hand_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    out, err = printed(2, line.replace("LOG", str(hand_log)).replace("FOLDER", str(tmp_path)))
    assert said in err
    assert bool(out) == line.startswith("design")
