"""The fingertip passes every conformance case; `tipforce conformance`: list, report, JSON, exit codes."""

import json
import re
import signal
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from bench.documents import case_counts, filled

from canopen_conformance.case import Case, CheckError, LostDeviceError, clause_key
from canopen_conformance.dut import Dut
from canopen_conformance.run import FAIL, PASS, Result, lines, run_case, run_on, summary
from canopen_conformance.wire import CoreLink
from conformance.fingertip import all_cases, core_node, matching, run_in_process
from host.bus_with_nodes import running
from tipforce_tools.cli.main import main

CHANNEL = "conformance"
ON_BUS = ("conformance", "--node-id", "5", "-i", "virtual", "-c", CHANNEL)
CASES = all_cases()
DOCUMENT = Path(__file__).parents[2] / "docs" / "conformance.md"


@pytest.fixture
def node() -> Iterator[None]:
    """Node 5 on a virtual bus, in a thread."""
    with running([core_node()], CHANNEL):
        yield


def failing() -> Result:
    """The result of a case that cannot be met."""

    def body(dut: Dut) -> None:
        dut.ask("40 00 10 00", "43 00 10 00 FF FF FF FF")

    impossible = replace(matching("identity.device_type")[0], name="test.body", title="another type", body=body)
    return run_case(impossible, Dut(CoreLink(core_node()), 5), True)


def test_list_names_every_case(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", "--list"]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) == len(all_cases())
    assert "sdo_block_download.bad_crc" in out


def test_pattern_chooses_by_name_and_by_clause() -> None:
    assert {case.name.partition(".")[0] for case in matching("CiA 305 6.6*")} == {"lss_identify", "lss_unconfigured"}
    assert [case.name for case in matching("emcy.message")] == ["emcy.message"]


@pytest.mark.usefixtures("node")
def test_report_of_a_node_on_a_bus(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*ON_BUS, "--case", "identity.*"]) == 0
    out = capsys.readouterr().out
    assert "CiA 301 7.5.2.21\n  pass  identity.identity " in out
    assert out.splitlines()[-1] == f"{len(matching('identity.*'))} passed, 0 failed, 0 not applicable"


@pytest.mark.usefixtures("node")
def test_persistent_cases_need_permission(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*ON_BUS, "--case", "lss.store", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["verdict"], "--persistent" in record["reason"]) == ("not applicable", True)
    assert main([*ON_BUS, "--case", "lss.store", "--json", "--persistent"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "pass"


def test_node_that_is_not_there_is_no_response(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("canopen_conformance.dut.BOOT_MS", 10)
    assert main([*ON_BUS, "--case", "identity.*"]) == 5
    assert "no boot-up message" in capsys.readouterr().err


def test_failure_shows_what_was_expected_and_the_frames() -> None:
    text = "\n".join(lines([failing()]))
    assert "FAIL  test.body" in text
    assert "expected 585#43 00 10 00 FF FF FF FF; got 585#4300100094010200" in text
    assert "> 605#4000100000000000" in text
    assert "< 585#4300100094010200" in text
    assert summary(Counter([failing().verdict])) == "0 passed, 1 failed, 0 not applicable"


def test_a_device_that_dies_ends_the_run() -> None:
    def kill(_dut: Dut) -> None:
        monkey.setattr(link, "send", lambda _can_id, _data: None)
        raise CheckError("life", "death")

    link = CoreLink(core_node())
    template = matching("identity.device_type")[0]
    killer = replace(template, name="test.kill", body=kill)
    with pytest.MonkeyPatch.context() as monkey:
        run = run_on(Dut(link, 5), [killer, template], persistent=False)
        assert next(run).verdict == FAIL
        with pytest.raises(LostDeviceError, match="no longer boots after the case test"):
            next(run)


@pytest.mark.usefixtures("node")
def test_sigterm_ends_with_the_results_until_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each result is printed before the next case runs; the last line counts them."""
    before = signal.getsignal(signal.SIGTERM)
    printed: list[str] = []

    def terminated(case: Case, dut: Dut, persistent: bool) -> Result:
        printed.append(capsys.readouterr().out)
        if len(printed) == 3:
            signal.raise_signal(signal.SIGTERM)
        return run_case(case, dut, persistent)

    monkeypatch.setattr("canopen_conformance.run.run_case", terminated)
    try:
        assert main([*ON_BUS, "--case", "identity.identity*"]) == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert ["  pass  " in text for text in printed] == [False, True, True]
    assert capsys.readouterr().out == "2 passed, 0 failed, 0 not applicable\n"


def test_clauses_are_ordered_by_their_numbers() -> None:
    clauses = ["CiA 305 6.3.1", "CiA 301 7.2.4.3.13", "CiA 301 7.2.4.3.9", "CiA 404 6130h", "CiA 302-2 1F80h"]
    assert sorted(clauses, key=clause_key)[:2] == ["CiA 301 7.2.4.3.9", "CiA 301 7.2.4.3.13"]


def test_silence_finds_what_came_before_too_and_a_time_out_names_what_was_expected() -> None:
    dut = Dut(CoreLink(core_node()), 5)
    dut.send(0x605, "40 00 10 00 00 00 00 00")
    with pytest.raises(CheckError, match="expected silence; got 585#43"):
        dut.silence()

    with pytest.raises(CheckError, match="a frame 185h 01 within 50 ms; got none"):
        dut.expect(0x185, "01", 50)


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
