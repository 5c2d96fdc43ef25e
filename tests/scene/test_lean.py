"""What a scene does not name is not built, not computed, not sent, not imported; and every scene does what it says.

Each scene of scenes/ runs in a Python of its own, and what `tipforce run --explain` tells is held against it.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tipforce.scene.reader import read_scene
from tipforce.scene.registry import identifiers, parts
from tipforce.scene.schema import Scene

ROOT = Path(__file__).parents[2]
SCENES = sorted((ROOT / "scenes").glob("*.toml"))
FOREIGN = (
    "msgspec", "numpy", "matplotlib", "can", "scipy", "canopen", "cantools", "rich", "skfem", "pyarrow", "mujoco",
    "gymnasium", "cyclonedds", "mcap",
)  # fmt: skip
# Scenes of a few lines, for what the files in scenes/ do not show.
SMALL = {
    "nothing": 'duration_s = 0.05\n[[nodes]]\nids = [9]\npdos = []\ncalibration = "none"\n',
    "gauges of an uncalibrated node": (
        'duration_s = 0.05\nsync_hz = 100\n[[nodes]]\nids = [9]\npdos = ["gauges"]\ncalibration = "none"\n'
    ),
    "gauges without status": (
        'duration_s = 0.05\nsync_hz = 100\n[[nodes]]\nids = [9]\npdos = ["gauges"]\nstatus = false\n'
    ),
    "force without status": (
        'duration_s = 0.05\nsync_hz = 100\n[[nodes]]\nids = [9]\npdos = ["force"]\nstatus = false\n'
        '[[loads]]\nkind = "static"\nP_N = 1.0\nphi_deg = -90\ntheta_deg = 80\n'
    ),
    "gauges with status": 'duration_s = 0.05\nsync_hz = 100\n[[nodes]]\nids = [9]\npdos = ["gauges"]\n',
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


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
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
    by_name = {path.stem: [part.name for part in parts(read_scene(path)) if part.built] for path in SCENES}
    every = {part.name for part in parts(read_scene(SCENES[0]))}
    assert every - set(by_name["full"]) == {"bus", "calibration file", "spare gauges"}
    assert all(set(by_name["static"]) <= set(names) for names in by_name.values())
    assert len(by_name["static"]) < min(len(names) for stem, names in by_name.items() if stem != "static")
