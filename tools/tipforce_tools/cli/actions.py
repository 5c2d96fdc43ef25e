"""Commands of several actions: `design table`, whose actions have a module and flags each, and `sdo read`."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Mapping
from typing import NoReturn

from tipforce_tools.cli import common

Actions = Mapping[str, tuple[str, str]]
"""name -> (module with add_arguments(parser) and run(args) -> exit code, one line of help)."""


class CommandParser(argparse.ArgumentParser):
    """A parser of one command line; where the action is missing it tells which there are."""

    told: Mapping[str, str] = {}
    """action -> one line of help."""
    told_dest = "action"

    def __init__(self, prog: str, description: str) -> None:
        # Descriptions and epilogs keep their lines: examples and tables are in them.
        super().__init__(prog, description=description, formatter_class=argparse.RawDescriptionHelpFormatter)

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        required = message.partition("the following arguments are required: ")[2].lower()
        if self.told and required.split(", ")[0] == self.told_dest:
            usage = f"usage: {self.prog} {self.told_dest.upper()} ...\n{self.prog}: error: which {self.told_dest}?"
            self.exit(2, f"{usage}\n{lines(self.told)}\n\n`{self.prog} --help` tells more.\n")
        super().error(message)


def lines(told: Mapping[str, str]) -> str:
    """A line for each action, as it stands in help."""
    width = max(map(len, told))
    return "\n".join(f"  {name:{width}}  {text}" for name, text in told.items())


def add_choice(parser: argparse.ArgumentParser, dest: str, told: Mapping[str, str]) -> None:
    """The first positional word of a command whose flags hold for all: one of ``told``, each with a line of help.

    What the epilog holds comes behind these lines.
    """
    parser.epilog = f"{dest}s:\n{lines(told)}\n\n{parser.epilog or ''}"
    parser.add_argument(dest, choices=tuple(told))
    if isinstance(parser, CommandParser):
        parser.told, parser.told_dest = told, dest


def add_action(parser: argparse.ArgumentParser, command: str, actions: Actions) -> None:
    """The action; its own flags are for its own parser: the bus flags alone cost a fifth of a second."""
    told = {name: summary for name, (_, summary) in actions.items()}
    if isinstance(parser, CommandParser):
        parser.told = told
    parser.epilog = f"actions:\n{lines(told)}\n\n`tipforce {command} ACTION --help` tells each one's options."
    parser.add_argument("action", choices=actions, metavar="ACTION", help=", ".join(actions))
    parser.add_argument("words", nargs=argparse.REMAINDER, metavar="...", help="options of the action")


def run_action(args: argparse.Namespace, command: str, actions: Actions) -> int:
    """Run the action; its exit code."""
    parser = action_parser(command, args.action, actions)
    module = importlib.import_module(actions[args.action][0])
    parsed = parser.parse_intermixed_args(args.words, argparse.Namespace(action=args.action))
    common.set_up_logging(parsed)
    return int(module.run(parsed))


def action_parser(command: str, action: str, actions: Actions) -> CommandParser:
    """The parser of the words behind `tipforce COMMAND ACTION`."""
    module_name, summary = actions[action]
    description = summary[0].upper() + summary[1:] + "."
    parser = CommandParser(prog=f"tipforce {command} {action}", description=description)
    importlib.import_module(module_name).add_arguments(parser)
    return parser
