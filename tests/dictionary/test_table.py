"""The table itself: order, the default PDOs, the calibration record, the MicroPython subset."""

from __future__ import annotations

import pytest

from canopen_device import types
from tipforce.dictionary import table, table_objects
from tipforce.dictionary.entries import entries, gauges_of, objects
from tipforce.errors import InputError

ALL = [(n, simulated) for n in range(3, 9) for simulated in (False, True)]


@pytest.mark.parametrize(("n", "simulated"), ALL)
def test_indices_are_sorted_and_unique(n: int, simulated: bool) -> None:
    indices = [row[0] for row in table_objects.objects(n, simulated)]
    assert indices == sorted(set(indices))
    assert (0x2200 in indices, 0x2201 in indices) == (simulated, simulated)


@pytest.mark.parametrize(("n", "simulated"), ALL)
def test_sub_indices_and_defaults_are_consistent(n: int, simulated: bool) -> None:
    for found in objects(n, simulated):
        subs = [row.sub for row in found.entries]
        assert subs == sorted(set(subs)), hex(found.index)
        assert (found.code == table.VAR) == (subs == [0]), hex(found.index)
        names = [row.name for row in found.entries]
        assert len(set(names)) == len(names), hex(found.index)
        for row in found.entries:
            types.encode(row.type, b"" if row.type == "D" else row.default)
            if isinstance(row.default, int | float):
                assert row.low is None or row.low <= row.default, row.name
                assert row.high is None or row.default <= row.high, row.name


def test_dotted_names_are_unique() -> None:
    for n, simulated in ALL:
        dotted = [row.name for row in entries(n, simulated).values()]
        assert len(set(dotted)) == len(dotted)


@pytest.mark.parametrize("n", range(3, 9))
def test_default_mappings_are_mappable_and_fit(n: int) -> None:
    known = entries(n)
    for pdos, flag in ((table.tpdos(n), table.TPDO), (table.rpdos(), table.RPDO)):
        for number, _, _, _, _, _, mapping in pdos:
            bits = 0
            for place in mapping:
                assert known[place].flags & flag, place
                size = types.data_type(known[place].type).size
                assert size is not None
                assert table.mapped_bits(place[0]) == 8 * size
                bits += 8 * size
            assert 0 < bits <= 64, number


def test_every_gauge_is_in_exactly_one_default_tpdo() -> None:
    for n in range(3, 9):
        gauges = [s for pdo in table.tpdos(n) for index, s in pdo[6] if index == 0x7130 and s <= n]
        assert gauges == list(range(1, n + 1))


def test_the_calibration_record_of_three_gauges() -> None:
    staged = [row for row in entries(3).values() if row.flags & table.STAGED]
    expected = [(0x2100, s) for s in range(1, 10)] + [(0x2101, s) for s in range(1, 4)]
    expected += [(0x2102, s) for s in range(1, 5)] + [(0x2106, s) for s in range(1, 7)]
    expected += [(0x2110, s) for s in range(1, 7)] + [(0x2112, s) for s in range(1, 6)]
    expected += [(0x2113, s) for s in range(1, 4)] + [(0x2114, s) for s in range(1, 4)] + [(0x2115, 0), (0x2116, 0)]
    assert [(row.index, row.sub) for row in staged] == expected
    assert table_objects.staged(3) == tuple((row.index, row.sub, row.type) for row in staged)
    sizes = dict.fromkeys((index for index, _ in expected), 0)
    for row in staged:
        sizes[row.index] += types.data_type(row.type).size or 0
    assert list(sizes.values()) == [36, 12, 13, 24, 21, 20, 12, 12, 4, 4]
    assert sum(sizes.values()) == 158


def test_views_have_the_default_of_the_value_they_show() -> None:
    for n in (3, 8):
        known = entries(n)
        digits = [channel[3] for channel in table.channels(n)]
        for row in known.values():
            if not row.flags & table.VIEW or row.sub == 0:
                continue
            value = known[0x6000 | row.index & 0xFFF, row.sub]
            scale = 1 if row.unit == "counts" else 10 ** digits[row.sub - 1]
            assert row.default == round(float(value.default) * scale), row.name


def test_what_is_a_state_is_not_stored() -> None:
    """The write lock holds until a power cycle: a stored one would hold for ever."""
    assert entries(3)[0x2105, 2].flags & table.NOT_STORED


@pytest.mark.parametrize("n", [2, 9, 0, -1])
def test_number_of_gauges_outside(n: int) -> None:
    with pytest.raises(ValueError, match="allowed 3 to 8"):
        table_objects.objects(n)
    with pytest.raises(InputError, match="allowed 3 to 8"):
        objects(n)


@pytest.mark.parametrize("converter", [table.CONVERTER_16, table.CONVERTER_24])
@pytest.mark.parametrize("simulated", [False, True])
def test_a_product_code_states_the_gauges(simulated: bool, converter: table.Converter) -> None:
    assert [gauges_of(table.product_code(n, simulated, converter)) for n in range(3, 9)] == [3, 4, 5, 6, 7, 8]
    assert [gauges_of(table.product_code(n, simulated, converter)) for n in (0, 2, 9, 15)] == [0, 0, 0, 0]
    assert gauges_of(table.product_code(3, simulated, converter) | 1 << 10) == 0
