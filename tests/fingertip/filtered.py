"""A node with a filter, and the numbers of the filters."""

from fingertip.finger import Finger, finger
from tipforce.fingertip import filters

MOVING, REPEATING, IIR = filters.MOVING_AVERAGE, filters.REPEATING_AVERAGE, filters.FIRST_ORDER


def filtered(kind: int, constant: int, **options: object) -> Finger:
    """A node with a filter that has just begun."""
    talk = finger(**options)  # type: ignore[arg-type]
    assert talk.put("H", 0x61A1, 1, constant) == talk.put("B", 0x61A0, 1, kind) == 0
    return talk


def ramp(talk: Finger) -> None:
    """F1 in newtons is the number of the conversion since a second, divided by 100: gauge 1 in mN is 10 of it."""
    talk.source.forces = lambda now_us: ((now_us - 1_000_000) / 500 / 100, 0.0, 0.0)
