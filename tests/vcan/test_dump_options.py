"""`tipforce dump` beside the real candump on a real vcan: the same bytes, timestamps included."""

import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

EVERYTHING = "vcan0,0:0,#FFFFFFFF"
WORDS = [
    [EVERYTHING],
    ["-L", EVERYTHING],
    ["-ta", EVERYTHING],
    ["-tz", EVERYTHING],
    ["-td", EVERYTHING],
    ["-tA", EVERYTHING],
    ["-x", "-e", EVERYTHING],
    ["-L", "-x", EVERYTHING],
    ["any"],
    ["vcan0,181:7FF,00000123:DFFFFFFF,#4"],
    ["vcan0,181~7FF"],
    ["vcan0,180:780,1:1,j"],
    ["vcan0,12345678:DFFFFFFF"],
    ["vcan0,#FFFFFFFF"],
]
FRAMES = [
    (0x285, bytes.fromhex("2E1129239A110303")),
    (0x181, b"\x01\x02"),
    (0x80, b""),
    (0x40000181, bytes(8)),
    (0x40000182, b""),
    (0x20000004, bytes([0, 4, 0, 0, 0, 0, 0, 0])),
    (0x200001FF, bytes([5, 0x3F, 0xFF, 0x19, 0x34, 0, 96, 128])),
    (0x20000200, bytes([0, 0, 0, 0, 0, 0, 7, 8])),
    (0x20000008, bytes([0, 0, 0x80, 0x1E])),
    (0x92345678, bytes(range(8))),
    (0x80000123, b"\xff"),
    (0xC0000123, bytes(3)),
    (0x7FF, bytes(7)),
    (0x123, b""),
]


def raw_listeners() -> int:
    """How many raw sockets listen to a bus: lines of the kernel's own lists."""
    return sum(path.read_text().count(" raw") for path in Path("/proc/net/can").glob("rcvlist_*"))


def started(words: list[str]) -> "subprocess.Popen[bytes]":
    """A dump that listens: the kernel says so."""
    before = raw_listeners()
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60
    while raw_listeners() == before and process.poll() is None:
        assert time.monotonic() < deadline, words
        time.sleep(0.05)
    return process


def test_the_same_bytes_as_candump() -> None:
    tipforce = [sys.executable, "-m", "tipforce_tools.main", "dump"]
    runs = [[started([*command, *words]) for command in (["candump"], tipforce)] for words in WORDS]
    time.sleep(1)  # the last one sets its filters
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.bind(("vcan0",))
        for can_id, data in FRAMES:
            bus.send(struct.pack("=IB3x8s", can_id, len(data), data))
            time.sleep(0.03)
    time.sleep(1)
    for words, pair in zip(WORDS, runs, strict=True):
        for process in pair:
            process.terminate()
        theirs, ours = [process.communicate(timeout=60)[0].decode() for process in pair]
        assert theirs, words
        assert ours == theirs, words
