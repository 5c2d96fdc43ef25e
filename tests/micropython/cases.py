"""The conformance suite as conversations: its cases, as they run in one process, recorded."""

import os

from conformance.fingertip import NODE_ID, SERIAL, all_cases, core_eds, run_in_process
from micropython.recording import RecordedDevice, Recording


def conformance_recordings() -> list[Recording]:
    """Every third case, or each with TIPFORCE_ALL_CASES=1 (``make long``), on a node of ``fingertip.core_node``."""
    recordings = []
    for case in all_cases()[:: 1 if os.environ.get("TIPFORCE_ALL_CASES") else 3]:
        device = RecordedDevice(case.name, NODE_ID, eds=core_eds().decode(), serial=SERIAL)
        _result, link = run_in_process(case, device)
        assert len(link.steps) == len(device.recording.steps)
        recordings.append(device.recording)
    return recordings
