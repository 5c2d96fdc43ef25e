"""Commands in this process; what they leave behind is put back; a node command without its loop."""

import logging
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from canopen_device.core.node import Device
from canopen_device.running import loop
from host.bus_with_nodes import new_channel
from tools.hand_log import FAULTS, write_hand_log
from tools.rig import Printed, Streams, exit_code


@pytest.fixture(autouse=True)
def put_back_process_state() -> Iterator[None]:
    """Log levels and the handler of SIGTERM belong to the process: a command has it to itself, a test has not."""
    loggers = [logging.getLogger(name) for name in ("", "can", "canopen")]
    levels = [logger.level for logger in loggers]
    on_sigterm = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, on_sigterm)
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)


@pytest.fixture(autouse=True)
def any_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a flag a command finds no bus, also on a machine with one; no line of progress on a slow one."""
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("can.util.CONFIG_FILES", [])
    monkeypatch.setattr("tipforce.host.network.interfaces.interfaces", dict)
    monkeypatch.setattr("tipforce_tools.cli.common._LINE_S", float("inf"))


@pytest.fixture
def channel() -> str:
    """The name of a virtual bus that no other test uses."""
    return new_channel()


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> list[Device]:
    """The devices that the loop was given; it ends at once, as by Ctrl-C."""
    devices: list[Device] = []

    def run(given: Sequence[Device], _port: loop.Port, _stop: Callable[[], bool]) -> None:
        devices.extend(given)
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "run", run)
    return devices


@pytest.fixture(scope="session")
def hand_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of node 5 with every fault; its PDOs from 1.2 s to 1.25 s are lost."""
    path = write_hand_log(tmp_path_factory.mktemp("hand") / "run.log", (5,), 2.0, FAULTS)
    lines = path.read_text().splitlines(True)
    kept = [line for line in lines if "85#" not in line or not "(1700000001.2" <= line < "(1700000001.25"]
    path.write_text("".join(kept))
    return path


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Printed:
    def run(code: int | set[int], words: str | Sequence[object]) -> Streams:
        capsys.readouterr()
        ended = exit_code(words)
        streams = Streams(*capsys.readouterr())
        assert ended in (code if isinstance(code, set) else {code}), streams.err
        return streams

    return run
