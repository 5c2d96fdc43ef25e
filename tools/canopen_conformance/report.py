"""The report of a conformance run: results by clause, and the frames of each failed case."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

from canopen_conformance.case import Case
from canopen_conformance.dut import Dut
from canopen_conformance.run import FAIL, NOT_APPLICABLE, PASS, Result, run_on

_LAST_FRAMES = 40  # the end of a long exchange shows the failure


def listing(cases: Iterable[Case]) -> str:
    """Return a line per case: clause, name, title."""
    return "\n".join(f"{case.clause:22} {case.name:36} {case.title}" for case in cases)


def run_and_print(
    dut: Dut, cases: Sequence[Case], persistent: bool, as_json: bool, note: Callable[[str], None]
) -> bool:
    """Run cases and print each result as it comes, in the end the counts; return whether no case failed.

    ``as_json``: a JSON record a line, and the counts to ``note``. Raises LostDeviceError if the device does not boot.
    """
    results: list[Result] = []

    def collected() -> Iterator[Result]:
        for result in run_on(dut, cases, persistent):
            results.append(result)
            yield result

    dut.measure_resets()
    try:
        for line in (json.dumps(record(result)) for result in collected()) if as_json else lines(collected()):
            print(line, flush=True)
    finally:  # also after Ctrl-C, SIGTERM or the loss of the device
        (note if as_json else print)(summary(results))
    return all(result.verdict != FAIL for result in results)


def lines(results: Iterable[Result]) -> Iterator[str]:
    """Yield the report of results in the order of ``by_clause`` as they come: a heading per clause, a line per case,
    the frames of each failed case.
    """
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


def summary(results: Iterable[Result]) -> str:
    """Return the counts of cases passed, failed, not applicable."""
    counts = Counter(result.verdict for result in results)
    return f"{counts[PASS]} passed, {counts[FAIL]} failed, {counts[NOT_APPLICABLE]} not applicable"


def record(result: Result) -> dict[str, object]:
    """Return a result as a JSON record."""
    return {
        "case": result.case.name,
        "clause": result.case.clause,
        "title": result.case.title,
        "verdict": result.verdict,
        "reason": result.reason,
        "log": result.log,
    }
