"""What a conformance run looks like to people: by clause, and frame by frame where something failed."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence

from tipforce_tools.conformance.case import Case
from tipforce_tools.conformance.run import FAIL, NOT_APPLICABLE, PASS, Result

_LAST_FRAMES = 40  # of a long conversation the end tells what went wrong


def by_clause(cases: Iterable[Case]) -> list[Case]:
    """Cases in the order of their clauses: CiA 301 before 302, 7.2.4.3.9 before 7.2.4.3.13."""
    return sorted(cases, key=lambda case: clause_key(case.clause))


def clause_key(clause: str) -> tuple[tuple[int, int | str], ...]:
    """A sort key that takes the numbers in a clause as numbers."""
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"[ .]", clause))


def lines(results: Sequence[Result]) -> list[str]:
    """The report: a heading for each clause, a line for each case, the conversation of each that failed."""
    found: list[str] = []
    clause = ""
    for result in sorted(results, key=lambda result: clause_key(result.case.clause)):
        if result.case.clause != clause:
            clause = result.case.clause
            found.append(clause)
        shown = {PASS: "pass", FAIL: "FAIL", NOT_APPLICABLE: "n/a "}[result.verdict]
        found.append(f"  {shown}  {result.case.name:36} {result.case.title}")
        if result.reason:
            found.append(f"        {result.reason}")
        if len(result.log) > _LAST_FRAMES:
            found.append(f"        ... {len(result.log) - _LAST_FRAMES} frames before")
        found += [f"        {line}" for line in result.log[-_LAST_FRAMES:]]
    return [*found, summary(results)]


def summary(results: Iterable[Result]) -> str:
    """How many passed, failed, did not apply."""
    counts = Counter(result.verdict for result in results)
    return f"{counts[PASS]} passed, {counts[FAIL]} failed, {counts[NOT_APPLICABLE]} not applicable"


def record(result: Result) -> dict[str, object]:
    """A result as a JSON record."""
    return {
        "case": result.case.name,
        "clause": result.case.clause,
        "title": result.case.title,
        "verdict": result.verdict,
        "reason": result.reason,
        "log": result.log,
    }
