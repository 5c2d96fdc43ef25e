"""The node as a process: how it ends, what it keeps, a disk that is full, an interface that goes away."""

import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tipforce.dictionary import objects as od
from tipforce.errors import SdoAbortError
from tipforce.host.network.bus import Bus
from tipforce_tools.demo.job import case_calibration
from vcan.adc import in_user_mode_linux
from vcan.support import (
    HEARTBEAT,
    NMT,
    NODE_ID,
    OPERATIONAL_BEAT,
    SDO_REQUEST,
    WAIT_S,
    Command,
    RawBus,
    answers_a_sync,
    running_node,
    start_with_fast_heartbeats,
    wait_until,
)  # fmt: skip  # fmt: skip

STORE_CALIBRATION = b"\x23\x10\x10\x04save"  # SDO download, expedited, 1010h:4
OWN_BUS = "tipforce0"
KILLS = 5


def receivers(channel: str) -> int:
    """How many sockets listen on a bus, as the kernel lists them (each of ours without a filter)."""
    return sum(line.split()[:1] == [channel] for line in Path("/proc/net/can/rcvlist_all").read_text().splitlines())


def active_crc(connection: Bus) -> int:
    return connection.sdo(NODE_ID).read(od.CALIBRATION_ACTIVE_CRC)


# Its end


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_sigterm_and_ctrl_c_end_the_node_and_free_the_socket(bus: RawBus, tmp_path: Path, number: int) -> None:
    """Its last frame says that it stopped."""
    before = receivers("vcan0")
    with running_node(tmp_path) as node:
        assert receivers("vcan0") == before + 1
        assert node.end(number) == 0
        assert receivers("vcan0") == before
        assert "Traceback" not in node.stderr
        assert node.stdout == ""
    bus.until(lambda frame: frame == (HEARTBEAT + NODE_ID, b"\x04"))


# What it keeps


def test_kill_during_a_store_leaves_the_old_or_the_new_calibration(host: Bus, tmp_path: Path) -> None:
    store = ("--store", str(tmp_path / "store.json"))
    finger = host.finger(NODE_ID)
    calibrations = [case_calibration("I", pull=True), case_calibration("II", pull=True)]
    chance = random.Random(20261121)
    with running_node(tmp_path, *store):
        finger.apply_calibration(calibrations[0], store=False)
        begin_s = time.monotonic()
        finger.store(calibration=True)
        duration_s = time.monotonic() - begin_s
    allowed = {calibrations[0].crc32()}
    for _ in range(KILLS):
        with running_node(tmp_path, *store) as node:
            found = active_crc(host)
            assert found in allowed, node.stderr
            new = calibrations[1] if found == calibrations[0].crc32() else calibrations[0]
            allowed = {found, new.crc32()}
            finger.apply_calibration(new, store=False)
            host.send(SDO_REQUEST + NODE_ID, STORE_CALIBRATION)
            time.sleep(chance.uniform(0.0, duration_s))
            assert node.end(signal.SIGKILL) == -signal.SIGKILL
    with running_node(tmp_path, *store) as node:
        assert active_crc(host) in allowed, node.stderr


# Its interface


def ip(*words: str) -> None:
    subprocess.run(["ip", "link", *words], check=True, capture_output=True, timeout=WAIT_S)


@pytest.fixture
def own_bus() -> Iterator[str]:
    """A bus of its own, that the test may take down and away."""
    try:
        ip("add", "dev", OWN_BUS, "type", "vcan")
    except subprocess.CalledProcessError as error:
        if b"not permitted" in error.stderr:
            pytest.skip("taking an interface down needs CAP_NET_ADMIN; `tipforce vcan --uml -- ...` has it")
        raise
    ip("set", OWN_BUS, "up")
    yield OWN_BUS
    subprocess.run(["ip", "link", "del", OWN_BUS], check=False, capture_output=True, timeout=WAIT_S)


def still_operational(channel: str, node: Command) -> None:
    """It sends heartbeats in the state that it was in (so it was not restarted), and answers a SYNC."""
    with RawBus(channel) as bus:
        bus.until(lambda frame: frame == OPERATIONAL_BEAT)
        assert answers_a_sync(bus)
    wait_until(lambda: "up again" in node.stderr, "no word that the interface is up again")
    assert node.end() == 0


@pytest.mark.parametrize(
    ("away", "back", "said"),
    [
        (["set", OWN_BUS, "down"], [], "Network is down"),
        (["del", OWN_BUS], ["add", "dev", OWN_BUS, "type", "vcan"], "continues when it is up again"),
    ],
    ids=["down", "deleted"],
)
def test_node_outlives_its_interface(own_bus: str, tmp_path: Path, away: list[str], back: list[str], said: str) -> None:
    with running_node(tmp_path, channel=own_bus) as node:
        with RawBus(own_bus) as bus:
            start_with_fast_heartbeats(bus)
        ip(*away)
        wait_until(lambda: said in node.stderr, "no word that the interface is gone")
        time.sleep(0.2)  # ten heartbeats that can't be sent
        if back:
            ip(*back)
        ip("set", own_bus, "up")
        still_operational(own_bus, node)
        assert node.stderr.count(said) == 1


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
        assert answers_a_sync(bus)


@pytest.mark.parametrize(("trouble", "message"), [("full", "No space left on device"), ("read-only", "Read-only file")])
def test_a_disk_that_takes_nothing_costs_nothing_but_the_storing(
    disk: Path, host: Bus, tmp_path: Path, trouble: str, message: str
) -> None:
    store = ("--store", str(disk / "node.json"))
    finger = host.finger(NODE_ID)
    first, second = case_calibration("I", pull=True), case_calibration("II", pull=True)
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


def test_a_clock_that_is_set_moves_nothing(bus: RawBus, tmp_path: Path) -> None:
    if not in_user_mode_linux():
        pytest.skip("sets the time of day: only on a kernel of its own, `tipforce vcan --uml -- ...`")
    with running_node(tmp_path) as node:
        start_with_fast_heartbeats(bus)
        before = time.clock_gettime(time.CLOCK_REALTIME)
        began = time.monotonic()
        try:
            for step_s in (86400.0, -2 * 86400.0, 1e9):
                time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + step_s)
                beats = [bus.until(lambda frame: frame == OPERATIONAL_BEAT) for _ in range(10)]
                assert all(len(frames) == 1 for frames in beats), "nothing but heartbeats: no EMCY, no burst"
        finally:
            time.clock_settime(time.CLOCK_REALTIME, before + time.monotonic() - began)
        # Thirty heartbeats of 20 ms: less would be a burst after a step forward. The lower bound alone is no timing.
        assert time.monotonic() - began > 0.5
        still_answers()
        assert node.end() == 0


def test_priority_and_locked_memory_as_root(tmp_path: Path) -> None:
    if not in_user_mode_linux():
        pytest.skip("needs real-time rights; `tipforce vcan --uml -- ...` has them")
    with running_node(tmp_path, "--priority", "60", "--lock-memory") as node:
        assert os.sched_getscheduler(node.pid) == os.SCHED_FIFO
        assert os.sched_getparam(node.pid).sched_priority == 60
        assert int(Path(f"/proc/{node.pid}/status").read_text().split("VmLck:")[1].split()[0]) > 1000, "kilobytes"
