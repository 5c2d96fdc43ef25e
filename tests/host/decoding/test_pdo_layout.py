"""Layouts from a DCF and from a DBC."""

from pathlib import Path

import cantools
import numpy as np
import pytest
from cantools.database.can import Database

from canopen_device.core.codes import EXTENDED_FLAG
from tipforce.dictionary.eds import dcf_text, eds_text
from tipforce.dictionary.signals import tpdo_messages
from tipforce.errors import InputError
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.decoding.pdo_layout import dbc_messages, dcf_layout, layout_decoder
from tipforce.host.frames.frame_array import FRAME, FrameArray, frame_array

DBC = Path(__file__).parents[3] / "dbc" / "tipforce.dbc"
DEFAULTS = {message.name: message for message in tpdo_messages()}
FOREIGN = """\
VERSION ""
BU_: A
BO_ 2566834709 Motor: 8 A
 SG_ speed : 7|12@0- (0.25,-100) [0|0] "rpm" A
 SG_ load : 20|10@0+ (0.5,0) [0|0] "%" A
 SG_ volts : 32|12@1+ (0.01,5) [0|0] "V" A
 SG_ count : 44|20@1- (1,0) [0|0] "" A
BO_ 500 Real: 8 A
 SG_ single : 0|32@1- (1,0) [0|0] "" A
 SG_ scaled : 32|32@1- (2,1) [0|0] "" A
BO_ 501 Double: 8 A
 SG_ double : 0|64@1- (1,0) [0|0] "" A
BO_ 502 Choice: 2 A
 SG_ m0 m0 : 8|8@1+ (1,0) [0|0] "" A
 SG_ select M : 0|8@1+ (1,0) [0|0] "" A
SIG_VALTYPE_ 500 single : 1;
SIG_VALTYPE_ 500 scaled : 1;
SIG_VALTYPE_ 501 double : 2;
"""


def random_frames(can_ids: list[int], count: int, seed: int) -> FrameArray:
    random = np.random.default_rng(seed)
    frames: FrameArray = np.zeros(count, dtype=FRAME)
    frames["t_ns"] = np.arange(count)
    frames["can_id"] = random.choice(can_ids, count)
    frames["length"] = 8
    frames["data"] = random.integers(0, 256, (count, 8))
    return frames


def test_a_dcf_gives_identifiers_and_mappings(tmp_path: Path) -> None:
    path = tmp_path / "five.dcf"
    changed = {(0x1800, 1): 0x40000311, (0x1A00, 0): 2, (0x1A00, 1): 0x71300710, (0x1A00, 2): 0x21210008}
    path.write_text(dcf_text(3, 5, changed))
    layout = dcf_layout(path)
    assert (layout.node_id, layout.gauges) == (5, 3)
    assert layout.pdos["Gauges"] == (0x311, ((0x7130, 7, 16), (0x2121, 0, 8)))
    assert layout.pdos["Contact"] == (0x285, DEFAULTS["Contact"].mapping)
    assert layout.pdos["Force"] == (0, DEFAULTS["Force"].mapping)
    found = layout_decoder([layout]).decode(frame_array([(0, 0x311, bytes([0xD2, 4, 9])), (0, 0x185, bytes(8))]))
    assert list(found) == [(5, "Gauges")]
    assert {name: column.tolist() for name, column in found[5, "Gauges"].columns.items()} == {
        "P": [1.234],
        "counter": [9],
    }


@pytest.mark.parametrize("gauges", [3, 8])
def test_an_eds_needs_the_node_id(tmp_path: Path, gauges: int) -> None:
    path = tmp_path / "x.eds"
    path.write_text(eds_text(gauges))
    with pytest.raises(InputError, match="no NodeID"):
        dcf_layout(path)
    layout = dcf_layout(path, 7)
    messages = tpdo_messages(gauges)
    assert layout.pdos == {
        message.name: (message.cob_id_base + 7 if message.enabled else 0, message.mapping) for message in messages
    }
    layout_decoder([layout])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0x54500003", "0x54500009", "product code 0x54500009"),
        ("$NODEID+0x40000180", "$NODEID*2", r"0x1800:01 = '\$NODEID\*2'"),
        ("$NODEID+0x40000180", "0x60001234", "COB-ID 0x60001234"),
    ],
)
def test_what_is_wrong_in_a_dcf(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "x.dcf"
    text = dcf_text(3, 5, {})
    path.write_text(text.replace("NodeID=0x05", "NodeID=05 ; octal"))
    assert (old in text, dcf_layout(path).node_id) == (True, 5)
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        dcf_layout(path)
    with pytest.raises(InputError, match="No such file"):
        dcf_layout(tmp_path / "missing.dcf")


def test_layouts_of_one_decoder_have_to_agree(tmp_path: Path) -> None:
    path = tmp_path / "x.eds"
    path.write_text(eds_text(3))
    three = dcf_layout(path, 1)
    path.write_text(eds_text(4))
    with pytest.raises(InputError, match="one decode needs"):
        layout_decoder([three, dcf_layout(path, 2)])
    with pytest.raises(InputError, match="each node has one layout"):
        layout_decoder([three, three])


def test_our_own_dbc_is_the_dictionary() -> None:
    messages = dbc_messages(DBC)
    frames = random_frames([base + node for base in (0x180, 0x280, 0x380, 0x480) for node in range(1, 16)], 3000, 2)
    ours, theirs = Decoder().decode(frames), Decoder.of_messages(messages).decode(frames)
    assert set(ours) == {key for key in theirs if key[1] in DEFAULTS}
    for key, samples in ours.items():
        other = theirs[key]
        np.testing.assert_array_equal(samples.row, other.row)
        assert set(samples.columns) == set(other.columns)
        for name, column in samples.columns.items():
            np.testing.assert_array_equal(column, other.columns[name], err_msg=f"{key} {name}")


def test_a_foreign_dbc_equals_cantools(tmp_path: Path) -> None:
    path = tmp_path / "foreign.dbc"
    path.write_text(FOREIGN)
    database = cantools.database.load_file(path)
    assert isinstance(database, Database)
    said: list[str] = []
    messages = dbc_messages(path, said.append)
    assert said == [f"{path}: 1 left out (multiplexed signals, messages over 8 bytes): m0"]
    assert messages[0, "Motor"][0] == 2566834709 & 0x1FFFFFFF | EXTENDED_FLAG
    assert [signal.name for signal in messages[0, "Choice"][1].signals] == ["select"]
    can_ids = [can_id for can_id, _ in messages.values()] + [0x18FEF101 | EXTENDED_FLAG, 1]
    frames = random_frames(can_ids, 400, 3)
    frames["data"][frames["can_id"] == 502, 0] = 0  # the multiplexer
    found = Decoder.of_messages(messages).decode(frames)
    assert len(found) == 4
    compared = 0
    for (_, name), samples in found.items():
        message = database.get_message_by_name(name)
        for position, row in enumerate(samples.row.tolist()):
            decoded = message.decode(frames["data"][row].tobytes(), decode_choices=False, allow_truncated=True)
            assert isinstance(decoded, dict)
            for signal, column in samples.columns.items():
                theirs = decoded[signal]
                assert isinstance(theirs, int | float)
                np.testing.assert_allclose(column[position], theirs, rtol=1e-12)
                compared += 1
    assert compared > 500


def test_what_is_no_database(tmp_path: Path) -> None:
    path = tmp_path / "x.dbc"
    with pytest.raises(InputError, match="No such file"):
        dbc_messages(path)
    path.write_text("hello")
    with pytest.raises(InputError, match="not a database"):
        dbc_messages(path)
