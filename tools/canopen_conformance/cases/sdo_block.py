"""SDO server: upload and download by blocks (CiA 301, 7.2.4.3.9 to 7.2.4.3.16)."""

import binascii
import struct

from canopen_conformance import steps as do
from canopen_conformance.case import NotApplicableError, Service, check, need
from canopen_conformance.cases.sdo import BEAT, NAMES, UPLOADED, not_written, unknown
from canopen_conformance.dut import Dut
from canopen_conformance.wire import SDO, STOP, Abort

# fmt: off
# A table: a case is its header, and below it its steps.

upload = Service("sdo_block")
download = Service("sdo_block_download")


def initiate(dut: Dut, index: int, block_size: int, switch: int = 0, crc: bool = True) -> bytes:
    """Initiate a block upload; not applicable where the device knows no block transfer."""
    answer = dut.ask(struct.pack("<BHBBB", 0xA4 if crc else 0xA0, index, 0, block_size, switch))
    need(not unknown(answer), "no SDO block transfer")
    return answer


def begin_block_upload(dut: Dut, block_size: int, crc: bool = True, start: bool = True) -> None:
    """Initiate the block upload of a string of several segments, which it first reads segmented, and start it."""
    for index in NAMES:
        data = dut.try_read(index)
        if isinstance(data, bytes) and len(data) > 7:
            answer = initiate(dut, index, block_size, crc=crc)
            right = answer[0] & 0xF9 == 0xC0 and answer[1:4] == struct.pack("<HB", index, 0)
            check(right, f"C0h (with bits 1, 2) and {index:04X}h", answer.hex(" "))
            right = not answer[0] & 2 or answer[4:] == struct.pack("<I", len(data))
            check(right, f"size {len(data)}", answer[4:].hex(" "))
            dut.upload_index, dut.data = index, data
            if start:
                dut.request("A3")
            return
    raise NotApplicableError("no string of several segments")


def begun_upload(dut: Dut, started: bool = True) -> None:
    """Initiate a block upload of one segment a block, and (``started``) receive the first."""
    begin_block_upload(dut, 1, start=started)
    if started:
        block(dut, 0, 1)


def segments(dut: Dut, first: int = 0) -> list[bytes]:
    """The segments of a block that holds the data from segment ``first`` on, the last of all marked."""
    parts = [dut.data[at : at + 7] for at in range(0, len(dut.data), 7)][first:]
    return [bytes((number | (0x80 if number == len(parts) else 0),)) + part for number, part in enumerate(parts, 1)]


def block(dut: Dut, first: int = 0, most: int = 127) -> int:
    """Receive the data from segment ``first`` on in at most so many segments; return how many."""
    wanted = segments(dut, first)[:most]
    for segment in wanted:
        data = dut.answer()
        check(data.startswith(segment), segment.hex(" "), data.hex(" "))
    return len(wanted)


def end_block_upload(dut: Dut, crc: bool = True) -> None:
    """The end of the server, after which the client says that it is content."""
    unused = -len(dut.data) % 7
    answer = dut.answer(lambda d: d[0] & 0xE3 == 0xC1)
    wanted = binascii.crc_hqx(dut.data, 0) if crc else 0
    right = answer[0] >> 2 & 7 == unused and struct.unpack("<H", answer[1:3])[0] == wanted
    check(right, f"{unused} bytes unused, CRC {wanted:04X}h", answer.hex(" "))
    dut.request("A1")
    dut.silence(SDO)


def last_block(dut: Dut, first: int = 0, crc: bool = True) -> None:
    """The data from segment ``first`` on in one block, its acknowledgement, and the end."""
    count = block(dut, first)
    dut.request(f"A2 {count:02X} 7F")
    end_block_upload(dut, crc)


upload("upload 7.2.4.3.13: one block: size, segments, end with CRC", (),
    do.run(begin_block_upload, 127), last_block)


@upload("7.2.4.3.14: blocks of one segment")
def blocks_of_one(dut: Dut) -> None:
    begin_block_upload(dut, 1)
    for first in range(len(segments(dut))):
        block(dut, first, 1)
        dut.request("A2 01 01")
    end_block_upload(dut)


upload("changed_block_size 7.2.4.3.14: the client changes the block size from block to block", (),
    do.run(begin_block_upload, 1), do.run(block, 0, 1), do.request("A2 01 7F"), do.run(last_block, 1))
for received in (0, 1):
    upload(f"resend 7.2.4.3.14: ackseq {received} of 2: the rest comes again from there", (),
        do.run(begin_block_upload, 2), do.run(block, 0, 2), do.request(f"A2 {received:02X} 7F"),
        do.run(last_block, received))
upload("resend_last 7.2.4.3.14: the last block is lost: ackseq 0, and it comes again", (),
    do.run(begin_block_upload, 127), do.repeat(2, block, do.request("A2 00 7F")), last_block)


def refused_initiate(dut: Dut, index: int, block_size: int, code: int) -> None:
    """Check that the initiate of a block upload is aborted."""
    answer = initiate(dut, index, block_size)
    check(answer == struct.pack("<BHBI", 0x80, index, 0, code), f"abort {code:08X}h", answer.hex(" "))


for size in (0, 128, 255):
    upload(f"block_size_refused 7.2.4.3.13: block size {size} at the initiate: 05040002h", ((0x1008, 0),),
        do.run(refused_initiate, 0x1008, size, Abort.BLOCK_SIZE))
for size in (0, 128):
    upload(f"block_size_refused_later 7.2.4.3.14: block size {size} in an answer: 05040002h", (),
        begun_upload, do.request(f"A2 01 {size:02X}"), do.aborted(UPLOADED, 0, Abort.BLOCK_SIZE))
upload("without_crc 7.2.4.3.16: a client without CRC finds 0 in its place", (),
    do.run(begin_block_upload, 127, False), do.run(last_block, 0, False))


@upload("7.2.4.3.13: refused at the initiate: {2}", each=[
    (0xFFFF, Abort.NO_OBJECT, "no object"), (None, Abort.WRITE_ONLY, "a write-only object"),
])
def refused(dut: Dut, index: int | None, code: int, _why: str) -> None:
    if index is None:
        index = dut.product.write_only_index if dut.product and dut.is_of_product() else None
    if index is None:
        raise NotApplicableError("no write-only object is known")
    refused_initiate(dut, index, 127, code)


for started, when in ((False, "before the start"), (True, "after a block")):
    upload(f"aborted 7.2.4.3.17: the client aborts {when}: no answer, the transfer is over", (),
        do.run(begun_upload, started), do.abort(UPLOADED), do.silence(SDO), do.ask("40 00 10 00", "43 00 10 00 *"))
upload("stopped 7.3.2.3: stop ends a block upload without a word", (),
    do.run(begun_upload, False), do.nmt(STOP), do.request("A3"), do.silence(SDO))
for command in ("A1", "A2", "A3", "C1"):
    upload("no_transfer 7.2.4.3.17: a block command without a transfer: 05040001h", (),
        do.run(initiate, 0x1000, 127), do.abort(0x1000), do.ask(f"{command} 00 10 00", unknown))


VALUE = b"\x34\x12"


def begin_block_download(dut: Dut, index: int, size: int | None, crc: bool = True) -> int:
    """Initiate a block download; the block size that the server asks for."""
    command = 0xC0 | (4 if crc else 0) | (0 if size is None else 2)
    answer = dut.ask(struct.pack("<BHBI", command, index, 0, size or 0))
    need(not unknown(answer), "no SDO block transfer")
    right = answer[0] & 0xFB == 0xA0 and answer[1:4] == struct.pack("<HB", index, 0) and 1 <= answer[4] <= 127
    check(right, f"A0h or A4h, {index:04X}h, a block size of 1 to 127", answer.hex(" "))
    return answer[4]


def segment(dut: Dut, number: int, data: bytes, last: bool = False) -> None:
    """One segment, which has no answer of its own."""
    dut.request(bytes((number | (0x80 if last else 0),)) + data)


def end_block_download(dut: Dut, data: bytes, unused: int | None = None, crc: int | None = None) -> None:
    """The client's end."""
    bytes_unused = -len(data) % 7 if unused is None else unused
    checksum = binascii.crc_hqx(data, 0) if crc is None else crc
    dut.request(struct.pack("<BH", 0xC1 | bytes_unused << 2, checksum))


def one_segment(dut: Dut, size: int | None = 2, crc: bool = True) -> None:
    """1017h in one segment, up to the answer to it."""
    begin_block_download(dut, 0x1017, size, crc)
    segment(dut, 1, VALUE, True)
    dut.answer("A2 01 .. 00 00 00 00 00")


for stated, how in ((2, "size stated"), (None, "size not stated")):
    download(f"download 7.2.4.3.9: one segment, {how}", BEAT,
        do.run(one_segment, stated), do.run(end_block_download, VALUE), do.answer("A1"),
        do.holds("H", 0x1017, 0, 0x1234))
download("without_crc 7.2.4.3.16: a client without CRC: what stands in its place is not looked at", BEAT,
    do.run(one_segment, crc=False), do.run(end_block_download, VALUE, crc=0xBEEF), do.answer("A1"),
    do.holds("H", 0x1017, 0, 0x1234))
download("bad_crc 7.2.4.3.16: a wrong CRC: 05040004h, nothing is written", BEAT,
    not_written(one_segment, do.run(end_block_download, VALUE, crc=binascii.crc_hqx(VALUE, 0) ^ 1),
        do.aborted(0x1017, 0, Abort.CRC_ERROR)))
for unused, how, code in ((4, "more", Abort.TOO_LONG), (6, "fewer", Abort.TOO_SHORT)):
    download(f"size_mismatch 7.2.4.3.11: {how} bytes at the end than stated", BEAT,
        not_written(one_segment, do.run(end_block_download, (VALUE + bytes(5))[: 7 - unused], unused),
            do.aborted(0x1017, 0, code, Abort.WRONG_LENGTH)))
download("sequence_zero 7.2.4.3.10: segment number 0: 05040003h", BEAT,
    do.run(begin_block_download, 0x1017, 2), do.request("00 34 12"), do.aborted(0x1017, 0, Abort.SEQUENCE_NUMBER))


@download("7.2.4.3.9: refused at the initiate: {3}", each=[
    (0x1000, 4, Abort.READ_ONLY, "a read-only object"), (0xFFFF, 4, Abort.NO_OBJECT, "no object"),
])
def sdo_block_download_refused(dut: Dut, index: int, size: int, code: int, _why: str) -> None:
    codes = (code,) if dut.is_of_product() else (code, Abort.UNKNOWN_COMMAND)  # a device may know no block transfer
    dut.request(struct.pack("<BHBI", 0xC6, index, 0, size))
    dut.aborted(index, 0, *codes)


for begun, when in (
    (do.run(begin_block_download, 0x1017, 2), "before the first segment"), (one_segment, "before the end"),
):
    download(f"aborted 7.2.4.3.17: the client aborts {when}: no answer, nothing is written", BEAT,
        not_written(begun, do.abort(0x1017), do.silence(SDO)))
download("refused_value 7.2.4.3.11: a refused value is refused at the end", ((0x1019, 0),),
    do.run(begin_block_download, 0x1019, 1), do.run(segment, 1, b"\xf1", True), do.answer("A2 01 .."),
    do.run(end_block_download, b"\xf1"), do.aborted(0x1019, 0, Abort.TOO_HIGH, Abort.INVALID_VALUE),
    do.holds("B", 0x1019, 0, 0))
download("afterwards 7.2.4.3.9: after a block download another transfer goes as ever", BEAT,
    one_segment, do.run(end_block_download, VALUE), do.answer("A1"), do.ask("40 17 10 00", "4B 17 10 00 34 12"),
    do.ask("2B 17 10 00 00 00", "60 17 10 00"))
