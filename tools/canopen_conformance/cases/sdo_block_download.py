"""SDO server, block download (CiA 301, 7.2.4.3.8 to 7.2.4.3.11 and 7.2.4.3.16)."""

from __future__ import annotations

import binascii
import struct

from canopen_conformance.case import CheckError, NotApplicableError, Service
from canopen_conformance.dut import Dut

case = Service("sdo_block_download")

UNKNOWN, SEQUENCE, CRC, TIMED_OUT = 0x05040001, 0x05040003, 0x05040004, 0x05040000
TOO_LONG, TOO_SHORT, BAD_LENGTH = 0x06070012, 0x06070013, 0x06070010
BEAT = ((0x1017, 0),)
VALUE = b"\x34\x12"


def begin(dut: Dut, index: int, size: int | None, crc: bool = True) -> int:
    """Initiate a block download; the block size that the server asks for."""
    command = 0xC0 | (4 if crc else 0) | (0 if size is None else 2)
    answer = dut.ask(struct.pack("<BHBI", command, index, 0, size or 0))
    if answer[0] == 0x80 and answer[4:] == struct.pack("<I", UNKNOWN):
        raise NotApplicableError("no SDO block transfer")
    if answer[0] & 0xFB != 0xA0 or answer[1:4] != struct.pack("<HB", index, 0) or not 1 <= answer[4] <= 127:
        raise CheckError(f"A0h or A4h, {index:04X}h, a block size of 1 to 127", answer.hex(" "))
    return answer[4]


def segment(dut: Dut, number: int, data: bytes, last: bool = False) -> None:
    """One segment, which has no answer of its own."""
    dut.request(bytes((number | (0x80 if last else 0),)) + data)


def end(dut: Dut, data: bytes, unused: int | None = None, crc: int | None = None) -> None:
    """The client's end."""
    bytes_unused = -len(data) % 7 if unused is None else unused
    checksum = binascii.crc_hqx(data, 0) if crc is None else crc
    dut.request(struct.pack("<BH", 0xC1 | bytes_unused << 2, checksum))


def one_segment(dut: Dut, size: int | None = 2, crc: bool = True) -> None:
    """1017h in one segment, up to the answer to it."""
    begin(dut, 0x1017, size, crc)
    segment(dut, 1, VALUE, True)
    dut.answer("A2 01 .. 00 00 00 00 00")


@case("CiA 301 7.2.4.3.9", "one segment, {1}", needs=BEAT, each=[(2, "size stated"), (None, "size not stated")])
def download(dut: Dut, size: int | None, _how: str) -> None:
    one_segment(dut, size)
    end(dut, VALUE)
    dut.answer("A1")
    dut.holds("H", 0x1017, 0, 0x1234)


@case("CiA 301 7.2.4.3.16", "a client without CRC: what stands in its place is not looked at", needs=BEAT)
def without_crc(dut: Dut) -> None:
    one_segment(dut, crc=False)
    end(dut, VALUE, crc=0xBEEF)
    dut.answer("A1")
    dut.holds("H", 0x1017, 0, 0x1234)


@case("CiA 301 7.2.4.3.16", "a wrong CRC: 05040004h, nothing is written", needs=BEAT)
def bad_crc(dut: Dut) -> None:
    before = dut.integer("H", 0x1017)
    one_segment(dut)
    end(dut, VALUE, crc=binascii.crc_hqx(VALUE, 0) ^ 1)
    dut.aborted(0x1017, 0, CRC)
    dut.holds("H", 0x1017, 0, before)


@case(
    "CiA 301 7.2.4.3.11",
    "{1} bytes at the end than stated",
    needs=BEAT,
    each=[(4, "more", TOO_LONG), (6, "fewer", TOO_SHORT)],
)
def size_mismatch(dut: Dut, unused: int, _how: str, code: int) -> None:
    before = dut.integer("H", 0x1017)
    one_segment(dut)
    end(dut, (VALUE + bytes(5))[: 7 - unused], unused)
    dut.aborted(0x1017, 0, code, BAD_LENGTH)
    dut.holds("H", 0x1017, 0, before)


@case("CiA 301 7.2.4.3.10", "segment number 0: 05040003h", needs=BEAT)
def sequence_zero(dut: Dut) -> None:
    begin(dut, 0x1017, 2)
    dut.request("00 34 12")
    dut.aborted(0x1017, 0, SEQUENCE)


@case("CiA 301 7.2.4.3.9", "refused at the initiate: {3}", each=[
    (0x1000, 4, 0x06010002, "a read-only object"), (0xFFFF, 4, 0x06020000, "no object"),
])  # fmt: skip
def refused(dut: Dut, index: int, size: int, code: int, _why: str) -> None:
    codes = (code,) if dut.is_of_product() else (code, UNKNOWN)  # a device may know no block transfer
    dut.request(struct.pack("<BHBI", 0xC6, index, 0, size))
    dut.aborted(index, 0, *codes)


@case("CiA 301 7.2.4.3.17", "the client aborts {1}: no answer, nothing is written", needs=BEAT, each=[
    (False, "before the first segment"), (True, "before the end"),
])  # fmt: skip
def aborted(dut: Dut, sent: bool, _when: str) -> None:
    before = dut.integer("H", 0x1017)
    if sent:
        one_segment(dut)
    else:
        begin(dut, 0x1017, 2)
    dut.request("80 17 10 00 00 00 00 08")
    dut.no_sdo()
    dut.holds("H", 0x1017, 0, before)


@case("CiA 301 7.2.4.3.11", "a refused value is refused at the end", needs=((0x1019, 0),))
def refused_value(dut: Dut) -> None:
    begin(dut, 0x1019, 1)
    segment(dut, 1, b"\xf1", True)
    dut.answer("A2 01 ..")
    end(dut, b"\xf1")
    dut.aborted(0x1019, 0, 0x06090031, 0x06090030)
    dut.holds("B", 0x1019, 0, 0)


@case("CiA 301 7.2.4.3.9", "after a block download another transfer goes as ever", needs=BEAT)
def afterwards(dut: Dut) -> None:
    one_segment(dut)
    end(dut, VALUE)
    dut.answer("A1")
    dut.ask("40 17 10 00", "4B 17 10 00 34 12")
    dut.ask("2B 17 10 00 00 00", "60 17 10 00")
