"""Logs of a hand's traffic as candump -L writes them, seeded, made many lines at a time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from tipforce.host.frames.frame_array import FRAME, FrameArray

CHANNEL = b"can0"
START_US = 1_700_000_000_000_000
CYCLE_US = 2000
_CHUNK = 200_000
_HEX = np.frombuffer(b"0123456789ABCDEF", dtype=np.uint8)
_SPECIAL = np.array([-32768, 32767, -32767, 0], dtype=np.int16)

Bytes = npt.NDArray[np.uint8]


def hand_traffic(count: int, nodes: int, variable: bool, seed: int) -> FrameArray:
    """``count`` frames: TPDO1 and TPDO2 of ``nodes`` at each SYNC. One value in twenty is unknown or at a limit.

    ``variable``: with the SYNC itself (no data), and a foreign frame of 0 to 8 bytes in each cycle.
    """
    random = np.random.default_rng(seed)
    ids = [base + node for node in range(1, nodes + 1) for base in (0x180, 0x280)]
    cycle = np.array([0x080, *ids, 0x5C0] if variable else ids, dtype=np.uint32)
    frames: FrameArray = np.zeros(count, dtype=FRAME)
    number = np.arange(count)
    frames["can_id"] = cycle[number % len(cycle)]
    step_us = CYCLE_US // (len(cycle) + 1)
    frames["t_ns"] = (START_US + number // len(cycle) * CYCLE_US + number % len(cycle) * step_us) * 1000
    values = random.integers(-32767, 32768, (count, 3), dtype=np.int16)
    special = random.random((count, 3)) < 0.05
    values[special] = random.choice(_SPECIAL, int(special.sum()))
    data = frames["data"]
    data[:, :6] = values.view(np.uint8)
    data[:, 6] = random.choice(np.array([3, 2, 0, 11, 0x83], dtype=np.uint8), count)
    data[:, 7] = number // len(cycle) % 256
    frames["length"] = 8
    if variable:
        frames["length"][frames["can_id"] == 0x080] = 0
        foreign = frames["can_id"] == 0x5C0
        frames["length"][foreign] = random.integers(0, 9, int(foreign.sum()))
    data *= np.arange(8) < frames["length"][:, None]
    return frames


def write_log(path: Path, frames: FrameArray) -> None:
    """The frames as candump -L writes them. All identifiers have 11 bits."""
    with path.open("wb") as file:
        for start in range(0, len(frames), _CHUNK):
            file.write(_lines(frames[start : start + _CHUNK]))


def _lines(frames: FrameArray) -> bytes:
    t_us = frames["t_ns"] // 1000
    head = len(CHANNEL) + 21
    text: Bytes = np.empty((len(frames), head + 4 + 17), dtype=np.uint8)
    text[:, 0] = ord("(")
    text[:, 1:11] = _digits(t_us // 1_000_000, 10)
    text[:, 11] = ord(".")
    text[:, 12:18] = _digits(t_us % 1_000_000, 6)
    text[:, 18:head] = np.frombuffer(b") " + CHANNEL + b" ", dtype=np.uint8)
    for place, shift in enumerate((8, 4, 0)):
        text[:, head + place] = _HEX[frames["can_id"] >> shift & 15]
    text[:, head + 3] = ord("#")
    payload = text[:, head + 4 : head + 20]
    payload[:, 0::2], payload[:, 1::2] = _HEX[frames["data"] >> 4], _HEX[frames["data"] & 15]
    ends = head + 4 + 2 * frames["length"].astype(np.int64)
    text[np.arange(len(frames)), ends] = ord("\n")
    return text[np.arange(text.shape[1]) <= ends[:, None]].tobytes()


def _digits(values: npt.NDArray[np.int64], count: int) -> Bytes:
    powers = 10 ** np.arange(count - 1, -1, -1)
    return (values[:, None] // powers % 10 + ord("0")).astype(np.uint8)
