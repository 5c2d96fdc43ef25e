"""A second, small device of other code: what it lacks is "not applicable", what it has is checked, nothing crashes."""

from canopen_conformance.run import FAIL, NOT_APPLICABLE, PASS
from conformance.fingertip import all_cases, run_in_process
from conformance.minimal import MinimalDevice

# The standard demands segmented transfer of an SDO server (7.2.4.1); this one has none, and that is to be found.
LACKING = "sdo_segmented."


def test_minimal_device_never_crashes_a_case() -> None:
    verdicts = []
    for case in all_cases():
        result, _link = run_in_process(case, MinimalDevice())
        verdicts.append(result.verdict)
        if result.verdict == NOT_APPLICABLE:
            assert result.reason
        else:
            passed = result.verdict == PASS or case.name.startswith(LACKING)
            assert passed, "\n".join([case.name, result.reason, *result.log])
            assert not case.own, f"{case.name}: a case of the fingertip ran on a foreign device"
    assert verdicts.count(PASS) > 80
    assert verdicts.count(NOT_APPLICABLE) > 300
    assert 0 < verdicts.count(FAIL) < 20
