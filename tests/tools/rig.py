"""A command line in this process: what it prints and its exit code."""

import io
import itertools
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
import pytest
from bench.measure import background

from canopen_device.core.node import Device
from host.bus_with_nodes import new_channel
from tipforce.fingertip.node import Fingertip
from tipforce.sensor.calibration.simulation import Simulated
from tipforce_tools.cli.main import main


def write_readings(path: Path, sim: Simulated, **more: Sequence[object]) -> None:
    """Write the readings of a simulated calibration as a file for `calibrate fit`; ``more``: further columns."""
    columns: dict[str, Sequence[object]] = {"t_s": sim.t_s.tolist()}
    columns |= {f"SG{k + 1}": (1e6 * gauge).tolist() for k, gauge in enumerate(sim.strain.T)}
    columns |= {"P_N": sim.P_newtons.tolist(), "phi_deg": np.degrees(sim.phi_rad).tolist()}
    columns |= {"theta_deg": np.degrees(sim.theta_rad).tolist(), **more}
    rows = zip(*columns.values(), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows), ""]))


def files(folder: Path) -> dict[str, bytes]:
    """The content of every file below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class Clock:
    """Seconds that pass when somebody sleeps."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now_s += seconds


def until(condition: Callable[[], object]) -> None:
    """Wait for it, on a loaded machine too."""
    deadline_s = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.002)


def in_namespace(
    script: str, *words: object, cwd: Path | None = None, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run lines of bash in a network namespace with loopback alone; where there can be none, skip the test."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"], "/sbin", "/usr/sbin"])
    environment = {**os.environ, "PATH": path, "PYTHONPATH": os.pathsep.join(sys.path), **variables}

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = ["unshare", "--map-root-user", "--net", "bash", "-c", *arguments]
        return subprocess.run(
            command, capture_output=True, text=True, timeout=600, check=False, cwd=cwd, env=environment
        )

    if shutil.which("unshare") is None:
        pytest.skip("unshare is not installed")
    if (trial := run("ip link set lo up")).returncode:
        pytest.skip(f"no network namespace here: {trial.stderr.strip()}")
    return run(script, "bash", *map(str, words))


class Terminal(io.StringIO):
    """A stdin with a person at it."""

    def isatty(self) -> bool:
        return True


class Streams(NamedTuple):
    """What a command wrote."""

    out: str
    err: str

    @property
    def records(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.out.splitlines()]


Printed = Callable[[int | set[int], str | Sequence[object]], Streams]
"""Run a command line, a text or words, that must end with this exit code, or one of these; what it printed."""


def exit_code(words: str | Sequence[object]) -> int:
    """That of a command line, a text or words."""
    try:
        return main(words.split() if isinstance(words, str) else [str(word) for word in words])
    except SystemExit as ended:  # argparse
        return int(ended.code or 0)


TIPFORCE = (sys.executable, "-m", "tipforce_tools.cli.main")


def process(line: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """`tipforce LINE` in a process of its own."""
    words = [*TIPFORCE, *line.split()]
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=False, **options)


def run_node(*words: object, channel: str = "") -> int:
    """Exit code of `tipforce node` with node-id 5; the fixture ``devices`` has what it ran."""
    return main(["node", "--node-id", "5", "-i", "virtual", "-c", channel or new_channel(), *map(str, words)])


def source_of(device: Device) -> Any:
    """The gauges of a fingertip, of the class that its flags ask for."""
    assert isinstance(device.application, Fingertip)
    return device.application.source


def message(can_id: int, data: bytes = b"", **options: bool) -> can.Message:
    """A frame, with 11 bits unless ``options`` say otherwise."""
    return can.Message(arbitration_id=can_id, data=data, **({"is_extended_id": False} | options))


@contextmanager
def sending(channel: str, frames: Callable[[int], Sequence[can.Message]], period_s: float = 0.005) -> Iterator[None]:
    """Sends frames(0), frames(1)... on a virtual bus, over and over, until the with block ends."""

    def send(stop: threading.Event) -> None:
        with can.Bus(channel, interface="virtual") as bus:
            for number in itertools.count():
                if stop.wait(period_s):
                    break
                for frame in frames(number):
                    bus.send(frame)

    with background(send):
        yield
