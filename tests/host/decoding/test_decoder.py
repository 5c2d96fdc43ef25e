"""The bulk decoder: hand-made bytes, other mappings, frames that are not ours, counters."""

import struct

import numpy as np
import pytest

from tipforce.dictionary.table import STATUS_BITS
from tipforce.errors import InputError
from tipforce.host.decoding.decoder import Decoder, Samples, lost_samples, unwrap_counter
from tipforce.host.frames.frame_array import FrameArray, frame_array

STATUS_NAMES = [name for name, _ in STATUS_BITS]
REAL_P = (0x6130, 7, 32)  # n = 3: channel 7 is P
P, PHI, THETA, STATUS, COUNTER = (0x7130, 7, 16), (0x7130, 8, 16), (0x7130, 9, 16), (0x2120, 0, 8), (0x2121, 0, 8)


def contact_bytes(raw: tuple[int, int, int], status: int = 0, counter: int = 0) -> bytes:
    return struct.pack("<hhhBB", *raw, status, counter)


def one(can_id: int, data: bytes) -> FrameArray:
    return frame_array([(1_000, can_id, data)])


def contact(data: bytes) -> Samples:
    return Decoder().decode(one(0x285, data))[5, "Contact"]


def test_the_frame_of_the_protocol() -> None:
    samples = contact(bytes.fromhex("2E1129239A110303"))
    assert (samples.node_id, samples.message.name) == (5, "Contact")
    assert samples.t_ns.tolist() == [1_000]
    assert samples.row.tolist() == [0]
    values = {name: column[0] for name, column in samples.columns.items()}
    assert (values["P"], values["phi"], values["theta"], values["counter"]) == (4.398, 90.01, 45.06, 3)
    assert [name for name in STATUS_NAMES if values[name]] == ["contact", "calibrated"]
    types = {name: column.dtype.name for name, column in samples.columns.items()}
    expected = dict.fromkeys(STATUS_NAMES, "bool") | dict.fromkeys(("P", "phi", "theta"), "float64")
    assert types == expected | {"counter": "uint8"}


def test_order_rows_and_nodes() -> None:
    ids = (0x285, 0x281, 0x185, 0x285, 0x7FF, 0, 0x80, 0x280, 0x300, 0x605, 0x705)
    frames = frame_array([(k, can_id, contact_bytes((k, 0, 0), 0, k)) for k, can_id in enumerate(ids)])
    found = Decoder().decode(frames)
    assert sorted(found) == [(1, "Contact"), (5, "Contact"), (5, "Gauges")]
    assert found[5, "Contact"].row.tolist() == [0, 3]
    assert found[5, "Contact"].t_ns.tolist() == [0, 3]
    assert found[5, "Contact"].columns["P"].tolist() == [0.0, 0.003]
    assert found[1, "Contact"].columns["counter"].tolist() == [1]


def test_only_what_was_asked_for() -> None:
    frames = frame_array([(0, 0x185, bytes(8)), (0, 0x285, bytes(8))])
    found = Decoder().decode(frames, ["P", "stale"])
    assert {key: sorted(samples.columns) for key, samples in found.items()} == {
        (5, "Contact"): ["P", "stale"],
        (5, "Gauges"): ["stale"],
    }
    assert list(Decoder().decode(frames, ["theta"])) == [(5, "Contact")]
    assert Decoder().decode(frames, []) == {}
    with pytest.raises(InputError, match=r"signal Theta: allowed are .*theta"):
        Decoder().decode(frames, ["Theta"])


def test_only_these_nodes() -> None:
    frames = frame_array([(0, 0x281, bytes(8)), (0, 0x285, bytes(8))])
    assert list(Decoder(node_ids=[5]).decode(frames)) == [(5, "Contact")]
    with pytest.raises(InputError, match="node-id 128"):
        Decoder(node_ids=[128])
    with pytest.raises(InputError):
        Decoder(n=9)


def test_short_frames_are_counted_over_all_calls() -> None:
    decoder = Decoder()
    for count in (1, 2):
        assert decoder.decode(one(0x285, b"")) == {}
        assert decoder.malformed == {(5, "Contact"): count}


def test_unaligned_mapping() -> None:
    decoder = Decoder()
    decoder.remap(5, "Contact", 0x3A5, [COUNTER, P, STATUS, PHI, THETA])
    data = struct.pack("<BhBhh", 7, -4398, 0b11, -32768, 4506)
    found = decoder.decode(frame_array([(0, 0x3A5, data), (0, 0x285, data), (0, 0x286, data)]))
    assert sorted(found) == [(5, "Contact"), (6, "Contact")]
    columns = found[5, "Contact"].columns
    assert (columns["counter"][0], columns["P"][0], columns["theta"][0]) == (7, -4.398, 45.06)
    assert np.isnan(columns["phi"][0])
    assert [bool(columns[name][0]) for name in STATUS_NAMES] == [True, True] + 6 * [False]


def test_gaps_real32_and_integer32() -> None:
    decoder = Decoder()
    decoder.remap(5, "Contact", 0x285, [(0x0005, 0, 8), REAL_P])
    decoder.remap(5, "Force", 0x385, [(0x0005, 0, 8), (0x9130, 7, 32)])
    frames = [(0, 0x285, struct.pack("<Bf", 0xFF, value)) for value in (0.5, -1e-30)]
    frames += [(0, 0x385, struct.pack("<Bi", 0xFF, raw)) for raw in (474, -(2**31), -(2**31) + 1)]
    found = decoder.decode(frame_array(frames))
    assert found[5, "Contact"].columns["P"].tolist() == np.array([0.5, -1e-30], dtype=np.float32).tolist()
    np.testing.assert_array_equal(found[5, "Force"].columns["P"], [0.474, np.nan, -2147483.647])


def test_nodes_with_the_same_other_mapping_decode_together() -> None:
    decoder = Decoder()
    for node_id in (5, 6):
        decoder.remap(node_id, "Contact", 0x280 + node_id, [P, STATUS])
    found = decoder.decode(frame_array([(0, 0x286, b"\x01\x00\x01"), (0, 0x285, b"\x02\x00\x00")]))
    assert found[5, "Contact"].message is found[6, "Contact"].message
    assert [found[node_id, "Contact"].columns["P"][0] for node_id in (5, 6)] == [0.002, 0.001]
    assert [bool(found[node_id, "Contact"].columns["contact"][0]) for node_id in (5, 6)] == [False, True]


def test_remap_refuses_and_then_changes_nothing() -> None:
    decoder = Decoder()
    decoder.remap(6, "Contact", 0x286, [P])
    refused = [(5, "Touch", 0x285, [P]), (5, "Contact", 0x286, [P]), (5, "Contact", 0x800, [P]), (0, "Contact", 1, [P])]
    for node_id, name, can_id, mapping in refused:
        with pytest.raises(InputError, match=r"allowed|already assigned"):
            decoder.remap(node_id, name, can_id, mapping)
    with pytest.raises(InputError, match="64"):
        decoder.remap(5, "Contact", 0x285, [P] * 5)
    assert decoder.decode(one(0x285, contact_bytes((1, 1, 1))))[5, "Contact"].columns["theta"][0] == 0.01


def test_a_message_can_be_taken_from_nowhere() -> None:
    decoder = Decoder()
    decoder.remap(5, "Contact", 0, [P])
    assert decoder.decode(one(0x285, bytes(8))) == {}
    decoder.remap(6, "Contact", 0x281, [P])
    decoder.remap(6, "Contact", 0x285, [P])
    assert list(decoder.decode(one(0x281, bytes(8)))) == [(1, "Contact")]
    assert list(decoder.decode(one(0x285, bytes(8)))) == [(6, "Contact")]


def test_more_gauges_on_an_identifier_of_their_own() -> None:
    decoder = Decoder(n=8)
    frames = one(0x1C5, contact_bytes((1, 2, -32768), 0, 9))
    assert (5, "Gauges2") not in decoder.decode(frames)
    assert list(decoder.decode(frames)) == [(69, "Gauges")]  # whose default identifier it is
    decoder.remap(5, "Gauges2", 0x1C5, [(0x7130, 4, 16), (0x7130, 5, 16), (0x7130, 6, 16), STATUS, COUNTER])
    found = decoder.decode(frames)
    assert list(found) == [(5, "Gauges2")]
    columns = found[5, "Gauges2"].columns
    assert (columns["SG4"][0], columns["SG5"][0], columns["counter"][0]) == (0.1, 0.2, 9)
    assert np.isnan(columns["SG6"][0])


def test_a_view_of_frames_decodes_as_its_copy() -> None:
    frames = frame_array([(k, 0x281 + k % 3, contact_bytes((k, -k, 2 * k), k, k)) for k in range(120)])
    for view in (frames[::2], frames[::-1], frames[5:50]):
        direct, copied = Decoder().decode(view), Decoder().decode(view.copy())
        for key, samples in direct.items():
            np.testing.assert_array_equal(samples.columns["P"], copied[key].columns["P"])
            np.testing.assert_array_equal(samples.row, copied[key].row)


@pytest.mark.parametrize(
    ("counter", "lost", "unwrapped"),
    [
        ([], 0, []),
        ([7], 0, [7]),
        ([254, 255, 0, 1], 0, [254, 255, 256, 257]),
        ([3, 3, 4, 4, 4, 5], 0, [3, 3, 4, 4, 4, 5]),  # stale repeats
        ([250, 3], 8, [250, 259]),
        ([0, 2, 2, 5], 3, [0, 2, 2, 5]),
        ([0, 255], 254, [0, 255]),
    ],
)
def test_counter(counter: list[int], lost: int, unwrapped: list[int]) -> None:
    assert lost_samples(np.array(counter, dtype=np.uint8)) == lost
    assert unwrap_counter(counter).tolist() == unwrapped
