"""Conversations recorded on CPython, to be held again on MicroPython."""

import json
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from canopen_device.testing import Frame, parse
from micropython import engine, on_node
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import strain_matrix

STEPS_PER_CALL = 50  # garbage is collected between calls only


@dataclass
class Recording:
    """One node's life from power-on: how it was built, each step's time and frames, and what CPython answered."""

    name: str
    header: dict[str, Any]
    steps: list[str] = field(default_factory=list)
    answers: list[str] = field(default_factory=list)
    stored: str = ""

    def text(self) -> str:
        """What MicroPython gets to read: everything but the answers."""
        return "\n".join([json.dumps(self.header), *self.steps, ""])

    def frames(self) -> tuple[int, int]:
        """How many frames went in and how many came out."""
        return sum(len(step.split()) - 1 for step in self.steps), sum(answer.count("#") for answer in self.answers)


class RecordedDevice:
    """A node whose steps are noted; for the rest it is the node itself."""

    def __init__(
        self,
        name: str,
        node_id: int = 5,
        layout: str | Sequence[str] = "I",
        store: dict[str, str] | None = None,
        eds: str = "",
        serial: int = 0x01020304,
        front_end: dict[str, Any] | None = None,
    ) -> None:
        rows = strain_matrix(FABRICATED, layout)
        header = {
            "node_id": node_id,
            "serial": serial,
            "rows": struct.pack(f"<{rows.size}d", *rows.flat).hex(),
            "store": store or {},
            "eds": eds,
            "front_end": front_end,
        }
        self.recording = Recording(name, header)
        self._store = on_node.Store(header["store"])  # type: ignore[arg-type]
        self.device = on_node.build(header, self._store)

    @property
    def node_id(self) -> int:
        """The node-id that it has now."""
        return self.device.node_id

    def step(self, now_us: int, frames: Iterable[Frame] = ()) -> tuple[list[Frame], int]:
        """One step of the node, noted with its answer."""
        frames = [(can_id, bytes(data)) for can_id, data in frames]
        words = [str(now_us), *(f"{can_id:X}#{data.hex()}" for can_id, data in frames)]
        self.recording.steps.append(" ".join(words))
        answer = on_node.answer(self.device, now_us, frames)
        self.recording.answers.append(answer)
        self.recording.stored = self._store.shown()
        words = answer.split()
        return [parse(word) for word in words[1:] if "#" in word], int(words[0])

    def stored(self) -> dict[str, str]:
        """What the store holds, for a next life of this node."""
        return {name: content.hex() for name, content in self._store.groups.items()}


def replay(
    recordings: Sequence[Recording], files: dict[str, bytes], replayer: str = "from on_node import Replay"
) -> list[list[str]]:
    """Hold each conversation on MicroPython with ``files`` as its library: the answers to its steps, and the store."""
    told = dict(files)
    calls = ["import sys", f"sys.path.append({engine.LIBRARY!r})", replayer]
    for number, recording in enumerate(recordings):
        told[f"/recording{number}"] = recording.text().encode()
        calls.append(f"replay = Replay('/recording{number}')")
        for left in range(len(recording.steps), 0, -STEPS_PER_CALL):
            calls.append(f"replay.go({min(left, STEPS_PER_CALL)})")
        calls.append("replay.end()")
    lines = iter(engine.run(told, calls))
    return [[next(lines) for _ in range(len(recording.steps) + 1)] for recording in recordings]


def assert_same(
    recordings: Sequence[Recording], files: dict[str, bytes], replayer: str = "from on_node import Replay"
) -> None:
    """MicroPython answers every step as CPython did, byte for byte, and stores the same."""
    for recording, answers in zip(recordings, replay(recordings, files, replayer), strict=True):
        for k, (step, here, there) in enumerate(zip(recording.steps, recording.answers, answers[:-1], strict=True)):
            assert here == there, f"{recording.name}, step {k} ({step}): CPython {here}, MicroPython {there}"
        assert recording.stored == answers[-1], f"{recording.name}: what was stored differs"
