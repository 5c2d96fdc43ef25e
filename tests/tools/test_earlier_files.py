"""Files that commands of 9931bb3 wrote, and hand-written ones of its time, keep working: earlier/ holds them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import tipforce
from canopen_device.machine.file import read_machine
from canopen_device.running.store import FileStore
from canopen_device.testing import Conversation
from tipforce.dictionary import objects as od
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource
from tipforce_tools.cli.main import main

BUS = ["-i", "virtual", "-c", "earlier"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the files, in which commands run."""
    shutil.copytree(Path(__file__).with_name("earlier"), tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        ("hand check hand.toml", 0, "thumb"),
        ("run scene.toml -q", 0, "PASS: 3 of 3 expectations hold"),
        ("estimate cal.toml session.csv -q", 0, "4,4.39951343,0.0246814928,59.9829389"),
        ("calibrate budget cal.toml", 0, "total                       0.03429"),
        ("calibrate fit session.csv --layout I -o new.toml --date 2026-01-02 -q", 0, "7290.433 +- 1.6e+02"),
        ("decode run.log --calibration cal.toml --summary", 0, "50 samples"),
        ("dataset show data", 2, "an earlier tipforce wrote this dataset"),
        ("decode run.log -o data/", 2, "`tipforce decode LOGS -o NEW/` writes its logs again"),
    ],
)
def test_a_command_takes_them(line: str, code: int, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line.split()) == code
    printed = capsys.readouterr()
    assert said in printed.out + printed.err


@pytest.mark.usefixtures("folder")
def test_an_mcap_is_its_log(capsys: pytest.CaptureFixture[str]) -> None:
    texts = []
    for name in ("run.log", "run.mcap"):
        assert main(["decode", name, "-q", "-o", "out.csv"]) == 0
        texts.append(Path("out.csv").read_text())
    assert texts[0] == texts[1]
    assert main(["decode", "run.mcap", "--summary", "--json", "-q"]) == 0
    assert json.loads(capsys.readouterr().out)["samples"] == 50


def test_a_node_and_a_machine_start_with_their_stores(folder: Path) -> None:
    store = FileStore(folder / "node-5.json")
    talk = Conversation(fingertip_node(5, SimulatedSource([[1.0, 0.0, 0.0]] * 3), save=store.save, load=store.load))
    assert talk.upload(0x1017) == (250).to_bytes(2, "little")
    assert not any(can_id == 0x85 for can_id, _ in talk.sent)
    lamp, other, drive = read_machine(folder / "machine.toml")
    lamp.step(0)
    assert (lamp[0x2001], other.node_id, drive.node_id) == (290, 8, 9)


@pytest.mark.usefixtures("folder")
def test_settings_are_applied_to_a_node(capsys: pytest.CaptureFixture[str]) -> None:
    with tipforce.simulated_hand([5], interface="virtual", channel="earlier") as bus:
        assert main(["config", "apply", "5", "kept.toml", "-y", *BUS]) == 0
        assert main(["config", "verify", "5", "kept.toml", *BUS]) == 0
        assert bus.finger(5).sdo.read(od.HEARTBEAT_PRODUCER_MS) == 250
        assert main(["calibrate", "apply", "cal.toml", "--node", "5", "-y", *BUS]) == 0
        assert main(["calibrate", "verify", "cal.toml", "--node", "5", *BUS]) == 0
    assert "Traceback" not in capsys.readouterr().err
