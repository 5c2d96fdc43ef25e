"""Only what a scene names is built, computed, sent and imported; and scenes in real time on a bus of python-can's."""

import functools
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import can
import pytest
from can.interfaces.virtual import VirtualBus
from msgspec.structs import replace

from tipforce import EnvironmentLackError
from tipforce.host.network.interfaces import open_bus
from tipforce.scene import Outcome, Scene, parts, read_scene, realtime, run_scene
from tipforce.scene.registry import identifiers
from tipforce.scene.schema import Bus, Outputs

SCENES = Path(__file__).parents[2] / "scenes"
PATHS = sorted(SCENES.glob("*.toml"))
FOREIGN = (
    "msgspec", "numpy", "matplotlib", "can", "scipy", "canopen", "cantools", "rich", "skfem", "pyarrow", "mujoco",
    "gymnasium", "cyclonedds", "mcap",
)  # fmt: skip
NODE = "duration_s = 0.05\nsync_hz = 100\n[[nodes]]\nids = [9]\n"
# Scenes of a few lines, for what the files in scenes/ do not show.
SMALL = {
    "nothing": 'duration_s = 0.05\n[[nodes]]\nids = [9]\npdos = []\ncalibration = "none"\n',
    "gauges of an uncalibrated node": NODE + 'pdos = ["gauges"]\ncalibration = "none"\n',
    "gauges without status": NODE + 'pdos = ["gauges"]\nstatus = false\n',
    "force without status": NODE + 'pdos = ["force"]\nstatus = false\n'
    '[[loads]]\nkind = "static"\nP_N = 1.0\nphi_deg = -90\ntheta_deg = 80\n',
    "gauges with status": NODE + 'pdos = ["gauges"]\n',
    "health alone": 'duration_s = 1.5\n[[nodes]]\nids = [9]\npdos = ["health"]\nheartbeat_ms = 100\n',
}


def run_child(path: Path, folder: Path) -> dict[str, Any]:
    words = [sys.executable, str(Path(__file__).with_name("lean_child.py")), str(path), ""]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == 0, done.stderr
    told: dict[str, Any] = json.loads(done.stdout)
    return told


@functools.cache
def packages_of(foreign: tuple[str, ...]) -> frozenset[str]:
    """Top-level packages in memory after these, and a figure where matplotlib is among them."""
    code = "import sys\n" + "".join(f"import {name}\n" for name in foreign)
    if "matplotlib" in foreign:
        code += "import matplotlib.pyplot as plt, io\nplt.savefig(io.BytesIO(), format='png')\n"
    code += "print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return frozenset(done.stdout.split())


def check_lean(scene: Scene, told: dict[str, Any]) -> None:
    """Modules, parts and COB-IDs are those that explain names, no more and no fewer."""
    built = [part for part in parts(scene) if part.built]
    declared = {module for part in built for module in part.modules}
    on_demand = {module for part in built for module in part.on_demand}
    named = {name for name in declared if name.startswith(("tipforce", "canopen_device"))}
    compiled = {"tipforce._core"}  # beside tipforce.core where it was built
    assert set(told["modules"]) - on_demand - compiled == named - on_demand
    assert named <= set(told["modules"])
    foreign = tuple(sorted(name for name in declared if name in FOREIGN))
    assert set(told["packages"]) & set(FOREIGN) == set(foreign)
    # The packages themselves are free to load what they like; nothing may come from elsewhere.
    assert ("random" in told["packages"]) == ("random" in declared or "random" in packages_of(foreign))

    in_node = {"force in the node", "contact in the node", "spare gauges"}
    assert set(told["built"]) == {part.name for part in built} - in_node
    for name in ("force", "contact"):
        assert (told["calls"][name] > 0) == (f"{name} in the node" in {part.name for part in built}), name

    sent = {int(can_id) for can_id in told["frames"]}
    emcy = {0x80 + int(node_id) for node_id, codes in told["emcy"].items() if codes}
    assert sent == {one.can_id for one in identifiers(scene)} | emcy


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_a_scene_is_what_it_names(path: Path, tmp_path: Path) -> None:
    scene = read_scene(path)
    told = run_child(path, tmp_path)
    check_lean(scene, told)
    assert told["failed"] == []
    for one in identifiers(scene):
        if one.rate_hz == scene.sync_hz:
            assert told["frames"][str(one.can_id)] == told["syncs"]
    written = {name for name in (scene.outputs.log, scene.outputs.table, scene.outputs.plot) if name}
    assert {file.name for file in tmp_path.iterdir()} == written


@pytest.mark.parametrize("name", SMALL)
def test_a_small_scene_is_what_it_names(name: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(SMALL[name])
    check_lean(read_scene(path), run_child(path, tmp_path))


def test_what_does_without_a_lost_gauge_is_loaded_when_one_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    text = SMALL["gauges with status"].replace("ids = [9]", 'ids = [9]\nlayout = ["K_H", "S_H", "U", "L"]')
    for more, loaded in (("", False), ('[[faults]]\nkind = "open"\nnodes = [9]\nat_s = 0.02\n', True)):
        path.write_text(text + more)
        told = run_child(path, tmp_path)
        check_lean(read_scene(path), told)
        assert ("tipforce.sensor.contact.scalar_redundancy" in told["modules"]) == loaded


def test_full_names_every_part_but_the_bus_and_static_the_fewest() -> None:
    by_name = {path.stem: [part.name for part in parts(read_scene(path)) if part.built] for path in PATHS}
    every = {part.name for part in parts(read_scene(PATHS[0]))}
    assert every - set(by_name["full"]) == {"bus", "calibration file", "spare gauges"}
    assert all(set(by_name["static"]) <= set(names) for names in by_name.values())
    assert len(by_name["static"]) < min(len(names) for stem, names in by_name.items() if stem != "static")


@pytest.mark.parametrize("bus", [None, Bus(interface="virtual", channel="test-scene-realtime")])
def test_a_hand_on_a_bus(bus: Bus | None, tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    scene = read_scene(SCENES / "grasp.toml")
    outcome = run_scene(replace(scene, bus=bus, outputs=Outputs(log=str(path))), SCENES, 0.45, realtime=True)
    assert "bus" in outcome.built
    expected = {0x000, 0x080, *range(0x181, 0x186), *range(0x281, 0x286), *range(0x701, 0x706)}
    assert set(outcome.frames_by_id) == expected
    assert outcome.frames_by_id[0x080] == outcome.syncs == 225
    for finger in outcome.fingers:
        assert finger.samples == 225
        # The load moves on in real time: where the machine is late, so is the host's SYNC, and the error is its own.
        assert finger.known[0] >= 1
    stamps = [float(line[1:18]) for line in path.read_text().splitlines()]
    assert stamps == sorted(stamps)
    assert stamps[-1] >= 0.44


def test_an_answer_that_is_sent_at_the_end_of_a_wait_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    master, port, slept = realtime._Master(Mock()), Mock(answered=0), list[float]()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        port.answered = 1
        if len(slept) == 2:
            master(can.Message(arbitration_id=0x185))

    monkeypatch.setattr(realtime, "time", SimpleNamespace(sleep=sleep))
    master.syncs = 1
    master.settle(port)
    assert len(slept) == 3


def test_faults_come_on_a_bus_too() -> None:
    outcome = run_scene(read_scene(SCENES / "dying-gauge.toml"), SCENES, 1.7, realtime=True)
    assert [list(finger.emcy) for finger in outcome.fingers] == [["5030", "5010"]] * 2


class FailingBus(VirtualBus):
    """The host's end of the bus, which is down while ``down`` says so of the number of frames that it has sent."""

    down: Callable[[int], bool]
    count = 0

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.count += 1
        if self.down(self.count):
            raise can.CanOperationError("Network is down")
        super().send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.down(self.count):
            raise can.CanOperationError("Network is down")
        return super()._recv_internal(timeout)


def run_with_outage(monkeypatch: pytest.MonkeyPatch, path: Path, down: Callable[[int], bool]) -> Outcome:
    def opened(**options: Any) -> can.BusABC:
        monkeypatch.setattr(realtime, "open_bus", open_bus)  # the nodes' end stays up
        bus = FailingBus(options["channel"])
        bus.down = down
        return bus

    monkeypatch.setattr(realtime, "open_bus", opened)
    scene = replace(read_scene(SCENES / "grasp.toml"), outputs=Outputs(log=str(path)))
    return run_scene(scene, SCENES, 0.6, realtime=True)


def test_a_bus_that_comes_back_is_recorded_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "run.log"
    outcome = run_with_outage(monkeypatch, path, lambda count: 50 <= count < 150)
    assert "100 SYNCs were not sent while the bus was down" in caplog.text
    assert caplog.text.count("the bus failed: Network is down") == 1
    assert (outcome.frames_by_id[0x080], outcome.syncs) == (200, 300)
    assert all(195 <= finger.samples <= 200 for finger in outcome.fingers)
    late = [line for line in path.read_text().splitlines() if float(line[1:18]) > 0.4 and " 281#" in line]
    assert len(late) > 50, "PDOs after the outage"


def test_a_bus_that_stays_down_is_an_error_with_what_was_heard(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    with pytest.raises(EnvironmentLackError, match="the bus failed and did not recover: Network is down; the log has"):
        run_with_outage(monkeypatch, path, lambda count: count >= 100)
    assert len([line for line in path.read_text().splitlines() if " 080#" in line]) == 98


def test_a_bus_that_is_not_there() -> None:
    scene = read_scene(SCENES / "static.toml")
    bus = Bus(interface="socketcan", channel="nosuchcan9")
    with pytest.raises(EnvironmentLackError, match="nosuchcan9"):
        run_scene(replace(scene, bus=bus), SCENES)
