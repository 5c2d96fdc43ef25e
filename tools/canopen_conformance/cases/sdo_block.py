"""SDO server, block upload (CiA 301, 7.2.4.3.12 to 7.2.4.3.16)."""

from __future__ import annotations

import binascii
import struct

from canopen_conformance.case import CheckError, NotApplicableError, Service, check
from canopen_conformance.dut import STOP, Dut

case = Service("sdo_block")

UNKNOWN, BLOCK_SIZE, SEQUENCE, TIMED_OUT = 0x05040001, 0x05040002, 0x05040003, 0x05040000
NAMES = (0x1008, 0x1009, 0x100A)


def initiate(dut: Dut, index: int, block_size: int, switch: int = 0, crc: bool = True) -> bytes:
    """Initiate a block upload; not applicable where the device knows no block transfer."""
    answer = dut.ask(struct.pack("<BHBBB", 0xA4 if crc else 0xA0, index, 0, block_size, switch))
    if answer[0] == 0x80 and answer[4:] == struct.pack("<I", UNKNOWN):
        raise NotApplicableError("no SDO block transfer")
    return answer


def begin(dut: Dut, block_size: int, crc: bool = True) -> tuple[int, bytes]:
    """Initiate the block upload of a string of several segments; (index, what a segmented upload gives)."""
    for index in NAMES:
        data = dut.try_read(index)
        if isinstance(data, bytes) and len(data) > 7:
            answer = initiate(dut, index, block_size, crc=crc)
            if answer[0] & 0xF9 != 0xC0 or answer[1:4] != struct.pack("<HB", index, 0):
                raise CheckError(f"C0h (with bits 1, 2) and {index:04X}h", answer.hex(" "))
            if answer[0] & 2 and answer[4:] != struct.pack("<I", len(data)):
                raise CheckError(f"size {len(data)}", answer[4:].hex(" "))
            return index, data
    raise NotApplicableError("no string of several segments")


def block(dut: Dut, count: int, last: bool) -> bytes:
    """``count`` segments numbered from 1, the last of them marked as the last of all or not."""
    data = b""
    for number in range(1, count + 1):
        head = number | (0x80 if last and number == count else 0)
        data += dut.answer(lambda d, h=head: d[0] == h)[1:]  # type: ignore[misc]
    return data


def end(dut: Dut, data: bytes, crc: bool = True) -> None:
    """The end of the server, after which the client says that it is content."""
    unused = -len(data) % 7
    answer = dut.answer(lambda d: d[0] & 0xE3 == 0xC1)
    wanted = binascii.crc_hqx(data, 0) if crc else 0
    if answer[0] >> 2 & 7 != unused or struct.unpack("<H", answer[1:3])[0] != wanted:
        raise CheckError(f"{unused} bytes unused, CRC {wanted:04X}h", answer.hex(" "))
    dut.request("A1")
    dut.no_sdo()


def segments(data: bytes) -> int:
    """How many segments carry ``data``."""
    return -(-len(data) // 7)


@case("CiA 301 7.2.4.3.13", "one block: size, segments, end with CRC")
def upload(dut: Dut) -> None:
    _index, data = begin(dut, 127)
    dut.request("A3")
    found = block(dut, segments(data), True)
    check(found[: len(data)] == data, data.hex(" "), found.hex(" "))
    dut.request(f"A2 {segments(data):02X} 7F")
    end(dut, data)


@case("CiA 301 7.2.4.3.14", "blocks of one segment")
def blocks_of_one(dut: Dut) -> None:
    _index, data = begin(dut, 1)
    dut.request("A3")
    count = segments(data)
    for number in range(1, count + 1):
        part = block(dut, 1, number == count)
        if part[: len(data) - 7 * number + 7] != data[7 * number - 7 : 7 * number]:
            raise CheckError(f"segment {number}", part.hex(" "))
        dut.request("A2 01 01")
    end(dut, data)


@case("CiA 301 7.2.4.3.14", "the client changes the block size from block to block")
def changed_block_size(dut: Dut) -> None:
    _index, data = begin(dut, 1)
    dut.request("A3")
    found = block(dut, 1, False)
    dut.request("A2 01 7F")
    found += block(dut, segments(data) - 1, True)
    dut.request(f"A2 {segments(data) - 1:02X} 7F")
    end(dut, data)
    check(found[: len(data)] == data, data.hex(" "), found.hex(" "))


@case("CiA 301 7.2.4.3.14", "ackseq {0} of 2: the rest comes again from there", each=[(0,), (1,)])
def resend(dut: Dut, received: int) -> None:
    _index, data = begin(dut, 2)
    dut.request("A3")
    block(dut, 2, segments(data) == 2)
    dut.request(f"A2 {received:02X} 7F")
    rest = data[7 * received :]
    found = block(dut, segments(rest), True)
    check(found[: len(rest)] == rest, rest.hex(" "), found.hex(" "))
    dut.request(f"A2 {segments(rest):02X} 7F")
    end(dut, data)


@case("CiA 301 7.2.4.3.14", "the last block is lost: ackseq 0, and it comes again")
def resend_last(dut: Dut) -> None:
    _index, data = begin(dut, 127)
    dut.request("A3")
    for _ in range(2):
        block(dut, segments(data), True)
        dut.request("A2 00 7F")
    block(dut, segments(data), True)
    dut.request(f"A2 {segments(data):02X} 7F")
    end(dut, data)


@case(
    "CiA 301 7.2.4.3.13",
    "block size {0} at the initiate: 05040002h",
    needs=((0x1008, 0),),
    each=[(0,), (128,), (255,)],
)
def block_size_refused(dut: Dut, size: int) -> None:
    answer = initiate(dut, 0x1008, size)
    check(answer == struct.pack("<BHBI", 0x80, 0x1008, 0, BLOCK_SIZE), "abort 05040002h", answer.hex(" "))


@case("CiA 301 7.2.4.3.14", "block size {0} in an answer: 05040002h", each=[(0,), (128,)])
def block_size_refused_later(dut: Dut, size: int) -> None:
    index, _data = begin(dut, 1)
    dut.request("A3")
    block(dut, 1, False)
    dut.request(f"A2 01 {size:02X}")
    dut.aborted(index, 0, BLOCK_SIZE)


@case("CiA 301 7.2.4.3.16", "a client without CRC finds 0 in its place")
def without_crc(dut: Dut) -> None:
    _index, data = begin(dut, 127, crc=False)
    dut.request("A3")
    block(dut, segments(data), True)
    dut.request(f"A2 {segments(data):02X} 7F")
    end(dut, data, crc=False)


@case("CiA 301 7.2.4.3.13", "refused at the initiate: {2}", each=[
    (0xFFFF, 0x06020000, "no object"), (None, 0x06010001, "a write-only object"),
])  # fmt: skip
def refused(dut: Dut, index: int | None, code: int, _why: str) -> None:
    if index is None:
        index = dut.product.write_only_index if dut.product and dut.is_of_product() else None
    if index is None:
        raise NotApplicableError("no write-only object is known")
    answer = initiate(dut, index, 127)
    check(answer == struct.pack("<BHBI", 0x80, index, 0, code), f"abort {code:08X}h", answer.hex(" "))


@case("CiA 301 7.2.4.3.17", "the client aborts {1}: no answer, the transfer is over", each=[
    (False, "before the start"), (True, "after a block"),
])  # fmt: skip
def aborted(dut: Dut, started: bool, _when: str) -> None:
    index, _data = begin(dut, 1)
    if started:
        dut.request("A3")
        block(dut, 1, False)
    dut.request(struct.pack("<BHBI", 0x80, index, 0, 0x08000000))
    dut.no_sdo()
    dut.ask("40 00 10 00", "43 00 10 00 *")


@case("CiA 301 7.3.2.3", "stop ends a block upload without a word")
def stopped(dut: Dut) -> None:
    begin(dut, 1)
    dut.nmt(STOP)
    dut.request("A3")
    dut.no_sdo()


@case("CiA 301 7.2.4.3.17", "a block command without a transfer: 05040001h", each=[("A1",), ("A2",), ("A3",), ("C1",)])
def no_transfer(dut: Dut, command: str) -> None:
    initiate(dut, 0x1000, 127)
    dut.request("80 00 10 00 00 00 00 08")
    dut.ask(f"{command} 00 10 00", lambda d: d[0] == 0x80 and d[4:] == struct.pack("<I", UNKNOWN))
