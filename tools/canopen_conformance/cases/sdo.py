"""SDO server: expedited and segmented transfer, and aborts (CiA 301, 7.2.4)."""

import struct

from canopen_conformance import steps as do
from canopen_conformance.case import NotApplicableError, Service, Step, check
from canopen_conformance.dut import Dut
from canopen_conformance.wire import EXTENDED_FLAG, REMOTE_FLAG, REQUEST, RESET_COMMUNICATION, SDO, Abort, abort_code

# fmt: off
# A table: a case is its header, and below it its steps.

expedited = Service("sdo")
segmented = Service("sdo_segmented")

BEAT = ((0x1017, 0),)


def not_written(*steps: Step) -> Step:
    """Take the steps, and check that they left 1017h as it was."""
    return do.unchanged(BEAT, *steps)


def unknown(data: bytes) -> bool:
    """Whether an answer is the abort of an unknown command."""
    return abort_code(data) == Abort.UNKNOWN_COMMAND


over = do.ask("60", lambda data: data[0] == 0x80)  # no transfer goes on: a segment is aborted
for place in ("00 10 00", "18 10 01"):
    expedited("upload_u32 7.2.4.3.6: an UNSIGNED32 is read expedited, with its size", (),
        do.ask(f"40 {place}", f"43 {place} *"))
expedited("upload_u16 7.2.4.3.6: an UNSIGNED16 is read expedited, two bytes unused", BEAT,
    do.ask("40 17 10 00", "4B 17 10 00 .. .."))
for place in ("01 10 00", "18 10 00"):
    expedited("upload_u8 7.2.4.3.6: an UNSIGNED8 is read expedited, three bytes unused", (),
        do.ask(f"40 {place}", f"4F {place} .."))
expedited("download 7.2.4.3.3: a write is confirmed with 60h and the multiplexer, and is read back", BEAT,
    do.ask("2B 17 10 00 34 12", "60 17 10 00"), do.ask("40 17 10 00", "4B 17 10 00 34 12"))
expedited("download_u8 7.2.4.3.3: a write of one byte", ((0x1019, 0),),
    do.ask("2F 19 10 00 0A", "60 19 10 00"), do.ask("40 19 10 00", "4F 19 10 00 0A"))
expedited("download_u32 7.2.4.3.3: a write of four bytes", ((0x1016, 1),),
    do.put("I", 0x1016, 1, 0x7003E8), do.put("I", 0x1016, 1, 0), do.ask("23 16 10 01 E8 03 70 00", "60 16 10 01"),
    do.ask("40 16 10 01", "43 16 10 01 E8 03 70 00"))
expedited("download_without_size 7.2.4.3.3: expedited without a size: the object's own length holds", BEAT,
    do.ask("22 17 10 00 34 12 FF FF", "60 17 10 00"), do.ask("40 17 10 00", "4B 17 10 00 34 12"))
for command, size, code in (("2F", 1, Abort.TOO_SHORT), ("27", 3, Abort.TOO_LONG), ("23", 4, Abort.TOO_LONG)):
    expedited(f"download_size 7.2.4.3.3: {size} bytes for an UNSIGNED16 are refused", BEAT,
        not_written(do.request(f"{command} 17 10 00 11 00 00 00"), do.aborted(0x1017, 0, code, Abort.WRONG_LENGTH)))


for index, sub in ((0x1000, 0), (0x1001, 0), (0x1018, 1), (0x1018, 0)):
    expedited(f"read_only 7.2.4.3.17: 06010002h: a write to {index:04X}h:{sub}, which can only be read", (),
        do.refuses_bytes(index, sub, do.late(Dut.read)(index, sub), Abort.READ_ONLY))
for which, command in (("upload", "40"), ("download", "23")):
    expedited(f"no_object 7.2.4.3.17: 06020000h: {which} of an object that is not there", (),
        do.request(f"{command} FF FF 00"), do.aborted(0xFFFF, 0, Abort.NO_OBJECT))
    expedited(f"no_sub 7.2.4.3.17: 06090011h: {which} of a sub-index that is not there", (),
        do.request(f"{command} 18 10 77"), do.aborted(0x1018, 0x77, Abort.NO_SUB))
expedited("variable_sub 7.4.3: a simple variable has sub-index 0 alone", (),
    do.request("40 00 10 01"), do.aborted(0x1000, 1, Abort.NO_SUB))
for value in (241, 255):
    expedited(f"value_high 7.2.4.3.17: 06090031h: {value} to an object of 0 to 240", ((0x1019, 0),),
        do.refuses("B", 0x1019, 0, value, Abort.TOO_HIGH, Abort.INVALID_VALUE), do.holds("B", 0x1019, 0, 0))
for command in ("E0", "FF"):
    expedited(f"unknown_command 7.2.4.3.17: 05040001h: command specifier {command}", (),
        do.request(f"{command} 17 10 00"), do.aborted(0x1017, 0, Abort.UNKNOWN_COMMAND))
for command, what in (("00", "a download"), ("60", "an upload")):
    expedited(f"segment_without_transfer 7.2.4.3.17: 05040001h: {what} segment without a transfer", (),
        do.ask(f"{command} 00 00 00", unknown))
READ = bytes.fromhex("4000100000000000")  # 1000h
for length in (0, 1, 4, 7):
    expedited(f"request_length 7.2.4.3: a request of {length} bytes is no SDO", (),
        do.send(REQUEST, READ[:length]), do.silence(SDO))
for can_id, data, what in (
    (EXTENDED_FLAG | REQUEST, READ, "a 29-bit frame"), (REMOTE_FLAG | REQUEST, b"", "a remote frame"),
    (SDO, READ, "the answer's identifier"),
):
    expedited(f"no_request 7.2.4.3: not a request: {what}", (), do.send(can_id, data), do.silence(SDO))
expedited("other_node 7.2.4.3: a request to another node is not answered", (),
    lambda dut: dut.send(0x600 + (dut.node_id ^ 0x40), READ), do.silence(SDO))
expedited("client_abort_idle 7.2.4.3.17: an abort of the client is not answered, and ends nothing when nothing goes on",
    (),
    do.abort(0x1000), do.silence(SDO), do.ask("40 00 10 00", "43 00 10 00 *"))
expedited("reserved_bytes 7.2.4.3.6: reserved bytes of a request are not looked at", (),
    do.ask("40 00 10 00 FF FF FF FF", "43 00 10 00 *"))
expedited("unused_bytes 7.2.4.3.3: unused bytes of a write are not looked at", BEAT,
    do.ask("2B 17 10 00 34 12 FF FF", "60 17 10 00"), do.holds("H", 0x1017, 0, 0x1234))
expedited("in_order 7.2.4.3: every request has one answer, in order", (),
    do.repeat(3, do.ask("40 00 10 00", "43 00 10 00 *"), do.ask("40 18 10 00", "4F 18 10 00 *")), do.silence(SDO))


def highest_sub(dut: Dut, index: int) -> None:
    """Sub-index 0 is the highest sub-index that is there."""
    highest = dut.integer("B", index, 0)
    dut.request(struct.pack("<BHB", 0x40, index, highest))
    dut.answer(lambda data: abort_code(data) in (0, Abort.WRITE_ONLY))
    dut.request(struct.pack("<BHB", 0x40, index, highest + 1))
    dut.aborted(index, highest + 1, Abort.NO_SUB)


for index in (0x1018, 0x1200, 0x1016, 0x1800):
    expedited(f"highest_sub 7.4.3: sub-index 0 of {index:04X}h is the highest sub-index", ((index, 1),),
        do.between("B", index, 0, 0, 0xFE), do.run(highest_sub, index))


SEGMENT_BYTES = 7
UPLOADED = do.late(lambda dut: dut.upload_index)()  # the object of the upload that the case has begun
NAMES = (0x1008, 0x1009, 0x100A)


def begin_upload(dut: Dut, above: int = 4) -> None:
    """Initiate a segmented upload of a string of more than ``above`` bytes."""
    for index in NAMES:
        answer = dut.ask(struct.pack("<BHB", 0x40, index, 0))
        if answer[0] == 0x41:
            dut.upload_index, dut.upload_size = index, int(struct.unpack("<I", answer[4:])[0])
            if dut.upload_size > above:
                return
            dut.read_segments()
    raise NotApplicableError(f"no string that is longer than {above} bytes")


def read_all(dut: Dut) -> None:
    """The segments of the upload that was begun are as long as it stated."""
    size = len(dut.read_segments())
    check(size == dut.upload_size, f"{dut.upload_size} bytes", f"{size}")


def begin_download(dut: Dut, size: int | None = 2) -> None:
    """Initiate a segmented download of 1017h."""
    dut.ask("20 17 10 00" if size is None else f"21 17 10 00 {size:02X}", "60 17 10 00")


segmented("upload 7.2.4.3.7: all segments: the toggle bit alternates from 0, the stated size comes", (),
    begin_upload, read_all)
for segments, when in ((0, "at first"), (1, "later")):
    segmented(f"upload_toggle 7.2.4.3.7: a wrong toggle bit {when}: 05030000h, and the transfer is over", (),
        do.run(begin_upload, max(4, SEGMENT_BYTES * segments)), do.repeat(segments, do.ask("60", "0. *")),
        do.request("60" if segments else "70"), do.aborted(UPLOADED, 0, Abort.TOGGLE_BIT), over)
segmented("upload_over 7.2.4.3.7: after the last segment the transfer is over", (),
    begin_upload, do.read_segments(), over)
segmented("upload_abort 7.2.4.3.17: the client aborts an upload: no answer, the transfer is over", (),
    begin_upload, do.abort(UPLOADED), do.silence(SDO), over)
segmented("upload_wrong_segment 7.2.4.3.17: a download segment during an upload: 05040001h", (),
    begin_upload, do.request("00"), do.aborted(UPLOADED, 0, Abort.UNKNOWN_COMMAND))
segmented("upload_reset 7.2.8.2.1.6: reset communication ends a transfer", (),
    begin_upload, do.reset(RESET_COMMUNICATION), over)
segmented("upload_twice 7.2.4.3.7: the value is taken at the initiate: a string read twice is the same", (),
    begin_upload, do.reads(UPLOADED, 0, do.late(Dut.read_segments)()))
for stated, how in ((2, "size stated"), (None, "size not stated")):
    segmented(f"download 7.2.4.3.4: one segment, {how}", BEAT,
        do.run(begin_download, stated), do.ask("0B 34 12", "20"), do.holds("H", 0x1017, 0, 0x1234))
segmented("download_two 7.2.4.3.4: two segments: the toggle bit alternates from 0", BEAT,
    begin_download, do.ask("0C 34", "20"), do.ask("1D 12", "30"), do.holds("H", 0x1017, 0, 0x1234))
segmented("download_late 7.2.4.3.4: nothing is written before the last segment", BEAT,
    not_written(begin_download, do.ask("0C 34", "20"), do.abort(0x1017)))
for steps, when in (((do.request("1B 34 12"),), "at first"), ((do.ask("0C 34", "20"), do.request("0D 12")), "later")):
    segmented(f"download_toggle 7.2.4.3.4: a wrong toggle bit {when}: 05030000h, nothing is written", BEAT,
        not_written(begin_download, *steps, do.aborted(0x1017, 0, Abort.TOGGLE_BIT)))
segmented("download_short 7.2.4.3.4: fewer bytes than stated: 06070013h", BEAT,
    begin_download, do.request("0D 34"), do.aborted(0x1017, 0, Abort.TOO_SHORT, Abort.WRONG_LENGTH))
segmented("download_long 7.2.4.3.4: more bytes than stated: 06070012h", BEAT,
    begin_download, do.request("09 34 12 56"), do.aborted(0x1017, 0, Abort.TOO_LONG, Abort.WRONG_LENGTH))
for segment, how, code in (
    ("0D 34", "shorter", Abort.TOO_SHORT), ("01 34 12 56 78 9A BC DE", "longer", Abort.TOO_LONG),
):
    segmented(f"download_wrong_end 7.2.4.3.4: size not stated, {how} than the object: refused at the end", BEAT,
        do.run(begin_download, None), do.request(segment), do.aborted(0x1017, 0, code, Abort.WRONG_LENGTH))
segmented("download_abort 7.2.4.3.17: the client aborts a download: the transfer is over, nothing is written", BEAT,
    not_written(begin_download, do.abort(0x1017), do.silence(SDO), do.ask("0B 34 12", lambda data: data[0] == 0x80)))
segmented("download_wrong_segment 7.2.4.3.17: an upload segment during a download: 05040001h", BEAT,
    begin_download, do.request("60"), do.aborted(0x1017, 0, Abort.UNKNOWN_COMMAND))
segmented("download_value 7.2.4.3.4: a refused value is refused with the last segment", ((0x1019, 0),),
    do.ask("21 19 10 00 01", "60 19 10 00"), do.request("0D F1"),
    do.aborted(0x1019, 0, Abort.TOO_HIGH, Abort.INVALID_VALUE))
