"""A scene on a bus of python-can's: the frames that a host hears, in real time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import pytest
from can.interfaces.virtual import VirtualBus

from tipforce.errors import EnvironmentLackError
from tipforce.host.network.open_bus import open_bus
from tipforce.scene import realtime
from tipforce.scene.reader import read_scene
from tipforce.scene.run import Options, Outcome, run_scene
from tipforce.scene.schema import Bus

SCENES = Path(__file__).parents[2] / "scenes"


@pytest.mark.parametrize("bus", [None, Bus(interface="virtual", channel="test-scene-realtime")])
def test_a_hand_on_a_bus(bus: Bus | None, tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    scene = read_scene(SCENES / "grasp.toml")
    options = Options(duration_s=0.45, bus=bus, realtime=True, log=str(path))
    outcome = run_scene(scene, SCENES, options)
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


def test_faults_come_on_a_bus_too() -> None:
    scene = read_scene(SCENES / "dying-gauge.toml")
    outcome = run_scene(scene, SCENES, Options(duration_s=1.7, realtime=True))
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
    return run_scene(read_scene(SCENES / "grasp.toml"), SCENES, Options(duration_s=0.6, realtime=True, log=str(path)))


def test_a_bus_that_comes_back_is_recorded_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "run.log"
    outcome = run_with_outage(monkeypatch, path, lambda count: 50 <= count < 150)
    assert "100 SYNCs were not sent while the bus was down" in caplog.text
    assert caplog.text.count("the bus failed: Network is down") == 1
    assert (outcome.frames_by_id[0x080], outcome.syncs) == (200, 300)
    assert all(195 <= finger.samples <= 200 for finger in outcome.fingers)
    lines = path.read_text().splitlines()
    late = [line for line in lines if float(line[1:18]) > 0.4 and " 281#" in line]
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
        run_scene(scene, SCENES, Options(bus=bus))
