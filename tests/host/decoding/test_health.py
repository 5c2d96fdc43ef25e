"""2124h as TPDO4, EMCY and boot-ups tell it: what the host understands is what the node has."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fingertip.finger import PUSH, Finger
from fingertip.test_judgement import drift, redundant
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.decoding.health import ALL, TOLD_BY_EMCY, Health, of_emcy
from tipforce.host.decoding.log import read_log
from tipforce.host.frames.frame_array import FrameArray, frame_array
from tipforce.samples import reasons
from tipforce.samples.columns import contact_values
from tipforce.samples.reasons import Status
from tipforce.scene import beam_calibration
from tipforce.sensor.contact.estimate import force_vector
from tipforce_tools.cli.main import main

GAUGES = 8


def frames(sent: list[tuple[int, bytes]], t_ns: int) -> FrameArray:
    return frame_array([(t_ns, *frame) for frame in sent])


def followed(talk: Finger, health: Health, decoder: Decoder, syncs: int) -> int:
    """Let the host follow some SYNCs; 2124h of the node at the end."""
    for _ in range(syncs):
        talk.now_us += 1000
        talk.step([(0x80, b"")])
        sent = frames(talk.take(), 1000 * talk.now_us)
        health.take(sent, decoder.decode(sent).values())
    application: Any = talk.device.application
    faults: int = application.sample.faults
    return faults


def test_the_host_follows_emcy_and_tpdo4() -> None:
    for with_tpdo4 in (False, True):
        talk = redundant(GAUGES, emcy=True)
        if with_tpdo4:
            assert talk.put("I", 0x1803, 1, 0x40000485) == 0
        health, decoder = Health(), Decoder(GAUGES)
        followed(talk, health, decoder, 5)
        seen = 0
        for gauge, microstrain in ((3, 50.0), (3, 0.0), (0, 50.0), (1, 50.0), (1, 0.0)):
            drift(talk, gauge, microstrain)
            faults = followed(talk, health, decoder, 150)  # 100 ms after the last contradiction it has ended
            assert health.now(5)[0] == faults
            seen |= faults
        assert seen >> 12 & 1
        assert health.now(5)[1] == (ALL if with_tpdo4 else seen)
        talk.source.load = (40.0, *PUSH[1:])
        faults = followed(talk, health, decoder, 150)
        assert health.now(5)[0] == faults


def test_a_boot_up_ends_what_was_told() -> None:
    health = Health()
    contradiction, over = struct.pack("<HBHHx", 0x5030, 0x21, 12, 0), struct.pack("<HBHHx", 0x5020, 0x21, 15, 0)
    health.take(frames([(0x085, contradiction), (0x086, over)], 10))
    health.take(frames([(0x705, b"\0")], 20))
    assert health.now(5) == (0, TOLD_BY_EMCY)
    assert health.now(6) == (1 << 15, 1 << 15)
    assert health.now(7) == (0, 0)
    told, seen = health.at(5, np.array([5, 10, 19, 20]))
    assert told.tolist() == [0, 1 << 12, 1 << 12, 0]
    assert seen.tolist() == [0, 1 << 12, 1 << 12, TOLD_BY_EMCY]


def test_emcy_of_other_errors_tells_nothing() -> None:
    for code, detail in ((0x8110, 0), (0x4210, 0), (0x5010, 0), (0x5010, 200), (0x6320, 0), (0x5030, 0x0900)):
        assert of_emcy(struct.pack("<HBHHx", code, 0x81, detail, 0)) == (0, False)
    assert of_emcy(struct.pack("<HBHHx", 0x5030, 0x81, 0x0C04, 0)) == (1 << 3, True)
    assert of_emcy(struct.pack("<HBHHx", 0, 0, 0x5010, 2)) == (1 << 1, False)


def logged(path: Path, with_tpdo4: bool, skipped: tuple[int, ...] = ()) -> list[int]:
    """A log of a node with a gauge that drifts between the 30th and the 60th SYNC; 2124h of each SYNC."""
    talk = redundant(GAUGES, emcy=True)
    if with_tpdo4:
        assert talk.put("I", 0x1803, 1, 0x40000485) == 0
        talk.take()
    application: Any = talk.device.application
    lines, faults = [], []
    for count in range(100):
        drift(talk, 3, 50.0 if 30 <= count < 60 else 0.0)
        talk.now_us += 20_000
        talk.step([(0x80, b"")])
        faults.append(application.sample.faults)
        for can_id, data in talk.take():
            if can_id not in skipped:
                lines.append(f"({talk.now_us / 1e6:.6f}) can0 {can_id:03X}#{data.hex().upper()}\n")
    path.write_text("".join(lines))
    return faults


@pytest.mark.parametrize("with_tpdo4", [True, False])
def test_a_log_joins_them_to_the_samples(with_tpdo4: bool, tmp_path: Path) -> None:
    faults = logged(tmp_path / "run.log", with_tpdo4)
    log = read_log(tmp_path / "run.log", gauges=GAUGES)
    assert log.unseen == ()
    samples = log[5].counter >= 0
    status = log[5].status[samples]
    assert len(status) == len(faults) == 100
    left_out = np.array(faults) & 1 << 3 != 0
    assert left_out[31:59].all()
    np.testing.assert_array_equal(status & Status.LEFT_OUT != 0, left_out)
    assert np.isfinite(log[5].P_newtons[samples]).all()
    # 100 ms hold of EMCY, 1 sample later at the beginning of TPDO4 and EMCY.
    said = status & Status.CONTRADICTION != 0
    assert said[32:59].all()
    assert not said[:30].any()
    assert not said[66:].any()
    table = log[5].columns["SG4_fault"][samples]
    assert (table[32:59] == 1).all()
    assert set(table[:30].tolist()) <= {0, -1}


@pytest.mark.parametrize("microstrain", [0.0, 50.0])
def test_live_values_from_gauges_do_without_the_gauge_that_the_node_left_out(microstrain: float) -> None:
    talk = redundant(GAUGES)
    application: Any = talk.device.application
    drift(talk, 3, microstrain)
    talk.now_us += 1000
    talk.step([(0x80, b"")])
    sample, calibration = application.sample, Calibration.from_record(application.calibration.active_record())
    strain = 1e-6 * np.array([sample.microstrains])
    status = np.array([sample.status()], dtype=np.uint16)
    saturated = np.array([bool(sample.status() & Status.SATURATED)])
    for columns in ({"saturated": saturated}, {"saturated": saturated, "SG4_fault": np.array([1])}):
        values, _ = contact_values(columns, strain, status, calibration)
        assert values[0, 0] == pytest.approx(sample.contact()[0], rel=1e-6)
    # A fault that the readings do not show, and that nothing names, is no value.
    hidden, _ = contact_values(
        {}, strain - calibration.offset_strain, status | np.uint16(Status.SATURATED), calibration
    )
    assert np.isnan(hidden).all() == (microstrain == 0.0)


def test_a_log_with_neither_says_so_once_where_it_is_asked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    logged(tmp_path / "run.log", False, (0x085,))
    caplog.set_level("INFO")
    assert read_log(tmp_path / "run.log", gauges=GAUGES).unseen == (5,)
    (record,) = caplog.records
    assert (record.levelname, "node 5: neither TPDO4 nor EMCY" in record.getMessage()) == ("INFO", True)
    words = ["decode", str(tmp_path / "run.log"), "--gauges", "8", "-o", str(tmp_path / "run.csv")]
    assert main(words) == 0
    assert "TPDO4" not in capsys.readouterr().err
    assert main([*words, "-v"]) == 0
    assert capsys.readouterr().err.count("node 5: neither TPDO4 nor EMCY") == 1


def test_words() -> None:
    assert reasons.of_faults(1 << 1 | 1 << 9 | 1 << 13) == [
        "SG2 saturated or left out", "front end: frozen", "beyond the calibrated force",
    ]  # fmt: skip


def test_a_mapping_may_have_part_of_a_contact() -> None:
    """P alone, or F1 alone: the gauges and the calibration give the rest, and without them it is unknown."""
    calibration = beam_calibration("I", pull=True)
    strain = np.linalg.solve(calibration.C, force_vector(2.0, np.radians(30.0), np.radians(70.0)).ravel())[np.newaxis]
    strain = strain + calibration.offset_strain
    status = np.array([int(Status.CALIBRATED | Status.CONTACT)], dtype=np.uint16)
    for name in ("P", "F1"):
        columns = {name: np.array([1.9])}
        values, _ = contact_values(columns, strain, status, calibration)
        assert np.allclose(values, [[2.0, 30.0, 70.0]])
        values, _ = contact_values(columns, strain, status, None)
        assert np.isnan(values[0, 1:]).all()
        assert values[0, 0] == pytest.approx(1.9 if name == "P" else np.nan, nan_ok=True)
