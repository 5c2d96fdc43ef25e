"""`tipforce calibrate guide`, walked through at a simulated node: by a person at the keys, and by itself."""

import csv
import io
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from canopen_device.core.node import Device
from canopen_device.running.store import FileStore
from host.bus_with_nodes import apply_load, connected
from tipforce.dictionary import objects as od
from tipforce.fingertip.node import fingertip_node
from tipforce.fingertip.source import Reading, Source
from tipforce.host.configuration.calibration import read_calibration
from tipforce.host.network.bus import Bus
from tipforce.sensor import covariance_of_estimate
from tipforce.sensor.contact.estimate import force_vector, standard_uncertainties
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources.simulated import DRIFT, OPEN, SATURATED, SILENT, STUCK, SimulatedSource
from tools.rig import Printed, Streams, exit_code

OFFSETS = (12.0, -8.5, 5.3)
FEW = ("--grooves", "x30,x60,x150,y45,y90,y135", "--samples", 20, "--drift", "none")
LOAD = r"hang ([\d.]+) N .* theta = ([\d.]+) degrees \(phi = ([\d.]+)\)|remove every load"
QUICK = ("--period", 1)


class Bench(NamedTuple):
    """Node 5 on its bus, and what loads it."""

    connection: Bus
    channel: str
    device: Device
    source: SimulatedSource
    folder: Path
    capsys: pytest.CaptureFixture[str]
    patch: pytest.MonkeyPatch

    @property
    def session(self) -> Path:
        return self.folder / "session.csv"

    @property
    def file(self) -> Path:
        return self.folder / "finger.toml"

    def guide(self, *words: object) -> int:
        line = ["calibrate", "guide", "--node", 5, "--session", self.session, *QUICK, *words]
        return exit_code([*line, "-i", "virtual", "-c", self.channel])

    def auto(self, *words: object, code: int = 0) -> Streams:
        assert self.guide("--auto", *FEW, *words) == code
        return Streams(*self.capsys.readouterr())

    def by_hand(self, key: Callable[[str], str], *words: object, code: int = 0) -> "Person":
        """Run the guide for a person at the keys."""
        person = Person(self, key)
        self.patch.setattr(sys, "stdin", person)
        assert self.guide(*words) == code
        person.listen()
        return person

    def rows(self) -> list[dict[str, str]]:
        with self.session.open() as file:
            return list(csv.DictReader(file))


class Person:
    """Reads what the guide says, hangs the weight, and presses the key that ``key`` says."""

    def __init__(self, bench: Bench, key: Callable[[str], str]) -> None:
        self._bench, self._key = bench, key
        self.heard = self.out = ""

    def listen(self) -> str:
        """What the guide has said since the last time."""
        out, err = self._bench.capsys.readouterr()
        self.out += out
        self.heard += err
        return str(err)

    def readline(self) -> str:
        question = self.listen()
        loads = re.findall(LOAD, question)
        if loads:
            P, theta, phi = (float(word or 0.0) for word in loads[-1])
            self._bench.source.load = (P, phi, theta)
        return self._key(question) + "\n"


@pytest.fixture
def bench(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, channel: str
) -> Iterator[Bench]:
    source = SimulatedSource(strain_matrix(FABRICATED, "I").tolist(), 0.5, OFFSETS, seed=4)
    store = FileStore(tmp_path / "node.json")
    device = fingertip_node(5, source, serial=1005, save=store.save, load=store.load)
    with connected(device, channel=channel) as (connection, _):
        yield Bench(connection, channel, device, source, tmp_path, capsys, monkeypatch)


def test_from_the_first_weight_to_the_stored_calibration(bench: Bench) -> None:
    """Quit at step 9, interrupted within the capture of a later one, resumed twice; then unseen loads."""
    flags = ("--samples", 60, "--angle-scatter", 0.1, "--layout", "I", "-o", bench.file)
    first = bench.by_hand(lambda question: "q" if "step 9 of 25" in question else "", *flags)
    assert "8 of 25 steps are in" in first.heard
    assert [row["step"] for row in bench.rows()] == [str(k) for k in range(1, 9)]

    before = bench.session.read_bytes()
    syncs, sync = [0], Bus.sync

    def interrupted_sync(connection: Bus) -> None:
        syncs[0] += 1
        if syncs[0] > 5 * 60:
            raise KeyboardInterrupt
        sync(connection)

    with bench.patch.context() as patch:
        patch.setattr(Bus, "sync", interrupted_sync)
        second = bench.by_hand(lambda _question: "", *flags, code=130)
    assert "continuing: 8 of 25 steps done, 17 to do" in second.heard
    assert "the extra unloaded reading: remove every load" in second.heard
    rows = bench.rows()
    assert [row["step"] for row in rows[8:]] == ["extra", "9", "10", "11"][: len(rows) - 8]
    assert bench.session.read_bytes().startswith(before)

    third = bench.by_hand(lambda question: "y" if "apply this calibration" in question else "", *flags)
    assert "read back: equal byte for byte" in third.heard
    assert "node 5 (0x05): stored" in third.heard
    assert "condition number 2.5" in third.out
    assert "applied and stored, generation 1" in third.out
    assert sorted({row["step"] for row in bench.rows()} - {"extra"}, key=int) == [str(k) for k in range(1, 26)]
    _check_stored(bench)
    _check_unseen_loads(bench)


def _check_stored(bench: Bench) -> None:
    bench.connection.buffer.clear()
    bench.connection.nmt("reset-node", 5)
    bench.connection.wait_for({0x705}, 10.0)
    calibration = read_calibration(bench.file)
    assert bench.connection.finger(5).verify_calibration(calibration) == []
    assert (calibration.serial, calibration.pull, calibration.layout_code) == (1005, True, 1)
    np.testing.assert_allclose(np.sqrt(np.diag(calibration.covariance_strain2)) * 1e6, 0.5, rtol=0.1)
    np.testing.assert_allclose(calibration.offset_strain * 1e6, OFFSETS, atol=0.4)


def _check_unseen_loads(bench: Bench) -> None:
    """The node's own estimates, against its uncertainty and the calibration's; z for 1 in a million over all."""
    calibration = read_calibration(bench.file, with_fit=True)
    assert calibration.parameter_covariance is not None
    for P, phi, theta in ((2.0, 20.0, 75.0), (3.1, 100.0, 60.0), (1.2, 0.0, 20.0), (4.0, 150.0, 110.0)):
        apply_load(bench.connection, 5, P, phi, theta)
        time.sleep(0.002)
        applied_s, finger = time.time(), bench.connection.finger(5)
        while (contact := finger.read()).t_s < applied_s:  # an answer to a SYNC of before, which came late
            pass
        F = force_vector(P, *np.radians([phi, theta]))
        covariance = covariance_of_estimate(
            calibration.C, calibration.covariance_strain2, calibration.parameter_covariance, F[np.newaxis]
        )
        u = standard_uncertainties(F[np.newaxis], covariance, pull=True)[0] * [1.0, 180 / np.pi, 180 / np.pi]
        error = np.array([contact.P_newtons, contact.phi_deg, contact.theta_deg]) - [P, phi, theta]
        assert (np.abs(error) <= 5.3 * u + [0.0005, 0.005, 0.005]).all()


def test_by_itself(bench: Bench) -> None:
    apply_load(bench.connection, 5, 1.0, 20.0, 30.0)
    ended = bench.auto("-o", bench.file, "--json")
    assert "node 5 (0x05): simulated fingertip, 3 gauges, serial 1005; not calibrated yet; 23.00 degC" in ended.err
    assert "plan: 6 loads and 3 unloaded readings; by SYNC and TPDO1 (0x185)" in ended.err
    assert "step 2 of 9: hang 4.4 N (448.7 g) in the x-groove at theta = 30 degrees (phi = 0)" in ended.err
    records = ended.records
    assert [record["step"] for record in records[:9]] == list(range(1, 10))
    assert records[3] | {"P_N": 4.4, "phi_deg": 180.0, "theta_deg": 150.0, "samples": 20} == records[3]
    assert abs(records[9]["condition_number"] - 2.51) < 0.02
    assert records[10]["node"] == 5
    assert bench.source.load == (1.0, 20.0, 30.0)
    # Once more: everything is there, so it fits and applies at once.
    again = bench.auto()
    assert "step 1" not in again.err
    assert "generation 2" in again.out


def test_more_gauges_than_three(tmp_path: Path, printed: Printed, channel: str) -> None:
    """The record's C must be the best one for the record's covariance: a node gets A back from the two."""
    A = strain_matrix(FABRICATED, ("K_H", "S_H", "U", "L", "R"))
    store = FileStore(tmp_path / "node.json")
    device = fingertip_node(5, SimulatedSource(A.tolist(), 0.5, seed=3), 5, save=store.save, load=store.load)
    with connected(device, channel=channel) as (connection, _):
        words = ["calibrate", "guide", "--node", 5, "--auto", *FEW, *QUICK, "--session", tmp_path / "s.csv"]
        assert "by SYNC and SDO reads" in printed(0, [*words, "-i", "virtual", "-c", channel]).err
        held = connection.finger(5).calibration()
    assert held is not None
    np.testing.assert_allclose(held.C @ A, np.eye(3), atol=2e-3)
    W = np.linalg.inv(held.covariance_strain2)
    np.testing.assert_allclose(held.C, np.linalg.solve(A.T @ W @ A, A.T @ W), rtol=0.02, atol=20.0)


def test_skip_redo_and_nonsense(bench: Bench) -> None:
    keys = iter(["r", "x", "", "", "r", "", "s", *[""] * 6, "r", "", "n"])
    heard = bench.by_hand(lambda _question: next(keys), *FEW).heard
    for text in (
        "there is no capture to repeat", "'x' is not one of the keys", "step 2 of 9 is removed",
        "step 9 of 9 is removed", "1 steps were skipped", "node 5 (0x05) is unchanged",
    ):  # fmt: skip
        assert text in heard
    assert [row["step"] for row in bench.rows()] == ["1", "2", "4", "5", "6", "7", "8", "9"]
    assert bench.connection.sdo(5).read(od.CALIBRATION_ACTIVE_CRC) == 0
    assert next(keys, None) is None


def test_nobody_at_the_keys(bench: Bench) -> None:
    bench.patch.setattr(sys, "stdin", io.StringIO("\n\n"))
    assert bench.guide(*FEW) == 2
    err = bench.capsys.readouterr().err
    assert "2 of 9 steps are in" in err
    assert "end of input: the guide needs a user to hang weights" in err


def test_a_weight_that_was_forgotten_is_remarked_upon(bench: Bench) -> None:
    forgetful = {"step 2 of 9": (0.0, 0.0, 0.0), "step 6 of 9": (4.4, 90.0, 45.0)}

    def key(question: str) -> str:
        for title, load in forgetful.items():
            if title in question:
                bench.source.load = load
        return "q" if "step 7 of 9" in question else ""

    heard = bench.by_hand(key, *FEW).heard
    assert heard.count("is the weight applied? (r repeats it)") == 1
    assert heard.count("is a load still applied? (r repeats it)") == 1


@pytest.mark.parametrize(
    ("fault", "magnitude", "reason"),
    [
        (STUCK, 0.0, "stuck: SG2 reads a constant value"),
        (OPEN, 0.0, "front-end fault in .* wire break.*: check the wiring"),
        (SATURATED, 0.0, "saturated: SG2 in up to .*: use a smaller weight"),
        (SILENT, 0.0, "stale|no data"),
        (DRIFT, 400.0, r"not quiet: SG2 (drifts|scatters) by .*: "),
    ],
)
def test_a_refused_capture(bench: Bench, fault: int, magnitude: float, reason: str) -> None:
    """It is not written, the person hears why, and once the fault is gone the same step goes on."""
    asked = [0]
    sdo = bench.connection.sdo(5)

    def key(question: str) -> str:
        if "step 3 of 9" in question:
            asked[0] += 1
            sdo.write(od.SIMULATION_GAUGE, 2)
            sdo.write(od.SIMULATION_MAGNITUDE, magnitude)
            sdo.write(od.SIMULATION_FAULT, fault if asked[0] == 1 else 0)
        return "q" if "step 4 of 9" in question else ""

    assert re.search(f"refused: .*({reason})", bench.by_hand(key, *FEW, "--samples", 40).heard)
    assert asked == [2]
    assert [row["step"] for row in bench.rows()] == ["1", "2", "3"]


def test_refused_with_nobody_there_is_1(bench: Bench) -> None:
    bench.connection.sdo(5).write(od.SIMULATION_FAULT, SATURATED)
    out, err = bench.auto(code=1)
    assert out == ""
    assert err.count("refused: saturated: SG1") == 2
    assert "nothing was captured" in err
    assert not bench.session.exists()


@pytest.mark.parametrize(
    ("fault", "reason"), [(SILENT, "its sample counter (2121h) does not change"), (OPEN, "2124h = 0x0401 (wire break)")]
)
def test_a_faulty_node_is_refused_before_the_first_weight(bench: Bench, fault: int, reason: str) -> None:
    bench.connection.sdo(5).write(od.SIMULATION_FAULT, fault)
    assert reason in bench.auto(code=12).err


def test_a_node_that_goes_and_comes_back(bench: Bench) -> None:
    asked = [0]

    def step(now_us: int, _frames: object) -> tuple[list[tuple[int, bytes]], int]:
        return [], now_us + 1000

    def key(question: str) -> str:
        if "step 2 of 9" in question:  # without its plug the first time
            asked[0] += 1
            bench.device.__dict__.pop("step", None)
            if asked[0] == 1:
                bench.patch.setitem(bench.device.__dict__, "step", step)
        return "q" if "step 3 of 9" in question else ""

    assert "no capture: node 5 (0x05)" in bench.by_hand(key, *FEW, "--timeout", 0.05, "--retries", 0).heard
    assert len(bench.rows()) == 2


def test_a_line_that_was_cut_short(bench: Bench) -> None:
    bench.auto()
    lines = bench.session.read_text().splitlines(keepends=True)
    bench.session.write_text("".join(lines[:4]) + lines[4][:30])
    assert "its last line was truncated by an interruption and is removed" in bench.auto().err
    assert [row["step"] for row in bench.rows()] == ["1", "2", "3", "extra", "4", "5", "6", "7", "8", "9"]


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (",4.4,", ",4.5,", "line 3: step 2 is 4.5 N at phi 0, theta 30 degrees, pull, in this plan it is 4.4 N at"),
        (",pull,2,", ",pull,17,", r"line 3: step 17 \(4.4 N .*\), this plan has 9 steps: another plan"),
        (",pull,2,", ",pull,extra,", "line 3: an extra step is 4.4 N at phi 0, theta 30 degrees, pull"),
        (",1005,", ",1006,", "of the node with serial 1006, this one has serial 1005"),
        (",pull,2,", ",pull,two,", "line 3: not a line of a session"),
        (",pull,2,", ",twist,2,", "line 3: mode is 'twist', allowed: push, pull, tare or blank; correct that line"),
        ("SG1,SG2,SG3", "SG1,SG2,SG3,SG4", "it has 4 gauges, the node has 3"),
        ("step,serial", "step,number", r"not a session file \(the column serial is missing\)"),
        ("t_s,SG1", "SG1,t_s", "the columns are not those of a session"),
    ],
)
def test_a_session_that_does_not_belong_here(bench: Bench, old: str, new: str, reason: str) -> None:
    bench.auto()
    wrong = bench.session.read_text().replace(old, new)
    bench.session.write_text(wrong)
    err = bench.auto(code=2).err
    assert re.search(f"session .*{reason}", err), err
    assert bench.session.read_text() == wrong


class RealGauges(Source):
    """A converter that is no simulation."""

    def read(self, now_us: int) -> Reading:
        return Reading((1, 2, now_us % 7), 0, 2300)


def test_no_auto_with_real_gauges(printed: Printed, tmp_path: Path, channel: str) -> None:
    with connected(fingertip_node(5, RealGauges()), channel=channel):
        err = printed(2, f"calibrate guide --node 5 --auto --session {tmp_path}/s.csv -i virtual -c {channel}").err
    assert "node 5 (0x05) has real gauges: --auto needs a simulated node" in err
