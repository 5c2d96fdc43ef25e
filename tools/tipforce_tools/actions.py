"""Commands of several actions (`design table`, `calibrate fit`): each action has a module and flags of its own."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Mapping

from tipforce_tools import common

Actions = Mapping[str, tuple[str, str]]
"""name -> (module with add_arguments(parser) and run(args) -> exit code, one line of help)."""


def add_action(parser: argparse.ArgumentParser, command: str, actions: Actions) -> None:
    """The action; its own flags are for its own parser: the bus flags alone cost a fifth of a second."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    lines = "\n".join(f"  {name:9} {summary}" for name, (_, summary) in actions.items())
    parser.epilog = f"actions:\n{lines}\n\n`tipforce {command} ACTION --help` tells each one's options."
    parser.add_argument("action", choices=actions, metavar="ACTION", help=", ".join(actions))
    parser.add_argument("words", nargs=argparse.REMAINDER, metavar="...", help="options of the action")


def run_action(args: argparse.Namespace, command: str, actions: Actions) -> int:
    """Run the action; its exit code."""
    parser = action_parser(command, args.action, actions)
    module = importlib.import_module(actions[args.action][0])
    parsed = parser.parse_intermixed_args(args.words, argparse.Namespace(action=args.action))
    common.set_up_logging(parsed)
    return int(module.run(parsed))


def action_parser(command: str, action: str, actions: Actions) -> argparse.ArgumentParser:
    """The parser of the words behind `tipforce COMMAND ACTION`."""
    module_name, summary = actions[action]
    description = summary[0].upper() + summary[1:] + "."
    parser = argparse.ArgumentParser(prog=f"tipforce {command} {action}", description=description)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    importlib.import_module(module_name).add_arguments(parser)
    return parser
