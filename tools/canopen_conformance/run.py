"""Run cases: select those that apply, collect the results, print them by clause with the frames of each failure."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from canopen_conformance.case import Case, CheckError, LostDeviceError, NotApplicableError, Product
from canopen_conformance.dut import Dut
from canopen_conformance.wire import RESET_NODE, Core, CoreLink

PASS, FAIL, NOT_APPLICABLE = "pass", "FAIL", "not applicable"
_LAST_FRAMES = 40  # the end of a long exchange shows the failure


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
        log = dut.log[mark:]
        constant = dut.constant(case.needs, log)
        return Result(case, NOT_APPLICABLE, constant) if constant else Result(case, FAIL, str(failure), log)
    finally:
        del dut.log[:mark]
    return Result(case, PASS)


def _lack(case: Case, dut: Dut, persistent: bool) -> str:
    if case.persistent and not persistent:
        return "would change the stored parameters or the node-id; --persistent allows it"
    if case.error_frames and not dut.link.error_frames:
        return "error frames come from the CAN controller; a bus does not carry them"
    if case.own and not dut.is_of_product():
        return f"specific to {dut.product.name if dut.product else 'another product'}"
    lacking = dut.lacks(case.needs)
    return "" if lacking is None else f"no object {lacking[0]:04X}h:{lacking[1]:02X}"


def run_on(dut: Dut, cases: Iterable[Case], persistent: bool) -> Iterator[Result]:
    """Run cases on one device, and leave it as after a reset. Raises LostDeviceError if it then no longer boots."""
    try:
        for case in cases:
            result = run_case(case, dut, persistent)
            yield result
            if result.verdict == FAIL:
                dut.reset()  # otherwise each remaining case would wait for the boot-up message in vain
    except CheckError as failure:
        raise LostDeviceError(f"the node no longer boots after the case {case.name}: {failure}") from failure
    finally:
        dut.nmt(RESET_NODE)


def run_in_process(case: Case, device: Core, node_id: int, product: Product | None = None) -> tuple[Result, CoreLink]:
    """Run a case on a device core that has not run yet, with the fake clock."""
    link = CoreLink(device)
    return run_case(case, Dut(link, node_id, product), persistent=True), link


def listing(cases: Iterable[Case]) -> str:
    """Return a line per case: clause, name, title."""
    return "\n".join(f"{case.clause:22} {case.name:36} {case.title}" for case in cases)


def run_and_print(
    dut: Dut, cases: Sequence[Case], persistent: bool, as_json: bool, note: Callable[[str], None]
) -> bool:
    """Run cases and print each result as it comes, in the end the counts; return whether no case failed. ``as_json``: a
    JSON record a line, and the counts to ``note``. Raises LostDeviceError if the device does not boot."""
    counts: Counter[str] = Counter()

    def counted() -> Iterator[Result]:
        for result in run_on(dut, cases, persistent):
            counts[result.verdict] += 1
            yield result

    dut.measure_resets()
    try:
        for line in (json.dumps(record(result)) for result in counted()) if as_json else lines(counted()):
            print(line, flush=True)
    finally:  # also after Ctrl-C, SIGTERM or the loss of the device
        (note if as_json else print)(summary(counts))
    return not counts[FAIL]


def lines(results: Iterable[Result]) -> Iterator[str]:
    """Yield the report of results as they come: a heading per clause, a line per case, the frames of a failed one."""
    clause = ""
    for result in results:
        if result.case.clause != clause:
            clause = result.case.clause
            yield clause
        shown = {PASS: "pass", FAIL: "FAIL", NOT_APPLICABLE: "n/a "}[result.verdict]
        yield f"  {shown}  {result.case.name:36} {result.case.title}"
        if result.reason:
            yield f"        {result.reason}"
        if len(result.log) > _LAST_FRAMES:
            yield f"        ... {len(result.log) - _LAST_FRAMES} frames before"
        yield from (f"        {line}" for line in result.log[-_LAST_FRAMES:])


def summary(counts: Counter[str]) -> str:
    """Return the counts of verdicts as text."""
    return f"{counts[PASS]} passed, {counts[FAIL]} failed, {counts[NOT_APPLICABLE]} not applicable"


def record(result: Result) -> dict[str, object]:
    """Return a result as a JSON record."""
    case = {"case": result.case.name, "clause": result.case.clause, "title": result.case.title}
    return {**case, "verdict": result.verdict, "reason": result.reason, "log": result.log}
