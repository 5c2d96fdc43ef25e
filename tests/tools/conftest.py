"""Commands in this process; what they leave behind is put back; a node command without its loop."""

import logging
import signal
from collections.abc import Callable, Iterator, Sequence

import pytest

from canopen_device.core.node import Device
from canopen_device.running import loop
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
def devices(monkeypatch: pytest.MonkeyPatch) -> list[Device]:
    """The devices that the loop was given; it ends at once, as by Ctrl-C."""
    devices: list[Device] = []

    def run(given: Sequence[Device], _port: loop.Port, _stop: Callable[[], bool]) -> None:
        devices.extend(given)
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "run", run)
    return devices


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Printed:
    def run(code: int | set[int], words: str | Sequence[object]) -> Streams:
        capsys.readouterr()
        ended = exit_code(words)
        streams = Streams(*capsys.readouterr())
        assert ended in (code if isinstance(code, set) else {code}), streams.err
        return streams

    return run
