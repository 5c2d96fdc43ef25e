"""Tests on real SocketCAN buses vcan0 and vcan1, with real peers (can-utils); nodes and host in separate processes."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tipforce.host.network.bus import Bus
from tipforce.host.network.interfaces import interfaces
from vcan.support import Command, Launch, RawBus, running_node

BUSES = ("vcan0", "vcan1")
PEERS = ("candump", "canplayer")


def pytest_collection_modifyitems() -> None:
    """Without the buses nothing here can hold: say so once, and fail, rather than skip in silence."""
    down = [name for name in BUSES if not interfaces().get(name)]
    if down:
        raise pytest.UsageError(
            f"tests/vcan needs {' and '.join(BUSES)}; not up here: {', '.join(down)}; "
            "run it on a kernel that has them: tipforce vcan -- python -m pytest tests/vcan"
        )
    lacking = [name for name in PEERS if shutil.which(name) is None]
    if lacking:
        raise pytest.UsageError(f"tests/vcan needs {', '.join(lacking)}: apt-get install -y can-utils")


@pytest.fixture(scope="session")
def own_kernel() -> None:
    if "User Mode Linux" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("loads modules, or sets a clock or an interface: on a kernel of its own, `tipforce vcan --uml`")


@pytest.fixture
def bus() -> Iterator[RawBus]:
    """A raw socket on vcan0, of this process."""
    with RawBus() as opened:
        yield opened


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[Launch]:
    """Starts `tipforce` commands; those that still run when the test ends are ended."""
    started: list[Command] = []

    def start(*words: str) -> Command:
        started.append(Command(words, tmp_path))
        return started[-1]

    yield start
    for command in started:
        command.close()


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Command]:
    """Node 5 with layout I on vcan0, in a process of its own, for all the tests of a module."""
    folder = tmp_path_factory.mktemp("node")
    flags = ("--store", str(folder / "store.json"), "--offset", "12.0,-8.5,5.3", "--uncalibrated")
    with running_node(folder, *flags) as command:
        yield command


@pytest.fixture(scope="module")
def host() -> Iterator[Bus]:
    """The host library's connection to vcan0, in the test process."""
    with Bus.open("vcan0", "socketcan", timeout_s=5.0, retries=0) as connection:
        yield connection
