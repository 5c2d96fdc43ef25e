"""SDO server, segmented transfers (CiA 301, 7.2.4.3.3 to 7.2.4.3.7)."""

from __future__ import annotations

import struct

from canopen_conformance.case import NotApplicableError, Service, check
from canopen_conformance.dut import RESET_COMMUNICATION, Dut

case = Service("sdo_segmented")

BEAT = ((0x1017, 0),)
TOGGLE, TIMED_OUT, UNKNOWN = 0x05030000, 0x05040000, 0x05040001
TOO_LONG, TOO_SHORT, BAD_LENGTH = 0x06070012, 0x06070013, 0x06070010
SEGMENT_BYTES = 7
NAMES = (0x1008, 0x1009, 0x100A)


def begin_upload(dut: Dut, above: int = 4) -> tuple[int, int]:
    """Initiate a segmented upload of a string of more than ``above`` bytes; (index, stated size)."""
    for index in NAMES:
        answer = dut.ask(struct.pack("<BHB", 0x40, index, 0))
        if answer[0] == 0x41:
            size = int(struct.unpack("<I", answer[4:])[0])
            if size > above:
                return index, size
            dut.read_segments()
    raise NotApplicableError(f"no string that is longer than {above} bytes")


def begin_download(dut: Dut, size: int | None = 2) -> None:
    """Initiate a segmented download of 1017h."""
    dut.ask("20 17 10 00" if size is None else f"21 17 10 00 {size:02X}", "60 17 10 00")


# --- upload -----------------------------------------------------------------------------------------------


@case("CiA 301 7.2.4.3.7", "all segments: the toggle bit alternates from 0, the stated size comes")
def upload(dut: Dut) -> None:
    _index, size = begin_upload(dut)
    found = len(dut.read_segments())
    check(found == size, f"{size} bytes", f"{found}")


@case(
    "CiA 301 7.2.4.3.7",
    "a wrong toggle bit {1}: 05030000h, and the transfer is over",
    each=[(0, "at first"), (1, "later")],
)
def upload_toggle(dut: Dut, segments: int, _when: str) -> None:
    index, _size = begin_upload(dut, max(4, SEGMENT_BYTES * segments))
    for _ in range(segments):
        dut.ask("60", "0. *")
    dut.request("60" if segments else "70")
    dut.aborted(index, 0, TOGGLE)
    dut.ask("60", lambda data: data[0] == 0x80)


@case("CiA 301 7.2.4.3.7", "after the last segment the transfer is over")
def upload_over(dut: Dut) -> None:
    begin_upload(dut)
    dut.read_segments()
    dut.ask("60", lambda data: data[0] == 0x80)


@case("CiA 301 7.2.4.3.17", "the client aborts an upload: no answer, the transfer is over")
def upload_abort(dut: Dut) -> None:
    index, _size = begin_upload(dut)
    dut.request(struct.pack("<BHBI", 0x80, index, 0, 0x08000000))
    dut.no_sdo()
    dut.ask("60", lambda data: data[0] == 0x80)


@case("CiA 301 7.2.4.3.17", "a download segment during an upload: 05040001h")
def upload_wrong_segment(dut: Dut) -> None:
    index, _size = begin_upload(dut)
    dut.request("00")
    dut.aborted(index, 0, UNKNOWN)


@case("CiA 301 7.2.8.2.1.6", "reset communication ends a transfer")
def upload_reset(dut: Dut) -> None:
    begin_upload(dut)
    dut.reset(RESET_COMMUNICATION)
    dut.ask("60", lambda data: data[0] == 0x80)


@case("CiA 301 7.2.4.3.7", "the value is taken at the initiate: a string read twice is the same")
def upload_twice(dut: Dut) -> None:
    index, _size = begin_upload(dut)
    first = dut.read_segments()
    check(dut.read(index) == first, "the same string", "another one")


# --- download ---------------------------------------------------------------------------------------------


@case("CiA 301 7.2.4.3.4", "one segment, {1}", needs=BEAT, each=[(2, "size stated"), (None, "size not stated")])
def download(dut: Dut, size: int | None, _how: str) -> None:
    begin_download(dut, size)
    dut.ask("0B 34 12", "20")
    dut.holds("H", 0x1017, 0, 0x1234)


@case("CiA 301 7.2.4.3.4", "two segments: the toggle bit alternates from 0", needs=BEAT)
def download_two(dut: Dut) -> None:
    begin_download(dut)
    dut.ask("0C 34", "20")
    dut.ask("1D 12", "30")
    dut.holds("H", 0x1017, 0, 0x1234)


@case("CiA 301 7.2.4.3.4", "nothing is written before the last segment", needs=BEAT)
def download_late(dut: Dut) -> None:
    before = dut.integer("H", 0x1017)
    begin_download(dut)
    dut.ask("0C 34", "20")
    dut.request("80 17 10 00 00 00 00 08")
    dut.holds("H", 0x1017, 0, before)


@case("CiA 301 7.2.4.3.4", "a wrong toggle bit {1}: 05030000h, nothing is written", needs=BEAT, each=[
    (0, "at first"), (1, "later"),
])  # fmt: skip
def download_toggle(dut: Dut, segments: int, _when: str) -> None:
    before = dut.integer("H", 0x1017)
    begin_download(dut)
    if segments:
        dut.ask("0C 34", "20")
    dut.request("0D 12" if segments else "1B 34 12")
    dut.aborted(0x1017, 0, TOGGLE)
    dut.holds("H", 0x1017, 0, before)


@case("CiA 301 7.2.4.3.4", "fewer bytes than stated: {0:08X}h", needs=BEAT, each=[(TOO_SHORT,)])
def download_short(dut: Dut, code: int) -> None:
    begin_download(dut)
    dut.request("0D 34")
    dut.aborted(0x1017, 0, code, BAD_LENGTH)


@case("CiA 301 7.2.4.3.4", "more bytes than stated: {0:08X}h", needs=BEAT, each=[(TOO_LONG,)])
def download_long(dut: Dut, code: int) -> None:
    begin_download(dut)
    dut.request("09 34 12 56")
    dut.aborted(0x1017, 0, code, BAD_LENGTH)


@case("CiA 301 7.2.4.3.4", "size not stated, {1} than the object: refused at the end", needs=BEAT, each=[
    ("0D 34", "shorter", TOO_SHORT), ("01 34 12 56 78 9A BC DE", "longer", TOO_LONG),
])  # fmt: skip
def download_wrong_end(dut: Dut, segment: str, _how: str, code: int) -> None:
    begin_download(dut, None)
    dut.request(segment)
    dut.aborted(0x1017, 0, code, BAD_LENGTH)


@case("CiA 301 7.2.4.3.17", "the client aborts a download: the transfer is over, nothing is written", needs=BEAT)
def download_abort(dut: Dut) -> None:
    before = dut.integer("H", 0x1017)
    begin_download(dut)
    dut.request("80 17 10 00 00 00 00 08")
    dut.no_sdo()
    dut.ask("0B 34 12", lambda data: data[0] == 0x80)
    dut.holds("H", 0x1017, 0, before)


@case("CiA 301 7.2.4.3.17", "an upload segment during a download: 05040001h", needs=BEAT)
def download_wrong_segment(dut: Dut) -> None:
    begin_download(dut)
    dut.request("60")
    dut.aborted(0x1017, 0, UNKNOWN)


@case("CiA 301 7.2.4.3.4", "a refused value is refused with the last segment", needs=((0x1019, 0),))
def download_value(dut: Dut) -> None:
    dut.ask("21 19 10 00 01", "60 19 10 00")
    dut.request("0D F1")
    dut.aborted(0x1019, 0, 0x06090031, 0x06090030)
