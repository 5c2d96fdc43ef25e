"""The synchronous window 1007h (CiA 301, 7.5.2.9): a synchronous RPDO that comes after it is not taken."""

import pytest

from device.services import serving


@pytest.mark.parametrize(("late_us", "taken"), [(1000, True), (1001, False)])
def test_a_synchronous_rpdo_counts_inside_the_window(late_us: int, taken: bool) -> None:
    talk = serving()
    for kind, index, sub, value in (("I", 0x1007, 0, 1000), ("B", 0x1400, 2, 1), ("I", 0x1400, 1, 0x205)):
        assert talk.put(kind, index, sub, value) == 0
    talk.say(f"> 000#0105\n> 080#\n+ {late_us}\n> 205#220000\n> 080#")
    assert talk.get("B", 0x2000) == (0x22 if taken else 0x11)
