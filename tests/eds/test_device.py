"""What the core does for any device: bits in PDOs, event timers, SYNC production, storage, long error histories."""

from __future__ import annotations

import struct
from pathlib import Path

from canopen_device.core import codes
from canopen_device.core.emcy import GENERIC
from canopen_device.testing import Conversation, MemoryStore
from eds.samples import Talk, described, pdo, record, text, var

SYNC = var("1005", 7, "rw", "0x80")


def test_bits_are_packed_and_unpacked(tmp_path: Path) -> None:
    outputs = [0x20000001, 0x20010001, 0x20020010, 0x20030008]
    found = described(
        tmp_path,
        text(
            SYNC, var("2000", 1, "rw", "1"), var("2001", 1, "rw", "0"), var("2002", 6, "rw", "0x8001"),
            var("2003", 1, "rw", "1"),
            pdo(0x1800, "$NODEID+0x180", 1, *outputs), pdo(0x1400, "$NODEID+0x200", 255, *outputs),
        ),
    )  # fmt: skip
    assert found.warnings == []
    talk = Talk(found)
    talk.nmt(1)
    word = 1 | 0 << 1 | 0x8001 << 2 | 1 << 18
    assert talk.step([(0x80, b"")]) == [(0x185, word.to_bytes(4, "little"))]
    talk.sent.clear()
    talk.step([(0x205, (2 | 0x1234 << 2 | 0 << 18).to_bytes(4, "little"))])
    assert [talk.upload(0x2000 + k) for k in range(4)] == [b"\0", b"\1", b"\x34\x12", b"\0"]


def test_wide_integers_reals_and_strings_in_pdos(tmp_path: Path) -> None:
    found = described(
        tmp_path,
        text(
            SYNC, var("2000", 0x10, "rw", "-2"), var("2001", 8, "rw", "1.5"), var("2002", 0x1B, "rw", "258"),
            var("2003", 9, "rw", "ab"), pdo(0x1800, "$NODEID+0x180", 1, 0x20000018, 0x20010020),
            pdo(0x1801, "$NODEID+0x280", 1, 0x20020040), pdo(0x1802, "$NODEID+0x380", 1, 0x20030020),
        ),
    )  # fmt: skip
    assert found.warnings == []
    talk = Talk(found)
    talk.nmt(1)
    assert talk.step([(0x80, b"")]) == [
        (0x185, b"\xfe\xff\xff" + struct.pack("<f", 1.5)), (0x285, struct.pack("<Q", 258)), (0x385, b"ab\0\0"),
    ]  # fmt: skip


def test_sync_production_with_a_counter(tmp_path: Path) -> None:
    objects = (
        SYNC, var("1006", 7, "rw", "1000"), var("1019", 5, "rw", "3"), var("2000", 5, "rw", "7"),
        pdo(0x1800, "$NODEID+0x180", 2, 0x20000008),
        record("1029", var("1029sub0", 5, "const", "1"), var("1029sub1", 5, "rw", "1")),  # bus-off: no change of state
    )  # fmt: skip
    talk: Conversation = Talk(described(tmp_path, text(*objects)))
    talk.say("""\
        > 000#0105
        + 5000
        > 605#2305100080000040    bit 30 of 1005h: produce
        < 585#6005100000000000
        + 999
        + 1
        < 080#01
        + 1000
        < 080#02
        < 185#07
        > 605#2305100081000040    another identifier while producing: refused
        < 585#8005100030000906
        > 605#2F19100000000000    the counter while 1006h is set: refused
        < 585#8019100022000008
        + 1000
        < 080#03
        + 1000
        < 080#01
        < 185#07
        > 000#0205
        + 3000
        > 000#0105
        + 1000
        < 080#01                  starts again at 1
    """)
    talk.step([(codes.ERROR_FLAG | 0x40, bytes(8))])  # bus-off: neither SYNC 2 nor the TPDO on it is sent later
    talk.say("""\
        + 1000
        > 605#2306100000000000
        < 585#6006100000000000
        + 9000
    """)


def test_parameters_are_stored_in_their_groups(tmp_path: Path) -> None:
    stores = record("1010", var("1010sub0", 5, "ro", "4"), *(var(f"1010sub{k}", 7, "rw", "1") for k in (1, 2, 3, 4)))
    content = text(stores, var("2000", 5, "rw", "1"), var("6000", 5, "rw", "1"), var("1017", 6, "rw", "0"))
    found = described(tmp_path, content)
    assert Talk(found).download(0x1010, 1, b"save") == codes.HARDWARE  # nowhere to store
    store = MemoryStore()
    talk = Talk(found, store)
    assert talk.upload(0x1010, 0) == b"\4"  # ro in the file, as in most files
    assert talk.upload(0x1010, 4) == b"\1\0\0\0"
    for index in (0x2000, 0x6000):
        assert talk.download(index, 0, b"\x09") == 0
    assert talk.download(0x1010, 4, b"save") == 0
    talk.step([(0, b"\x81\x05")])
    talk.sent.clear()
    assert talk.upload(0x2000) == b"\x09"
    assert talk.upload(0x6000) == b"\1"


def test_the_error_history_is_as_long_as_1003h(tmp_path: Path) -> None:
    history = "[1003]\nParameterName=Errors\nObjectType=8\nDataType=7\nAccessType=ro\nCompactSubObj=20\n"
    talk = Talk(described(tmp_path, text(history)))
    for code in range(0xFF00, 0xFF20):
        talk.device.emcy.raise_error(code, GENERIC)
    assert talk.upload(0x1003, 0) == b"\x14"
    assert talk.upload(0x1003, 20) == struct.pack("<I", 0xFF0C)
    assert talk.download(0x1003, 0, b"\0") == 0
    assert talk.upload(0x1003, 20) == codes.NO_DATA
    assert talk.upload(0x1003, 21) == codes.NO_SUB


def test_a_tpdo_that_allows_remote_requests_can_be_reconfigured(tmp_path: Path) -> None:
    talk = Talk(described(tmp_path, text(var("2000", 5), pdo(0x1800, "$NODEID+0x180", 255, 0x20000008))))
    assert talk.download(0x1800, 1, struct.pack("<I", 0x80000185)) == 0
    assert talk.download(0x1800, 1, struct.pack("<I", 0x185)) == 0


def test_an_object_of_ten_kilobytes_is_downloaded(tmp_path: Path) -> None:
    talk = Talk(described(tmp_path, text(var("2000", 15, "rw"))))
    data = bytes(range(256)) * 40
    assert talk.download(0x2000, 0, data) == 0
    assert talk.upload(0x2000) == data
