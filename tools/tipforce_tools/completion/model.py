"""What can be completed on the command line, read from the parsers of all commands."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from tipforce_tools.cli import actions as shared
from tipforce_tools.cli import common
from tipforce_tools.cli.main import COMMANDS, command_parser

FILE, CAN, OBJECT, COMMAND = "file", "can", "object", "command"
NODE_IDS = tuple(str(number) for number in range(1, 16))
"""What is offered for a node-id: those that the DBC has. Others are allowed, too."""

_FILE = re.compile(r"(FILE|LOG|DIR|PATH|OUT|SCENE)(\.\w+)?|\w+\.(toml|csv|npz|json|log)")
_WORD = re.compile(r"[\w.+-]*\w")


@dataclass(frozen=True, slots=True)
class Value:
    """What may stand in one place: these ``words``, and what the ``sources`` (FILE, CAN, ...) give."""

    words: tuple[str, ...] = ()
    sources: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Flag:
    """A flag with all its spellings; ``value`` is None where it takes none."""

    names: tuple[str, ...]
    help: str
    value: Value | None


@dataclass(frozen=True, slots=True)
class CommandLine:
    """`tipforce` + ``path``: ``actions`` by name with a line of help, or flags and positional words.

    The last of ``positionals`` holds for all further words where ``more``.
    """

    path: tuple[str, ...]
    summary: str
    flags: tuple[Flag, ...]
    positionals: tuple[Value, ...]
    more: bool
    actions: Mapping[str, str]


def command_lines() -> tuple[CommandLine, ...]:
    """Every command, and behind it each of its actions."""
    found: list[CommandLine] = []
    for name, (_, summary) in COMMANDS.items():
        parser = command_parser(name)
        table = _actions(parser)
        found.append(_command_line((name,), summary, parser, {key: text for key, (_, text) in table.items()}))
        for action, (_, text) in table.items():
            found.append(_command_line((name, action), text, shared.action_parser(name, action, table), {}))
    return tuple(found)


def object_names() -> tuple[str, ...]:
    """The dictionary's names that `tipforce sdo` takes."""
    from tipforce.dictionary.names import all_names

    return all_names()


def _actions(parser: argparse.ArgumentParser) -> shared.Actions:
    for action in parser._actions:
        if isinstance(action.choices, Mapping):
            return action.choices
    return {}


def _command_line(
    path: tuple[str, ...], summary: str, parser: argparse.ArgumentParser, actions: Mapping[str, str]
) -> CommandLine:
    flags = tuple(_flags(parser))
    if actions:
        return CommandLine(path, summary, flags, (), False, actions)
    places = [action for action in parser._actions if not action.option_strings]
    more = any(action.nargs in ("*", "+", argparse.REMAINDER) for action in places)
    return CommandLine(path, summary, flags, tuple(_value(action) for action in places), more, {})


def _flags(parser: argparse.ArgumentParser) -> Iterator[Flag]:
    for action in parser._actions:
        if action.option_strings and action.help != argparse.SUPPRESS:
            text = " ".join((action.help or "").replace("; one of %(choices)s", "").split())
            text = text % {**vars(action), "prog": parser.prog} if "%" in text else text
            yield Flag(tuple(action.option_strings), text, None if action.nargs == 0 else _value(action))


def _value(action: argparse.Action) -> Value:
    if action.choices is not None:
        return Value(tuple(str(choice) for choice in action.choices))
    if action.type in (common.node_id, common.node_ids):
        return Value(NODE_IDS)
    if action.nargs == argparse.REMAINDER:
        return Value(sources=frozenset({COMMAND}))
    words: list[str] = []
    sources: set[str] = set()
    metavar = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    alternatives = [re.sub(r"^\[\w+=\]", "", part.strip()) for part in metavar.split("|")]
    for part in alternatives:
        if _FILE.fullmatch(part):
            sources.add(FILE)
        elif part.partition("[")[0] == "CHANNEL":
            sources.add(CAN)
        elif part == "OBJECT":
            sources.add(OBJECT)
        elif len(alternatives) > 1 and part != "NAME" and _WORD.fullmatch(part):
            words.append(part)
    return Value(tuple(words), frozenset(sources))
