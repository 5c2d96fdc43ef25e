"""Simulated time: process SYNCs, timers and faults in the order of their times, without bus, clock or waiting."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tipforce.device.codes import NMT_COB_ID, SYNC_COB_ID
from tipforce.scene import schema
from tipforce.scene.build import FAULTS, Finger

Frame = tuple[int, bytes]
Emit = Callable[[int, int, bytes], None]  # t_us, can_id, data


def sync_times(scene: schema.Scene, duration_s: float) -> list[int]:
    """Return the times of all SYNCs, microseconds: the first one period after the start."""
    if scene.sync_hz is None:
        return []
    count = int(duration_s * scene.sync_hz + 1e-9)
    return [round(1e6 * k / scene.sync_hz) for k in range(1, count + 1)]


def fault_events(scene: schema.Scene, fingers: Sequence[Finger]) -> list[tuple[int, Finger, int, int, float]]:
    """Return (t_us, finger, 2200h:1, gauge, magnitude) in the order of time; a fault of 0 ends one."""
    by_id = {finger.node_id: finger for finger in fingers}
    found = []
    for fault in scene.faults:
        for node_id in fault.nodes:
            at_us = round(1e6 * fault.at_s)
            found.append((at_us, 1, by_id[node_id], FAULTS[fault.kind], fault.gauge, fault.microstrain_per_s))
            if fault.until_s is not None:
                found.append((round(1e6 * fault.until_s), 0, by_id[node_id], 0, fault.gauge, 0.0))
    # At equal times the end of a fault comes first: another fault may start then.
    found.sort(key=lambda event: event[:2])
    return [(at_us, *rest) for at_us, _order, *rest in found]  # type: ignore[misc]


def simulate(
    scene: schema.Scene, fingers: Sequence[Finger], duration_s: float, emit: Emit, advance: Callable[[int], None]
) -> None:
    """Run the hand for ``duration_s``; ``emit`` gets every frame in order, ``advance`` gets the time now and then.

    A frame's time is the time of its transmit request: transmission time on the bus is not simulated.
    """
    end_us = round(1e6 * duration_s)
    hand = _Hand(fingers, emit, end_us)
    events = [event for event in fault_events(scene, fingers)[::-1] if event[0] <= end_us]
    for number, t_us in enumerate(sync_times(scene, duration_s)):
        while events and events[-1][0] <= t_us:
            hand.inject(*events.pop())
        hand.expire(t_us)
        hand.say(t_us, SYNC_COB_ID, b"")
        if number % 1024 == 0:
            advance(t_us)
    for event in reversed(events):
        hand.inject(*event)
    hand.expire(end_us + 1)
    advance(end_us)


class _Hand:
    """The booted and started nodes, and the due times of their timers."""

    def __init__(self, fingers: Sequence[Finger], emit: Emit, end_us: int) -> None:
        self._fingers = fingers
        self._emit = emit
        self._due = [end_us + 1] * len(fingers)  # due time of each node's next timer
        for finger in fingers:
            for can_id, data in finger.boot(0):
                emit(0, can_id, data)
        self.say(0, NMT_COB_ID, b"\x01\x00")

    def say(self, t_us: int, can_id: int, data: bytes) -> None:
        """Send one frame of the scene's master to every node."""
        self._emit(t_us, can_id, data)
        frames = ((can_id, data),)
        for place in range(len(self._fingers)):
            self._step(place, t_us, frames)

    def expire(self, until_us: int) -> None:
        """Step each node with a timer due before a time, in the order of the due times."""
        while (t_us := min(self._due)) < until_us:
            self._step(self._due.index(t_us), t_us, ())

    def inject(self, at_us: int, finger: Finger, fault: int, gauge: int, magnitude: float) -> None:
        """Start or end a fault."""
        self.expire(at_us)
        finger.source.set_fault(fault, gauge, magnitude, at_us)

    def _step(self, place: int, t_us: int, frames: Sequence[Frame]) -> None:
        sent, due_us = self._fingers[place].device.step(t_us, frames)
        for can_id, data in sent:
            self._emit(t_us, can_id, data)
        self._due[place] = due_us
