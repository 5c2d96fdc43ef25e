"""The layout of the PDOs, default and remapped."""

from __future__ import annotations

import pytest

from tipforce.dictionary import table
from tipforce.dictionary.signals import Message, mapping_signals, rpdo_messages, tpdo_messages
from tipforce.errors import InputError

STATUS = tuple(name for name, _ in table.STATUS_BITS)


def _named(n: int) -> dict[str, Message]:
    return {message.name: message for message in tpdo_messages(n)}


def test_contact_with_three_gauges() -> None:
    contact = _named(3)["Contact"]
    assert (contact.kind, contact.number, contact.cob_id_base, contact.length_bytes) == ("tpdo", 2, 0x280, 8)
    assert contact.mapping == ((0x7130, 7, 16), (0x7130, 8, 16), (0x7130, 9, 16), (0x2120, 0, 8), (0x2121, 0, 8))
    assert tuple(s.name for s in contact.signals) == ("P", "phi", "theta", *STATUS, "counter")
    force, phi = contact.signals[:2]
    assert (force.start_bit, force.bits, force.signed, force.scale, force.unit) == (0, 16, True, 0.001, "N")
    assert (force.minimum, force.maximum, force.unknown) == (-32.767, 32.767, -32768)
    assert (phi.start_bit, phi.scale, phi.unit, phi.minimum, phi.maximum) == (16, 0.01, "degree", -180, 180)
    counter = contact.signals[-1]
    assert (counter.start_bit, counter.bits, counter.signed, counter.unknown) == (56, 8, False, None)


def test_gauges_and_forces() -> None:
    gauge = _named(3)["Gauges"].signals[2]
    assert (gauge.name, gauge.start_bit, gauge.scale, gauge.unit) == ("SG3", 32, 0.1, "microstrain")
    assert (gauge.minimum, gauge.maximum) == (-3276.7, 3276.7)
    assert tuple(s.name for s in _named(3)["Force"].signals[:3]) == ("F1", "F2", "F3")


def test_health() -> None:
    health = {s.name: s for s in _named(4)["Health"].signals}
    assert (health["temperature"].scale, health["temperature"].unknown) == (0.01, -32768)
    assert (health["u_P"].scale, health["u_P"].unknown, health["u_P"].maximum) == (0.001, 0xFFFF, 65.534)
    assert [s.start_bit for s in health.values()] == [0, 16, 32, 33, 34, 35, 40, 41, 42, 43, 44, 45, 46, 47, 48, 56]
    assert {
        "SG4_fault",
        "fault_no_data",
        "fault_supply",
        "fault_overload",
        "configuration_counter",
        "error_register",
    } <= set(health)
    assert "SG5_fault" not in health


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


def test_command() -> None:
    (message,) = rpdo_messages()
    (command,) = message.signals
    assert (message.name, message.cob_id_base, message.enabled, message.length_bytes) == ("Command", 0x200, False, 2)
    assert (command.name, command.bits, command.minimum, command.maximum) == ("command", 16, 0, 3)


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
