"""DCF files: our own read back, go to a node, and say what is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from canopen_device import types
from tipforce.dictionary import objects as od
from tipforce.dictionary.eds import dcf_text
from tipforce.dictionary.entries import entries
from tipforce.errors import InputError
from tipforce.host.configuration.configuration_file import (
    apply_configuration,
    read_configuration,
    verify_configuration,
)
from tipforce.host.network.sdo import SdoChannel

NODE = 5


PLACES = {
    place: row.type
    for place, row in entries(3, False).items()
    if row.access == "rw" and row.type in "bBhHiIf" and place[0] not in (0x1010, 0x1011)
}
NUMBERS = {
    letter: st.integers(*limits)
    if (limits := types.data_type(letter).limits)
    else st.floats(-(2.0**99), 2.0**99, width=32)
    for letter in set(PLACES.values())
}


@st.composite
def settings_of_a_node(draw: st.DrawFn) -> dict[tuple[int, int], types.Value]:
    chosen = draw(st.lists(st.sampled_from(sorted(PLACES)), min_size=1, max_size=6, unique=True))
    found: dict[tuple[int, int], types.Value] = {}
    for place in chosen:
        row = entries(3, False)[place]
        if row.low is None and row.high is None:
            found[place] = draw(NUMBERS[PLACES[place]])
        else:
            bounds = types.data_type(row.type).limits or (-1e30, 1e30)
            found[place] = bounds[0] if row.low is None else row.low
        if 0x1800 <= place[0] < 0x1A00 and place[1] == 1:
            found[place] = int(found[place]) | 0x40000000  # no remote requests: nothing else is accepted
    return found


@settings(max_examples=10, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(settings_of_a_node())
def test_our_own_dcf_reads_back(tmp_path: Path, wanted: dict[tuple[int, int], types.Value]) -> None:
    path = tmp_path / "node.dcf"
    path.write_text(dcf_text(3, NODE, wanted), encoding="utf-8")
    found = read_configuration(path, NODE)
    assert {place: entry.encode(value) for place, (entry, value) in found.items()} == {
        place: types.encode(PLACES[place], value) for place, value in wanted.items()
    }


def test_a_dcf_goes_to_a_node(tmp_path: Path, sdo: SdoChannel) -> None:
    wanted: dict[tuple[int, int], types.Value] = {
        (0x1017, 0): 123,
        (0x1800, 1): 0xC0000185,  # bit 30: no remote requests, which this device does not answer
        (0x2105, 1): 500.0,
        (0x6134, 2): -12.5,
        (0x7134, 3): -5,
    }
    path = tmp_path / "node.dcf"
    path.write_text(dcf_text(3, NODE, wanted), encoding="utf-8")
    configuration = read_configuration(path, NODE)
    apply_configuration(sdo, configuration)
    assert verify_configuration(sdo, configuration) == []
    assert sdo.read(od.HEARTBEAT_PRODUCER_MS) == 123
    assert sdo.read(od.TPDO1_COB_ID) == 0xC0000185


def test_an_eds_sets_nothing(tmp_path: Path) -> None:
    path = tmp_path / "node.eds"
    path.write_bytes((Path(__file__).parents[3] / "eds" / "tipforce-3.eds").read_bytes())
    with pytest.raises(InputError, match=r"node\.eds: no object is set"):
        read_configuration(path, NODE)


def test_a_foreign_dcf_names_the_file_and_the_object(tmp_path: Path) -> None:
    text = dcf_text(4, NODE, {(0x2100, 12): 1.0})
    path = tmp_path / "four.dcf"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"four\.dcf: 0x2100:0C: no sub-index 12 .* with 3 gauges"):
        read_configuration(path, NODE)
    found = read_configuration(path, NODE, gauges=4)
    assert {place: value for place, (_, value) in found.items()} == {(0x2100, 12): 1.0}
