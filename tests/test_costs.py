"""What ten named paths cost, as numbers of calls: no seconds, so that other work on the machine changes nothing.

    python tests/test_costs.py                   the table of BASELINE, to be copied here after a change that is wanted
    python tests/test_costs.py --instructions    instructions of a unit by valgrind, for `make long`; half an hour

Calls of functions of the product, and calls of C functions in them, count. Comprehensions do not: later versions of
Python do not call them. Paths with a body in the compiled core cost less with it."""

import json
import os
import re
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from tipforce.core import core as built_core

Works = Iterator[tuple[str, int, Callable[[], object]]]
"""(name and unit of a path, units, what does them)."""

ROOT = Path(__file__).parents[1]
FOLDERS = f"{ROOT}/node/", f"{ROOT}/tools/"
EDS, SCENE = ROOT / "eds" / "tipforce-3.eds", ROOT / "scenes" / "static.toml"
TOLERANCE = 0.10
BASELINE: dict[str, tuple[float, float]] = {
    "node, a SYNC": (76, 76),
    "node, its two PDOs packed once more": (12, 12),
    "SDO upload of 7 kB by segments": (38100, 38100),
    "SDO upload of 7 kB by blocks": (18314, 18314),
    "Estimator, a reading": (71.52, 71.52),
    "Estimator, 1000 readings at once": (117, 117),
    "a log of 5000 frames read": (182926, 2746),
    "a live row of five fingers": (25.96, 25.96),
    "an EDS loaded": (161381, 161381),
    "a scene, 100 steps": (15194, 15194),
}
"""Calls of a unit: without the compiled core, with it."""


def node_paths() -> Works:
    from canopen_device.core.sdo_client import BlockUpload
    from canopen_device.testing import Conversation
    from tipforce.fingertip import fingertip_node
    from tipforce.scene.delivered import CALIBRATION, beam_calibration, stored_calibration
    from tipforce.sources.simulated import SimulatedSource

    source = SimulatedSource([[3e-5, 0.0, 0.0], [0.0, 3e-5, 0.0], [0.0, 0.0, 3e-5]], 0.2, seed=1)
    source.load = (2.0, 90.0, 80.0)
    stored = {CALIBRATION: stored_calibration(beam_calibration("I"))}
    node = Conversation(fingertip_node(1, source, load=stored.get, eds=EDS.read_bytes()[:7000]))
    node.nmt(1)
    pdos = node.device.tpdos._pdos[:2]

    def syncs() -> None:
        for _ in range(100):
            node.now_us += 1000
            node.device.step(node.now_us, [(0x80, b"")])

    yield "node, a SYNC", 100, syncs
    yield "node, its two PDOs packed once more", 100, lambda: [pdo.pack() for _ in range(100) for pdo in pdos]
    yield "SDO upload of 7 kB by segments", 1, lambda: node.upload(0x1021)
    yield "SDO upload of 7 kB by blocks", 1, lambda: node.upload(0x1021, 0, BlockUpload)


def host_paths(folder: Path) -> Works:
    import numpy as np

    from canopen_device.eds.reader import read_eds
    from tipforce import Estimator, read_log
    from tipforce.host.frames.frame_array import frame_array
    from tipforce.host.hand.rows import Collector, rows_one_by_one
    from tipforce.samples.record import RowContacts
    from tipforce.scene.build import build
    from tipforce.scene.delivered import beam_calibration
    from tipforce.scene.reader import read_scene
    from tipforce.scene.run import simulate

    estimator, gauges = Estimator(beam_calibration("I")), np.random.default_rng(1).normal(0.0, 300.0, (1000, 3))
    readings = gauges[:50].tolist()
    yield "Estimator, a reading", 50, lambda: [estimator(reading) for reading in readings]
    yield "Estimator, 1000 readings at once", 1, lambda: estimator(gauges)
    frames = [
        (10**9 + 10**6 * (k // 5), 0x281 + k % 5, struct.pack("<hhhBB", 900, 9000, 8000, 3, k // 5 & 255))
        for k in range(5000)
    ]
    log, fingers = folder / "run.log", range(1, 6)
    contacts = RowContacts(fingers, ["thumb", "index", "middle", "ring", "little"])
    log.write_text("".join(f"({t / 1e9:.6f}) can0 {can_id:03X}#{data.hex()}\n" for t, can_id, data in frames))
    yield "a log of 5000 frames read", 1, lambda: read_log(log)

    def live() -> None:
        collector = Collector(fingers)
        for k in range(0, 500, 5):
            rows = collector.add(frame_array(frames[k : k + 5]), frames[k][0] / 1e9)
            assert {row["thumb"].P_newtons for row in rows_one_by_one(rows, contacts)} <= {0.9}

    yield "a live row of five fingers", 100, live
    yield "an EDS loaded", 1, lambda: read_eds(EDS, 5)
    scene = read_scene(SCENE)
    yield "a scene, 100 steps", 1, lambda: simulate(scene, build(scene, folder), 0.1, lambda *_: None, lambda _: None)


def paths() -> Works:
    with tempfile.TemporaryDirectory() as folder:
        yield from node_paths()
        yield from host_paths(Path(folder))


def calls(work: Callable[[], object]) -> int:
    """Return the calls that count, of the second run: the first imports and compiles."""
    work()
    count = 0

    def event(frame: FrameType, what: str, _argument: Any) -> None:
        nonlocal count
        code = frame.f_code
        if what == "c_call" or (what == "call" and not re.match("<(list|dict|set|gen)", code.co_name)):
            count += code.co_filename.startswith(FOLDERS)

    sys.setprofile(event)
    work()
    sys.setprofile(None)
    return count


def output(core: bool, *words: str) -> str:
    """Return what this program prints, with or without the compiled core."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "TIPFORCE_NO_CORE": "" if core else "1"}
    done = subprocess.run([*words[1:], sys.executable, __file__, words[0]], env=environment | {"PYTHONHASHSEED": "0"},
                          capture_output=True, text=True, check=True)  # fmt: skip
    return done.stdout + done.stderr


@pytest.mark.parametrize("core", [False, True], ids=["Python", "core"])
def test_no_path_costs_a_tenth_more_or_less_than_in_the_table(core: bool) -> None:
    if core and built_core is None:
        pytest.skip("the compiled core is not built")
    now = json.loads(output(core, "--json"))
    table = {name: counts[core] for name, counts in BASELINE.items()}
    off = {name: count for name, count in now.items() if abs(count / table.get(name, 1e-9) - 1.0) > TOLERANCE}
    assert not off, f"calls: {off}; where it is wanted: python tests/test_costs.py, and copy its table to BASELINE"
    assert list(now) == list(table)


def main(word: str = "") -> None:
    if word == "--json":
        print(json.dumps({name: calls(work) / units for name, units, work in paths()}))
    elif word == "--instructions":
        with tempfile.TemporaryDirectory() as folder:
            valgrind = "valgrind", "--tool=callgrind", f"--callgrind-out-file={folder}/out"
            for name, units, _ in paths():
                texts = [output(True, f"{name}*{runs}", *valgrind) for runs in (11, 1)]
                most, least = (int(text.split("Collected :")[1].split()[0]) for text in texts)
                print(f"{name:40}{(most - least) / 10 / units:15,.0f} instructions", flush=True)
    elif word:
        name, _, runs = word.partition("*")
        work = next(work for path, _, work in paths() if path == name)
        for _ in range(int(runs)):
            work()
    else:
        python, core = (json.loads(output(core, "--json")) for core in (False, True))
        print("\n".join(f'    "{name}": ({python[name]:g}, {core[name]:g}),' for name in python))


if __name__ == "__main__":
    main(*sys.argv[1:])
