"""2124h as TPDO4, EMCY and boot-ups tell it: what the host understands is what the node has."""

from __future__ import annotations

import struct

import numpy as np

from fingertip.finger import PUSH, Finger
from fingertip.test_judgement import drift, redundant, with_emcy
from tipforce.fingertip.application import Fingertip
from tipforce.host.decoding import status_words
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.decoding.health import ALL, TOLD_BY_EMCY, Health, of_emcy
from tipforce.host.frames.frame_array import FRAME, FrameArray

GAUGES = 8


def frames(sent: list[tuple[int, bytes]], t_ns: int) -> FrameArray:
    found = np.zeros(len(sent), dtype=FRAME)
    for row, (can_id, data) in zip(found, sent, strict=True):
        row["t_ns"], row["can_id"], row["length"] = t_ns, can_id, len(data)
        row["data"][: len(data)] = np.frombuffer(data, dtype=np.uint8)
    return found


def followed(talk: Finger, health: Health, decoder: Decoder, syncs: int) -> int:
    """Let the host follow some SYNCs; 2124h of the node at the end."""
    for _ in range(syncs):
        talk.now_us += 1000
        talk.step([(0x80, b"")])
        sent = frames(talk.take(), 1000 * talk.now_us)
        health.take(sent, decoder.decode(sent).values())
    application = talk.device.application
    assert isinstance(application, Fingertip)
    return application.sample.faults


def test_the_host_follows_emcy_and_tpdo4() -> None:
    for with_tpdo4 in (False, True):
        talk = with_emcy(redundant(GAUGES))
        if with_tpdo4:
            assert talk.put("I", 0x1803, 1, 0x40000485) == 0
        health, decoder = Health(), Decoder(GAUGES)
        followed(talk, health, decoder, 5)
        seen = 0
        for gauge, microstrain in ((3, 50.0), (3, 0.0), (0, 50.0), (1, 50.0), (1, 0.0)):
            drift(talk, gauge, microstrain)
            faults = followed(talk, health, decoder, 150)  # 100 ms after the last contradiction it has ended
            assert health.now(5)[0] == faults
            seen |= faults
        assert seen >> 12 & 1
        assert health.now(5)[1] == (ALL if with_tpdo4 else seen)
        talk.source.load = (40.0, *PUSH[1:])
        faults = followed(talk, health, decoder, 150)
        assert health.now(5)[0] == faults


def test_a_boot_up_ends_what_was_told() -> None:
    health = Health()
    contradiction, over = struct.pack("<HBHHx", 0x5030, 0x21, 12, 0), struct.pack("<HBHHx", 0x5020, 0x21, 15, 0)
    health.take(frames([(0x085, contradiction), (0x086, over)], 10))
    health.take(frames([(0x705, b"\0")], 20))
    assert health.now(5) == (0, TOLD_BY_EMCY)
    assert health.now(6) == (1 << 15, 1 << 15)
    assert health.now(7) == (0, 0)
    told, seen = health.at(5, np.array([5, 10, 19, 20]))
    assert told.tolist() == [0, 1 << 12, 1 << 12, 0]
    assert seen.tolist() == [0, 1 << 12, 1 << 12, TOLD_BY_EMCY]


def test_emcy_of_other_errors_tells_nothing() -> None:
    for code, detail in ((0x8110, 0), (0x4210, 0), (0x5010, 0), (0x5010, 200), (0x6320, 0), (0x5030, 0x0900)):
        assert of_emcy(struct.pack("<HBHHx", code, 0x81, detail, 0)) == (0, False)
    assert of_emcy(struct.pack("<HBHHx", 0x5030, 0x81, 0x0C04, 0)) == (1 << 3, True)
    assert of_emcy(struct.pack("<HBHHx", 0, 0, 0x5010, 2)) == (1 << 1, False)


def test_words() -> None:
    assert status_words.of_faults(1 << 1 | 1 << 9 | 1 << 13) == [
        "SG2 saturated or left out", "front end: frozen", "beyond the calibrated force",
    ]  # fmt: skip
