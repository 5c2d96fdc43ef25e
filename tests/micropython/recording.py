"""Conversations recorded on CPython, scripted or random, to be held again on MicroPython."""

import json
import random
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from bench.fuzz_frames import Frames

from canopen_device.testing import Conversation, Frame, parse
from micropython import engine, on_node
from tipforce.dictionary import table
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix

STEPS_PER_CALL = 50  # garbage is collected between calls only
SYNC: Frame = (0x80, b"")
PAST_SMALL_INTEGERS_US = 1 << 41  # a node's clock after 25 days; MicroPython keeps integers beyond 2^30 on the heap


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

    def note(self, step: str, answer: str, stored: str) -> tuple[list[Frame], int]:
        """Keep a step and its answer; return the frames of the answer, and its number: when the node is due."""
        self.steps.append(step)
        self.answers.append(answer)
        self.stored = stored
        words = answer.split()
        return [parse(word) for word in words[1:] if "#" in word], int(words[0])

    def frames(self) -> tuple[int, int]:
        return sum(len(step.split()) - 1 for step in self.steps), sum(answer.count("#") for answer in self.answers)


class RecordedDevice:
    """A node whose steps are noted, on a clock that is at ``start_us`` first; for the rest it is the node itself."""

    def __init__(
        self, name: str, node_id: int = 5, layout: str | Sequence[str] = "I", store: dict[str, str] | None = None,
        eds: str = "", serial: int = 0x01020304, front_end: dict[str, Any] | None = None, start_us: int = 0,
    ) -> None:  # fmt: skip
        rows = strain_matrix(FABRICATED, layout)
        header = {
            "node_id": node_id, "serial": serial, "rows": struct.pack(f"<{rows.size}d", *rows.flat).hex(),
            "store": store or {}, "eds": eds, "front_end": front_end,
        }  # fmt: skip
        self.recording, self._start_us = Recording(name, header), start_us
        self._store = on_node.Store(header["store"])  # type: ignore[arg-type]
        self.device = on_node.build(header, self._store)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.device, name)

    def step(self, now_us: int, frames: Iterable[Frame] = ()) -> tuple[list[Frame], int]:
        frames, now_us = [(can_id, bytes(data)) for can_id, data in frames], now_us + self._start_us
        step = " ".join([str(now_us), *(f"{can_id:X}#{data.hex()}" for can_id, data in frames)])
        answer = on_node.answer(self.device, now_us, frames)
        sent, due_us = self.recording.note(step, answer, self._store.shown())
        return sent, due_us - self._start_us

    def stored(self) -> dict[str, str]:
        return {name: content.hex() for name, content in self._store.groups.items()}


def all_steps(recording: Recording) -> list[str]:
    """Calls that hold a conversation which MicroPython has as ``replay``."""
    return [f"replay.go({min(left, STEPS_PER_CALL)})" for left in range(len(recording.steps), 0, -STEPS_PER_CALL)]


def replay(
    recordings: Sequence[Recording], files: dict[str, bytes], replayer: str = "from on_node import Replay"
) -> list[list[str]]:
    """Hold each conversation on MicroPython with ``files`` as its library: the answers to its steps, and the store."""
    told = dict(files)
    calls = [replayer]
    for number, recording in enumerate(recordings):
        told[f"/recording{number}"] = recording.text().encode()
        calls += [f"replay = Replay('/recording{number}')", *all_steps(recording), "replay.end()"]
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


class Talk(Conversation):
    """A conversation with a recorded node, EMCY shown. What the node says is noted, and compared on MicroPython."""

    def __init__(self, name: str, now_us: int = 0, **built: Any) -> None:
        self.recorded = RecordedDevice(name, **built)
        self.sdo_answers = 0  # in the last step
        super().__init__(self.recorded, now_us, emcy=True)

    @property
    def recording(self) -> Recording:
        return self.recorded.recording

    def start(self) -> None:
        self.send("000#0100")

    def load(self, P_newtons: float, phi_deg: float, theta_deg: float) -> None:
        for sub, value in enumerate((P_newtons, phi_deg, theta_deg), 1):
            assert self.put("f", 0x2201, sub, value) == 0

    def sync(self, count: int = 1, period_us: int = 1000) -> list[Frame]:
        """SYNCs a period apart; what the last one brought."""
        sent: list[Frame] = []
        for _ in range(count):
            self.advance(period_us)
            sent = self.step([SYNC])
        return sent

    def calibrate(self, layout: str | Sequence[str] = "I") -> None:
        """Stage the calibration of an ideal sensor by SDO, entry by entry, and commit it."""
        C = calibration_matrix(FABRICATED, layout)
        n = C.shape[1]
        for sub, value in enumerate(C.flat, 1):
            assert self.put("f", 0x2100, sub, float(value)) == 0
        for k in range(n):  # the diagonal of the upper triangle, by rows
            assert self.put("f", 0x2106, 1 + k * n - k * (k - 1) // 2, 1e-12) == 0
        for kind, sub, fact in (("I", 1, 77), ("I", 2, 20250131), ("f", 3, 23.0), ("B", 4, 1)):
            assert self.put(kind, 0x2102, sub, fact) == 0
        for sub, setting in enumerate((0.01, -80.0, 80.0, 0.05, 0.03), 1):
            assert self.put("f", 0x2110, sub, setting) == 0
        assert self.put("I", 0x2103, 1, self.get("I", 0x2103, 2)) == 0
        assert self.put("I", 0x2104, 0, table.SIGNATURE_COMMIT) == 0


def random_recording(seed: int, steps: int) -> Recording:
    """``steps`` steps of the frame fuzzer: conversations, broken ones, and noise."""
    talk = Talk(f"random frames, seed {seed}")
    chance = random.Random(seed)
    if chance.random() < 0.7:
        talk.calibrate()
    talk.start()
    frames = Frames(chance, talk)
    for _ in range(steps):
        pause_us, received = frames.next()
        talk.now_us += pause_us
        talk.sdo_answers = sum(can_id == 0x585 for can_id, _ in talk.step(received))
    return talk.recording
