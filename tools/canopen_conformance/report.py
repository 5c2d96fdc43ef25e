"""The report of a conformance run: results by clause, and the frames of each failed case."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator

from canopen_conformance.case import Case
from canopen_conformance.run import FAIL, NOT_APPLICABLE, PASS, Result

_LAST_FRAMES = 40  # the end of a long exchange shows the failure


def by_clause(cases: Iterable[Case]) -> list[Case]:
    """Sort cases by clause: CiA 301 before 302, 7.2.4.3.9 before 7.2.4.3.13."""
    return sorted(cases, key=lambda case: clause_key(case.clause))


def clause_key(clause: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that compares the numbers in a clause as numbers."""
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"[ .]", clause))


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
