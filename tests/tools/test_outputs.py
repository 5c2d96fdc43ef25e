"""Outputs are safe: a failed write leaves the old file, and inputs and files of other kinds are refused."""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from host.bus_with_nodes import connected, finger, new_channel
from tipforce.errors import InputError, WriteError
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.configuration.measurements import write_measurements
from tipforce.output_file import CALIBRATION, NewFile, new_file, write_file
from tipforce.scene import beam_calibration
from tipforce.sensor.calibration.simulation import simulate
from tipforce_tools.cli.main import main
from tools.blocks import CONTACTS_LOG
from tools.test_calibrate_fit import measured
from tools.test_log import counting

SCENE = """
duration_s = 0.05
sync_hz = 200
[[nodes]]
ids = [1]
pdos = ["contact"]
[[loads]]
kind = "static"
P_N = 2.0
phi_deg = -90
theta_deg = 80
[outputs]
"""

TOML, SVG, PNG, CSV = b"[calibration]\nold = 1\n", b"<svg/>\n", b"\x89PNG old", b"a,b\n1,2\n"
WRITES: list[tuple[str, str, bytes]] = [
    ("calibrate fit data.csv --saturation none -o cal2.toml", "cal2.toml", TOML),
    ("estimate cal.toml readings.csv -o out.csv", "out.csv", CSV),
    ("estimate cal.toml readings.csv --json -o out.jsonl", "out.jsonl", b"{}\n"),
    ("export eds -o x.eds", "x.eds", b"[FileInfo]\n"),
    ("export dbc -o x.dbc", "x.dbc", b'VERSION ""\n'),
    ("export dcf --node-id 5 -o x.dcf", "x.dcf", b"[DeviceInfo]\n"),
    ("export c -o firmware", "firmware/tipforce_od.h", b"/* old */\n"),
    ("design sweep h2 --steps 3 -o x.svg", "x.svg", SVG),
    ("design table 3 --format svg -o figures", "figures/condition-and-noise.svg", SVG),
    ("calibrate budget cal.toml -o x.png", "x.png", PNG),
    ("plot run.log -o x.svg", "x.svg", SVG),
    ("plot run.log -o x.png", "x.png", PNG),
    ("plot run.log -o x.pdf", "x.pdf", b"%PDF old"),
    ("decode run.log -o x.csv", "x.csv", CSV),
    ("decode run.log -o x.jsonl", "x.jsonl", b"{}\n"),
    ("decode run.log -o x.txt", "x.txt", b"node   5 (0x05)\n"),
    ("decode run.log -o x.parquet", "x.parquet", b"PAR1 old"),
    ("decode run.log -o x.mcap", "x.mcap", b"\x89MCAP old"),
    ("run scene.toml -o x.log", "x.log", b"(1.000000) vcan0 123#\n"),
    ("run table.toml", "table.csv", CSV),
    ("run plot.toml", "scene.svg", SVG),
    ("config save 5 settings.toml --all {bus}", "settings.toml", b"[objects]\n"),
    ("config save 5 settings.dcf {bus}", "settings.dcf", b"[FileInfo]\n"),
]


@contextmanager
def full_disk(limit_bytes: int = 64) -> Iterator[None]:
    """No file of this process may become longer: a write fails as on a full disk, with another error number.

    Python before 3.14 keeps the truncated byte code of a module that it imports meanwhile: none may be written.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_calibration(folder / "cal.toml", beam_calibration("I", pull=True))
    write_measurements(folder / "data.csv", measured(simulate("I", np.random.default_rng(4))))
    (folder / "readings.csv").write_text("SG1,SG2,SG3\n" + 50 * "-125.0,728.7,323.6\n")
    (folder / "run.log").write_text(CONTACTS_LOG)
    for name, outputs in (("scene", ""), ("table", 'table = "table.csv"\n'), ("plot", 'plot = "scene.svg"\n')):
        (folder / f"{name}.toml").write_text(SCENE + outputs)
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("command", "name", "old"), WRITES, ids=[f"{c.split()[0]}-{n}" for c, n, _ in WRITES])
def test_a_failed_write_leaves_the_old_file(
    command: str,
    name: str,
    old: bytes,
    inputs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for path in inputs.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_bytes(old)
    monkeypatch.chdir(tmp_path)
    before = files(tmp_path)
    channel = new_channel()
    with connected(finger(5), channel=channel), full_disk():
        code = main(command.format(bus=f"-i virtual -c {channel}").split())
    err = capsys.readouterr().err
    assert (code, files(tmp_path)) == (1, before), err
    last = err.splitlines()[-1]
    assert Path(name).name in last or name.split("/", maxsplit=1)[0] in last
    assert "File too large" in last
    assert "Traceback" not in err


def test_a_failed_write_leaves_the_dataset(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other.log").write_text(CONTACTS_LOG.replace("(17", "(18"))
    assert main(["decode", str(inputs / "run.log"), "-q", "-o", "parts/"]) == 0
    before = files(tmp_path)
    with full_disk():
        code = main(["decode", "other.log", "-q", "-o", "parts/"])
    assert (code, files(tmp_path)) == (1, before)
    assert "File too large" in capsys.readouterr().err


def test_a_recording_that_replaces_another_is_kept_beside_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.log"
    path.write_text(CONTACTS_LOG)
    words = ["log", "-i", "virtual", "outputs1", "-o", str(path), "--overwrite", "-q"]
    with counting("outputs1"), full_disk(2000):
        assert main(words) == 1
    assert "File too large; the frames so far are in" in capsys.readouterr().err
    assert path.read_text() == CONTACTS_LOG
    (beside,) = set(tmp_path.iterdir()) - {path}
    assert beside.stat().st_size == 2000
    with counting("outputs1"):
        assert main([*words, "-n", "3"]) == 0
    assert len(path.read_text().splitlines()) == 3


def test_the_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "cal.toml"
    with new_file(path) as partial:
        partial.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    with pytest.raises(ZeroDivisionError), new_file(path) as partial:
        partial.write_text(str(1 // 0))
    assert files(tmp_path) == {"cal.toml": b"new"}


def test_links_and_permissions_stay_and_devices_are_written_directly(tmp_path: Path) -> None:
    path, link = tmp_path / "real.toml", tmp_path / "link.toml"
    path.write_bytes(TOML)
    path.chmod(0o640)
    link.symlink_to(path)
    write_file(link, TOML * 2, CALIBRATION)
    assert link.is_symlink()
    assert path.read_bytes() == TOML * 2
    assert path.stat().st_mode & 0o777 == 0o640
    with pytest.raises(WriteError, match="No space left on device"):
        write_file("/dev/full", TOML)
    with pytest.raises(InputError, match="is a directory"):
        NewFile(tmp_path)
