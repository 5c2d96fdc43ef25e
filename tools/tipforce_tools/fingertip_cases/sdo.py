"""Beyond the standard: the SDO server of a fingertip, expedited, segmented and by blocks."""

from __future__ import annotations

import struct

from canopen_conformance import steps as do
from canopen_conformance.case import Service, check
from canopen_conformance.cases import sdo_block
from canopen_conformance.cases.sdo import BEAT, begin_download, begin_upload, not_written, over
from canopen_conformance.dut import Dut
from canopen_conformance.wire import Abort

# fmt: off
# A table: a case is its header, and below it its steps.

sdo = Service("sdo", own=True)
segmented = Service("sdo_segmented", own=True)
block_upload = Service("sdo_block", own=True)
download = Service("sdo_block_download", own=True)


for index, sub in ((0x2104, 0), (0x2105, 3), (0x6125, 1)):
    sdo(f"write_only 7.2.4.3.17: 06010001h: a read of {index:04X}h:{sub}, which can only be written", (),
        do.request(struct.pack("<BHB", 0x40, index, sub)), do.aborted(index, sub, Abort.WRITE_ONLY))
for index, sub, kind, value in ((0x6114, 1, "I", 99), (0x6112, 1, "B", 0), (0x61A1, 1, "H", 0)):
    sdo(f"value_low 7.2.4.3.17: 06090032h: a value below the limit of {index:04X}h:{sub}", (),
        do.unchanged(kind, index, sub, do.refuses(kind, index, sub, value, Abort.TOO_LOW)))


RECORD = ((0x2141, 0),)


@segmented("7.2.4.2.5: a new initiate gives up the upload that went on")
def upload_restart(dut: Dut) -> None:
    size = begin_upload(dut)
    dut.ask("60", "0. *")
    begin_upload(dut)
    size_read = len(dut.read_segments())
    check(size_read == size, f"{size} bytes from the start", f"{size_read}")


segmented("upload_timeout 7.2.4.3.17: a silent client: 05040000h, and the transfer is over", (),
    begin_upload, do.upload_aborted(Abort.TIMED_OUT, within_ms=1200), over)
segmented("upload_patience 7.2.4.3.17: each request gives the client its time anew", (),
    begin_upload, do.no_sdo(ms=700), do.ask("60", "0. *"), do.no_sdo(ms=700),
    do.ask("70", lambda data: data[0] & 0xF0 == 0x10))
for index, size, code in (
    (0x1017, 1, Abort.TOO_SHORT), (0x1017, 3, Abort.TOO_LONG), (0x2141, 5, Abort.TOO_SHORT),
    (0x2141, 0x10000, Abort.TOO_LONG), (0x1017, 0, Abort.TOO_SHORT),
):
    segmented("download_stated 7.2.4.3.3: a stated size that the object cannot have is refused at the initiate", (),
        do.request(struct.pack("<BHBI", 0x21, index, 0, size)), do.aborted(index, 0, code))
for index, sub, code, why in (
    (0x1008, 0, Abort.READ_ONLY, "a read-only object"), (0xFFFF, 0, Abort.NO_OBJECT, "no object"),
    (0x1018, 9, Abort.NO_SUB, "no sub-index"),
):
    segmented(f"download_refused 7.2.4.3.3: refused at the initiate: {why}", (),
        do.request(struct.pack("<BHBI", 0x21, index, sub, 20)), do.aborted(index, sub, code),
        do.ask("00", lambda data: data[0] == 0x80))
segmented("download_restart 7.2.4.2.2: a new initiate gives up the download that went on", BEAT,
    begin_download, do.ask("0C 99", "20"), begin_download, do.ask("0B 34 12", "20"), do.holds("H", 0x1017, 0, 0x1234))
segmented("download_timeout 7.2.4.3.17: a silent client: 05040000h, nothing is written", BEAT,
    not_written(begin_download, do.aborted(0x1017, 0, Abort.TIMED_OUT, within_ms=1200)))


@segmented("7.2.4.3.4: many segments: a whole record is written and read back", RECORD)
def download_many(dut: Dut) -> None:
    record = bytes(len(dut.read(0x2141)) - 1) + b"\1"
    dut.refuses_bytes(0x2141, 0, record, 0)
    check(dut.read(0x2141) == record, "the record that was written", "another one")


LONG = ((0x1021, 0),)
block_upload("acknowledged_too_much 7.2.4.3.14: ackseq beyond what was sent: 05040003h", (),
    sdo_block.begun_upload, do.request("A2 02 7F"), do.upload_aborted(Abort.SEQUENCE_NUMBER))

@block_upload("7.2.4.3.13: protocol switch: {0} bytes and pst {1} give a {2} upload", ((0x1000, 0),), each=[
    (4, 4, "expedited"), (4, 255, "expedited"), (4, 3, "block"), (4, 0, "block"),
])
def protocol_switch(dut: Dut, _size: int, switch: int, how: str) -> None:
    answer = sdo_block.initiate(dut, 0x1000, 127, switch)
    wanted = 0x43 if how == "expedited" else 0xC6
    check(answer[0] == wanted, f"{wanted:02X}h", f"{answer[0]:02X}h")


@block_upload("7.2.4.3.13: protocol switch to a segmented upload")
def protocol_switch_segmented(dut: Dut) -> None:
    answer = sdo_block.initiate(dut, 0x1008, 127, 100)
    check(answer[0] == 0x41, "41h", f"{answer[0]:02X}h")
    dut.read_segments()


@block_upload("7.2.4.3.14: full blocks of 127 segments", LONG)
def full_block(dut: Dut) -> None:
    size = struct.unpack("<I", sdo_block.initiate(dut, 0x1021, 127)[4:])[0]
    dut.request("A3")
    first = sdo_block.block(dut, 127, size <= 889)
    dut.request("A2 7F 02")
    first += sdo_block.block(dut, 2, False)
    dut.request("80 21 10 00 00 00 00 08")
    dut.ask("40 21 10 00", "41 21 10 00 *")
    for offset in range(0, 35, 7):
        part = dut.ask("60" if offset % 14 == 0 else "70")[1:]
        check(part == first[offset : offset + 7], part.hex(" "), first[offset : offset + 7].hex(" "))


block_upload("restart 7.2.4.2.13: an initiate gives up the block upload that went on", (),
    sdo_block.begun_upload, do.ask("40 00 10 00", "43 00 10 00 *"))
for command, why in (
    ("A2 01 7F", "an answer before the start"), ("A1", "an end before the start"),
    ("60", "a segment of another transfer"),
):
    block_upload(f"wrong_command 7.2.4.3.17: {why}: 05040001h", (),
        do.run(sdo_block.begun_upload, False), do.request(command), do.upload_aborted(Abort.UNKNOWN_COMMAND))
for started, when in ((False, "before the start"), (True, "after a block")):
    block_upload(f"silent_client 7.2.4.3.17: a client that is silent {when}: 05040000h", (),
        do.run(sdo_block.begun_upload, started), do.upload_aborted(Abort.TIMED_OUT, within_ms=1200))


def begin_record(dut: Dut) -> tuple[bytes, int]:
    """Initiate the block download of a record that is not the present one; the record, and its number of segments."""
    data = bytes(len(dut.read(0x2141)) - 1) + b"\1"
    sdo_block.begin_block_download(dut, 0x2141, len(data))
    return data, -(-len(data) // 7)


def end_record(dut: Dut, data: bytes, acknowledged: int) -> None:
    """The answer to the last block, the end of the transfer, and the record that is read back."""
    dut.answer(f"A2 {acknowledged:02X} ..")
    sdo_block.end_block_download(dut, data)
    dut.answer("A1")
    check(dut.read(0x2141) == data, "the record that was written", "another one")


def send(dut: Dut, data: bytes, *numbers: int) -> None:
    """Segments of a block of ``data``, by their numbers in it."""
    for number in numbers:
        sdo_block.segment(dut, number, data[7 * number - 7 : 7 * number], 7 * number >= len(data))


@download("7.2.4.3.10: many segments: the whole record is written", RECORD)
def many(dut: Dut) -> None:
    data, last = begin_record(dut)
    send(dut, data, *range(1, last + 1))
    end_record(dut, data, last)


@download("7.2.4.3.10: a segment is lost: ackseq names the one before it, and the rest is sent again", RECORD)
def lost_segment(dut: Dut) -> None:
    data, last = begin_record(dut)
    send(dut, data, 1, 2, *range(4, last + 1))
    dut.answer("A2 02 ..")
    send(dut, data[14:], *range(1, last - 1))
    end_record(dut, data, last - 2)


@download("7.2.4.3.10: a segment that comes twice counts once", RECORD)
def twice(dut: Dut) -> None:
    data, last = begin_record(dut)
    send(dut, data, 1, 2, *range(2, last + 1))
    end_record(dut, data, last)


@download("7.2.4.3.10: the last segment is lost: the server says after a while what it has", RECORD)
def lost_last(dut: Dut) -> None:
    data, last = begin_record(dut)
    send(dut, data, *range(1, last))
    dut.answer(f"A2 {last - 1:02X} ..", within_ms=900)
    sdo_block.segment(dut, 1, data[7 * last - 7 :], True)
    dut.answer("A2 01 ..")
    sdo_block.end_block_download(dut, data)
    dut.answer("A1")


for code in (Abort.TOO_LONG,):
    download(f"too_much 7.2.4.3.10: more data than stated: {code:08X}h, before the end", BEAT,
        do.run(sdo_block.begin_block_download, 0x1017, 2), do.run(sdo_block.segment, 1, bytes(7)),
        do.aborted(0x1017, 0, code))
for size, code in ((1, Abort.TOO_SHORT), (3, Abort.TOO_LONG), (0xFFFFFFFF, Abort.TOO_LONG)):
    download("refused_size 7.2.4.3.9: a size that the object cannot have is refused at the initiate", BEAT,
        do.request(struct.pack("<BHBI", 0xC6, 0x1017, 0, size)), do.aborted(0x1017, 0, code))


@download("7.2.4.3.17: a client that is silent {1}: 05040000h", BEAT, each=[
    (False, "during a block"), (True, "before the end"),
])
def sdo_block_download_silent_client(dut: Dut, sent: bool, _when: str) -> None:
    if sent:
        sdo_block.one_segment(dut)
    else:
        sdo_block.begin_block_download(dut, 0x1017, 2)
        dut.answer("A2 00 .. 00 00 00 00 00", within_ms=900)
    dut.aborted(0x1017, 0, Abort.TIMED_OUT, within_ms=1200)


download("wrong_end 7.2.4.3.11: no end but another command: 05040001h", BEAT,
    sdo_block.one_segment, do.request("C2"), do.aborted(0x1017, 0, Abort.UNKNOWN_COMMAND))
