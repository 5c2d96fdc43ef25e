"""What running commands in this process leaves behind is put back; a node command without its loop."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Iterator, Sequence

import pytest

from tipforce.device.node import Device
from tipforce.running import loop


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


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> list[Device]:
    """The devices that the loop was given; it ends at once."""
    found: list[Device] = []

    def run(given: Sequence[Device], _port: loop.Port, _stop: Callable[[], bool]) -> None:
        found.extend(given)

    monkeypatch.setattr(loop, "run", run)
    return found
