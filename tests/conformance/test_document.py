"""docs/conformance.md counts the cases as they are, and each passed or does not apply on a bus."""

from pathlib import Path

from bench.conformance_document import COMMAND, LIST_COMMAND, summary

from conformance.fingertip import all_cases

DOCUMENT = Path(__file__).parents[2] / "docs" / "conformance.md"


def test_document_counts_every_case_as_passed_but_those_that_no_bus_carries() -> None:
    rows = [(case.clause, "not applicable" if case.error_frames else "pass") for case in all_cases()]
    assert DOCUMENT.read_text(encoding="utf-8") == summary(rows), f"regenerate: {LIST_COMMAND}; {COMMAND}"
