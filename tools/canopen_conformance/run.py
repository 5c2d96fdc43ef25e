"""Run cases: select those that apply, and collect the results."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from canopen_conformance.case import Case, CheckError, LostDeviceError, NotApplicableError, Product
from canopen_conformance.dut import RESET_NODE, Dut
from canopen_conformance.links import Core, CoreLink

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
    if case.own and not dut.is_of_product():
        return f"specific to {dut.product.name if dut.product else 'another product'}"
    lacking = dut.lacks(case.needs)
    return "" if lacking is None else f"no object {lacking[0]:04X}h:{lacking[1]:02X}"


def run_on(dut: Dut, cases: Iterable[Case], persistent: bool) -> Iterator[Result]:
    """Run cases on one device in sequence, and leave it as after a reset.

    Raises LostDeviceError if the device no longer boots after a failed case.
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
        raise LostDeviceError(f"the node no longer boots after the case {case.name}: {failure}") from failure


def run_in_process(case: Case, device: Core, node_id: int, product: Product | None = None) -> tuple[Result, CoreLink]:
    """Run a case on a device core that has not run yet, with the fake clock."""
    link = CoreLink(device)
    return run_case(case, Dut(link, node_id, product), persistent=True), link
