"""A node whose disk is full or read-only."""

import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tipforce.errors import SdoAbortError
from tipforce.host.network.bus import Bus
from tipforce.scene import beam_calibration
from vcan.support import NMT, NODE_ID, RawBus, running_node


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 64 kB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    try:
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)], check=True, capture_output=True
        )
    except subprocess.CalledProcessError as error:
        pytest.skip(f"mounting needs root, `tipforce vcan --uml -- ...` has it: {error.stderr.decode().strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True, capture_output=True)


def fill(disk: Path) -> None:
    with (disk / "ballast").open("wb", buffering=0) as file:
        for size in (4096, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue


def remount(disk: Path, mode: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{mode}", str(disk)], check=True, capture_output=True)


def still_answers() -> None:
    with RawBus() as bus:  # a new one: what came before must not pass for an answer
        bus.send(NMT, bytes((1, NODE_ID)))
        assert bus.answers_a_sync()


@pytest.mark.parametrize(("trouble", "message"), [("full", "No space left on device"), ("read-only", "Read-only file")])
def test_a_disk_that_takes_nothing_costs_nothing_but_the_storing(
    disk: Path, host: Bus, tmp_path: Path, trouble: str, message: str
) -> None:
    store = ("--store", str(disk / "node.json"))
    finger = host.finger(NODE_ID)
    first, second = beam_calibration("I", pull=True), beam_calibration("II", pull=True)
    with running_node(tmp_path, *store) as node:
        finger.apply_calibration(first)
        fill(disk) if trouble == "full" else remount(disk, "ro")
        finger.apply_calibration(second, store=False)
        for _ in range(3):
            with pytest.raises(SdoAbortError) as refused:
                finger.store(calibration=True)
            assert refused.value.code == 0x06060000
        assert node.stderr.count(message) == 1
        assert finger.verify_calibration(second) == [], "what is active stays active"
        still_answers()
        assert node.end(signal.SIGKILL) == -signal.SIGKILL
    (disk / "ballast").unlink() if trouble == "full" else remount(disk, "rw")
    with running_node(tmp_path, *store):
        assert finger.verify_calibration(first) == [], "what was stored is still there"
        finger.apply_calibration(second)
    with running_node(tmp_path, *store):
        assert finger.verify_calibration(second) == []
