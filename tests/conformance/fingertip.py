"""The fingertip that the cases run on in this process: the simulated node, with the fake clock of ``CoreLink``."""

from functools import cache

from canopen_conformance import case
from canopen_conformance.case import Case
from canopen_conformance.run import Result
from canopen_conformance.run import run_in_process as run_on_core
from canopen_conformance.wire import Core, CoreLink
from canopen_device.core.node import Device
from canopen_device.testing import MemoryStore
from tipforce.dictionary.eds import eds_text
from tipforce.fingertip.node import fingertip_node
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources.simulated import SimulatedSource
from tipforce_tools import fingertip_cases

NODE_ID, SERIAL = 5, 0x1234
_EDS_BYTES = 2000  # more than two blocks of SDO block transfer; the whole EDS would only make the recording longer


def all_cases() -> list[Case]:
    """The standards' cases and the fingertip's."""
    return case.all_cases(fingertip_cases)


def matching(pattern: str) -> list[Case]:
    return case.matching(pattern, all_cases())


def run_in_process(case: Case, device: Core | None = None) -> tuple[Result, CoreLink]:
    return run_on_core(case, core_node() if device is None else device, NODE_ID, fingertip_cases.FINGERTIP)


def core_node() -> Device:
    """Return a node with 3 gauges, case I, no noise, a store in memory."""
    source, store = SimulatedSource(strain_matrix(FABRICATED, "I").tolist()), MemoryStore()
    return fingertip_node(NODE_ID, source, 3, SERIAL, store.save, store.load, core_eds())


@cache
def core_eds() -> bytes:
    return eds_text(3, simulated=True).encode()[:_EDS_BYTES]
