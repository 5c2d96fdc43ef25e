"""Devices of another kind: what one lacks is "not applicable", what the standard permits is no failure."""

import pytest

from canopen_conformance.case import Case
from canopen_conformance.dut import Dut
from canopen_conformance.run import FAIL, NOT_APPLICABLE, PASS, run_on
from canopen_conformance.wire import CoreLink
from conformance.fingertip import all_cases, matching, run_in_process
from conformance.minimal import MinimalDevice
from conformance.self_starting import NODE_ID, SelfStarting

FOREIGN = [case for case in all_cases() if not case.own]


def test_no_case_fails() -> None:
    failed = {}
    verdicts = []
    for case in FOREIGN:
        result, _ = run_in_process(case, SelfStarting())
        verdicts.append(result.verdict)
        if result.verdict == FAIL:
            failed[case.name] = "\n".join([result.reason, *result.log[-6:]])
    assert not failed, "\n\n".join(f"{name}: {text}" for name, text in failed.items())
    assert verdicts.count(PASS) > 250


def on_one_device(cases: list[Case], reset_us: int) -> tuple[list[str], float, int]:
    """Run cases in sequence as on a bus; return the verdicts, the time in seconds and the number of node resets."""
    device = SelfStarting(reset_us)
    link = CoreLink(device)
    dut = Dut(link, NODE_ID)
    dut.measure_resets()
    verdicts = [result.verdict for result in run_on(dut, cases, persistent=False)]
    return verdicts, 1e-6 * link.now_us(), device.resets


def test_a_slow_reset_does_not_cost_minutes() -> None:
    fast, fast_s, _ = on_one_device(FOREIGN, 0)
    slow, slow_s, resets = on_one_device(FOREIGN, 3_000_000)
    assert slow == fast
    assert FAIL not in fast
    assert resets < 12, "the cases about it, and one to measure"
    assert slow_s - fast_s < 40


def test_cases_that_only_read_share_one_reset() -> None:
    _, _, resets = on_one_device(matching("identity.*"), 0)
    assert resets < len(matching("identity.*")) / 4


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("nmt.reset.1", "the device enters OPERATIONAL by itself after its boot-up"),
        ("pdo_parameters.moved.1", "1800h:01 does not take 40000390h (abort 06090030h)"),
        ("sync.moved", "TPDO1 maps no object"),
    ],
)
def test_the_reason_names_what_the_device_refuses(name: str, reason: str) -> None:
    result, _ = run_in_process(matching(name)[0], SelfStarting())
    assert (result.verdict, result.reason) == (NOT_APPLICABLE, reason)


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
