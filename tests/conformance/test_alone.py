"""canopen_conformance copied alone, beside python-can: it needs nothing else of this installation."""

import shutil
from pathlib import Path

import pytest

import canopen_conformance
from canopen_conformance.__main__ import main
from canopen_conformance.case import all_cases
from device.test_alone import alone

# A device in a thread, and the command line in the main thread, on one virtual bus.
ON_A_BUS = """
import sys, threading, time
import can
from canopen_conformance.__main__ import main
from minimal import MinimalDevice

def serve():
    device, start = MinimalDevice(), time.monotonic_ns()
    with bus:
        while not ended.is_set():
            message = bus.recv(0.001)
            frames = [(message.arbitration_id, bytes(message.data))] if message else []
            for can_id, data in device.step((time.monotonic_ns() - start) // 1000, frames)[0]:
                bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

ended, bus = threading.Event(), can.Bus(interface="virtual", channel="alone")
thread = threading.Thread(target=serve)
thread.start()
code = main(["--node-id", "5", "-i", "virtual", "-c", "alone", "--case", "identity.*", "--tolerance", "1000"])
ended.set()
thread.join()
sys.exit(code)
"""


def conformance(folder: Path, code: str) -> list[str]:
    """What Python prints where there is nothing but the package, a device and python-can; a warning is an error."""
    shutil.copytree(Path(canopen_conformance.__file__).parent, folder / "canopen_conformance")
    shutil.copy(Path(__file__).with_name("minimal.py"), folder)
    return alone(folder, f"import warnings; warnings.simplefilter('error')\n{code}", "python-can").splitlines()


def test_nothing_else_is_there(tmp_path: Path) -> None:
    others = ("tipforce", "tipforce_tools", "numpy", "canopen", "rich")
    code = f"import importlib.util as i; print([name for name in {others} if i.find_spec(name)])"
    assert conformance(tmp_path, code) == ["[]"]


def test_help_and_list(tmp_path: Path) -> None:
    code = "import runpy, sys; sys.argv[1:] = ['{}']; runpy.run_module('canopen_conformance', None, '__main__')"
    helped, listed = (conformance(tmp_path / flag, code.format(flag)) for flag in ("--help", "--list"))
    assert any("--persistent" in line for line in helped)
    assert len(listed) == len(all_cases())


def test_mistakes_of_the_user_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for more in ("--list --case nosuch", "--tolerance -1", "--tolerance 60001", "-i socketcand -c can0"):
        assert main((more if "--list" in more else f"--node-id 5 {more}").split()) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_device_on_a_bus(tmp_path: Path) -> None:
    assert " 0 failed" in conformance(tmp_path, ON_A_BUS)[-1]
