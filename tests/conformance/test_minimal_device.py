"""A second, small device of other code: what it lacks is "not applicable", what it has is checked, nothing crashes."""

import pytest

from canopen_conformance.case import Case
from canopen_conformance.run import FAIL, NOT_APPLICABLE, PASS
from conformance.fingertip import all_cases, run_in_process
from conformance.minimal import MinimalDevice

# The standard demands segmented transfer of an SDO server (7.2.4.1); this one has none, and that is to be found.
LACKING = "sdo_segmented."


@pytest.mark.parametrize("case", all_cases(), ids=lambda case: case.name)
def test_minimal_device_never_crashes_a_case(case: Case) -> None:
    result, _link = run_in_process(case, MinimalDevice())
    if result.verdict == NOT_APPLICABLE:
        assert result.reason
    else:
        assert result.verdict == PASS or case.name.startswith(LACKING), f"{result.reason}\n" + "\n".join(result.log)


def test_minimal_device_gets_all_three_verdicts() -> None:
    verdicts = [run_in_process(case, MinimalDevice())[0].verdict for case in all_cases()]
    assert verdicts.count(PASS) > 80
    assert verdicts.count(NOT_APPLICABLE) > 300
    assert 0 < verdicts.count(FAIL) < 20


def test_own_cases_are_not_run_on_a_foreign_device() -> None:
    for case in all_cases():
        if case.own:
            assert run_in_process(case, MinimalDevice())[0].verdict == NOT_APPLICABLE
