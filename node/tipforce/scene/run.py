"""Run a scene: build its parts, run its time, and evaluate the received frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from tipforce.errors import InputError
from tipforce.scene import schema
from tipforce.scene.build import Finger, build
from tipforce.scene.simulate import simulate, sync_times

if TYPE_CHECKING:
    from tipforce.host.decoding.decoder import Samples
    from tipforce.host.frames.frame_array import FrameArray
    from tipforce.scene.expectations import Check
    from tipforce.scene.recording import Recording
    from tipforce.scene.results import Contact, FingerResult

    Messages = dict[tuple[int, str], Samples]


@dataclass(frozen=True, slots=True)
class Options:
    """Changes to a scene from the command line; None keeps the value of the file."""

    duration_s: float | None = None
    seed: int | None = None
    log: str | None = None
    bus: schema.Bus | None = None
    realtime: bool = False
    """Real time without a named bus: nodes and host on a python-can bus inside this process."""


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


def with_options(scene: schema.Scene, options: Options) -> tuple[schema.Scene, float]:
    """Return the scene to run, and for how long. The scene keeps its own duration, which its expectations need.

    Raises InputError for values that are not allowed.
    """
    duration_s = scene.duration_s if options.duration_s is None else options.duration_s
    if not 0.0 < duration_s <= 86_400.0:
        raise InputError(f"--duration {duration_s:g}: allowed are more than 0 and at most 86400 s")
    if options.seed is not None:
        if options.seed < 0:
            raise InputError(f"--seed {options.seed}: allowed is 0 or more")
        scene = replace(scene, seed=options.seed)
    if options.log is not None:
        scene = replace(scene, outputs=replace(scene.outputs, log=options.log))
    if options.bus is not None:
        scene = replace(scene, bus=options.bus)
    return scene, duration_s


def run_scene(
    scene: schema.Scene,
    folder: Path,
    options: Options = Options(),
    advance: Callable[[float], None] = lambda _t_s: None,
) -> Outcome:
    """Run a scene whose calibration files are relative to ``folder``; ``advance`` is called with the time now and then.

    Raises InputError for files that cannot be read or written, EnvironmentLackError for a bus that cannot be opened.
    """
    from tipforce.scene.recording import Recording

    scene, duration_s = with_options(scene, options)
    built = ["nodes"]
    fingers = build(scene, folder, built)
    built += _named_without_object(scene)
    on_bus = scene.bus is not None or options.realtime
    name = "sim0" if scene.bus is None else scene.bus.channel or scene.bus.interface or "can"
    with Recording(scene.outputs.log, name) as recording:
        if on_bus:
            from tipforce.scene.realtime import run_on_bus

            built.append("bus")
            run_on_bus(scene, fingers, duration_s, recording, advance)
        else:
            simulate(scene, fingers, duration_s, recording.add, lambda t_us: advance(1e-6 * t_us))
        frames = recording.frames()
    return _account(scene, fingers, duration_s, recording, frames, built)


def _named_without_object(scene: schema.Scene) -> list[str]:
    """Parts that are an act of the run, not an object that build() makes."""
    found = ["recording"]
    if scene.sync_hz is not None:
        found.append("SYNC")
    if scene.faults:
        found.append("faults")
    if scene.slit is not None:
        found.append("slit")
    if scene.outputs.log is not None:
        found.append("log")
    return found


def _account(
    scene: schema.Scene,
    fingers: Sequence[Finger],
    duration_s: float,
    recording: Recording,
    frames: FrameArray,
    built: list[str],
) -> Outcome:
    """Decode the frames, check the expectations, write the table and the plot."""
    from tipforce.scene import results

    messages: Messages = {}
    if any(finger.pdos for finger in fingers):
        built.append("decoder")
        messages = results.decode(fingers, frames)
    syncs = [t_us / 1e6 for t_us in sync_times(scene, duration_s)]
    contacts = {finger.node_id: results.contact_of(finger, messages, scene.slit) for finger in fingers}
    emcys = {finger.node_id: results.emcy_of(finger.node_id, frames) for finger in fingers}
    checks: list[Check] = []
    if scene.expect:
        from tipforce.scene.expectations import judge

        built.append("expectations")
        checks = judge(scene, duration_s, syncs, contacts, emcys)
    files = _write(scene, fingers, messages, contacts, built)
    found = tuple(
        results.finger_result(finger, len(syncs), contacts[finger.node_id], emcys[finger.node_id]) for finger in fingers
    )
    unique = tuple(dict.fromkeys(built))
    return Outcome(found, tuple(checks), unique, dict(recording.counts), files, duration_s, len(syncs))


def _write(
    scene: schema.Scene,
    fingers: Sequence[Finger],
    messages: Messages,
    contacts: dict[int, Contact | None],
    built: list[str],
) -> tuple[str, ...]:
    outputs = scene.outputs
    if outputs.table is not None:
        from tipforce.scene.table_file import write_table

        built.append("table")
        write_table(outputs.table, messages)
    if outputs.plot is not None:
        from tipforce.scene.plot import write_plot

        built.append("plot")
        write_plot(outputs.plot, scene, [finger.node_id for finger in fingers], contacts)
    return tuple(path for path in (outputs.log, outputs.table, outputs.plot) if path is not None)
