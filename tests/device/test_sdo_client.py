"""The SDO client byte for byte, against the device core, and against servers that do all they can to hold it."""

import itertools
import struct
import tracemalloc
from collections.abc import Callable, Iterable
from functools import partial

import pytest
from bench import fuzz, fuzz_sdo
from bench.fuzz_sdo import DEADLINE_US, INDEX, LIMIT_BYTES, TIMEOUT_US, Response, play

from canopen_device.core import codes
from canopen_device.core.sdo_block import crc16
from canopen_device.core.sdo_client import BlockDownload, BlockUpload, Download, Transfer, Upload

PLACE = struct.pack("<HB", INDEX, 0)
OTHER = struct.pack("<HB", 0x1018, 4)
Behaviour = Callable[[int, bytes], Iterable[Response]]
ONE_MS = 1000
START = b"\x40" + PLACE  # an upload without a size
BLOCK = b"\xc4" + PLACE  # a block upload without a size, with CRC
TAKEN = b"\xa4" + PLACE + b"\x7f"  # a block download, with CRC
Malice = tuple[Callable[[], Transfer], Behaviour, int, str]


def upload(kind: type[Upload] = Upload) -> Upload:
    return kind(INDEX, 0, TIMEOUT_US, DEADLINE_US, LIMIT_BYTES)


def download(kind: type[Download] = Download, size: int = 40) -> Download:
    return kind(INDEX, 0, TIMEOUT_US, DEADLINE_US, bytes(range(size)))


block_upload, block_download = partial(upload, BlockUpload), partial(download, BlockDownload)


def crc(data: bytes) -> str:
    return crc16(data).to_bytes(2, "little").hex(" ")


def talk(transfer: Transfer, script: str) -> None:
    """``> hex`` is the next request, ``< hex`` the response to what was sent; all requests must be named."""
    sent, _ = transfer.step(0)
    for line in filter(None, (raw.strip() for raw in script.splitlines())):
        data = bytes.fromhex(line[1:])
        if line[0] == ">":
            assert sent.pop(0).hex(" ") == data.ljust(8, b"\0").hex(" "), line
        else:
            assert not sent, (line, [request.hex(" ") for request in sent])
            sent, _ = transfer.step(0, data.ljust(8, b"\0"))
    assert not sent, [request.hex(" ") for request in sent]


CONTENT, SIXTEEN = bytes(range(1, 17)), bytes(range(16))


@pytest.mark.parametrize(
    ("make", "script", "data"),
    [
        (upload, "> 40 00 20 00 \n < 4B 00 20 00 11 22", b"\x11\x22"),
        (
            upload, "> 40 00 20 00 \n < 41 00 20 00 09 \n > 60 \n < 00 01 02 03 04 05 06 07 \n > 70 \n < 1B 08 09",
            bytes(range(1, 10)),
        ),
        (partial(download, size=2), "> 2B 00 20 00 00 01 \n < 60 00 20 00", b""),
        (partial(download, size=0), "> 21 00 20 00 \n < 60 00 20 00 \n > 0F \n < 20", b""),
        (
            partial(download, size=9),
            "> 21 00 20 00 09 \n < 60 00 20 00 \n > 00 00 01 02 03 04 05 06 \n < 20 \n > 1B 07 08 \n < 30", b"",
        ),
        # A block upload asks for a lost segment again; the protocol switch.
        (
            block_upload,
            f"""> A4 00 20 00 7F 1C \n < C6 00 20 00 10 \n > A3 \n < 01 01 02 03 04 05 06 07 \n < 83 0F 10 \n > A2 01 7F
            < 01 08 09 0A 0B 0C 0D 0E \n < 82 0F 10 \n > A2 02 7F \n < D5 {crc(CONTENT)} \n > A1""",
            CONTENT,
        ),
        (block_upload, "> A4 00 20 00 7F 1C \n < 43 00 20 00 01 02 03 04", b"\1\2\3\4"),
        # A block download repeats what is not acknowledged.
        (
            partial(block_download, size=16),
            f"""> C6 00 20 00 10 \n < A4 00 20 00 02 \n > 01 00 01 02 03 04 05 06 \n > 02 07 08 09 0A 0B 0C 0D
            < A2 01 7F \n > 01 07 08 09 0A 0B 0C 0D \n > 82 0E 0F \n < A2 02 7F \n > D5 {crc(SIXTEEN)} \n < A1""",
            b"",
        ),
    ],
)  # fmt: skip
def test_a_transfer_byte_for_byte(make: Callable[[], Transfer], script: str, data: bytes) -> None:
    transfer = make()
    talk(transfer, script)
    assert (transfer.ended, transfer.failure, transfer.abort_code, transfer.data) == (True, None, None, data)


def test_silence_in_a_block_is_acknowledged_once_and_then_ends_the_transfer() -> None:
    transfer = block_upload()
    talk(transfer, "> A4 00 20 00 7F 1C \n < C4 00 20 00 \n > A3 \n < 01 01 02 03 04 05 06 07")
    assert transfer.step(TIMEOUT_US - 1) == ([], TIMEOUT_US)
    assert transfer.step(TIMEOUT_US) == ([bytes.fromhex("A2017F0000000000")], 2 * TIMEOUT_US)
    assert transfer.step(2 * TIMEOUT_US) == ([b"\x80" + PLACE + struct.pack("<I", codes.TIMEOUT)], codes.NEVER_US)
    assert transfer.failure == ""


def test_an_abort_of_the_server_is_the_end() -> None:
    transfer = upload()
    talk(transfer, "> 40 00 20 00 \n < 80 00 20 00 00 00 02 06")
    assert (transfer.ended, transfer.abort_code, transfer.failure) == (True, codes.NO_OBJECT, None)


def test_responses_to_others_are_passed_over_and_restart_no_time_out() -> None:
    transfer = upload()
    transfer.step(0)
    for k, other in enumerate((b"\x43" + OTHER + bytes(4), b"\x80" + OTHER + bytes(4), b"\x60" + PLACE, b"\x43\x00")):
        assert transfer.step(1000 * k, other) == ([], TIMEOUT_US)
        assert transfer.ignored == other
    assert transfer.step(5000, b"\x4f" + PLACE + b"\7\0\0\0") == ([], codes.NEVER_US)
    assert transfer.data == b"\7"


def test_a_cancelled_transfer_aborts_once() -> None:
    transfer = upload()
    transfer.step(0)
    assert transfer.cancel() == [b"\x80" + PLACE + struct.pack("<I", codes.GENERAL)]
    assert transfer.cancel() == []
    assert transfer.step(1, b"\x4f" + PLACE + b"\7\0\0\0") == ([], codes.NEVER_US)


def scripted(*answers: Callable[[int], list[bytes]] | bytes) -> Behaviour:
    """Give each request but aborts the next answer; the last one for ever. A function gets the count of requests."""
    count = itertools.count()

    def server(_now_us: int, request: bytes) -> list[Response]:
        if request[0] == 0x80:
            return []
        number = next(count)
        answer = answers[min(number, len(answers) - 1)]
        found = [answer] if isinstance(answer, bytes) else answer(number)
        return [Response(ONE_MS, data.ljust(8, b"\0")) for data in found]

    return server


def storm(answer: bytes) -> Behaviour:
    """Answer the first request with frames every 100 us for as long as any transfer may last."""
    frames = [Response(0, answer.ljust(8, b"\0"), DEADLINE_US // 100)]
    return lambda _now_us, _request: [frames.pop()] if frames else []


def trickle(_now_us: int, request: bytes) -> list[Response]:
    """Answer each request just before its time-out, with one byte."""
    answer = b"\x40" + PLACE if request[0] == 0x40 else bytes((request[0] & 0x10 | 12, 1))
    return [Response(TIMEOUT_US - 1, answer.ljust(8, b"\0"))] if request[0] != 0x80 else []


def segments(first: int, toggle: bool = True) -> Callable[[int], list[bytes]]:
    """A segment with toggle bit whose command is ``first``, for the count of requests."""
    return lambda number: [bytes((first | ((number + 1) % 2 << 4 if toggle else 0),)) + b"1234567"]


def block(numbers: Iterable[int]) -> Callable[[int], list[bytes]]:
    """A block of segments with these sequence numbers."""
    return lambda _number: [bytes((number,)) + b"1234567" for number in numbers]


def malice() -> dict[str, Malice]:
    """By name: the transfer, the server, the client's abort code and its text. A server serves one transfer."""
    return {
        "wrong toggle, upload": (upload, scripted(START, b"\x10"), codes.TOGGLE, "wrong toggle bit"),
        "wrong toggle, download": (download, scripted(b"\x60" + PLACE, b"\x30"), codes.TOGGLE, "wrong toggle bit"),
        "duplicate segments": (upload, scripted(START, segments(0, toggle=False)), codes.TOGGLE, "wrong toggle bit"),
        "size too small": (upload, scripted(b"\x41" + PLACE + b"\x03", segments(0)), codes.TOO_LONG, "than the 3 "),
        "size too large": (upload, scripted(b"\x41" + PLACE + b"\x14", segments(1)), codes.TOO_SHORT, "7 bytes of 20"),
        "4 GB announced": (
            upload, scripted(b"\x41" + PLACE + b"\xff" * 4), codes.OUT_OF_MEMORY, "4294967295 bytes announced, allowed",
        ),
        "endless": (upload, scripted(START, segments(0)), codes.TOO_LONG, "than the 2048 allowed"),
        "empty segments": (upload, scripted(START, segments(14)), codes.UNKNOWN_COMMAND, "an empty segment"),
        "trickle": (upload, trickle, codes.TIMEOUT, "exceeded its deadline"),
        "silence in the middle": (upload, scripted(START, segments(0), lambda _: []), codes.TIMEOUT, ""),
        "silence in a download": (download, scripted(b"\x60" + PLACE, lambda _: []), codes.TIMEOUT, ""),
        "silence in a block": (block_upload, scripted(BLOCK, block((1, 2)), lambda _: []), codes.TIMEOUT, ""),
        "wrong CRC": (
            block_upload, scripted(BLOCK, block((0x81,)), b"\xc1\x12\x34"), codes.BLOCK_CRC, "CRC of the blocks",
        ),
        "number 0": (block_upload, scripted(BLOCK, block((0,))), codes.BLOCK_SEQUENCE, "sequence number 0"),
        "never begins": (block_upload, scripted(BLOCK, block(range(2, 128))), codes.BLOCK_SEQUENCE, "3 blocks had no"),
        "endless blocks": (block_upload, scripted(BLOCK, block(range(1, 128))), codes.TOO_LONG, "the 2048 allowed"),
        "block shorter than announced": (
            block_upload, scripted(b"\xc2" + PLACE + b"\x64", block((0x81,)), b"\xc1"), codes.TOO_SHORT,
            "7 bytes of 100 announced",
        ),
        "acknowledges what was not sent": (
            block_download, scripted(TAKEN, b"\xa2\x7f\x7f"), codes.BLOCK_SEQUENCE, "127 segments acknowledged of 6",
        ),
        "acknowledges nothing": (
            block_download, scripted(TAKEN, b"\xa2\x00\x7f"), codes.BLOCK_SEQUENCE,
            "no segment of 3 blocks was acknowledged",
        ),
        "block size 0": (block_download, scripted(b"\xa4" + PLACE), codes.BLOCK_SIZE, "block size 0"),
        "never confirmed": (block_download, scripted(TAKEN, b"\xa2\x06\x7f"), codes.TIMEOUT, ""),
        "aborts of others": (upload, storm(b"\x80" + OTHER), codes.TIMEOUT, ""),
        "answers to others": (download, storm(b"\x43" + OTHER), codes.TIMEOUT, ""),
        "answers of another kind": (block_download, storm(b"\x60" + PLACE), codes.TIMEOUT, ""),
    }  # fmt: skip


@pytest.mark.parametrize("name", malice())
def test_a_malicious_server_cannot_hold_the_client(name: str) -> None:
    make, server, code, text = malice()[name]
    transfer = make()
    tracemalloc.start()
    try:
        requests = play(transfer, server, DEADLINE_US)
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert transfer.abort_code is None
    assert transfer.failure is not None
    assert text in transfer.failure
    assert bool(text) == bool(transfer.failure), "no reason, no response"
    assert requests[-1] == b"\x80" + PLACE + struct.pack("<I", code)
    assert sum(request[0] == 0x80 for request in requests) == 1
    assert transfer.data == b""
    assert peak_bytes < 20 * LIMIT_BYTES, "most of it are a block in flight, and the last requests"


def test_a_storm_of_aborts_ends_one_transfer_and_not_the_next() -> None:
    """An abort that names the object is a response; its repetitions arrive when no transfer listens."""
    first, second = upload(), upload()
    play(first, storm(b"\x80" + PLACE + struct.pack("<I", codes.NO_OBJECT)), DEADLINE_US)
    assert first.abort_code == codes.NO_OBJECT
    assert first.step(1, b"\x80" + PLACE + bytes(4)) == ([], codes.NEVER_US)
    play(second, scripted(b"\x4f" + PLACE + b"\7"), DEADLINE_US)
    assert second.data == b"\7"


def test_conversations_with_a_lying_server() -> None:
    ends = fuzz_sdo.rounds(2, range(1000))
    assert sum(ends.values()) == 1000
    assert {f"{kind}: done" for kind in ("Upload", "BlockUpload", "Download", "BlockDownload")} <= set(ends)
    assert len(ends) > 20


def test_the_fuzzer_notices_a_transfer_that_does_not_end(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Transfer._advance

    def deaf(self: Transfer, now_us: int, response: bytes | None) -> None:
        original(self, now_us if response is not None or self._due_us < 0 else min(now_us, TIMEOUT_US - 1), response)

    monkeypatch.setattr(Transfer, "_advance", deaf)
    with pytest.raises(fuzz.BrokenError, match=r"--seed 2 --only \d+: BrokenError: no end after"):
        fuzz_sdo.rounds(2, range(200))
