"""canopen_conformance copied alone, beside python-can: it needs nothing else of this installation."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import canopen_conformance
from canopen_conformance.__main__ import main
from canopen_conformance.case import all_cases
from device.test_alone import link_packages

# A device in a thread, and the command line in the main thread, on one virtual bus.
ON_A_BUS = """
import sys, threading, time
import can
from canopen_conformance.__main__ import main
from minimal import MinimalDevice

def serve():
    device, start = MinimalDevice(), time.monotonic_ns()
    with can.Bus(interface="virtual", channel="alone") as bus:
        while not ended.is_set():
            message = bus.recv(0.001)
            frames = [(message.arbitration_id, bytes(message.data))] if message else []
            for can_id, data in device.step((time.monotonic_ns() - start) // 1000, frames)[0]:
                bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

ended = threading.Event()
thread = threading.Thread(target=serve)
thread.start()
code = main(["--node-id", "5", "-i", "virtual", "-c", "alone", "--case", "identity.*", "--tolerance", "1000"])
ended.set()
thread.join()
sys.exit(code)
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package and python-can."""
    folder = tmp_path_factory.mktemp("alone")
    shutil.copytree(Path(canopen_conformance.__file__).parent, folder / "canopen_conformance")
    shutil.copy(Path(__file__).with_name("minimal.py"), folder)
    link_packages(folder, "python-can")
    return folder


def run(environment: Path, *words: str) -> str:
    variables = {**os.environ, "PYTHONPATH": str(environment)}
    command = [sys.executable, "-S", "-W", "error", *words]
    done = subprocess.run(command, cwd=environment, env=variables, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_nothing_else_is_there(environment: Path) -> None:
    for name in ("tipforce", "tipforce_tools", "numpy", "canopen", "rich"):
        assert "no" in run(environment, "-c", f"import importlib.util as i; print(i.find_spec({name!r}) or 'no')")


def test_help_and_list(environment: Path) -> None:
    assert "--persistent" in run(environment, "-m", "canopen_conformance", "--help")
    assert len(run(environment, "-m", "canopen_conformance", "--list").splitlines()) == len(all_cases())


def test_mistakes_of_the_user_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ("--list --case nosuch", "--node-id 5 --tolerance -1", "--node-id 5 --tolerance 60001"):
        assert main(words.split()) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_device_on_a_bus(environment: Path) -> None:
    assert " 0 failed" in run(environment, "-c", ON_A_BUS).splitlines()[-1]
