"""The layout of the PDOs, default and remapped."""

from __future__ import annotations

import pytest

from tipforce.dictionary import table
from tipforce.dictionary.signals import mapping_signals, rpdo_messages, tpdo_messages
from tipforce.errors import InputError


@pytest.mark.parametrize("n", range(3, 9))
def test_signals_lie_side_by_side_and_names_are_unique(n: int) -> None:
    messages = tpdo_messages(n) + rpdo_messages()
    assert sum(m.kind == "tpdo" for m in messages) == len(table.tpdos(n))
    for message in messages:
        taken: set[int] = set()
        for signal in message.signals:
            own = set(range(signal.start_bit, signal.start_bit + signal.bits))
            assert not own & taken
            taken |= own
        assert max(taken) < 8 * message.length_bytes <= 64
        assert len({s.name for s in message.signals}) == len(message.signals)


def test_other_mappings() -> None:
    real, wide = mapping_signals([(0x6130, 7, 32), (0x9130, 9, 32)])
    assert (real.name, real.real, real.scale, real.unknown) == ("P", True, 1.0, None)
    assert (wide.name, wide.bits, wide.start_bit, wide.unknown) == ("theta", 32, 32, -0x80000000)
    u_phi, status = mapping_signals([(0x2107, 2, 32), (0x6150, 8, 8)])
    assert (u_phi.name, u_phi.unit, u_phi.real, status.name) == ("u_phi", "degree", True, "phi_status")
    counts, clock = mapping_signals([(0x7100, 1, 16), (0x1013, 0, 32)])
    assert (counts.name, counts.unit) == ("SG1_counts", "counts")
    assert (clock.name, clock.start_bit, clock.unit) == ("time_high_resolution_us", 16, "us")


def test_channels_move_with_the_number_of_gauges() -> None:
    assert mapping_signals([(0x7130, 7, 16)], 3)[0].name == "P"
    assert mapping_signals([(0x7130, 7, 16)], 8)[0].name == "SG7"


def test_one_quantity_twice_gets_two_names() -> None:
    found = mapping_signals([(0x7130, 7, 16), (0x6130, 7, 32), (0x7130, 7, 16)])
    assert [s.name for s in found] == ["P", "P_6130", "P_7130"]
    many = mapping_signals([(0x2121, 0, 8)] * 4)
    assert len({s.name for s in many}) == 4


def test_dummies_are_gaps() -> None:
    (force,) = mapping_signals([(0x0005, 0, 8), (0x7130, 7, 16)])
    assert force.start_bit == 8
    assert mapping_signals([]) == ()


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        ([(0x7130, 10, 16)], "0x7130:0A: no such object with 3 gauges"),
        ([(0x2100, 1, 32)], "can't be mapped"),
        ([(0x7130, 1, 8)], "8 bits, allowed is 16"),
        ([(0x6130, 1, 32)] * 3, "96 bits, allowed are at most 64"),
    ],
)
def test_impossible_mappings(mapping: list[tuple[int, int, int]], said: str) -> None:
    with pytest.raises(InputError, match=said):
        mapping_signals(mapping)
