"""SIGKILL at any instant of commit and store leaves one complete calibration: the last confirmed, or the next one."""

import binascii
import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from canopen_device.running.store import FileStore
from fingertip.finger import Finger, finger
from running.store_child import record

KILLS = int(os.environ.get("TIPFORCE_KILLS", "50"))
AT_ONCE = 2
LONGEST_US = 6000  # a few cycles of commit and store
CHILD = Path(__file__).with_name("store_child.py")

Parent = subprocess.Popen[str]  # of the children that are killed: store_child.py


def restarted(path: Path) -> Finger:
    """The node after a power cycle, on what the disk holds."""
    return finger(calibrated=False, store=FileStore(path))


def survive(parent: Parent, path: Path, first: int, wait_us: int) -> tuple[int, int]:
    """Let a child store calibrations from ``first`` on and kill it; the last confirmed number, and the one found."""
    assert parent.stdin is not None
    assert parent.stdout is not None
    parent.stdin.write(f"{first}\n")
    parent.stdin.flush()
    child = int(parent.stdout.readline())
    confirmed = int(parent.stdout.readline())
    until_ns = time.perf_counter_ns() + 1000 * wait_us
    while time.perf_counter_ns() < until_ns:
        pass  # sleep() is too coarse for an instant within a write
    os.kill(child, signal.SIGKILL)
    while not (line := parent.stdout.readline()).startswith("ended"):
        confirmed = int(line)  # one write to a pipe each: a number is said as a whole or not at all
    assert line == f"ended {int(signal.SIGKILL)}\n", "the child must have been killed, not have ended by itself"
    talk = restarted(path)
    active = talk.upload(0x2140)
    assert isinstance(active, bytes)
    found = int(talk.get("I", 0x2102, 1))
    assert active == record(found)
    assert talk.get("I", 0x2103, 3) == binascii.crc32(active)
    assert talk.upload(0x2141) == active
    assert talk.device.storage.damaged == []
    return confirmed, found


def start() -> str:
    """The first statement of the children's parent: find the package, then run the script."""
    package_root = Path(str(sys.modules["tipforce"].__file__)).parents[1]
    run = f"runpy.run_path({str(CHILD)!r}, run_name='__main__')"
    return f"import sys, runpy; sys.path.insert(0, {str(package_root)!r}); {run}"


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="SIGKILL is POSIX")
def test_calibration_survives_sigkill_at_any_instant(tmp_path: Path) -> None:
    rng = random.Random(200)
    waits = [[rng.randrange(LONGEST_US) for _ in range(KILLS // AT_ONCE)] for _ in range(AT_ONCE)]

    def series(worker: int) -> list[tuple[int, int]]:
        path, first, seen = tmp_path / f"node-{worker}.json", 1, []
        # -I -S: a start without site packages is faster; the path of the package is handed over.
        command = [sys.executable, "-I", "-S", "-c", start(), str(path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
            for wait_us in waits[worker]:
                seen.append(survive(parent, path, first, wait_us))
                first = seen[-1][1] + 1  # each child goes on from what the one before left behind
        return seen

    with ThreadPoolExecutor(AT_ONCE) as pool:
        results = [pair for seen in pool.map(series, range(AT_ONCE)) for pair in seen]
    assert len(results) == KILLS
    for confirmed, found in results:
        assert found in (confirmed, confirmed + 1)
