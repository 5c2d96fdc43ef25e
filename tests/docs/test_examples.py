"""Every documented example runs and prints what its page shows; every documented command line parses."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest

from docs.page_setups import SETUPS
from docs.runner import check_command, command_lines, examples, run_page

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted(path for folder in (".", "docs", "dbc", "eds") for path in (ROOT / folder).glob("*.md"))
every_document = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))


@every_document
def test_documented_examples_run(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with SETUPS.get(path.name, lambda: contextlib.nullcontext({}))() as names:
        report = io.StringIO()
        with contextlib.redirect_stdout(report):
            result = run_page(path, names)
    assert result.failed == 0, report.getvalue()
    assert result.attempted > 0 or not re.search(r"^(>>> |```console)", path.read_text(), re.MULTILINE)


@every_document
def test_no_document_expects_a_checksum_of_computed_numbers(path: Path) -> None:
    """It turns over with the last bit of one of them, and those differ between versions of numpy."""
    assert re.findall(r"CRC-32:? 0x[0-9A-Fa-f]{8}", path.read_text()) == []


@every_document
def test_documented_commands_parse(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for line in command_lines(path):
        words = shlex.split(line.split(" > ")[0].split(")")[0])
        try:
            check_command(words[1:])
        except (AssertionError, SystemExit) as error:
            pytest.fail(f"{path.name}: {line}: {error!r}")


@every_document
def test_no_example_is_outside_a_block(path: Path) -> None:
    inside = sum(example.source.count("\n") > 0 for example in examples(path) if "shell(" not in example.source)
    text = path.read_text()
    outside = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    assert ">>> " not in outside
    assert inside or ">>> " not in text


def test_documents_and_their_set_ups_are_found() -> None:
    names = {path.name for path in DOCUMENTS}
    assert names >= {"README.md", "protocol.md", "objects.md"}
    assert names >= set(SETUPS)


def test_a_wrong_output_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "page.md"
    page.write_text(
        '```text title="a.txt"\nalpha\n```\n<!-- test: k = 2 -->\n```pycon\n>>> k + 1\n3\n\n```\n'
        "```console\n$ cat a.txt\nalpha\n$ tipforce frobnicate\ntipforce: 'frobnicate' is not a command; ...\n"
        "$ echo $?\n2\n$ cat a.txt\nbeta\n```\n"
    )
    assert len(examples(page)) == 7
    report = io.StringIO()
    with contextlib.redirect_stdout(report):
        result = run_page(page, {})
    assert (result.failed, result.attempted) == (1, 7)
    assert "line 17" in report.getvalue()
    assert "beta" in report.getvalue()
