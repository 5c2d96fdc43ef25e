"""Sources of a page: a live bus, a log, the demo; rows as blocks, with what the node does not send computed."""

import json
import os
import re
import signal
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from websockets.sync.client import connect

from host.bus_with_nodes import beam_calibration
from tipforce.errors import EnvironmentLackError, RefusedError
from tipforce.host.frames.frame_array import FrameArray, frame_array
from tipforce.host.live.receiver import InterfaceDownError
from tipforce.samples.reasons import NO_ANSWER
from tipforce.samples.record import Rows
from tipforce.sensor.contact import estimate as contact_model
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.contact.scalar import CALIBRATED, CONTACT_PRESENT
from tipforce.shipped_files import file_or_shipped
from tipforce.watching.feeds import Finger, FrameFeed, Watcher, finger_maker
from tipforce.watching.frame_sources import FrameSource
from tipforce_tools.page.connection import drawing
from tipforce_tools.page.sources import LiveSource, LogSource, scene_source
from tools.decode.logs import write_frames
from tools.view.support import MS, START_NS, WAIT_S, fingers

STATUS = 3  # contact, calibrated


def contact(node_id: int, counter: int, P_mN: int) -> tuple[int, bytes]:
    return 0x280 + node_id, struct.pack("<hhhBB", P_mN, -9000, 9000, STATUS, counter % 256)


def gauges(node_id: int, counter: int) -> tuple[int, bytes]:
    return 0x180 + node_id, struct.pack("<hhhBB", 1000, -2000, 30, STATUS, counter % 256)


def cycle(k: int, nodes: tuple[int, ...], sync: bool = True, with_gauges: bool = False) -> list[tuple[int, int, bytes]]:
    """SYNC number k, 10 ms after the one before, and its answers."""
    t_ns = START_NS + 10 * MS * k
    frames = [(0x80, b"")] if sync else []
    for node_id in nodes:
        frames += [contact(node_id, k, 1000 * node_id + k)]
        frames += [gauges(node_id, k)] if with_gauges else []
    return [(t_ns + 1000 * n, can_id, data) for n, (can_id, data) in enumerate(frames)]


def run(watcher: Watcher, *cycles: list[tuple[int, int, bytes]]) -> list[np.ndarray]:
    found = []
    for frames in cycles:
        blocks, _ = watcher.add(frame_array(frames), frames[-1][0] * 1e-9)
        found += [block.contact[..., 0] for block in blocks]
    return found


def test_fingers_are_found_as_they_are_heard() -> None:
    watcher = Watcher(Finger)
    found = run(watcher, *(cycle(k, (3,), with_gauges=True) for k in range(5)))
    assert [finger.node_id for finger in watcher.fingers] == [3]
    found += run(watcher, *(cycle(k, (1, 3), with_gauges=True) for k in range(5, 10)))
    assert [finger.node_id for finger in watcher.fingers] == [1, 3]
    assert found[0] == pytest.approx(np.array([[3.0], [3.001]]), abs=1e-6)  # the first waits for the next SYNC
    assert found[-1] == pytest.approx(np.array([[1.009, 3.009]]), abs=1e-6)


def test_who_is_not_wanted_is_not_shown_and_foreign_pdos_are_no_finger() -> None:
    watcher = Watcher(lambda node_id: Finger(node_id) if node_id == 1 else None)
    motor = (START_NS, 0x285, b"\1\2\3\4")
    run(watcher, [motor, *cycle(0, (1, 2))])
    assert [finger.node_id for finger in watcher.fingers] == [1]


def test_without_a_sync_a_pdo_paces_the_rows() -> None:
    watcher = Watcher(Finger)
    found = run(watcher, *(cycle(k, (1, 2), sync=False) for k in range(60)))
    assert found[-1].shape == (1, 2)
    assert not np.isnan(found[-1]).any()
    found = run(watcher, *(cycle(k, (2,), sync=False) for k in range(60, 130)))  # that PDO comes no more
    assert np.isnan(found[-1]).tolist() == [[True, False]]


def test_health_tells_the_uncertainty_of_the_force() -> None:
    watcher = Watcher(Finger)
    health = (START_NS + 5 * MS, 0x481, struct.pack("<hHHBB", 2300, 25, 0, 0, 0))
    watcher.add(frame_array([*cycle(0, (1, 2)), health]), 0.0)
    (block,), _ = watcher.add(frame_array(cycle(1, (1, 2))), 0.01)
    assert block.u[0, 0, 0] == pytest.approx(0.025)
    assert np.isnan(block.u[0, 0, 1:]).all()  # no calibration: only health tells
    assert np.isnan(block.u[0, 1]).all()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Two seconds of two fingers; the second is gone for half of it, and has told why."""
    frames = []
    for k in range(200):
        frames += cycle(k, (1,) if 50 <= k < 150 else (1, 2))
    emcy = (START_NS + 505 * MS, 0x082, bytes.fromhex("3050210000000000"))
    return write_frames(tmp_path / "run.log", frame_array(sorted([*frames, emcy])))


def test_a_log_is_shown_as_it_was(log: Path) -> None:
    source = LogSource(log, Finger)
    model = source.model
    assert model.counters.rows == 200
    # When it comes back its first answers are doubted (CounterCheck), and so missing.
    assert model.counters.missing == [0, 100 + model.counters.doubtful[1]]
    (event,) = model.events()
    assert (event.node_id, event.kind) == (2, "emcy")
    assert abs(event.t_ms - START_NS / 1e6 - 505) < 0.001
    assert model.now_ns() == START_NS + 1990 * MS
    words = {t: [s.word for s in model.picture(START_NS + t * MS).states] for t in (300, 510, 530, 600, 1480, 1600)}
    assert words == {
        300: ["live", "live"], 510: ["live", "live"], 530: ["live", "stale"], 600: ["live", "stale"],
        1480: ["live", "stale"], 1600: ["live", "live"],
    }  # fmt: skip
    assert model.picture(START_NS + 1600 * MS).states[1].contact[0] == pytest.approx(2.16)
    assert (model.rows_after(0, 1000, 2**62).status[50:150, 1] == NO_ANSWER).all()


def test_a_part_of_a_log(log: Path) -> None:
    source = LogSource(log, Finger, start_s=1.0, end_s=1.5)
    assert source.model.counters.rows == 50
    assert source.model.span_ns()[0] == START_NS + 1000 * MS
    assert LogSource(log, Finger, start_s=1.0, end_s=1.005).model.counters.load == (None, None)
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[300:] + lines[:300]))  # a clock that is set back: frames are not of a row's moment
    assert (source.model.frames is None, LogSource(log, Finger).model.frames is None) == (False, True)


def test_a_short_log_without_sync(tmp_path: Path) -> None:
    frames = frame_array([frame for k in range(3) for frame in cycle(k, (1, 2)) if frame[1] != 0x80])
    model = LogSource(write_frames(tmp_path / "run.log", frames), Finger).model
    assert (model.counters.rows, model.counters.missing) == (3, [0, 0])


class Bus(FrameSource):
    """A bus of a test: frames that are taken once, and a clock that stands at the newest plus ``silent_ns``."""

    def __init__(self) -> None:
        super().__init__(lambda: None)
        self.frames: list[tuple[int, int, bytes]] = []
        self.newest_ns = self.silent_ns = 0
        self.error: Exception | None = None

    def take(self, timeout_s: float) -> tuple[FrameArray, tuple[str, ...]]:
        assert timeout_s == 0.0
        if self.error is not None:
            raise self.error
        frames, self.frames = frame_array(self.frames), []
        self.newest_ns = int(frames["t_ns"][-1]) if len(frames) else self.newest_ns
        return frames, ("can0",)

    def now_ns(self) -> int:
        return self.newest_ns + self.silent_ns


def test_a_page_that_listens_says_what_happens_on_its_bus() -> None:
    """A heartbeat that is lost by the clock of the frames, a bus that is down and comes back, one that has ended."""
    bus = Bus()
    source = LiveSource(FrameFeed(bus, Finger), "can0", no_tare="listening")
    for k in range(20):
        bus.frames += [*cycle(k, (1,)), (START_NS + 10 * MS * k + 5000, 0x701, b"\5")]
    source.pump()
    assert (source.model.counters.rows, source.model.nmt) == (20, ["operational"])
    bus.silent_ns = 5_000 * MS
    source.pump()
    bus.error = InterfaceDownError("can0 is down")
    source.pump()
    source.pump()
    bus.error, bus.frames, bus.silent_ns = None, cycle(700, (1,)), 0
    source.pump()
    kinds = [event.kind for event in source.model.events()]
    assert kinds == ["heartbeat_back", "heartbeat_lost", "bus_down", "bus_up"]
    bus.frames = [(START_NS + 7_010 * MS, 0x081, b"\x50\x81\x11\x81\x02\0\0\0")]
    source.pump()
    assert source.model.nmt == ["id is that of two nodes"]
    bus.error = EnvironmentLackError("can0: no such device")
    source.pump()
    source.pump()
    assert source.model.error == "reception has ended: can0: no such device"
    assert [event.kind for event in source.model.events()][4:] == ["duplicate", "emcy", "bus_down"]
    with pytest.raises(RefusedError, match="only listens"):
        source.tare(1)


def test_a_page_names_once_what_calibrates_a_finger() -> None:
    bus = Bus()
    source = LiveSource(FrameFeed(bus, Finger), "can0", no_tare="listening")
    for k in range(3):
        bus.frames = [(t_ns, can_id, data[:-2] + b"\0" + data[-1:]) for t_ns, can_id, data in cycle(k, (1,))]
        source.pump()
    hint = "not calibrated: tipforce calibrate guide --node 1, or apply CAL.toml"
    assert [(event.node_id, event.text) for event in source.model.events()] == [(1, hint)]


@pytest.fixture(scope="module")
def demo() -> LogSource:
    return scene_source(file_or_shipped("hand", "scenes"), finger_maker())


def test_the_demo_shows_a_complete_calibrated_hand_in_every_row(demo: LogSource) -> None:
    """Its time is simulated: a busy machine loses nothing. Where a finger is unknown, a fault says why."""
    model = demo.model
    assert [finger.label for finger in model.fingers] == ["thumb", "index", "middle", "ring", "little"]
    counters = model.counters
    assert counters.rows == 2000
    assert not any(sum(counts) for counts in (counters.missing, counters.late, counters.mixed, counters.doubtful))
    reasons: set[str] = set()
    start_ns, end_ns = model.span_ns()
    for moment_ns in range(start_ns + 2_500_000_000, end_ns - 2_500_000_000, 500_000_000):
        for state in model.picture(moment_ns).states:
            P, phi, theta = state.contact or (np.nan,) * 3
            reasons |= {state.reason} - {""}
            assert state.reason or 0.3 < P < 5.0
            assert state.reason or np.cos(np.radians(phi - theta)) < -0.7  # a push goes inwards
            assert state.reason or np.isfinite(state.u).all()
            assert state.reason or np.isfinite(state.gauges).all()
    assert reasons == {"front-end fault"}


def test_the_demo_shows_the_frames_as_candump_does(demo: LogSource) -> None:
    start_ns, _ = demo.model.span_ns()
    lines = demo.model.picture(start_ns + 10_000_000_000).frames
    assert lines is not None
    assert len(lines) == 12
    line = re.compile(r" \(010\.0\d{5}\)  sim0  [123]8[1-5]   \[8\] ( [0-9A-F]{2}){8}")
    assert [text for text in lines if not line.fullmatch(text)] == []


def test_a_scene_ends_on_its_best_moment(demo: LogSource) -> None:
    assert demo.rest_ns is not None
    states = demo.model.picture(demo.rest_ns).states
    assert [state.word for state in states] == ["live"] * 5
    assert sum(state.contact[0] for state in states) > 10.0
    assert 'tipforce.read_log("scene.log")' in demo.python


def test_the_command_serves_and_ends_quietly() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "tipforce_tools.cli.main", "view", "-i", "virtual", "--port", "0", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ,
    )  # fmt: skip
    assert process.stdout is not None
    url = json.loads(process.stdout.readline())["url"]
    with connect(url.replace("http", "ws") + "live") as page:
        page.send('{"do": "setup"}')
        setup = json.loads(page.recv(WAIT_S))["answer"]
    assert setup["fingers"] == []
    assert setup["no_tare"] == "this page only listens to the bus"
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=WAIT_S)
    assert (process.returncode, out) == (0, "")
    assert "Traceback" not in err


def rows(columns: dict[str, np.ndarray], missing: np.ndarray | None = None) -> Rows:
    shape = next(iter(columns.values())).shape
    flags = {name: np.ones(shape, dtype=bool) for name in ("contact", "calibrated")}
    reason = np.zeros(shape, dtype=np.uint8) if missing is None else missing.astype(np.uint8)
    t_ns = np.arange(shape[0], dtype=np.int64)
    made = Rows(0, [(0, 0, (), (), ())] * shape[0], range(1, 1 + shape[1]), ())
    vars(made).update(sync_ns=t_ns, counter=np.where(reason, -1, 0), reason=reason, columns=flags | columns)
    return made


@pytest.mark.parametrize("pull", [False, True])
def test_uncertainties_are_those_of_the_sensor(pull: bool) -> None:
    generator = np.random.default_rng(7)
    P, theta = generator.uniform(0.5, 5, (6, 2)), generator.uniform(40, 140, (6, 2))
    phi = theta + generator.uniform(-30, 30, (6, 2)) + (0 if pull else 180)
    who = fingers(2, pull)
    found = rows({"P": P, "phi": phi, "theta": theta}).block([finger.calibration for finger in who], 3)
    F = force_vector(P[:, 1], np.radians(phi[:, 1]), np.radians(theta[:, 1]))
    calibration = who[1].calibration
    assert calibration is not None
    expected = contact_model.standard_uncertainties(F, calibration.covariance_F, pull=pull)
    expected[:, 1:] *= 180 / np.pi
    assert found.u[:, 1] == pytest.approx(expected, rel=1e-5)
    assert (found.status == CONTACT_PRESENT | CALIBRATED).all()


def test_what_is_unknown_has_no_uncertainty_and_what_is_known_keeps_its_own() -> None:
    nan = np.nan
    P = np.array([[1.0, nan], [1.0, 0.01]])
    phi, theta = np.array([[-90.0, nan], [-90.0, nan]]), np.array([[90.0, nan], [nan, nan]])
    found = rows({"P": P, "phi": phi, "theta": theta}, np.isnan(P)).block(
        [finger.calibration for finger in fingers(2)], 3
    )
    assert found.status[0, 1] & NO_ANSWER
    assert np.isnan(found.u[0, 1]).all()
    # Without the contact angle, force and direction are as uncertain as with it.
    assert found.u[1, 0, :2] == pytest.approx(found.u[0, 0, :2], rel=1e-6)
    assert np.isnan(found.u[1, 0, 2])
    assert found.u[1, 1, 0] > 0
    assert np.isnan(found.u[1, 1, 1:]).all()


def test_the_drawing_has_the_strain_of_the_beams() -> None:
    """At the gauges of case I the ends of the faces strain as Table 1 says."""
    (finger,) = fingers(1)
    calibration = finger.calibration
    assert calibration is not None
    drawn = drawing(finger, 3)
    faces = {(f["beam"], f["side"], f["face"]): f["microstrain_per_newton"] for f in drawn["faces"]}
    table = np.linalg.inv(calibration.C) * 1e6
    assert faces["H", "left", "lower"][0] == pytest.approx(table[0])  # K_H
    assert faces["H", "right", "lower"][0] == pytest.approx(table[1])  # S_H
    assert faces["V", "right", "lower"][1] == pytest.approx(table[2])  # U
    assert [gauge["name"] for gauge in drawn["gauges"]] == ["K_H", "S_H", "U"]
    for gauge in drawn["gauges"]:
        assert np.hypot(*np.subtract(gauge["to"], gauge["from"])) == pytest.approx(1.0)


@pytest.mark.parametrize("sent", ["SG", "F"])
def test_gauges_or_forces_alone_give_the_contact(sent: str) -> None:
    calibration = beam_calibration(pull=False)
    F = force_vector(2.0, np.radians(-80.0), np.radians(95.0))
    strain = np.linalg.solve(calibration.C, F) * 1e6
    values = rows({f"{sent}{k + 1}": np.array([[value]]) for k, value in enumerate(strain if sent == "SG" else F)})
    found = values.block([calibration if sent == "SG" else None], 3)
    assert found.contact[0, 0] == pytest.approx([2.0, -80.0, 95.0], rel=1e-5)
    if sent == "SG":
        assert found.gauges[0, 0] == pytest.approx(strain, rel=1e-5)
        assert np.isnan(values.block([None], 3).contact).all()
