"""docs/commands.md: every command with its flags and the exit codes, from the parsers. Run: `make generate`."""

from __future__ import annotations

import argparse
import html
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from tipforce_tools.cli import actions, bus_flags, common
from tipforce_tools.cli.main import COMMANDS, EXIT_TEXTS, command_parser

PATH = Path(__file__).parents[1] / "docs" / "commands.md"
_HEAD = """\
# Commands

This page is generated from the parsers (`make generate`). `tipforce COMMAND --help` prints the same with examples. Data
goes to stdout, everything else to stderr. A wrong command line is one line on stderr and exit code 2.

Node-ids are written `10` or `0x0A`, sets of them `1,2,5-9`. Shell completion: `tipforce --completion`.

## Exit codes

| code | meaning |
|---|---|
"""
_MEANINGS = {
    0: "ok; also where the reader of a pipe (`head`) closes it",
    1: "a check that was asked for failed (`demo`, `run`, `verify`, `conformance`, `doctor`, ...), or an output failed",
    2: "usage: a flag, a value or an input file is wrong, or this machine lacks something (the line names it)",
    5: "no response from a node",
    9: "permission",
    11: "a node aborted an SDO transfer",
    12: "a device refused",
    130: "interrupted (Ctrl-C)",
}
_COMMON = actions.SHARED


def page() -> str:
    """The text of the page."""
    assert list(_MEANINGS) == list(EXIT_TEXTS)
    parts = [_HEAD, *(f"| {code} | {text} |\n" for code, text in _MEANINGS.items()), "\n## Common flags\n"]
    shared = argparse.ArgumentParser(add_help=False)
    common.add_sdo_arguments(shared)
    common.add_confirm_argument(shared)
    for title, name in _COMMON.items():
        parts += [f"\n**{name[0].upper()}{name[1:]} flags**\n", _table(_groups(shared)[title])]
    for path, parser in _parsers():
        parts += _section(path, parser, _groups(shared))
    return "".join(parts)


def _parsers() -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for name in COMMANDS:
        parser = command_parser(name)
        table = next((action.choices for action in parser._actions if isinstance(action.choices, Mapping)), None)
        if table is None:
            yield name, parser
        for action in table or ():
            yield f"{name} {action}", actions.action_parser(name, action, table or {})


def _section(path: str, parser: argparse.ArgumentParser, shared: Mapping[str, list[argparse.Action]]) -> Iterator[str]:
    groups = _groups(parser)
    whole = [title for title in _COMMON if _dests(groups.get(title, [])) == _dests(shared[title])]
    own = [action for title, flags in groups.items() if title not in whole for action in flags]
    summary = " ".join((parser.description or "").split())
    yield f"\n## tipforce {path}\n\n{_escaped(summary)}\n"
    yield _table(own)
    if whole:
        yield f"\nAlso the [common flags](#common-flags): {', '.join(_COMMON[title] for title in whole)}.\n"


def _groups(parser: argparse.ArgumentParser) -> dict[str, list[argparse.Action]]:
    flags: dict[str, list[argparse.Action]] = {}
    for group in parser._action_groups:
        kept = [action for action in group._group_actions if action.help != argparse.SUPPRESS and action.dest != "help"]
        flags.setdefault(group.title or "", []).extend(kept)
    return flags


def _dests(flags: list[argparse.Action]) -> list[str]:
    return [action.dest for action in flags]


def _table(flags: list[argparse.Action]) -> str:
    rows = "".join(f"| {_words(action)} | {_escaped(_help(action))} |\n" for action in flags)
    return f"\n| argument | meaning |\n|---|---|\n{rows}" if rows else ""


def _words(action: argparse.Action) -> str:
    if not action.option_strings:
        value = action.metavar if isinstance(action.metavar, str) else _choices(action) or action.dest.upper()
        return _code(value)
    flags = ", ".join(map(_code, action.option_strings))
    if action.nargs == 0:
        return flags
    metavar = " ".join(action.metavar) if isinstance(action.metavar, tuple) else action.metavar
    return f"{flags} {_code(metavar or _choices(action) or action.dest.upper())}"


def _choices(action: argparse.Action) -> str:
    return "|".join(map(str, action.choices or ()))


def _help(action: argparse.Action) -> str:
    # Plug-ins of python-can would add interfaces of this machine.
    interfaces = isinstance(action.choices, bus_flags.Interfaces)
    choices = bus_flags.BUILT_IN_INTERFACES if interfaces else tuple(action.choices or ())
    words = {**vars(action), "choices": ", ".join(map(str, choices)), "prog": "tipforce"}
    return " ".join(((action.help or "") % words).split())


def _code(text: str) -> str:
    # In a table, Markdown's own code cannot hold a vertical bar on every renderer.
    return f"`{text}`" if "|" not in text else f"<code>{html.escape(text).replace('|', '&#124;')}</code>"


def _escaped(text: str) -> str:
    """Text outside of code, in which Markdown's characters are plain."""
    parts = text.split("`")
    parts[::2] = (re.sub(r"([\\|\[\]*<])", r"\\\1", part) for part in parts[::2])
    return "`".join(parts)


def main() -> int:
    text = page()
    if not PATH.is_file() or PATH.read_text() != text:
        PATH.write_text(text)
        print(PATH)
    return 0


if __name__ == "__main__":
    sys.exit(main())
