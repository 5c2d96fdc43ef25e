"""2200h and 2201h return to their power-on values with a reset of the node, and with nothing else."""

import pytest

from fingertip.finger import PUSH, Finger, finger

WRITES = (("H", 0x2200, 1, 3), ("B", 0x2200, 2, 2), ("f", 0x2200, 3, 7.0), ("f", 0x2201, 1, 5.0), ("f", 0x2201, 2, 9.0),
          ("f", 0x2201, 3, -4.0))  # fmt: skip


def read(talk: Finger) -> list[float]:
    """All of both objects."""
    return [talk.get(kind, index, sub) for kind, index, sub, _value in WRITES]


def reset(talk: Finger, command: int) -> None:
    """An NMT reset."""
    talk.step([(0, bytes((command, 5)))])
    talk.take()


@pytest.mark.parametrize("load", [(0.0, 0.0, 0.0), PUSH])
def test_reset_node_returns_both_to_power_on(load: tuple[float, float, float]) -> None:
    talk = finger(load=load)
    before = read(talk)
    gauges = talk.sync().gauges
    for write in WRITES:
        assert talk.put(*write) == 0
    assert read(talk) == [value for *_entry, value in WRITES]
    assert talk.sync().gauges[1] == 32767
    reset(talk, 0x82)
    assert read(talk) == [value for *_entry, value in WRITES]
    reset(talk, 0x81)
    assert read(talk) == before
    talk.step([(0, b"\x01\x05")])
    talk.take()
    assert talk.sync().gauges == gauges


def test_what_the_program_set_stays() -> None:
    talk = finger()
    assert talk.put("f", 0x2201, 1, 5.0) == talk.put("H", 0x2200, 1, 3) == 0
    talk.source.load = PUSH
    talk.source.set_fault(2, 3, 0.0, talk.now_us)
    reset(talk, 0x81)
    assert talk.source.load == PUSH
    assert (talk.source.fault, talk.source.fault_gauge) == (2, 3)
