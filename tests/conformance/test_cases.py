"""Every conformance case against the device core in this process on a fake clock; docs/conformance.md counts them."""

import re
from pathlib import Path

import pytest
from bench.documents import case_counts, filled

from canopen_conformance.case import Case
from canopen_conformance.run import PASS
from conformance.fingertip import all_cases, run_in_process

CASES = all_cases()
DOCUMENT = Path(__file__).parents[2] / "docs" / "conformance.md"


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_case_passes(case: Case) -> None:
    """None is "not applicable": a node with everything has something for each case."""
    result, _link = run_in_process(case)
    conversation = "\n".join([result.reason, *result.log])
    assert result.verdict == PASS, f"{case.title}\n{conversation}"


def test_titles_are_printable_and_every_clause_is_of_one_form() -> None:
    form = r"CiA 301 7(\.\d+)+|CiA 302-2 1F80h|CiA 305 6(\.\d)+|(CiA 404|tipforce) [0-9A-F]{4}h"
    assert [case.name for case in CASES if not (case.title.isprintable() and re.fullmatch(form, case.clause))] == []


def test_document_counts_every_case_as_passed_but_those_that_no_bus_carries() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    assert text == filled(text, case_counts()), "stale: run `make generate`"
