"""Conversations at random, from a seed: frames of every service, right, mutated and of no sense at all."""

import random
import struct

from micropython.recording import Recording
from micropython.talk import Talk

NODE_ID = 5
_OBJECTS = (
    0x1000, 0x1001, 0x1003, 0x1005, 0x1007, 0x1008, 0x100C, 0x100D, 0x1010, 0x1011, 0x1012, 0x1013, 0x1014, 0x1015,
    0x1016, 0x1017, 0x1018, 0x1019, 0x1029, 0x1400, 0x1600, 0x1800, 0x1801, 0x1802, 0x1803, 0x1A00, 0x1A01, 0x1A02,
    0x1A03, 0x1F80, 0x2100, 0x2101, 0x2102, 0x2103, 0x2104, 0x2105, 0x2106, 0x2107, 0x2110, 0x2111, 0x2120, 0x2121,
    0x2130, 0x2140, 0x2141, 0x2200, 0x2201, 0x6100, 0x6112, 0x6114, 0x6120, 0x6121, 0x6124, 0x6125, 0x6130, 0x6133,
    0x6134, 0x6139, 0x6150, 0x61A0, 0x7120, 0x7124, 0x7130, 0x7133, 0x9122, 0x9130, 0x9135,
)  # fmt: skip
_SDO_COMMANDS = (
    0x40, 0x40, 0x60, 0x70, 0x23, 0x2B, 0x2F, 0x21, 0x22, 0x00, 0x10, 0x0D, 0xC2, 0xC6, 0xA0, 0xA4, 0xA3, 0xA2,
)  # fmt: skip
_IDENTIFIERS = (
    0x000, 0x080, 0x100, 0x205, 0x285, 0x585, 0x705, 0x70A, 0x7E5, 0x40000705, 0x20000004, 0x20000040, 0x20000100,
)  # fmt: skip
_NUMBERS = (
    0, 1, 4, 5, 255, 0x65766173, 0x64616F6C, 0x74696D63, 0x6F72657A, 0x61726174, 0x6E65706F, 0x3F800000, 0x7FC00000,
)  # fmt: skip


def random_recording(seed: int, steps: int) -> Recording:
    """``steps`` steps with one to three frames each; time goes on by up to 0.2 s between them."""
    chance = random.Random(seed)
    talk = Talk(f"random frames, seed {seed}")
    if chance.random() < 0.7:
        talk.calibrate()
    talk.start()
    for _ in range(steps):
        talk.now_us += chance.choice((0, 100, 500, 500, 1000, 20_000, 200_000))
        talk.step([_frame(chance) for _ in range(chance.choice((1, 1, 1, 2, 3)))])
    return talk.recording


def _frame(chance: random.Random) -> tuple[int, bytes]:
    kind = chance.random()
    if kind < 0.25:
        return 0x80, b""
    if kind < 0.75:
        return 0x600 + NODE_ID, _sdo(chance)
    if kind < 0.8:
        # Mostly start: a node that is stopped or pre-operational for long says little.
        return 0x000, bytes((chance.choice((1, 1, 1, 1, 2, 128, 129, 130)), chance.choice((0, NODE_ID))))
    return chance.choice(_IDENTIFIERS), chance.randbytes(chance.randrange(9))


def _sdo(chance: random.Random) -> bytes:
    if chance.random() < 0.1:
        return chance.randbytes(8)
    value = chance.choice(_NUMBERS) if chance.random() < 0.5 else chance.getrandbits(chance.choice((8, 16, 32)))
    return struct.pack(
        "<BHBI", chance.choice(_SDO_COMMANDS), chance.choice(_OBJECTS), chance.choice((0, 1, 1, 2, 3, 4, 9)), value
    )
