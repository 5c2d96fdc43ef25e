"""The conformance suite as conversations: its cases, as they run in one process, recorded."""

from canopen_conformance.case import all_cases
from canopen_conformance.links import CORE_NODE_ID, core_eds
from canopen_conformance.run import run_in_process
from micropython.recording import RecordedDevice, Recording

_SERIAL = 0x1234  # that of links.core_node


def conformance_recordings() -> list[Recording]:
    """Each case on a node of its own, as ``links.core_node`` builds it."""
    found = []
    for case in all_cases():
        device = RecordedDevice(case.name, CORE_NODE_ID, eds=core_eds().decode(), serial=_SERIAL)
        _result, link = run_in_process(case, lambda device=device: device)  # type: ignore[misc]
        assert len(link.steps) == len(device.recording.steps)
        found.append(device.recording)
    return found
