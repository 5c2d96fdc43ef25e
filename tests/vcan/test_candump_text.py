"""`tipforce dump` beside candump (can-utils) on the same traffic: the same text."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest

from vcan.support import WAIT_S, Command, Launch, RawBus, peer, wait_until

START, END = b"start", b"end"
MARKER = 0x123  # passes every filter of these tests
FRAMES = (
    *(f"123#{'1122334455667788'[: 2 * length]}" for length in range(9)),
    "000#0105",
    "080#",
    "7FF#00",
    "185#FFFFFFFFFFFFFFFF",
    "123#R",
    "123#R4",
    "12345678#DEADBEEF",
    "00000001#",
    "1FFFFFFF#R",
    "585#4318100403000000",
)
FD_FRAME = "123##0112233"
CANGENS: tuple[tuple[str, ...], ...] = ((), ("-e",), ("-R",))  # random standard, extended, remote frames
GENERATED = 60

Words = tuple[str, ...]
LOG: Words = ("-L", "vcan0")
SCREEN: tuple[Words, ...] = (
    ("vcan0",),
    ("-x", "vcan0"),
    ("vcan0,123:7FF",),
    ("vcan0,123:C00007FF",),
    ("vcan0,185~7FF",),
)
OPTIONS = (LOG, *SCREEN)


def between_markers(text: str) -> list[str]:
    """The lines from the start marker to the end marker."""
    lines = text.splitlines(keepends=True)
    found = {
        data: [k for k, line in enumerate(lines) if data.hex(" ").upper() in line or data.hex().upper() in line]
        for data in (START, END)
    }
    return lines[found[START][0] : found[END][0] + 1] if found[START] and found[END] else []


class Texts(NamedTuple):
    """The lines of dump and of candump on the same traffic, and what dump says on stderr."""

    ours: list[str]
    theirs: list[str]
    said: str


@pytest.fixture(scope="module")
def texts(tmp_path_factory: pytest.TempPathFactory) -> dict[Words, Texts]:
    """Every pair of programs, all at once, on one traffic: standard, extended, remote and FD frames."""
    folder = tmp_path_factory.mktemp("texts")
    outputs = {words: folder / f"candump{k}" for k, words in enumerate(OPTIONS)}
    with ExitStack() as stack, RawBus() as bus:
        dumps = {words: Command(("dump", *words), folder) for words in OPTIONS}
        for words, dump in dumps.items():
            stack.callback(dump.close)
            stack.enter_context(peer("candump", *words, output=outputs[words]))

        def all_show(found: Callable[[str], object]) -> bool:
            return all(found(dumps[words].stdout) and found(outputs[words].read_text()) for words in OPTIONS)

        wait_until(lambda: all_show(len), "a dump or candump is silent", lambda: bus.send(MARKER))
        bus.send(MARKER, START)
        for frame in (*FRAMES, FD_FRAME):
            subprocess.run(["cansend", "vcan0", frame], check=True, timeout=WAIT_S)
        for flags in CANGENS:
            subprocess.run(["cangen", "vcan0", "-n", str(GENERATED), "-g", "1", *flags], check=True, timeout=WAIT_S)
        bus.send(MARKER, END)
        wait_until(lambda: all_show(between_markers), "a dump or candump lags")
        assert {dump.end(signal.SIGINT) for dump in dumps.values()} == {130}, "interrupted"
        return {
            words: Texts(between_markers(dump.stdout), between_markers(outputs[words].read_text()), dump.stderr)
            for words, dump in dumps.items()
        }


@pytest.mark.parametrize("words", OPTIONS, ids=" ".join)
def test_text_is_candumps_byte_for_byte(texts: dict[Words, Texts], words: Words) -> None:
    ours, theirs, said = texts[words]
    assert ours == theirs
    assert len(ours) >= 2 + 9, "the markers, and 123h with 0 to 8 bytes"
    assert sum("[03]" in line or "##" in line for line in ours) == 1, "the FD frame"
    if words == LOG:
        assert len(ours) == 2 + len(FRAMES) + 1 + len(CANGENS) * GENERATED
    assert "Traceback" not in said


def test_two_buses_with_their_own_filters_are_shown_together(launch: Launch, tmp_path: Path) -> None:
    words = ("vcan0,123:7FF", "vcan1,123~7FF")
    output = tmp_path / "candump"
    dump = launch("dump", *words)

    def shown(text: str) -> bool:
        return text in dump.stdout and text in output.read_text()

    with RawBus() as bus, RawBus("vcan1") as other, peer("candump", *words, output=output):
        passing = ((bus, "vcan0", 0x123, 0x124), (other, "vcan1", 0x124, 0x123))
        for one, name, can_id, _ in passing:
            wait_until(partial(shown, name), f"silent\n{dump.stderr}", partial(one.send, can_id))
        # One at a time: of frames that wait on two buses, each program may show either first.
        for number in range(8):
            for one, name, can_id, filtered in passing:
                one.send(filtered, bytes((number, 0xFF)))
                one.send(can_id, bytes((number, 0xAA)))
                wait_until(partial(shown, f"{name}  {can_id:03X}   [2]  {number:02X} AA"), f"lags\n{dump.stderr}")
    ours, theirs = ([line for line in text.splitlines() if "[2]" in line] for text in (dump.stdout, output.read_text()))
    assert ours == theirs
    assert len(ours) == 16


def test_count_ends_dump(launch: Launch) -> None:
    dump = launch("dump", "-n", "2", "vcan0", fresh=True)
    with RawBus() as bus:
        wait_until(lambda: dump.stdout.count("\n") == 2, dump.stderr, lambda: bus.send(MARKER, END))
        assert dump.wait() == 0
