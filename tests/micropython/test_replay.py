"""The same conversations on CPython and on MicroPython: every frame, due time, request and stored byte the same."""

import os

import pytest

from conformance.fingertip import NODE_ID, SERIAL, all_cases, core_eds, run_in_process
from micropython import engine, recording, scripts
from micropython.random_frames import random_recording
from micropython.recording import RecordedDevice, Recording

RANDOM_SEEDS, RANDOM_STEPS = range(4), 2500


@pytest.fixture(scope="module")
def spoken() -> list[Recording]:
    return [one for script in scripts.SCRIPTS for one in script()]


def test_conversations_from_compiled_files(spoken: list[Recording]) -> None:
    recording.assert_same(spoken, engine.compiled(3) | engine.program())


def test_random_frames() -> None:
    recordings = [random_recording(seed, RANDOM_STEPS) for seed in RANDOM_SEEDS]
    assert sum(sum(one.frames()) for one in recordings) > 20_000
    recording.assert_same(recordings, engine.sources())


def conformance_recordings() -> list[Recording]:
    """Every third case, or each with TIPFORCE_ALL_CASES=1 (``make long``), on a node of ``fingertip.core_node``."""
    recordings = []
    for case in all_cases()[:: 1 if os.environ.get("TIPFORCE_ALL_CASES") else 3]:
        device = RecordedDevice(case.name, NODE_ID, eds=core_eds().decode(), serial=SERIAL)
        _result, link = run_in_process(case, device)
        assert len(link.steps) == len(device.recording.steps)
        recordings.append(device.recording)
    return recordings


def test_the_conformance_suite() -> None:
    recordings = conformance_recordings()
    assert len(recordings) >= 50
    recording.assert_same(recordings, engine.sources())


def test_a_difference_is_found(spoken: list[Recording]) -> None:
    """The comparison is no formality: one other byte in what CPython is said to have answered fails."""
    for at, replacement in ((-1, "705#00"), (0, "0 705#01")):
        told = Recording("changed", spoken[0].header, spoken[0].steps[:2], spoken[0].answers[:2], spoken[0].stored)
        told.answers[at] = replacement
        with pytest.raises(AssertionError, match="changed, step"):
            recording.assert_same([told], engine.sources())
    told = Recording("changed", spoken[0].header, spoken[0].steps[:1], spoken[0].answers[:1], "calibration=00")
    with pytest.raises(AssertionError, match="what was stored"):
        recording.assert_same([told], engine.sources())


def test_the_conversations_speak_of_every_service(spoken: list[Recording]) -> None:
    """What the scripts are there for did take place: the identifiers that the node sent with, and its SDO answers."""
    sent = [
        frame.split("#") for one in spoken for answer in one.answers for frame in answer.split()[1:] if "#" in frame
    ]
    identifiers = {can_id for can_id, _ in sent}
    assert identifiers >= {"705", "585", "185", "285", "385", "485", "85", "7E4", "720"}  # 720: node-id 20h by LSS
    commands = {int(data[:2], 16) for can_id, data in sent if can_id == "585"}
    expedited, segments, block = {0x43, 0x4B, 0x4F, 0x60}, {0x41, 0x00, 0x10, 0x20, 0x30}, {0xC6, 0xA4, 0xA2, 0xA1}
    assert commands >= expedited | segments | block | {0x80}
    emcy = {data[2:4] + data[:2] for can_id, data in sent if can_id == "85"}
    assert emcy >= {"5030", "5010", "6320", "8110", "8120", "8130", "8140", "8150", "8210", "8240", "0000"}
    requests = {
        word.split(":")[0] for one in spoken for answer in one.answers for word in answer.split() if ":" in word
    }
    assert requests >= {"reset-node", "reset-communication", "bit-rate", "bus-restart"}
    assert {name for one in spoken for name in one.stored.replace("=", " ").split()} >= {
        "application", "calibration", "communication", "lss",
    }  # fmt: skip
