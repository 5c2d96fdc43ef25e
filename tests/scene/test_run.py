"""Running a scene: the same seed gives the same bytes, and every estimate comes from the frames."""

import math
import random
import re
import struct
from datetime import UTC, datetime
from pathlib import Path

import can
import numpy as np
import pytest
from msgspec.structs import replace

from tipforce import Calibration, InputError
from tipforce.host import write_calibration
from tipforce.scene import Outcome, Scene, read_scene, run_scene
from tipforce.scene.registry import bus_load, identifiers
from tipforce.scene.schema import Outputs
from tipforce.sensor import FABRICATED, calibration_matrix
from tools.blocks import block_of_text

SCENES = Path(__file__).parents[2] / "scenes"


def run(scene: Scene, duration_s: float | None = None, log: Path | None = None) -> Outcome:
    return run_scene(scene if log is None else replace(scene, outputs=Outputs(log=str(log))), SCENES, duration_s)


def scene_of(tmp_path: Path, text: str) -> Scene:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return read_scene(path)


@pytest.mark.parametrize("stem", ["grasp", "full", "dying-gauge"])
def test_the_same_seed_gives_the_same_log_byte_for_byte(stem: str, tmp_path: Path) -> None:
    scene = replace(read_scene(SCENES / f"{stem}.toml"), expect=())
    logs = []
    for name, seed in (("one", 5), ("two", 5), ("other", 6)):
        path = tmp_path / name
        run(replace(scene, seed=seed), 0.7, path)
        logs.append(path.read_bytes())
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]


def test_no_random_number_is_drawn_without_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> float:
        raise AssertionError("a random number was drawn")

    for name in ("random", "gauss", "getrandbits"):
        monkeypatch.setattr(random.Random, name, fail)
    for stem in ("static", "tap", "overload", "drift"):
        assert run(read_scene(SCENES / f"{stem}.toml")).ok
    with pytest.raises(AssertionError, match="a random number was drawn"):
        run(read_scene(SCENES / "grasp.toml"))


def test_the_log_is_what_was_decoded_and_opens_in_python_can(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    outcome = run(read_scene(SCENES / "grasp.toml"), 0.5, path)
    block = block_of_text(path.read_text())
    ids, counts = np.unique(block.frames["can_id"], return_counts=True)
    assert dict(zip(ids.tolist(), counts.tolist(), strict=True)) == outcome.frames_by_id
    with can.LogReader(path) as reader:
        assert sum(1 for _ in reader) == sum(outcome.frames_by_id.values())


def test_frames_of_one_sync_come_in_order(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    run(replace(read_scene(SCENES / "grasp.toml"), start=datetime(2026, 1, 1, 0, 0, 0, 250_000, UTC)), 0.004, path)
    heads = [line.rpartition("#")[0] for line in path.read_text().splitlines()]
    nodes = range(1, 6)
    boot = [f"(1767225600.250000) sim0 70{k}" for k in nodes] + ["(1767225600.250000) sim0 000"]
    syncs = [
        [f"(1767225600.25{t}000) sim0 080", *(f"(1767225600.25{t}000) sim0 {pdo}8{k}" for k in nodes for pdo in (1, 2))]
        for t in (2, 4)
    ]
    assert heads == boot + syncs[0] + syncs[1]


def test_errors_are_what_the_frames_say_against_the_load(tmp_path: Path) -> None:
    """The same figures again, from the log alone, by a decoder written down here."""
    path = tmp_path / "run.log"
    scene = replace(read_scene(SCENES / "grasp.toml"), expect=())
    outcome = run(scene, log=path)
    for finger in outcome.fingers:
        load = scene.load(finger.node_id)
        assert load is not None
        errors: list[list[float]] = [[], [], []]
        known = [0, 0, 0]
        for stamp, data in re.findall(rf"\(1767225(6.*)\) sim0 28{finger.node_id}#(.*)", path.read_text()):
            applied = load.at(float(stamp) - 600.0)
            for k, raw in enumerate(struct.unpack_from("<3h", bytes.fromhex(data))):
                known[k] += raw != -0x8000
                if raw != -0x8000 and (k == 0 or applied[0] > 0.0):
                    error = raw / (100.0 if k else 1000.0) - applied[k]
                    errors[k].append((error + 180.0) % 360.0 - 180.0 if k else error)
        assert tuple(known) == finger.known
        rms = [math.sqrt(sum(e * e for e in column) / len(column)) for column in errors]
        assert finger.rms_error == pytest.approx(rms, rel=1e-9, abs=1e-12)
        assert finger.max_error == pytest.approx([max(map(abs, column)) for column in errors], rel=1e-9, abs=1e-12)


def test_a_direction_without_a_force_has_no_error() -> None:
    """Node 2 of `drift` is never loaded: P leaves zero, and the direction of that is compared with nothing."""
    loaded, unloaded = run(replace(read_scene(SCENES / "drift.toml"), expect=())).fingers
    assert all(map(math.isfinite, (*loaded.applied_end, *loaded.rms_error, *loaded.max_error)))
    assert unloaded.known[1] > 0  # the node does say a direction
    for triple in (unloaded.applied_end, unloaded.rms_error, unloaded.max_error):
        assert math.isfinite(triple[0])
        assert all(map(math.isnan, triple[1:]))


TWO = """
duration_s = 0.2
sync_hz = 100
[[nodes]]
ids = [3]
pdos = ["gauges", "contact", "force"]
status = false
[[loads]]
kind = "static"
P_N = 1.0003
phi_deg = -90
theta_deg = 80
"""


def test_a_mapping_without_status_is_decoded_too(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, TWO)
    assert {one.data_bytes for one in identifiers(scene) if one.rate_hz} == {0, 7}
    (finger,) = run(scene).fingers
    assert finger.known == (20, 20, 20)
    assert finger.max_error[0] <= 0.002


def test_an_uncalibrated_node_knows_nothing_and_says_why(tmp_path: Path) -> None:
    bounds = "[[expect]]\nP_error_N = 1\ntheta_rms_deg = 1\n"
    outcome = run(scene_of(tmp_path, TWO.replace("status = false", 'calibration = "none"') + bounds))
    assert [check.ok for check in outcome.checks] == [False, False], "a bound that no sample could break does not hold"
    (finger,) = outcome.fingers
    assert finger.known == (0, 0, 0)
    assert finger.missing == {"not calibrated": 20}
    assert math.isnan(finger.rms_error[0])


@pytest.mark.parametrize(
    ("expect", "ok"),
    [
        ("P_error_N = 0.01", True), ("P_error_N = 1e-9", False), ("P_rms_N = 1e-9", False),
        ("P_known_at_least = 1.0", True), ("P_known_at_most = 0.5", False), ('status_seen = ["saturated"]', False),
        ('status_never = ["contact"]', False), ('emcy_seen = ["5030"]', False), ("emcy_none = true", True),
    ],
)  # fmt: skip
def test_expectations_hold_or_do_not(tmp_path: Path, expect: str, ok: bool) -> None:
    outcome = run(scene_of(tmp_path, TWO.replace("status = false", "") + f"[[expect]]\n{expect}\n"))
    assert [check.ok for check in outcome.checks] == [ok]
    assert outcome.ok == ok


def test_without_a_sample_nothing_is_known_to_stay_clear(tmp_path: Path) -> None:
    text = TWO.replace("1.0003", "100.0").replace("status = false", "").replace('"gauges", "contact", "force"', "PDO")
    for pdo, times in (('"contact"', "from_s = 0.001\nto_s = 0.009"), ('"gauges"', "")):
        expect = f'[slit]\n[[expect]]\nstatus_never = ["saturated"]\nslit_closes = false\n{times}\n'
        checks = run(scene_of(tmp_path, text.replace("PDO", pdo) + expect)).checks
        assert [check.ok for check in checks] == [False, False]


def test_health_and_heartbeat_come_at_their_own_times(tmp_path: Path) -> None:
    text = 'duration_s = 2.5\n[[nodes]]\nids = [3]\npdos = ["health"]\nheartbeat_ms = 500\ncalibration = "none"\n'
    outcome = run(scene_of(tmp_path, text))
    # One health PDO when the node becomes operational, then one a second; boot-up and five heartbeats.
    assert outcome.frames_by_id == {0x703: 6, 0x000: 1, 0x483: 3}


def test_a_fault_begins_and_ends_at_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.csv"
    monkeypatch.chdir(tmp_path)
    text = TWO.replace("status = false", "") + (
        '[[faults]]\nkind = "open"\nnodes = [3]\nat_s = 0.05\nuntil_s = 0.1\n[outputs]\ntable = "run.csv"\n'
    )
    run(scene_of(tmp_path, text))
    header, *rows = (line.split(",") for line in path.read_text().splitlines())
    records = [dict(zip(header, row, strict=True)) for row in rows]
    contact = [record for record in records if record["message"] == "Contact"]
    assert [float(record["t_s"]) for record in contact if record["fault"] == "1"] == [0.05, 0.06, 0.07, 0.08, 0.09]
    assert all((record["P"] == "") == (record["fault"] == "1") for record in contact)
    assert [float(record["P"]) for record in contact if record["P"]] == pytest.approx([1.0] * 15, abs=2e-3)


def test_the_tip_swings_as_an_independent_integration_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first mode of an undamped tip under a step that dynamics sees: P overshoots to nearly twice."""
    text = """
    duration_s = 0.2
    sync_hz = 2000
    [[nodes]]
    ids = [1]
    pdos = ["contact"]
    [[loads]]
    kind = "history"
    t_s = [0.0, 0.02, 0.02]
    P_N = [0.0, 0.0, 2.0]
    phi_deg = 90
    theta_deg = 90
    [dynamics]
    damping_ratio = 0.0
    step_us = 50
    """
    path = tmp_path / "run.csv"
    monkeypatch.chdir(tmp_path)
    run(scene_of(tmp_path, text + '[outputs]\ntable = "run.csv"\n'))
    P = [float(line.split(",")[3]) for line in path.read_text().splitlines()[1:]]
    assert max(P[:39]) == 0.0
    assert 3.9 < max(P) < 4.01


@pytest.mark.parametrize("duration_s", [0.0, -1.0, math.nan])
def test_a_duration_that_is_not_allowed(duration_s: float) -> None:
    with pytest.raises(InputError, match=f"--duration {duration_s:g}: allowed are more than 0"):
        run(read_scene(SCENES / "static.toml"), duration_s)


def test_the_bus_load_is_that_of_the_standard_frame() -> None:
    """Ten PDOs and a SYNC at 500 Hz: 500 (10 x 111 + 47) bit/s without stuff bits, and 135 and 55 with all."""
    low, high = bus_load(read_scene(SCENES / "grasp.toml"))
    assert low == pytest.approx(500 * (10 * 111 + 47) / 1e6)
    assert high == pytest.approx(500 * (10 * 135 + 55) / 1e6)


def test_a_calibration_file_beside_the_scene(tmp_path: Path) -> None:
    C = calibration_matrix(FABRICATED, "I")
    write_calibration(tmp_path / "cal.toml", Calibration(2.0 * C, np.zeros(3), 1e-14 * np.eye(3)))
    outcome = run_scene(scene_of(tmp_path, TWO.replace("status = false", 'calibration = "cal.toml"')), tmp_path)
    assert "calibration file" in outcome.built
    assert outcome.fingers[0].estimated_end[0] == pytest.approx(2.0, abs=0.003)
    refused = Calibration(np.diag([1e6, 1e6, 50.0]), np.zeros(3), 1e-14 * np.eye(3))
    write_calibration(tmp_path / "refused.toml", refused)  # the node's own condition limit (2105h:1)
    write_calibration(tmp_path / "II.toml", Calibration(C, np.zeros(3), 1e-14 * np.eye(3), layout_code=2))
    for keys, message in (
        ('calibration = "II.toml"', "calibration II.toml: it is for another layout, the node has I"),
        ('calibration = "no-such.toml"', "no-such"),
        ('layout = ["K_H", "S_H", "U", "T"]\ncalibration = "cal.toml"', "it is for 3 gauges, the layout has 4"),
        ('calibration = "refused.toml"', "node 3 rejects 0x2104:00: abort 0x06090031"),
    ):
        with pytest.raises(InputError, match=message):
            run_scene(scene_of(tmp_path, TWO.replace("status = false", keys)), tmp_path)
