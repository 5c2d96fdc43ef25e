"""A scene on a bus of python-can's: the frames that a host hears, in real time."""

from __future__ import annotations

from pathlib import Path

import pytest

from tipforce.errors import EnvironmentLackError
from tipforce.scene.run import Options, run_scene
from tipforce.scene.schema import Bus, read_scene

SCENES = Path(__file__).parents[2] / "scenes"


@pytest.mark.parametrize("bus", [None, Bus(interface="virtual", channel="test-scene-realtime")])
def test_a_hand_on_a_bus(bus: Bus | None, tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    scene = read_scene(SCENES / "grasp.toml")
    options = Options(duration_s=0.45, bus=bus, realtime=True, log=str(path))
    outcome = run_scene(scene, SCENES, options)
    assert "bus" in outcome.built
    expected = {0x000, 0x080, *range(0x281, 0x286), *range(0x701, 0x706)}
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


def test_a_bus_that_is_not_there() -> None:
    scene = read_scene(SCENES / "static.toml")
    bus = Bus(interface="socketcan", channel="nosuchcan9")
    with pytest.raises(EnvironmentLackError, match="nosuchcan9"):
        run_scene(scene, SCENES, Options(bus=bus))
