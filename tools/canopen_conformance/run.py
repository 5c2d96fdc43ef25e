"""Run cases: select those that apply, collect the results, and record the in-process run."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from canopen_conformance.case import Case, CheckError, NotApplicableError, all_cases
from canopen_conformance.dut import RESET_NODE, Dut
from canopen_conformance.links import CORE_NODE_ID, CoreLink, core_eds, core_node
from tipforce.errors import NoResponseError
from tipforce.output_file import write_file

PASS, FAIL, NOT_APPLICABLE = "pass", "FAIL", "not applicable"


@dataclass(frozen=True)
class Result:
    """``log`` holds the frames of a failed case."""

    case: Case
    verdict: str
    reason: str = ""
    log: list[str] = field(default_factory=list)


def run_case(case: Case, dut: Dut, persistent: bool) -> Result:
    """Reset the device, check the requirements of the case, and run it."""
    mark = len(dut.log)
    try:
        lack = _lack(case, dut, persistent)
        if lack:
            return Result(case, NOT_APPLICABLE, lack)
        dut.refresh()
        mark = len(dut.log)
        case.body(dut)
    except NotApplicableError as reason:
        return Result(case, NOT_APPLICABLE, str(reason))
    except CheckError as failure:
        return Result(case, FAIL, str(failure), dut.log[mark:])
    finally:
        del dut.log[:mark]
    return Result(case, PASS)


def _lack(case: Case, dut: Dut, persistent: bool) -> str:
    """Return why a case cannot be run here, "" if it can."""
    if case.persistent and not persistent:
        return "would change the stored parameters or the node-id; --persistent allows it"
    if case.error_frames and not dut.link.error_frames:
        return "error frames come from the CAN controller; a bus does not carry them"
    if case.own and not dut.is_tipforce():
        return "specific to tipforce"
    lacking = dut.lacks(case.needs)
    return "" if lacking is None else f"no object {lacking[0]:04X}h:{lacking[1]:02X}"


def run_on(dut: Dut, cases: Iterable[Case], persistent: bool) -> Iterator[Result]:
    """Run cases on one device in sequence, and leave it as after a reset.

    Raises NoResponseError if the device no longer boots after a failed case.
    """
    try:
        for case in cases:
            result = run_case(case, dut, persistent)
            yield result
            if result.verdict == FAIL:
                _boots(dut, case)
    finally:
        dut.nmt(RESET_NODE)


def _boots(dut: Dut, case: Case) -> None:
    """Check that the device boots; otherwise each remaining case would wait for the boot-up message in vain."""
    try:
        dut.reset()
    except CheckError as failure:
        raise NoResponseError(f"the node no longer boots after the case {case.name}: {failure}") from failure


def run_in_process(case: Case, device: Callable[[], object] = core_node) -> tuple[Result, CoreLink]:
    """Run a case on a new device core with the fake clock."""
    link = CoreLink(device())  # type: ignore[arg-type]
    return run_case(case, Dut(link, CORE_NODE_ID), persistent=True), link


def record(path: str | Path) -> int:
    """Save the in-process run as JSON lines for a byte-exact replay; return the number of cases.

    The first line names the node: ``node_id``, ``gauges``, ``layout``, ``noise``, ``serial``, ``eds`` (1021h).
    Each further line is a case on a new node with an empty store: ``case`` and ``steps``, each step
    [now_us, frames in, frames out] of one ``step()``, a frame as [can_id, "hex"].
    """
    node = {
        "node_id": CORE_NODE_ID,
        "gauges": 3,
        "layout": "I",
        "noise": 0.0,
        "serial": 0x1234,
        "eds": core_eds().decode(),
    }
    lines = [json.dumps(node)]
    for case in all_cases():
        _result, link = run_in_process(case)
        steps = [[now_us, _plain(came), _plain(went)] for now_us, came, went in link.steps]
        lines.append(json.dumps({"case": case.name, "steps": steps}))
    write_file(path, "\n".join(lines) + "\n")
    return len(lines) - 1


def _plain(frames: list[tuple[int, bytes]]) -> list[list[int | str]]:
    return [[can_id, data.hex()] for can_id, data in frames]
