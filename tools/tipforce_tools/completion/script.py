"""The scripts, made by shtab from the parsers of all commands, and the values that only tipforce can complete."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Mapping
from typing import Any, NamedTuple

from tipforce_tools.cli import actions as shared
from tipforce_tools.cli import common
from tipforce_tools.cli.main import COMMANDS, command_parser

FILE, CAN, COMMAND = "file", "can", "command"
NODE_IDS = tuple(str(number) for number in range(1, 16))
"""Offered for a node-id: those that the DBC has. Others are allowed, too."""

_FILE = re.compile(r"(FILE|LOG|DIR|PATH|OUT|SCENE)(\.\w+)?|\w+\.(toml|csv|npz|json|log)")
_WORD = re.compile(r"[\w.+-]*\w")

_OFFERS = {
    "bash": {
        "words": 'compgen -W "{}" -- "$1"', FILE: 'compgen -f -- "$1"', COMMAND: 'compgen -c -- "$1"',
        CAN: 'compgen -W "$(_tipforce_interfaces)" -- "$1"',
    },
    "zsh": {"words": "compadd -- {}", FILE: "_files", COMMAND: "_normal", CAN: "compadd -- $(_tipforce_interfaces)"},
    "fish": {
        "words": "printf '%s\\n' {}", FILE: "__fish_complete_path (commandline -ct)", CAN: "_tipforce_interfaces",
        COMMAND: "__fish_complete_subcommand",
    },
}  # fmt: skip
"""What prints or adds the completions of each source. {} becomes the words."""

_FUNCTION = {"fish": "function {}\n  {}\nend"}
_POSIX_FUNCTION = "{}() {{\n  {}\n}}"

# ARPHRD_CAN is 280.
_CAN_INTERFACES = (
    "find -L /sys/class/net -mindepth 2 -maxdepth 2 -name type -exec grep -lx 280 '{}' + 2>/dev/null | cut -d/ -f5"
)

# shtab takes COMP_WORDS, which readline splits at = and : where the parsers do not.
_BASH_END = """
_tipforce() {
  local line=${COMP_LINE:0:COMP_POINT} word words COMP_WORDS=() COMP_CWORD
  read -ra words <<< "$line"
  [[ $line == *[[:space:]] ]] && words+=("")
  for word in "${words[@]}"; do
    if [[ $word == --*=* ]]; then COMP_WORDS+=("${word%%=*}" "${word#*=}"); else COMP_WORDS+=("$word"); fi
  done
  COMP_CWORD=$(( ${#COMP_WORDS[@]} - 1 )) word=${COMP_WORDS[${#COMP_WORDS[@]} - 1]}
  _shtab_tipforce
  COMPREPLY=("${COMPREPLY[@]#"${word%"${word##*:}"}"}")
}

complete -F _tipforce tipforce
"""


class Value(NamedTuple):
    """What can be completed in one place: ``words``, and what the ``sources`` (FILE, CAN, COMMAND) give."""

    words: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()


def script(shell: str) -> str:
    """The script of "bash", "zsh" or "fish"."""
    import shtab

    function = _FUNCTION.get(shell, _POSIX_FUNCTION)
    preamble = function.format("_tipforce_interfaces", _CAN_INTERFACES)
    text: str = shtab.complete(root_parser(shell), shell, preamble=preamble)
    if shell == "zsh":
        # For _arguments, (*) is a list of what a word excludes; * is a word that can be repeated.
        text = re.sub(r'"\(\*\)::?', '"*:', text)
    return text + (_BASH_END if shell == "bash" else "")


def root_parser(shell: str) -> argparse.ArgumentParser:
    """One parser with every command and its actions as subparsers; values carry what completes them in ``shell``."""
    root = argparse.ArgumentParser(prog="tipforce")
    root.add_argument("-V", "--version", action="version", help="print the version")
    commands = root.add_subparsers()
    for name, (_, summary) in COMMANDS.items():
        parser = command_parser(name)
        table = next((a.choices for a in parser._actions if isinstance(a.choices, Mapping)), None)
        if table is None:
            commands.add_parser(name, help=summary, add_help=False, parents=[_with_values(parser, shell)])
            continue
        actions = commands.add_parser(name, help=summary).add_subparsers()
        for action, (_, text) in table.items():
            one = _with_values(shared.action_parser(name, action, table), shell)
            actions.add_parser(action, help=text, add_help=False, parents=[one])
    return root


def _with_values(parser: argparse.ArgumentParser, shell: str) -> argparse.ArgumentParser:
    for action in parser._actions:
        if action.choices is None and action.nargs != 0 and any(value := value_of(action)):
            action.complete = _completer(value, shell)  # type: ignore[attr-defined]
        if shell == "zsh" and action.nargs != 0:
            # So that _arguments takes --flag=VALUE, beside --flag VALUE.
            action.option_strings = [f"{name}=" if name[:2] == "--" else name for name in action.option_strings]
    return parser


def _completer(value: Value, shell: str) -> dict[str, Any]:
    """As shtab wants it: the function to call, and its definition; equal definitions are printed once."""
    offers = [_OFFERS[shell][source] for source in value.sources]
    if value.words:
        offers.append(_OFFERS[shell]["words"].format(shlex.join(value.words)))
    # shtab's script for bash takes completions as file names by the function's name.
    what = "_".join((*value.sources, *value.words[:3], *map(str, [len(value.words)] if value.words else ())))
    name = "_tipforce_" + re.sub(r"\W", "_", what)
    definition = _FUNCTION.get(shell, _POSIX_FUNCTION).format(name, "\n  ".join(offers))
    return {shell: f"({name})" if shell == "fish" else name, "preamble": {shell: definition}}


def value_of(action: argparse.Action) -> Value:
    """What completes the value of a flag or a positional word without choices, by its type and metavar."""
    if action.type in (common.node_id, common.node_ids):
        return Value(NODE_IDS)
    if action.nargs == argparse.REMAINDER:
        return Value(sources=(COMMAND,))
    words: list[str] = []
    sources: dict[str, None] = {}
    metavar = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    alternatives = [re.sub(r"^\[\w+=\]", "", part.strip()) for part in metavar.split("|")]
    for part in alternatives:
        if _FILE.fullmatch(part):
            sources[FILE] = None
        elif part.partition("[")[0] == "CHANNEL":
            sources[CAN] = None
        elif part == "OBJECT":
            from tipforce.dictionary.names import all_names

            words += all_names()
        elif len(alternatives) > 1 and part != "NAME" and _WORD.fullmatch(part):
            words.append(part)
    return Value(tuple(words), tuple(sources))
