"""docs/conformance.md lists the cases as they are, and each passed or does not apply on a bus."""

from pathlib import Path

from bench.conformance_document import COMMAND

from canopen_conformance.case import all_cases
from canopen_conformance.report import by_clause

DOCUMENT = Path(__file__).parents[2] / "docs" / "conformance.md"


def rows() -> list[list[str]]:
    """The cells of the table."""
    lines = [line for line in DOCUMENT.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[1:]]


def test_document_lists_the_cases_as_they_are() -> None:
    wanted = [[case.clause, case.name, case.title] for case in by_clause(all_cases())]
    assert [row[:3] for row in rows()] == wanted, f"regenerate: {COMMAND}"


def test_every_case_passed_in_process() -> None:
    assert {row[3] for row in rows()} == {"pass"}


def test_every_case_passed_on_vcan_but_those_that_no_bus_carries() -> None:
    by_verdict = {row[1]: row[4] for row in rows()}
    assert {name for name, verdict in by_verdict.items() if verdict != "pass"} == {
        case.name for case in all_cases() if case.error_frames
    }
