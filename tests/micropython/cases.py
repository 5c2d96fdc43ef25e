"""The conformance suite as conversations: its cases, as they run in one process, recorded."""

from conformance.fingertip import NODE_ID, SERIAL, all_cases, core_eds, run_in_process
from micropython.recording import RecordedDevice, Recording


def conformance_recordings() -> list[Recording]:
    """Each case on a node of its own, as ``fingertip.core_node`` builds it."""
    recordings = []
    for case in all_cases():
        device = RecordedDevice(case.name, NODE_ID, eds=core_eds().decode(), serial=SERIAL)
        _result, link = run_in_process(case, device)
        assert len(link.steps) == len(device.recording.steps)
        recordings.append(device.recording)
    return recordings
