"""`tipforce report`: the page, well-formed, complete, alone; selection, text, JSON, exit codes."""

import base64
import hashlib
import importlib.util
import json
import re
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import pytest
from bench.documents import filled, section

from tipforce_lab.report import page
from tipforce_lab.report.study import Effort, LeftOut, Report, Study
from tipforce_lab.report.text import Cell, advice_table, verdict
from tipforce_tools.cli.common import json_line
from tools.report import made
from tools.report.made import cases, grid, study
from tools.rig import Printed

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("matplotlib") is None, reason="the page needs the extra `report`"
)
VOID = {"meta"}


class Elements(HTMLParser):
    """Every element with its attributes; unbalanced ones are an error."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len({name for name, _ in attrs}) == len(attrs), f"<{tag}> has an attribute twice"
        self.found.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    def tags(self, name: str) -> list[dict[str, str]]:
        return [attributes for tag, attributes in self.found if tag == name]


@pytest.fixture(scope="module")
def report() -> Report:
    made = Report("2026-01-31", Effort(quick=True), {"processor": "<fast>"})
    made.studies += [study("near", 1e-5), study("far", 1e-30), study("known", 0.0)]
    made.cases += [case for case in cases() if case.key != "other.broken"]
    made.grids += [grid()]
    made.left_out.append(LeftOut("absent", "skfem is not installed", False))
    return made


@pytest.fixture(scope="module")
def html(report: Report) -> str:
    return page.html(report)


@pytest.fixture(scope="module")
def parsed(html: str) -> Elements:
    parser = Elements()
    parser.feed(html)
    parser.close()
    assert not parser.open
    return parser


def test_one_plot_per_study_and_one_row_per_case(parsed: Elements, report: Report) -> None:
    assert len(parsed.tags("svg")) == len(report.studies)
    rows = [row["id"] for row in parsed.tags("tr") if row.get("id", "").startswith("case-")]
    assert rows == [f"case-{one.key}" for one in report.cases]
    assert "NOT flagged" in "".join(parsed.text)
    assert "skfem is not installed" in "".join(parsed.text)


def test_verdict_and_advice_come_first(html: str, report: Report) -> None:
    parts = ("cases of fault", "do NOT hold: other.wrong", "Which method for which need", "Contents", "<svg")
    assert (places := [html.index(part) for part in parts]) == sorted(places)
    assert "3 references that are code of the project agree with an independent computation within 3.0e-12" in html
    assert "In 0 of 1 cases of fault and gauges no way to show values shows more wrong ones as ok" in html
    assert "; in 1 at least one shows more, for reasons that are known and listed. Fewest: one." in html
    assert "none is exact enough" in html
    first, second, *_ = advice_table(report).rows
    # Good enough are 2 and 3 cells, "rms" and exact; the least time decides, not the least error.
    assert first[:3] == [Cell("1 < 2, nearly", link="near"), "with \"rms\" & 'quotes'", "0.01 %"]
    assert second[1] == "none is exact enough"


def test_a_wrong_row_without_a_reason_is_in_the_verdict() -> None:
    report = Report("", Effort(), {})
    report.studies.append(study("near"))
    report.grids.append(grid(held=False))
    assert not report.sound()
    assert "in 1 at least one shows more, without a known reason in drift, <3>." in verdict(report)[0]
    assert report.grids[0].rows[0].held is False
    assert '<td data-name="two" class="broken">80 % ok, 7 wrong</td>' in page.html(report)


def test_tables_fold_unless_a_claim_does_not_hold(parsed: Elements, report: Report) -> None:
    opened = ["open" in details for details in parsed.tags("details")]
    assert opened == [False] * (1 + len(report.studies)) + [False, True]  # area, other


def test_identifiers_are_unique_and_references_lead_somewhere(parsed: Elements) -> None:
    identifiers = [attributes["id"] for _, attributes in parsed.found if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    targets = {attributes["href"] for _, attributes in parsed.found if "href" in attributes}
    assert targets
    assert targets <= {f"#{name}" for name in identifiers}
    clips = {name for _, a in parsed.found for name in re.findall(r"url\((#[^)]*)\)", " ".join(a.values()))}
    assert clips <= {f"#{name}" for name in identifiers}


def test_the_page_needs_nothing_from_outside(html: str, parsed: Elements) -> None:
    assert "//" not in html
    assert "@import" not in html
    assert not {"script", "link", "img", "iframe", "object", "embed"} & {tag for tag, _ in parsed.found}
    assert not any("src" in attributes or "style" in attributes for _, attributes in parsed.found)


def test_the_policy_allows_the_one_style_sheet_and_nothing_else(html: str, parsed: Elements) -> None:
    (policy,) = [meta["content"] for meta in parsed.tags("meta") if "http-equiv" in meta]
    sheets = re.findall(r"<style[^>]*>(.*?)</style>", html, flags=re.DOTALL)
    assert len(sheets) == 1
    digest = base64.b64encode(hashlib.sha256(sheets[0].encode()).digest()).decode()
    assert f"style-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy


@pytest.fixture(scope="module")
def written(report: Report, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return page.write(report, tmp_path_factory.mktemp("report"), json_line)


def test_files_are_written_and_the_lines_parse(written: list[Path]) -> None:
    assert [path.name for path in written] == ["index.html", "report.jsonl", "near.svg", "far.svg", "known.svg"]
    records = [json.loads(line) for line in written[1].read_text(encoding="utf-8").splitlines()]
    assert [one["record"] for one in records] == ["report", *["study"] * 3, "grid", *["case"] * 5, "left out"]


def test_the_document_takes_verdict_and_advice_over(written: list[Path]) -> None:
    text = section(json.loads(written[1].read_text(encoding="utf-8").splitlines()[0]))
    page_text = filled("before\n<!-- begin -->\nprevious figures\n<!-- end -->\nafter\n", text)
    assert page_text.startswith("before\n<!-- begin -->\n\nA quick run of 2026-01-31")
    assert page_text.endswith("<!-- end -->\nafter\n")
    assert "previous figures" not in page_text
    assert page_text.index("do NOT hold: other.wrong") < page_text.index("| need | method | error | processor time |")
    assert filled(page_text, text) == page_text
    with pytest.raises(ValueError, match="0 places for one text"):
        filled("a page without marks", text)


def one_study(key: str) -> Callable[[Effort, Callable[[], None]], list[Study]]:
    def studies(_effort: Effort, advance: Callable[[], None]) -> list[Study]:
        advance()
        return [made.study(key)]

    return studies


def lacking(_effort: Effort, _advance: Callable[[], None]) -> list[Study]:
    import skfem  # noqa: F401

    return []


def failing(_effort: Effort, _advance: Callable[[], None]) -> list[Study]:
    raise ZeroDivisionError("on purpose")


@pytest.fixture
def sound(monkeypatch: pytest.MonkeyPatch) -> None:
    made.install(monkeypatch, {"alpha": made.module(one_study("alpha")), "beta": made.module(one_study("beta"))})


@pytest.mark.usefixtures("sound")
def test_json_lines_tell_everything(printed: Printed) -> None:
    head, *rest = printed(1, "report --json --quick --date 2026-01-31 --seed 5").records
    assert rest[-1]["record"] == "verdict"
    assert "2 of 6 claims" in rest[-1]["verdict"][0]
    assert (head["record"], head["date"], head["quick"], head["seed"]) == ("report", "2026-01-31", True, 5)
    assert {"processor", "Python", "tipforce", "numpy"} <= set(head["machine"])
    assert [one["key"] for one in rest if one["record"] == "study"] == ["alpha", "beta"]
    seen = {one["key"]: one["held"] for one in rest if one["record"] == "case"}
    assert seen == {case.key: case.held for case in cases()}


@pytest.mark.usefixtures("sound")
def test_text_names_what_did_not_hold(printed: Printed) -> None:
    out = printed(1, ["report"]).out
    assert "2 NOT AS CLAIMED (other.wrong, other.broken)" in " ".join(out.split())
    assert "ZeroDivisionError" in out
    for shown in ("Study alpha & more", "reference: what is known <exactly>; its own error is 1.0e-09", "- a remark"):
        assert shown in out


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize(
    ("only", "studies", "keys"),
    [
        ("beta", ["beta"], []),
        ("stability", [], [case.key for case in cases()]),
        ("beta, alpha", ["alpha", "beta"], []),
        ("area", [], [case.key for case in cases()][:4]),
        ("alpha,area.pass", ["alpha"], ["area.pass"]),
        ("*.b*", [], ["area.bounded", "other.broken"]),
    ],
)
def test_only_runs_what_is_named(printed: Printed, only: str, studies: list[str], keys: list[str]) -> None:
    found = printed({0, 1}, ["report", "--json", "--only", only]).records
    assert [one["key"] for one in found if one["record"] == "study"] == studies
    assert [one["key"] for one in found if one["record"] == "case"] == keys


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize("only", ["gamma", "area.nothing", "", ","])
def test_a_key_that_names_nothing_is_refused(printed: Printed, only: str) -> None:
    assert "alpha, beta, stability" in printed(2, ["report", "--only", only]).err


@pytest.mark.usefixtures("sound")
def test_list_runs_nothing(printed: Printed) -> None:
    lines = printed(0, "report --list").out.splitlines()
    assert [line.split()[0] for line in lines[:4]] == ["alpha", "beta", "stability", "area.pass"]
    assert {"key": "alpha", "kind": "study", "what": "about alpha"} in printed(0, "report --list --json").records


def test_a_missing_package_leaves_a_study_out_and_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    monkeypatch.setitem(sys.modules, "skfem", None)
    made.install(monkeypatch, {"fem": made.module(lacking), "beta": made.module(one_study("beta"))}, with_cases=False)
    out = printed(0, ["report"]).out
    assert 'left out fem: skfem is not installed: pip install "tipforce[fem]"' in out
    assert "Study beta" in out
    assert "1 left out (fem)" in out


def test_a_study_that_fails_is_a_line_and_an_exit_code(monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    made.install(monkeypatch, {"bad": made.module(failing), "beta": made.module(one_study("beta"))}, with_cases=False)
    _, lack, study, told = printed(1, "report --json").records
    assert told["verdict"][-1] == "Failed: bad."
    assert (lack["record"], lack["key"], lack["failed"]) == ("left out", "bad", True)
    assert "ZeroDivisionError in failing()" in lack["reason"]
    assert study["key"] == "beta"


def test_without_matplotlib_the_page_is_refused_before_anything_runs(
    monkeypatch: pytest.MonkeyPatch, printed: Printed, tmp_path: Path
) -> None:
    made.install(monkeypatch, {"bad": made.module(failing)})
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    captured = printed(2, ["report", "-o", str(tmp_path / "out")])
    assert 'pip install "tipforce[report]"' in captured.err
    assert not captured.out
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("sound")
def test_the_page_is_written_where_it_is_asked_for(printed: Printed, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    assert "index.html" in printed(0, f"report --only alpha -o {tmp_path}/a/b").err
    assert {path.name for path in (tmp_path / "a" / "b").iterdir()} == {"alpha.svg", "index.html", "report.jsonl"}
    (tmp_path / "file").write_text("")
    printed(2, f"report --only alpha -o {tmp_path}/file")
