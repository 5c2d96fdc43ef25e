"""The calibration record (docs/objects.md): its layout; the staged objects, 2141h and 2140h have the same bytes."""

import binascii
import math
import struct

import pytest

from fingertip.finger import finger, packing, record
from tipforce.dictionary import table_objects


@pytest.mark.parametrize(("n", "size"), [(3, 158), (4, 198), (5, 242), (6, 290), (7, 342), (8, 398)])
def test_length_of_the_record(n: int, size: int) -> None:
    # 4 (3n + n) + 13 + 4 n (n + 1) / 2 + 21, and in version 2 20 + 4 n + 4 n + 8
    assert size == 16 * n + 13 + 2 * n * (n + 1) + 21 + 28 + 8 * n == struct.calcsize(packing(n))
    talk = finger(n, calibrated=False)
    for index in (0x2140, 0x2141):
        assert talk.upload(index) == bytes(size)


@pytest.mark.parametrize("n", [3, 5, 8])
def test_writing_2141h_sets_every_staged_object(n: int) -> None:
    talk = finger(n, calibrated=False)
    values = [float(k) for k in range(1, 4 * n + 1)] + [7, 20240229, 21.5, 3]
    values += [100.0 + k for k in range(n * (n + 1) // 2)] + [0.0078125, -30.0, 30.0, 2.0, 1.0, 1]
    values += [5.0, 20.0, -10.0, 50.0, 0.25] + [0.5 + k for k in range(2 * n + 2)]
    data = struct.pack(packing(n), *values)
    assert talk.download(0x2141, 0, data) == 0
    read = [talk.get(kind, index, sub) for index, sub, kind in table_objects.staged(n)]
    assert read == values
    assert talk.upload(0x2141) == data
    assert talk.get("I", 0x2103, 2) == binascii.crc32(data)
    # Staged only: the node is still not calibrated.
    assert talk.calibration() == (bytes(len(data)), 0, 0)


@pytest.mark.parametrize("n", [3, 8])
def test_writing_each_object_gives_the_same_record(n: int) -> None:
    talk, data = finger(n, calibrated=False), record(n)
    offset = 0
    for index, sub, kind in table_objects.staged(n):
        size = struct.calcsize(kind)
        assert talk.download(index, sub, data[offset : offset + size]) == 0
        offset += size
    assert talk.upload(0x2141) == data
    assert talk.get("I", 0x2103, 2) == binascii.crc32(data)


def test_condition_number_is_that_of_the_staged_matrix() -> None:
    talk = finger()
    assert talk.get("f", 0x2102, 5) == pytest.approx(1.0)
    assert talk.put("f", 0x2100, 1, 1e6) == 0
    assert talk.get("f", 0x2102, 5) == pytest.approx(100.0)
    assert talk.put("f", 0x2100, 1, 0.0) == 0
    assert talk.get("f", 0x2102, 5) == math.inf
    assert talk.put("f", 0x2102, 5, 1.0) == 0x06010002
