"""`tipforce dump` beside the real candump, option by option, and behind it in a pipe."""

import random
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest
from bench.measure import background

from tipforce.host.frames.frame_block import LENGTHS
from vcan.support import NODE_ID, SYNC, WAIT_S, Command, RawBus, ip_link, wait_until

EVERYTHING = "vcan0,0:0,#FFFFFFFF"
TWO_BUSES = ["vcan0,123:7FF", "vcan1,123~7FF"]
WORDS = [
    [EVERYTHING], ["-L", EVERYTHING], ["-ta", EVERYTHING], ["-tz", EVERYTHING], ["-td", EVERYTHING],
    ["-tA", EVERYTHING], ["-e", EVERYTHING], ["-x", EVERYTHING], ["-a", EVERYTHING],
    ["-x", "-e", "-a", "-tz", EVERYTHING], ["-L", "-x", EVERYTHING], ["-n", "37", "-ta", EVERYTHING], ["any"],
    ["any,0:0,#FFFFFFFF", "-x", "-L"], ["vcan0,181:7FF,00000123:DFFFFFFF,#4"], ["vcan0,181~7FF"],
    ["vcan0,180:780,1:1,j"], ["vcan0,12345678:DFFFFFFF"], ["vcan0,#FFFFFFFF"], ["vcan0"], ["vcan0,123:C00007FF"],
    TWO_BUSES,
]  # fmt: skip
CHOSEN = [
    (0x285, bytes.fromhex("2E1129239A110303")), (0x181, b"\x01\x02"), (0x80, b""), (0x40000181, bytes(8)),
    (0x40000182, b""), (0x20000004, bytes([0, 4, 0, 0, 0, 0, 0, 0])),
    (0x200001FF, bytes([5, 0x3F, 0xFF, 0x19, 0x34, 0, 96, 128])), (0x20000200, bytes([0, 0, 0, 0, 0, 0, 7, 8])),
    (0x20000008, bytes([0, 0, 0x80, 0x1E])), (0x92345678, bytes(range(8))), (0x80000123, b"\xff"),
    (0xC0000123, bytes(3)), (0x7FF, bytes(7)), (0x123, b""),
    (0x60000004, bytes(8)),  # an error frame with the remote flag, which no controller makes
    (0xA0000004, bytes(8)),
]  # fmt: skip
RANDOM = 150
BUSY = 0x7FE


def random_frame(generator: random.Random) -> bytes:
    """struct can_frame or canfd_frame: standard, extended, remote or error frame, or CAN FD."""
    kind = generator.choice(("standard", "extended", "remote", "error", "fd"))
    can_id = generator.randrange(1 << 11)
    if kind == "extended" or (kind in {"remote", "fd"} and generator.random() < 0.5):
        can_id = generator.randrange(1 << 29) | 0x80000000
    if kind == "error":
        can_id = generator.randrange(1, 1 << 9) | 0x20000000
    if kind == "fd":
        length = generator.choice(LENGTHS)
        return struct.pack("=IBB2x64s", can_id, length, generator.randrange(4), generator.randbytes(length))
    length = generator.randrange(9)
    remote = 0x40000000 if kind == "remote" else 0
    return struct.pack("=IB3x8s", can_id | remote, length, b"" if remote else generator.randbytes(length))


def traffic() -> list[bytes]:
    """The chosen frames, and random ones of all kinds."""
    generator = random.Random(6)
    chosen = [struct.pack("=IB3x8s", can_id, len(data), data) for can_id, data in CHOSEN]
    return chosen + [random_frame(generator) for _ in range(RANDOM)]


def sockets_listening() -> int:
    """How many raw sockets receive: lines of the kernel's own lists."""
    return sum(path.read_text().count(" raw") for path in Path("/proc/net/can").glob("rcvlist_*"))


@contextmanager
def fd_bus(name: str = "vcan0") -> Iterator[socket.socket]:
    """A raw socket that sends CAN FD frames, too; the interface is made to carry them."""
    if int(Path(f"/sys/class/net/{name}/mtu").read_text()) < 72:
        for change in (["down"], ["mtu", "72"], ["up"]):
            ip_link("set", name, *change)
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        bus.bind((name,))
        yield bus


@contextmanager
def listening_candump(words: list[str], output: Path) -> Iterator[None]:
    before = sockets_listening()
    with output.open("wb") as file:
        process = subprocess.Popen(["candump", *words], stdin=subprocess.DEVNULL, stdout=file, stderr=file)
    try:
        wait_until(lambda: sockets_listening() > before, "candump does not listen")
        yield
    finally:
        process.terminate()
        process.wait(WAIT_S)


def start(stack: ExitStack, runs: list[list[str]], folder: Path) -> list[tuple[Command, Path]]:
    """dump and candump with the same words, for each of ``runs``; returns when all of them listen."""
    before = sockets_listening()
    outputs = [folder / f"candump{number}" for number in range(len(runs))]
    for words, output in zip(runs, outputs, strict=True):
        stack.enter_context(listening_candump(words, output))
    with_candumps = sockets_listening()
    dumps = [Command(("dump", *words), folder) for words in runs]
    for dump in dumps:
        stack.callback(dump.close)
    # Side by side, and with the same filters as their candumps.
    everything = with_candumps + with_candumps - before
    wait_until(lambda: sockets_listening() == everything or any(dump.ended for dump in dumps), "a dump does not listen")
    return list(zip(dumps, outputs, strict=True))


def complete(dump: Command, output: Path) -> bool:
    return 0 < output.stat().st_size == len(dump.stdout.encode())


@pytest.fixture(scope="module")
def texts(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, str]]:
    """What dump and candump say for each of WORDS, all at once on the same traffic."""
    folder = tmp_path_factory.mktemp("options")
    with ExitStack() as stack, fd_bus() as bus, RawBus("vcan1") as other:
        runs = start(stack, WORDS, folder)
        for number, frame in enumerate(traffic()):
            bus.send(frame)
            if number % 8 == 0:  # some frames come alone, most are read several at once
                time.sleep(0.002)
        with suppress(AssertionError):  # what differs is told run by run
            wait_until(lambda: all(complete(dump, output) for dump, output in runs), "dump or candump lags")
            # Of frames that wait on two buses each program may show either first: these come after all others.
            other.send(0x123)
            other.send(0x124)
            _, last = runs[WORDS.index(TWO_BUSES)]
            wait_until(lambda: "vcan1  124" in last.read_text(), "candump lags")
            wait_until(lambda: all(complete(dump, output) for dump, output in runs), "dump lags")
        found = []
        for dump, _ in runs:
            if not dump.ended:
                dump.send_signal(signal.SIGINT)
        for (dump, output), words in zip(runs, WORDS, strict=True):
            assert dump.wait() == (0 if "-n" in words else 130), "counted, or else interrupted"
            assert "Traceback" not in dump.stderr
            found.append((dump.stdout, output.read_text()))
        return found


@pytest.mark.parametrize("number", range(len(WORDS)), ids=[" ".join(words) for words in WORDS])
def test_the_same_bytes_as_candump(texts: list[tuple[str, str]], number: int) -> None:
    ours, theirs = texts[number]
    assert theirs
    assert ours == theirs


def test_the_traffic_has_every_kind_of_frame(texts: list[tuple[str, str]]) -> None:
    everything = texts[0][1]
    for part in ("  [64]  ", "remote request", "ERRORFRAME", "       123   [0]", "  12345678   [8]", "  [00] "):
        assert part in everything
    assert len(everything.splitlines()) == len(CHOSEN) + RANDOM
    assert "vcan1  123" not in texts[WORDS.index(TWO_BUSES)][1]


@contextmanager
def kept_busy(bus: socket.socket) -> Iterator[None]:
    """Frames until both listen: dump may take longer to start than the silence that ends candump."""

    def send(stop: threading.Event) -> None:
        while not stop.wait(0.05):
            bus.send(struct.pack("=IB3x8s", BUSY, 0, b""))

    with background(send):
        yield


def test_silence_ends_both(tmp_path: Path) -> None:
    with ExitStack() as stack, fd_bus() as bus:
        with kept_busy(bus):
            ((dump, output),) = start(stack, [["-T", "3000", "-L", EVERYTHING]], tmp_path)
            for frame in traffic()[:5]:  # before the silence
                bus.send(frame)
        assert dump.wait() == 0
        wait_until(lambda: sockets_listening() == 0, "candump goes on")
        ours, theirs = (
            [line for line in text.splitlines() if f" {BUSY:03X}#" not in line]
            for text in (dump.stdout, output.read_text())
        )
        assert ours == theirs
        assert len(ours) == 5


def test_decoded_lines_come_while_candump_still_runs(bus: RawBus, node: Command, tmp_path: Path) -> None:
    output = tmp_path / "decoded"
    bus.send(0x000, bytes((1, NODE_ID)))
    with output.open("wb") as file:
        candump = subprocess.Popen(["candump", "-L", "vcan0"], stdout=subprocess.PIPE)
        command = [sys.executable, "-m", "tipforce_tools.cli.main", "dump", "--decode", "-"]
        dump = subprocess.Popen(command, stdin=candump.stdout, stdout=file)
        try:
            wait_until(lambda: "Contact" in output.read_text(), "no decoded line", lambda: bus.send(SYNC))
            assert candump.poll() is None
            assert f"node {NODE_ID} (0x{NODE_ID:02X}) Contact" in output.read_text(), node.stderr
        finally:
            candump.terminate()
            candump.wait(WAIT_S)
            if candump.stdout is not None:
                candump.stdout.close()
            try:
                code = dump.wait(WAIT_S)
            finally:
                dump.kill()
        assert code == 0, "the end of its input is the end of its work"
