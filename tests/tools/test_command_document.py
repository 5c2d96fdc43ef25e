"""docs/commands.md: it is fresh, and it has every command, flag and exit code."""

from __future__ import annotations

from bench.documents import PATH, page

from tipforce_tools.cli.main import EXIT_CODES, EXIT_TEXTS
from tools.command_lines import PARSERS


def test_the_page_is_fresh() -> None:
    assert PATH.read_text() == page(), "docs/commands.md is stale: run `make generate`"


def test_every_command_and_flag_is_on_it() -> None:
    text = PATH.read_text()
    for path, parser in PARSERS.items():
        assert f"\n## {path}\n" in text
        for action in parser._actions:
            assert all(f"`{name}`" in text for name in action.option_strings if name not in ("-h", "--help")), path


def test_every_exit_code_has_a_meaning() -> None:
    assert set(EXIT_CODES.values()) <= set(EXIT_TEXTS)
