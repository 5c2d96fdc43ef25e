"""Commands with actions: `design table`, each action a module with its own flags, and `sdo read`."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Mapping
from typing import NoReturn

from tipforce.visible_text import visible
from tipforce_tools.cli import common

Actions = Mapping[str, tuple[str, str]]
"""name -> (module with add_arguments(parser) and run(args) -> exit code, one line of help)."""


class CommandParser(argparse.ArgumentParser):
    """A parser of one command line; its errors are one line, which for a missing action lists the actions."""

    told: Mapping[str, str] = {}
    """action -> one line of help."""
    told_dest = "action"

    def __init__(self, prog: str, description: str) -> None:
        # Descriptions and epilogs keep their line breaks: they contain examples and tables.
        super().__init__(prog, description=description, formatter_class=argparse.RawDescriptionHelpFormatter)

    def error(self, message: str) -> NoReturn:
        """Print one line, with the command that lists the options; exit with code 2."""
        required = message.partition("the following arguments are required: ")[2].lower()
        if self.told and required.split(", ")[0] == self.told_dest:
            message = f"which {self.told_dest}? {', '.join(self.told)}"
        self.exit(2, f"{self.prog}: error: {visible(message)}; see `{self.prog} --help`\n")


def lines(told: Mapping[str, str]) -> str:
    """Return the help text of the actions, one line each."""
    width = max(map(len, told))
    return "\n".join(f"  {name:{width}}  {text}" for name, text in told.items())


def add_choice(parser: argparse.ArgumentParser, dest: str, told: Mapping[str, str]) -> None:
    """Add the first positional word of a command with common flags: one of ``told``, each with a line of help.

    The epilog follows these lines.
    """
    parser.epilog = f"{dest}s:\n{lines(told)}\n\n{parser.epilog or ''}"
    parser.add_argument(dest, choices=tuple(told))
    if isinstance(parser, CommandParser):
        parser.told, parser.told_dest = told, dest


def add_action(parser: argparse.ArgumentParser, command: str, actions: Actions) -> None:
    """Add the action. Its flags belong to its own parser: the bus flags alone take a fifth of a second to build."""
    told = {name: summary for name, (_, summary) in actions.items()}
    if isinstance(parser, CommandParser):
        parser.told = told
    parser.epilog = f"actions:\n{lines(told)}\n\n`tipforce {command} ACTION --help` lists the options of an action."
    parser.add_argument("action", choices=actions, metavar="ACTION", help=", ".join(actions))
    parser.add_argument("words", nargs=argparse.REMAINDER, metavar="...", help="options of the action")


def run_action(args: argparse.Namespace, command: str, actions: Actions) -> int:
    """Run the action and return its exit code."""
    parser = action_parser(command, args.action, actions)
    module = importlib.import_module(actions[args.action][0])
    parsed = parser.parse_intermixed_args(args.words, argparse.Namespace(action=args.action))
    common.set_up_logging(parsed)
    return int(module.run(parsed))


def action_parser(command: str, action: str, actions: Actions) -> CommandParser:
    """Return the parser of the words after `tipforce COMMAND ACTION`."""
    module_name, summary = actions[action]
    description = summary[0].upper() + summary[1:] + "."
    parser = CommandParser(prog=f"tipforce {command} {action}", description=description)
    importlib.import_module(module_name).add_arguments(parser)
    return parser
