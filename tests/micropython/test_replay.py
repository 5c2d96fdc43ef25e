"""Conversations of CPython held again on MicroPython, which judges alike; its memory, its loop."""

import os
from pathlib import Path

import pytest

from conformance.fingertip import NODE_ID, SERIAL, all_cases, core_eds, run_in_process
from micropython import engine, footprint, recording, scripts
from micropython.recording import PAST_SMALL_INTEGERS_US, RecordedDevice, Recording, random_recording

RANDOM_SEEDS, RANDOM_STEPS = range(4), 3000
# A node is a server; and what devices from an EDS need, a fingertip does without.
OTHER_DEVICES = {f"canopen_device/core/{name}.py" for name in ("__init__", "sdo_client", "sync_producer", "wide_types")}
HEAP_BYTES = 180_000  # MicroPython leaves about 200 000 of an ESP32's memory
NODE_BYTES = 46_000
# MicroPython's table of names doubles, some 9 kB, while the modules are imported or while the node is built.
CODE_AND_NODE_BYTES = 164_000


@pytest.fixture(scope="module")
def cases() -> list[Recording]:
    """Every third case, or each with TIPFORCE_ALL_CASES=1 (``make long``), on a node of ``fingertip.core_node``."""
    recordings = []
    for number, case in enumerate(all_cases()[:: 1 if os.environ.get("TIPFORCE_ALL_CASES") else 3]):
        start_us = number % 2 * PAST_SMALL_INTEGERS_US
        device = RecordedDevice(case.name, NODE_ID, eds=core_eds().decode(), serial=SERIAL, start_us=start_us)
        _result, link = run_in_process(case, device)
        assert len(link.steps) == len(device.recording.steps)
        recordings.append(device.recording)
    return recordings


@pytest.fixture(scope="module")
def spoken() -> list[Recording]:
    return [one for script in scripts.SCRIPTS for one in script()]


def test_conversations_from_compiled_files(spoken: list[Recording]) -> None:
    recording.assert_same(spoken, engine.compiled(3) | engine.program())


def test_random_frames() -> None:
    recordings = [random_recording(seed, RANDOM_STEPS) for seed in RANDOM_SEEDS]
    assert sum(sum(one.frames()) for one in recordings) > 20_000
    recording.assert_same(recordings, engine.sources())


def test_the_conformance_suite(cases: list[Recording]) -> None:
    assert len(cases) >= 50
    recording.assert_same(cases, engine.sources())


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


def test_the_conversations_speak_of_every_service(spoken: list[Recording], cases: list[Recording]) -> None:
    """What they are there for did take place: the identifiers that the node sent with, and its SDO answers."""
    spoken = spoken + cases
    sent = [
        frame.split("#") for one in spoken for answer in one.answers for frame in answer.split()[1:] if "#" in frame
    ]
    identifiers = {can_id for can_id, _ in sent}
    assert identifiers >= {"705", "585", "185", "285", "485", "85", "7E4", "720"}  # 720: node-id 20h by LSS
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


def test_the_whole_device_core_is_among_them_and_nothing_of_a_pc() -> None:
    found = {path.relative_to(engine.SOURCE).as_posix() for path in engine.on_node_files()}
    core = {str(path.relative_to(engine.SOURCE)) for path in engine.SOURCE.glob("canopen_device/core/*.py")}
    assert found >= core - OTHER_DEVICES
    assert not found & OTHER_DEVICES
    assert found >= {f"tipforce/{name}.py" for name in ("dictionary/table", "sensor/contact/scalar", "fingertip/node")}
    assert not [name for name in found if name.startswith("canopen_device/") and "/core/" not in name]
    assert not found & {"tipforce/sensor/contact/estimate.py", "tipforce/errors.py"}


def test_a_node_and_everything_at_the_worst_moment_fit_the_heap_and_nothing_accumulates() -> None:
    used = footprint.heap(engine.compiled(3))
    assert 10_000 < used.node < NODE_BYTES, used
    assert used.code > 10_000
    assert used.code + used.node < CODE_AND_NODE_BYTES, used
    assert used.code + used.node < used.peak < HEAP_BYTES, used
    # What comes once (the EMCY history, a longer list) is in the first thousand steps.
    assert abs(used.after_many - used.after_some) < 500, used


DOCUMENT = Path(__file__).parents[2] / "docs/firmware.md"
BOARD = """
import firmware

class Off(Exception):
    pass

def power(frames):
    '''A bus that brings these frames, one a call, until power goes.'''
    waiting = list(frames)
    def receive(us):
        assert 0 <= us <= 100000
        if not waiting:
            raise Off
        return waiting.pop(0)
    sent, requests, groups = [], [], {}
    def save(group, data):
        groups[group] = data
        return True
    try:
        firmware.run(5, lambda: (100, -200, 300), receive, lambda *frame: sent.append(frame),
                     lambda *request: requests.append(request), save, groups.get)
    except Off:
        pass
    for can_id, data in sent:
        print('%03X#%s' % (can_id, data.hex()))
    print(requests, sorted(groups))

power([None, (0x000, b'\\1\\5'), (0x080, b''), (0x605, b'\\x23\\x10\\x10\\x01save'), (0x000, b'\\x82\\5')])
"""


def test_the_documented_firmware() -> None:
    (block,) = DOCUMENT.read_text(encoding="utf-8").split("```python\n")[1:]
    files = engine.sources() | {f"{engine.LIBRARY}/firmware.py": block.split("```")[0].encode()}
    assert engine.run(files, [BOARD]) == [
        "705#00",
        # Counts of 0.1 microstrain are the gauges' INTEGER16; no calibration, so the contact is unknown.
        "185#640038ff2c010001",
        "285#0080008000800001",
        "585#6010100100000000",
        "705#00",
        "[('reset-communication', 0, 0)] ['application', 'calibration', 'communication']",
    ]
