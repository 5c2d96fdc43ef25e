"""Configuration files, TOML and DCF: what they say, in which order it goes to the node, what is wrong with them."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest

from canopen_device import types
from host.bus_with_nodes import connected, finger
from tipforce.dictionary import objects as od
from tipforce.dictionary.eds import dcf_text
from tipforce.dictionary.names import entries
from tipforce.errors import InputError, NoResponseError, SdoAbortError
from tipforce.host import apply_configuration, read_configuration, verify_configuration
from tipforce.host.configuration.configuration_file import Configuration
from tipforce.host.network.bus import Bus
from tipforce.host.network.sdo import Request, SdoChannel

NODE = 5
REMAP = """[objects]
"heartbeat.producer_ms" = 250
"tpdo1.transmission_type" = 2
"tpdo1.mapping" = ["process_value_int16:7", "status", "counter"]
"rpdo1.cob_id" = 0x205
"""


@pytest.fixture(scope="module")
def connection(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    with connected(finger(NODE, store=tmp_path_factory.mktemp("store") / "node.json")) as (connection, _):
        yield connection


@pytest.fixture
def sdo(connection: Bus) -> SdoChannel:
    connection.buffer.clear()
    connection.nmt("reset-node", NODE)
    connection.wait_for({0x700 + NODE}, 10.0)
    return connection.sdo(NODE)


def read_text(tmp_path: Path, text: str, gauges: int = 3) -> Configuration:
    path = tmp_path / "finger.toml"
    path.write_text(text, encoding="utf-8")
    return read_configuration(path, NODE, gauges)


def values(configuration: Configuration) -> dict[tuple[int, int], types.Value]:
    return {place: value for place, (_, value) in configuration.items()}


class Recorder(SdoChannel):
    """Keeps the writes; reads what was written last, or zeros."""

    def __init__(self) -> None:
        self.node_id = NODE
        self.writes: list[tuple[int, int, int]] = []

    async def _transfer(self, request: Request, *, blocks: bool) -> bytes:
        assert blocks
        index, sub = request.index, request.sub
        if request.data is not None:
            self.writes.append((index, sub, int.from_bytes(request.data, "little")))
        found = [value for i, s, value in self.writes if (i, s) == (index, sub)]
        size = types.data_type(entries(8, True)[index, sub].type).size or 0
        return (found[-1] if found else 3).to_bytes(size, "little")


def test_names_indices_and_lists(tmp_path: Path) -> None:
    found = read_text(
        tmp_path,
        """[objects]
"tpdo2.cob_id" = "0xC0000285"
"heartbeat.producer_ms" = 500
"0x6114:01" = 1000
"calibration.offset" = [1e-6, 2, "0.5"]
"0x2100" = [1, 2, 3, 4, 5, 6, 7, 8, 9]
"0x6133:01" = "nan"
""",
    )
    assert values(found) == {
        (0x1017, 0): 500, (0x1801, 1): 0xC0000285, (0x2101, 1): 1e-6, (0x2101, 2): 2, (0x2101, 3): 0.5,
        (0x6114, 1): 1000, (0x6133, 1): pytest.approx(float("nan"), nan_ok=True),
        **{(0x2100, k): k for k in range(1, 10)},
    }  # fmt: skip
    assert list(found) == sorted(found)


@pytest.mark.parametrize("name", ["calibration.matrix", "0x2100", "2100h"])
def test_a_list_of_more_than_nine_counts_on_in_decimal(tmp_path: Path, name: str) -> None:
    """After an index a sub-index is hexadecimal, so "0x2100:10" would be the sixteenth."""
    found = read_text(tmp_path, f'[objects]\n"{name}" = {list(range(1, 13))}\n', gauges=4)
    assert values(found) == {(0x2100, k): k for k in range(1, 13)}


def test_a_mapping_by_names_or_numbers_has_its_length(tmp_path: Path) -> None:
    found = read_text(
        tmp_path, '[objects]\n"tpdo1.mapping" = ["process_value_int16:7", "status", 0x21210008, "process_value:8"]\n'
    )
    assert values(found) == {
        (0x1A00, 0): 4, (0x1A00, 1): 0x71300710, (0x1A00, 2): 0x21200008, (0x1A00, 3): 0x21210008,
        (0x1A00, 4): 0x61300820,
    }  # fmt: skip
    assert values(read_text(tmp_path, '[objects]\n"tpdo1.mapping" = []\n')) == {(0x1A00, 0): 0}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "finger.toml: objects is missing"),
        ("[objects]\n", "no object is set"),
        ('[objects]\n"0x6124" = []\n', "no object is set"),
        ("[objects\n", "finger.toml: "),
        ("[object]\n", "finger.toml: object: no such key; did you mean objects?"),
        ("objects = 5\n", "finger.toml: objects is 5: expected table, got int"),
        ('[objects]\n"heartbeat.producer_ms" = true\n', "objects.heartbeat.producer_ms is True: expected int | float"),
        ('[objects]\n"heartbeat.producer_ms" = 70000\n', "heartbeat.producer_ms (0x1017:00): 70000 does not fit"),
        ('[objects]\n"heartbeat.producer_ms" = 70000\n', "allowed are 0 to 65535"),
        ('[objects]\n"heartbeat.producer_ms" = 0.5\n', "(0x1017:00): 0.5 is not UNSIGNED16: allowed are integers"),
        ('[objects]\n"heartbeat.producer_ms" = "soon"\n', "(0x1017:00): 'soon' is not UNSIGNED16: write a number"),
        ('[objects]\n"heartbeat.producer" = 1\n', "no object is called 'heartbeat.producer'; close to it: heartbeat"),
        ('[objects]\n"0x5000" = 1\n', "0x5000: no object 0x5000 with 3 gauges; the nearest are"),
        ('[objects]\n"0x2100:0A" = 1\n', "no sub-index 10 (0x0A); allowed, in hex, with 3 gauges: 00-09"),
        ('[objects]\n"0x2100" = 1.0\n', "0x2100 has several sub-indices: write 0x2100:SS"),
        ('[objects]\n"calibration.offset" = [1, 2, 3, 4]\n', "allowed, in hex, with 3 gauges: 00-03"),
        ('[objects]\n"calibration.offset" = [1, "x"]\n', "calibration.offset:2 (0x2101:02): 'x' is not REAL32"),
        ('[objects]\n"calibration.offset" = [1, 1e39]\n', "calibration.offset:2 (0x2101:02): 1e+39 does not fit"),
        ('[objects]\n"heartbeat.producer_ms" = 1\n"0x1017" = 2\n', "(0x1017:00) is set to 1 and to 2"),
        ('[objects]\n"heartbeat.producer_ms" = [1]\n', "heartbeat.producer_ms:1"),
        ('[objects]\n"tpdo1.cob_id" = 0x185\n', "bit 30 must be set: 0x40000185"),
        ('[objects]\n"tpdo1.mapping" = ["speed"]\n', "no object is called 'speed'"),
        ('[objects]\n"tpdo1.mapping" = [-1]\n', "tpdo1.mapping:1 (0x1A00:01): -1 does not fit UNSIGNED32"),
        ('[objects]\n"status" = 1\n', "status (0x2120:00) is ro and cannot be configured"),
        ('[objects]\n"device_name" = "x"\n', "device_name (0x1008:00) is const and cannot be configured"),
        ('[objects]\n"calibration.staged_record" = 5\n', "(0x2141:00): 5 is not DOMAIN: allowed are bytes"),
        ('[objects]\n"calibration.staged_record" = "xy"\n', "'xy' is not DOMAIN: write hex bytes"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        read_text(tmp_path, text)
    assert expected in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / "finger.toml") + ": ")


def test_a_file_without_values_sets_nothing() -> None:
    with pytest.raises(InputError, match=r"tipforce-3\.eds: no object is set"):
        read_configuration(Path(__file__).parents[3] / "eds" / "tipforce-3.eds", NODE)


def test_more_gauges_have_more_objects(tmp_path: Path) -> None:
    text = '[objects]\n"tpdo5.cob_id" = 0x400001A5\n"tpdo5.transmission_type" = 1\n'
    with pytest.raises(InputError, match="tpdo5"):
        read_text(tmp_path, text)
    recorder = Recorder()
    apply_configuration(recorder, read_text(tmp_path, text, gauges=4))
    assert recorder.writes == [(0x1804, 1, 0xC00001A5), (0x1804, 2, 1), (0x1804, 1, 0x400001A5)]


IN_ORDER = {
    "invalid, remapped, valid again": (
        '''"tpdo1.transmission_type" = 5
"tpdo1.cob_id" = 0x40000185
"tpdo1.inhibit_100us" = 7
"tpdo1.mapping" = ["status", "counter"]
"heartbeat.producer_ms" = 500''',
        [
            (0x1800, 1, 0xC0000185), (0x1A00, 0, 0), (0x1A00, 1, 0x21200008), (0x1A00, 2, 0x21210008), (0x1A00, 0, 2),
            (0x1800, 2, 5), (0x1800, 3, 7), (0x1800, 1, 0x40000185), (0x1017, 0, 500),
        ],
    ),
    "what the file leaves out is kept from the node": (
        '"0x1A01:02" = 0x21200008',
        [(0x1801, 1, 0x80000003), (0x1A01, 0, 0), (0x1A01, 2, 0x21200008), (0x1A01, 0, 3), (0x1801, 1, 3)],
    ),
    "off before its identifier changes": ('"emcy.cob_id" = 0x90', [(0x1014, 0, 0x80000090), (0x1014, 0, 0x90)]),
    "switched off, it stays off": ('"rpdo1.cob_id" = 0x80000205', [(0x1400, 1, 0x80000205)] * 2),
}  # fmt: skip


@pytest.mark.parametrize("name", IN_ORDER)
def test_the_order_of_the_writes(name: str, tmp_path: Path) -> None:
    text, writes = IN_ORDER[name]
    recorder = Recorder()
    apply_configuration(recorder, read_text(tmp_path, f"[objects]\n{text}\n"))
    assert recorder.writes == writes


def test_apply_then_verify_on_a_node(tmp_path: Path, sdo: SdoChannel) -> None:
    wanted = read_text(tmp_path, REMAP)
    before = verify_configuration(sdo, wanted)
    assert {str(line["object"]) for line in before} >= {
        "heartbeat.producer_ms (0x1017:00)",
        "tpdo1.transmission_type (0x1800:02)",
    }
    assert {"object": "heartbeat.producer_ms (0x1017:00)", "expected": "250", "found": "1000"} in before
    apply_configuration(sdo, wanted)
    assert verify_configuration(sdo, wanted) == []


def test_a_write_only_object_is_applied_and_not_compared(tmp_path: Path, sdo: SdoChannel) -> None:
    wanted = read_text(tmp_path, '[objects]\n"calibration.unlock" = 0x6E65706F\n')
    apply_configuration(sdo, wanted)
    assert verify_configuration(sdo, wanted) == []


def test_what_the_node_refuses_is_named(tmp_path: Path, sdo: SdoChannel) -> None:
    with pytest.raises(SdoAbortError, match=r"write of 0x1800:02: abort 0x06090030"):
        apply_configuration(sdo, read_text(tmp_path, '[objects]\n"tpdo1.transmission_type" = 252\n'))


@pytest.mark.parametrize("lost", [2, 5])
def test_silence_puts_back_what_was_there(tmp_path: Path, lost: int) -> None:
    """The responses to two tries of one write are lost: in a PDO, or in its mapping."""
    wanted = read_text(tmp_path, REMAP)
    with connected(finger(NODE), timeout_s=0.05, retries=1) as (connection, bus):
        sdo, writes = connection.sdo(NODE), itertools.count()
        before = {entry.key: sdo.read(entry) for entry, _ in wanted.values()}
        bus.fault = lambda frame: None if frame.data[0] == 0x60 and next(writes) in (lost, lost + 1) else frame
        with pytest.raises(NoResponseError):
            apply_configuration(sdo, wanted)
        assert {entry.key: sdo.read(entry) for entry, _ in wanted.values()} == before


def test_a_refusal_puts_back_what_was_there(tmp_path: Path, sdo: SdoChannel) -> None:
    before = {entry: sdo.read(entry) for entry in (od.TPDO1_COB_ID, od.TPDO1_MAPPED, od.HEARTBEAT_PRODUCER_MS)}
    mapping = [sdo.read(od.TPDO1_MAPPING[k]) for k in (1, 2, 3)]
    wanted = read_text(
        tmp_path, '[objects]\n"heartbeat.producer_ms" = 500\n"tpdo1.mapping" = [0x71300110, 0x21200008, 0x21000120]\n'
    )
    with pytest.raises(SdoAbortError, match=r"write of 0x1A00:03: abort 0x06040041"):
        apply_configuration(sdo, wanted)
    assert {entry: sdo.read(entry) for entry in before} == before
    assert [sdo.read(od.TPDO1_MAPPING[k]) for k in (1, 2, 3)] == mapping


@pytest.mark.parametrize("end", [0, 1])
def test_our_own_dcf_reads_back(tmp_path: Path, end: int) -> None:
    """Each number at an end of its range, or of its type."""
    wanted: dict[tuple[int, int], types.Value] = {}
    for place, row in entries(3, False).items():
        if row.access == "rw" and row.type in "bBhHiIf" and place[0] not in (0x1010, 0x1011):
            limit = (row.low, row.high)[end]
            wanted[place] = (types.data_type(row.type).limits or (-(2.0**99), 2.0**99))[end] if limit is None else limit
            if 0x1800 <= place[0] < 0x1A00 and place[1] == 1:
                wanted[place] = int(wanted[place]) | 0x40000000  # no remote requests: nothing else is accepted
    path = tmp_path / "node.dcf"
    path.write_text(dcf_text(3, NODE, wanted), encoding="utf-8")
    found = read_configuration(path, NODE)
    assert {place: entry.encode(value) for place, (entry, value) in found.items()} == {
        place: types.encode(entries(3)[place].type, value) for place, value in wanted.items()
    }


def test_a_foreign_dcf_names_the_file_and_the_object(tmp_path: Path) -> None:
    text = dcf_text(4, NODE, {(0x2100, 12): 1.0})
    path = tmp_path / "four.dcf"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"four\.dcf: 0x2100:0C: no sub-index 12 .* with 3 gauges"):
        read_configuration(path, NODE)
    found = read_configuration(path, NODE, gauges=4)
    assert {place: value for place, (_, value) in found.items()} == {(0x2100, 12): 1.0}
