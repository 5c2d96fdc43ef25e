"""Run a scene: build its parts, run its time, and evaluate the received frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from canopen_device.core.codes import NMT_COB_ID, SYNC_COB_ID
from tipforce.errors import InputError
from tipforce.scene import schema
from tipforce.scene.build import Finger, actions, build
from tipforce.scene.registry import built_parts

if TYPE_CHECKING:
    from tipforce.scene.results import Check, FingerResult

    Frame = tuple[int, bytes]
    Emit = Callable[[int, int, bytes], None]  # t_us, can_id, data


@dataclass(frozen=True, slots=True)
class Outcome:
    """Results of a run."""

    fingers: tuple[FingerResult, ...]
    checks: tuple[Check, ...]
    built: tuple[str, ...]
    """Parts in the order in which they were built; a part built for several nodes is listed once."""
    frames_by_id: dict[int, int]
    """Frames by COB-ID."""
    files: tuple[str, ...]
    duration_s: float
    syncs: int

    @property
    def ok(self) -> bool:
        """No expectation failed."""
        return all(check.ok is not False for check in self.checks)


def run_scene(
    scene: schema.Scene, folder: Path, duration_s: float | None = None, *, realtime: bool = False,
    advance: Callable[[float], None] = lambda _t_s: None,
) -> Outcome:  # fmt: skip
    """Run a scene for ``duration_s`` in place of its own; ``realtime`` without a named bus: on one inside this process.
    Raises InputError for a duration or file, EnvironmentLackError for a bus that cannot be opened."""
    from tipforce.scene import results

    duration_s = scene.duration_s if duration_s is None else duration_s
    if not 0.0 < duration_s <= 86_400.0:
        raise InputError(f"--duration {duration_s:g}: allowed are more than 0 and at most 86400 s")
    fingers, files = build(scene, folder), scene.outputs
    on_bus = scene.bus is not None or realtime
    name = "sim0" if scene.bus is None else scene.bus.channel or scene.bus.interface or "can"
    with results.Recording(files.log, name, round(1e6 * scene.start.timestamp()) * 1_000) as recording:
        if on_bus:
            from tipforce.scene.realtime import run_on_bus

            run_on_bus(scene, fingers, duration_s, recording, advance)
        else:
            simulate(scene, fingers, duration_s, recording.add, lambda t_us: advance(1e-6 * t_us))
        frames = recording.frames()
    built = built_parts(scene, *(("bus",) if on_bus else ()))
    messages = results.decode(fingers, frames) if "decoder" in built else {}
    syncs = [t_us / 1e6 for t_us, fault in actions(scene, fingers, duration_s) if fault is None]
    contacts = {finger.node_id: results.contact_of(finger, messages, scene.slit) for finger in fingers}
    emcys = {finger.node_id: results.emcy_of(finger.node_id, frames) for finger in fingers}
    if files.table is not None:
        results.write_table(files.table, messages)
    if files.plot is not None:
        results.write_plot(files.plot, scene.title or "scene", contacts)
    finger_results = tuple(
        results.finger_result(finger, len(syncs), contacts[finger.node_id], emcys[finger.node_id]) for finger in fingers
    )
    checks = tuple(results.judge(scene, duration_s, syncs, contacts, emcys))
    written = tuple(path for path in (files.log, files.table, files.plot) if path is not None)
    return Outcome(finger_results, checks, built, recording.counts, written, duration_s, len(syncs))


def simulate(
    scene: schema.Scene, fingers: Sequence[Finger], duration_s: float, emit: Emit, advance: Callable[[int], None]
) -> None:
    """Run the hand for ``duration_s``; ``emit`` gets every frame in order, ``advance`` gets the time now and then. A
    frame's time is the time of its transmit request: transmission time on the bus is not simulated."""
    end_us = round(1e6 * duration_s)
    hand = _Hand(fingers, emit, end_us)
    for number, (t_us, fault) in enumerate(actions(scene, fingers, duration_s)):
        hand.expire(t_us)
        if fault is None:
            hand.say(t_us, SYNC_COB_ID, b"")
        else:
            fault.inject(t_us)
        if number % 1024 == 0:
            advance(t_us)
    hand.expire(end_us + 1)
    advance(end_us)


class _Hand:
    def __init__(self, fingers: Sequence[Finger], emit: Emit, end_us: int) -> None:
        self._fingers, self._emit = fingers, emit
        self._due = [end_us + 1] * len(fingers)  # due time of each node's next timer
        for finger in fingers:
            for can_id, data in finger.boot(0):
                emit(0, can_id, data)
        self.say(0, NMT_COB_ID, b"\x01\x00")

    def say(self, t_us: int, can_id: int, data: bytes) -> None:
        """Send one frame of the scene's master to every node."""
        self._emit(t_us, can_id, data)
        for place in range(len(self._fingers)):
            self._step(place, t_us, ((can_id, data),))

    def expire(self, until_us: int) -> None:
        """Step each node with a timer due before a time, in the order of the due times."""
        while (t_us := min(self._due)) < until_us:
            self._step(self._due.index(t_us), t_us, ())

    def _step(self, place: int, t_us: int, frames: Sequence[Frame]) -> None:
        sent, self._due[place] = self._fingers[place].device.step(t_us, frames)
        for can_id, data in sent:
            self._emit(t_us, can_id, data)
