"""Lost samples where SYNCs carry numbers: from the log alone, also where the numbering begins in the middle of it."""

import struct
from pathlib import Path

import pytest

import tipforce
from tipforce.host.decoding.counters import SyncModulus
from tipforce.host.decoding.sample_rule import SAMPLES
from tipforce.host.frames.frame_array import FrameArray, frame_array
from tools.decode.logs import write_frames

Sent = tuple[int, bytes]


def cycles(numbers: list[int], lost: frozenset[int] = frozenset(), numbered: bool = True) -> list[Sent]:
    """SYNCs and the contact PDO of node 5 that follows each, except the ``lost`` ones (counted from 0)."""
    frames: list[Sent] = []
    for k, number in enumerate(numbers):
        frames.append((0x80, bytes((number,)) if numbered else b""))
        if k not in lost:
            frames.append((0x285, struct.pack("<hhhBB", 1000, 4500, 3000, 3, number % 256)))
    return frames


def count(first: int, samples: int, modulus: int) -> list[int]:
    return [(first - 1 + k) % modulus + 1 for k in range(samples)]


CASES = {
    "2,400 numbered": (cycles(count(1, 2400, 240)), 0),
    "three lost": (cycles(count(200, 400, 240), frozenset({39, 41, 300})), 3),
    "another producer, 100": (cycles(count(1, 350, 100), frozenset({99})), 1),
    "without numbers": (cycles(list(range(600)), frozenset({256}), numbered=False), 1),
    "numbered in the middle": (cycles(list(range(300)), numbered=False) + cycles(count(1, 600, 240)), 0),
    "numbered at first": (cycles(count(9, 500, 240)) + cycles(list(range(77, 400)), numbered=False), 0),
}


def framed(sent: list[Sent]) -> FrameArray:
    return frame_array([(1_000_000 * k, can_id, data) for k, (can_id, data) in enumerate(sent)])


@pytest.mark.parametrize("name", CASES)
def test_a_log_says_how_many_were_lost(tmp_path: Path, name: str) -> None:
    sent, lost = CASES[name]
    assert tipforce.read_log(write_frames(tmp_path / "run.log", framed(sent))).lost == {5: lost}


def test_modulus() -> None:
    modulus = SyncModulus()
    assert modulus.modulus == SAMPLES
    modulus.look(framed(cycles([7, 8])))
    assert modulus.modulus == 240
    modulus.look(framed(cycles([9, 10, 1])))
    assert modulus.modulus == 10
    modulus.look(framed(cycles([11, 12])))  # it was a restart
    assert modulus.modulus == 240
    assert len(list(modulus.parts(framed(cycles([1], numbered=False))))) == 2
    assert modulus.modulus == SAMPLES
