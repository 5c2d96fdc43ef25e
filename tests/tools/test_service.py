"""A node as delivered, calibrated; as a service: priority, locked memory, signals, systemd and its journal."""

import binascii
import ctypes
import errno
import logging
import math
import os
import signal
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest

from canopen_device.core import codes
from canopen_device.core.node import Device
from device.tiny import service_dictionary
from host.bus_with_nodes import new_channel
from tipforce.scene.delivered import beam_calibration, commit_calibration, download
from tipforce_tools.cli import service
from tipforce_tools.cli.listening import StopSignals
from tipforce_tools.cli.main import command_parser
from tools.rig import Printed, run_node

SYNC, RESET_NODE = (0x80, b""), (0x000, b"\x81\5")
FIVE = 'points = ["K_H", "S_H", "U", "L", { beam = "V", side = "left", position_mm = 3.0 }]\n'
LOAD = (4.4, 90.0, 45.0)
UNIT = Path(__file__).parents[2] / "tools/systemd/tipforce-node@.service"


def contact(device: Device, at_us: int) -> tuple[float, float, float]:
    """P in newtons, phi and theta in degrees, of a sample at that time."""
    device.step(at_us, [SYNC])
    first = int(device.od.get(0x1018, 2)) & 0xFF
    P, phi, theta = (device.od.get(0x6130, first + k) for k in (4, 5, 6))
    return P, phi, theta  # type: ignore[return-value]


@pytest.mark.parametrize("layout", ["I", "III'", "five.toml"])
@pytest.mark.parametrize("with_store", [False, True])
def test_a_simulated_finger_is_delivered_calibrated(
    layout: str, with_store: bool, devices: list[Device], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It measures its --load at once, and after reset node; its calibration has its serial, offsets and load sense."""
    monkeypatch.chdir(tmp_path)
    Path("five.toml").write_text(FIVE)
    offsets = ",".join(["12", "-8.5", "5.3", "100", "-40"][: 5 if layout == "five.toml" else 3])
    words = f"--layout {layout} --serial 77 --noise 0.1 --offset {offsets} --load 4.4,90,45 -q".split()
    assert run_node(*words, *(["--store", "store.json"] if with_store else [])) == 0
    (device,) = devices
    device.step(0)
    assert contact(device, 1_000_000) == pytest.approx(LOAD, abs=0.2)
    device.step(2_000_000, [RESET_NODE])
    assert contact(device, 3_000_000) == pytest.approx(LOAD, abs=0.2)
    assert (device.od.get(0x2102, 1), device.od.get(0x2110, 6), device.od.get(0x2103, 4)) == (77, 1, 1)
    assert (device.od.get(0x2102, 4), device.od.get(0x2112, 1)) == (1 if layout == "I" else 255, 15.0)
    assert list(tmp_path.glob("store*")) == [], "nothing is written until somebody stores"


def test_what_is_stored_comes_first(devices: list[Device], tmp_path: Path) -> None:
    """Also a restored default (1011h): nobody who erases a calibration finds another one."""
    words = ("-q", "--load", "4.4,90,45", "--store", str(tmp_path / "store.json"))
    stored = beam_calibration("II", pull=True)
    for signature, crc in ((codes.SIGNATURE_SAVE, stored.crc32()), (codes.SIGNATURE_LOAD, 0)):
        run_node(*words)
        device = devices[-1]
        device.step(0)
        commit_calibration(device, stored)
        download(device, 0x1010 if signature == codes.SIGNATURE_SAVE else 0x1011, 4, struct.pack("<I", signature))
        run_node(*words)
        devices[-1].step(0)
        assert devices[-1].od.get(0x2103, 3) == crc


def test_other_settings_that_are_stored_leave_it_calibrated(devices: list[Device], tmp_path: Path) -> None:
    words = ("-q", "--store", str(tmp_path / "store.json"))
    run_node(*words)
    devices[0].step(0)
    record = devices[0].od.get(0x2140)
    assert isinstance(record, bytes)
    download(devices[0], 0x1017, 0, struct.pack("<H", 250))
    download(devices[0], 0x1010, 2, struct.pack("<I", codes.SIGNATURE_SAVE))
    run_node(*words)
    devices[1].step(0)
    assert (devices[1].od.get(0x1017), devices[1].od.get(0x2103, 3)) == (250, binascii.crc32(record))


def test_uncalibrated(devices: list[Device], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_node("--uncalibrated", "-q") == 0
    (tmp_path / "same.toml").write_text(
        "points = [" + ",".join(f'{{ beam = "V", side = "left", position_mm = {k} }}' for k in (1, 5, 9)) + "]"
    )
    assert run_node("--layout", tmp_path / "same.toml") == 0
    for device in devices:
        device.step(0)
        assert device.od.get(0x2103, 3) == 0
        assert all(map(math.isnan, contact(device, 1_000_000)))
    line = capsys.readouterr().err.splitlines()[0]
    gauges = "V left 1.00, V left 5.00, V left 9.00"
    assert line.startswith(f"node 5 (0x05): not calibrated: the gauges {gauges} have rank 2 in this geometry")


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """The end of NOTIFY_SOCKET that systemd has."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        path = tmp_path / "notify"
        listening.bind(str(path))
        listening.settimeout(1.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        yield listening


def test_the_node_tells_systemd_that_it_is_ready_alive_and_stopping(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "2000000000")  # fed once, however slow the machine is

    def run(_devices: object, _port: object, stop: object) -> None:
        assert callable(stop)
        assert stop() is False
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop() is True

    monkeypatch.setattr("canopen_device.running.loop.run", run)
    assert run_node("-q") == 0
    assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler  # again: as Ctrl-C
    told = [manager.recv(1000).decode() for _ in range(3)]
    assert told[0].startswith("READY=1\nSTATUS=node 5 (0x05): layout I, ")
    assert told[1] == "WATCHDOG=1"
    assert told[2] == "STOPPING=1\nSTATUS=node 5 (0x05) stopped"


@pytest.mark.parametrize(("usec", "pid", "fed"), [("2000000", "", 5), ("", "", 0), ("x", "", 0), ("1000", "1", 0)])
def test_the_watchdog_is_fed_at_half_its_time_if_there_is_one(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch, usec: str, pid: str, fed: int
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", usec)
    if pid:
        monkeypatch.setenv("WATCHDOG_PID", pid)
    now = [0]
    notifier = service.Notifier(lambda: now[0])
    for now[0] in range(0, 5_000_000, 100_000):
        notifier.alive()
    manager.setblocking(False)
    assert [manager.recv(100) for _ in range(fed)] == [b"WATCHDOG=1"] * fed
    with pytest.raises(BlockingIOError):
        manager.recv(100)
    notifier.close()


def test_a_signal_as_soon_as_it_is_said_that_one_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def note(text: str) -> None:
        said.append(text)
        if len(said) == 1:
            signal.raise_signal(signal.SIGTERM)

    said, port, device = list[str](), Mock(receive=Mock(return_value=None)), Device(service_dictionary(5))
    monkeypatch.setattr("tipforce_tools.cli.common.note", note)
    service.serve("node 5", "a test", [device], [device], port)
    assert said == ["node 5: a test; Ctrl-C ends it", "node 5: stopped"]
    assert port.send.call_args.args == ([(0x705, b"\x04")],)


def test_without_systemd_or_with_one_that_is_gone_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    for address in ("", "/nowhere/notify", "@nobody-listens-here"):
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        notifier = service.Notifier()
        notifier.send("READY=1")
        notifier.close()


def test_priority_is_set_or_its_refusal_says_what_to_do(monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    asked: list[int] = []

    def allow(_pid: int, _policy: int, parameter: os.sched_param) -> None:
        asked.append(parameter.sched_priority)

    def refuse(_pid: int, _policy: int, _parameter: os.sched_param) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", allow)
    service.set_priority(80)
    assert asked == [80]
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert "LimitRTPRIO=80" in printed(9, f"node --node-id 5 -i virtual -c {new_channel()} --priority 80").err


@pytest.mark.parametrize("number", [errno.EPERM, errno.ENOMEM])
def test_memory_that_may_not_be_locked(monkeypatch: pytest.MonkeyPatch, printed: Printed, number: int) -> None:
    class Library:
        def mlockall(self, flags: int) -> int:
            assert flags == 3
            ctypes.set_errno(number)
            return -1

    monkeypatch.setattr(ctypes, "CDLL", lambda *_args, **_names: Library())
    err = printed(9, f"node --node-id 5 -i virtual -c {new_channel()} --lock-memory").err
    assert "LimitMEMLOCK=infinity" in err


def test_a_second_ctrl_c_interrupts_and_a_second_sigterm_does_not() -> None:
    with StopSignals((signal.SIGINT,)) as stop:
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_levels_in_the_journal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    handler = logging.StreamHandler(sys.stderr)
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        with (tmp_path / "journal").open("w") as file:
            status = os.fstat(file.fileno())
            monkeypatch.setattr(os, "fstat", lambda _fd: status)
            monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino + 1}")
            service.mark_levels_for_journal()
            assert handler.formatter is None
            monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
            kept = [(one, one.formatter) for one in root.handlers]
            service.mark_levels_for_journal()
        record = logging.LogRecord("tipforce.x", logging.WARNING, "", 0, "one\ntwo", None, None)
        assert handler.format(record) == "<4>tipforce.x: one\n<4>two"
        for one, formatter in kept:
            one.setFormatter(formatter)
    finally:
        root.removeHandler(handler)


def test_the_unit_starts_a_command_line_that_the_node_takes() -> None:
    lines = dict(line.split("=", 1) for line in UNIT.read_text().splitlines() if "=" in line and line[0] not in "#[")
    assert (lines["Type"], lines["Restart"], lines["KillSignal"]) == ("notify", "always", "SIGTERM")
    assert lines["After"] == "network.target"
    assert int(lines["WatchdogSec"]) >= 1
    words = lines["ExecStart"].replace("%i", "5").partition(" tipforce node ")[2].split()
    args = command_parser("node").parse_args([word for word in words if not word.startswith("$")])
    assert (args.node_id, args.store, args.lock_memory) == (5, "/var/lib/tipforce/node-5.json", True)
    assert lines["LimitRTPRIO"] == str(args.priority)
