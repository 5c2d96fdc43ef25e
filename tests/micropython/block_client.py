"""The client's side of SDO block transfer (CiA 301, 7.2.4.2.9 to 7.2.4.2.16), as far as the conversations need it."""

import struct

from device.conversation import Conversation
from tipforce.device.crc16 import crc16

SEGMENT_BYTES = 7


def block_upload(talk: Conversation, index: int, sub: int = 0, block_size: int = 127, lose: int = 0) -> bytes:
    """Read an object; segment number ``lose`` of the first block, if any, is lost on the way and asked for again."""
    first = _answer(talk, struct.pack("<BHBBxxx", 0xA4, index, sub, block_size))
    assert first[0] == 0xC6, first.hex()
    size = int.from_bytes(first[4:], "little")
    content = b""
    block = _answers(talk, b"\xa3" + bytes(7))
    while block:
        kept = 0
        for segment in block:
            if kept + 1 == lose:
                lose = 0
                break
            kept += 1
            assert segment[0] & 0x7F == kept
            content += segment[1:]
        block = _answers(talk, bytes((0xA2, kept, block_size)) + bytes(5))
        if len(block) == 1 and block[0][0] & 0xE3 == 0xC1 and len(content) >= size:
            end = block[0]
            content = content[: len(content) - (end[0] >> 2 & 7)]
            assert crc16(content) == end[1] | end[2] << 8
            _answers(talk, b"\xa1" + bytes(7))
            break
    assert len(content) == size
    return content


def block_download(talk: Conversation, index: int, sub: int, content: bytes, lose: int = 0, crc: int = -1) -> int:
    """Write an object: 0, or the abort code. Segment ``lose`` is lost at first; ``crc`` replaces the right one."""
    head = struct.pack("<BHBI", 0xC6, index, sub, len(content))
    first = _answer(talk, head)
    if first[0] == 0x80:
        return int.from_bytes(first[4:], "little")
    assert first[0] == 0xA4
    offset = 0
    while offset < len(content):
        answers: list[bytes] = []
        for number in range(1, first[4] + 1):
            at = offset + SEGMENT_BYTES * (number - 1)
            part = content[at : at + SEGMENT_BYTES]
            last = at + SEGMENT_BYTES >= len(content)
            if number != lose:
                answers = _answers(talk, bytes((number | (0x80 if last else 0),)) + part.ljust(SEGMENT_BYTES, b"\0"))
            if last:
                break
        lose = 0
        assert len(answers) == 1
        assert answers[0][0] == 0xA2
        offset += SEGMENT_BYTES * answers[0][1]
    unused = -len(content) % SEGMENT_BYTES
    right = crc16(content) if crc < 0 else crc
    answer = _answer(talk, struct.pack("<BH", 0xC1 | unused << 2, right) + bytes(5))
    return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0


def _answers(talk: Conversation, request: bytes) -> list[bytes]:
    node_id = talk.device.node_id
    return [data for can_id, data in talk.step([(0x600 + node_id, request)]) if can_id == 0x580 + node_id]


def _answer(talk: Conversation, request: bytes) -> bytes:
    (answer,) = _answers(talk, request)
    return answer
