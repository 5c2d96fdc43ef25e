"""The documents that are made.

python -m bench.documents generated    docs/commands.md, counts in docs/conformance.md (`make generate`)
python -m bench.documents report       verdict and recommendations of `make report`, in docs/report.md"""

import argparse
import html
import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from bench.measure import ROOT, arguments, table

from canopen_conformance.case import all_cases
from tipforce_tools import fingertip_cases
from tipforce_tools.cli import actions, bus_flags, common
from tipforce_tools.cli.main import COMMANDS, EXIT_TEXTS, command_parser

PATH = ROOT / "docs" / "commands.md"
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


def page() -> str:
    """The text of the page."""
    assert list(_MEANINGS) == list(EXIT_TEXTS)
    parts = [_HEAD, *(f"| {code} | {text} |\n" for code, text in _MEANINGS.items()), "\n## Common flags\n"]
    shared = argparse.ArgumentParser(add_help=False)
    bus_flags.add_bus_arguments(shared, sdo=True)
    common.add_confirm_argument(shared)
    for title, name in actions.SHARED.items():
        parts += [f"\n**{name[0].upper()}{name[1:]} flags**\n", _table(_groups(shared)[title])]
    for name in COMMANDS:
        parser = command_parser(name)
        choices = next((action.choices for action in parser._actions if isinstance(action.choices, Mapping)), None)
        parsers = {name: parser} if choices is None else {
            f"{name} {action}": actions.parser_of(f"{name} {action}", *choices[action]) for action in choices
        }  # fmt: skip
        for path, of_path in parsers.items():
            parts += _section(path, of_path, _groups(shared))
    return "".join(parts)


def _section(path: str, parser: argparse.ArgumentParser, shared: Mapping[str, list[argparse.Action]]) -> Iterator[str]:
    groups = _groups(parser)
    dests = {title: [action.dest for action in flags] for title, flags in groups.items()}
    whole = [title for title in actions.SHARED if dests.get(title) == [action.dest for action in shared[title]]]
    own = [action for title, flags in groups.items() if title not in whole for action in flags]
    summary = " ".join((parser.description or "").split())
    yield f"\n## tipforce {path}\n\n{_escaped(summary)}\n"
    yield _table(own)
    if whole:
        yield f"\nAlso the [common flags](#common-flags): {', '.join(actions.SHARED[title] for title in whole)}.\n"


def _groups(parser: argparse.ArgumentParser) -> dict[str, list[argparse.Action]]:
    flags: dict[str, list[argparse.Action]] = {}
    for group in parser._action_groups:
        kept = [action for action in group._group_actions if action.help != argparse.SUPPRESS and action.dest != "help"]
        flags.setdefault(group.title or "", []).extend(kept)
    return flags


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


def filled(document: str, text: str) -> str:
    """The document with this text between its marks. Raises ValueError where it has none."""
    parts = re.split(r"(?<=<!-- begin -->\n).*?(?=<!-- end -->\n)", document, flags=re.DOTALL)
    if len(parts) != 2:
        raise ValueError(f"{len(parts) - 1} places for one text")
    return f"{parts[0]}\n{text}\n\n{parts[1]}"


def fill_page(name: str, text: str) -> None:
    """Write the text to its place in a page of docs."""
    path = ROOT / "docs" / f"{name}.md"
    path.write_text(filled(path.read_text(encoding="utf-8"), text), encoding="utf-8")


GROUPS = {
    "CiA 301 7.2.2": "PDO", "CiA 301 7.2.4": "SDO", "CiA 301 7.2.5": "SYNC", "CiA 301 7.2.6": "TIME",
    "CiA 301 7.2.7": "EMCY", "CiA 301 7.2.8": "NMT, heartbeat, node guarding", "CiA 301 7.3.2": "services by NMT state",
    "CiA 301 7.3.3": "pre-defined connection set", "CiA 301 7.3.5": "restricted CAN-IDs",
    "CiA 301 7.4": "data types and dummy entries", "CiA 301 7.5.2": "objects 1000h to 1FFFh",
    "CiA 302-2": "NMT start-up",
    "CiA 305 6": "LSS", "CiA 404": "analogue inputs of the fingertip", "tipforce": "the fingertip's own objects",
}  # fmt: skip
"""The beginnings of clauses, and what they are about."""


def case_counts() -> str:
    """The cases that pass on a bus, by clause: all but those of error frames, which tests/vcan holds."""
    lines, left = [], all_cases(fingertip_cases)
    for start, about in GROUPS.items():
        cases = [case for case in left if case.clause.startswith(start)]
        left = [case for case in left if case not in cases]
        lacking = sum(case.error_frames for case in cases)
        lines.append([start, about, *map(str, (len(cases), len(cases) - lacking, lacking))])
    if left:
        raise ValueError(f"{left[0].clause}: a clause of no group")
    return table(["clauses", "about", "cases", "passed", "not applicable"], lines)


def section(head: dict[str, Any]) -> str:
    """Markdown of the first record of report.jsonl."""
    machine = ", ".join(f"{name} {value}" for name, value in head["machine"].items())
    effort = "quick" if head["quick"] else "full"
    parts = [f"A {effort} run of {head['date']}, seed {head['seed']}: {machine}."]
    parts.append("\n".join(f"- {sentence}" for sentence in head["verdict"]))
    if head["advice"]:
        parts.append(table(["need", "method", "error", "processor time"], head["advice"]))
    return "\n\n".join(parts)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("what", choices=("generated", "report"))
    if parser.parse_args().what == "report":
        lines = (ROOT / "build" / "report" / "report.jsonl").read_text(encoding="utf-8").splitlines()
        fill_page("report", section(json.loads(lines[0])))
    else:
        PATH.write_text(page(), encoding="utf-8")
        fill_page("conformance", case_counts())


if __name__ == "__main__":
    main()
