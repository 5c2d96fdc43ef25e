"""Commands with actions: `design table`, each action a module with its own flags, and `sdo read`."""

import argparse
import importlib
import os
import re
import sys
import textwrap
from collections.abc import Callable, Mapping
from typing import NoReturn

from canopen_device.visible_text import visible
from tipforce_tools.cli import common

Actions = Mapping[str, tuple[str, str]]
"""name -> (place, one line of help). A place is a module below tipforce_tools with add_arguments(parser), whose
docstring ends the help, and run(args) -> exit code; or ``module:word`` with add_word_arguments and run_word."""


def functions(place: str) -> tuple[Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], int]]:
    """Import the module of a place; return the function that adds its flags, and the one that runs it."""
    name, _, word = place.partition(":")
    module = importlib.import_module(f"tipforce_tools.{name}")
    added, run = (f"add_{word}_arguments", f"run_{word}") if word else ("add_arguments", "run")
    return getattr(module, added), getattr(module, run)


def check_files(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Raise InputError for an input file that does not exist."""
    for action in parser._actions:
        value = getattr(args, action.dest, None)
        if isinstance(action.type, common.InputFile) and value is not None:
            for text in value if isinstance(value, list) else [value]:
                action.type.check(text)


SHARED = {"bus arguments": "bus", "SDO": "SDO", "changes": "change", "output": "output"}
"""Groups of flags that many commands have: one page, `tipforce --help-bus`, lists them, and each help their names."""


class CommandParser(argparse.ArgumentParser):
    """A parser of one command line; its errors are one line, which for a missing action lists the actions."""

    choice: Mapping[str, str] = {}
    """Of the first word: action -> one line of help."""
    choice_name = "action"

    def __init__(self, prog: str, description: str) -> None:
        # Descriptions and epilogs keep their line breaks: they contain examples and tables.
        super().__init__(prog, description=description, formatter_class=_Formatter)

    def error(self, message: str) -> NoReturn:
        """Print one line, with what was probably meant, or the command that lists the options; exit with code 2."""
        required = message.partition("the following arguments are required: ")[2].lower()
        wrong = re.search(r"invalid choice: '(.*)' \(choose from (.*)\)|unrecognized arguments: ([^ =]+)", message)
        if self.choice and required.split(", ")[0] == self.choice_name:
            message = f"which {self.choice_name}? {', '.join(self.choice)}"
        elif wrong:
            import difflib

            known = wrong[2].replace("'", "").split(", ") if wrong[2] else list(self._option_string_actions)
            if near := difflib.get_close_matches(wrong[1] or wrong[3] or "", known, 2):
                message = f"{message}; did you mean {' or '.join(near)}?"
        self.exit(2, f"{self.prog}: error: {visible(message)}; see `{self.prog} --help`\n")

    def format_usage(self) -> str:
        """Return the line of usage, which lists the positional words."""
        formatter = _Formatter(f"{self.prog} [options]")
        formatter.add_usage(None, [action for action in self._actions if not action.option_strings], [])
        return formatter.format_help()

    def format_help(self) -> str:
        """Return the help; its last line names the shared flags."""
        formatter = _Formatter(self.prog)
        formatter.add_usage(self.usage or self.format_usage()[7:], [], [])
        formatter.add_text(self.description)
        shared: list[str] = []
        for group in self._action_groups:
            if group.title in SHARED:
                shared += [action.option_strings[0] for action in group._group_actions]
                continue
            formatter.add_group(group)
        formatter.add_text(self.epilog)
        formatter.add_text(f"also {' '.join(shared)}: see `tipforce --help-bus`" if shared else None)
        return formatter.format_help()


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """As Python 3.13 prints flags: `-o, --output FILE`, the value once."""

    def __init__(self, prog: str) -> None:
        fixed = not (sys.stdout.isatty() or os.environ.get("COLUMNS"))  # as tables that are written to a pipe
        super().__init__(prog, max_help_position=30, width=118 if fixed else None)

    def add_group(self, group: argparse._ArgumentGroup) -> None:
        """Add the flags of a group that have a help text, without -h."""
        self.start_section(group.title)
        self.add_text(group.description)
        self.add_arguments(action for action in group._group_actions if action.help and action.dest != "help")
        self.end_section()

    def _format_action_invocation(self, action: argparse.Action) -> str:
        if not action.option_strings or action.nargs == 0:
            return super()._format_action_invocation(action)
        value = self._format_args(action, self._get_default_metavar_for_optional(action))
        return f"{', '.join(action.option_strings)} {value}"


def shared_help() -> str:
    """Return the help of the flags that commands share: `tipforce --help-bus`."""
    from tipforce_tools.cli import bus_flags

    parser = argparse.ArgumentParser("tipforce COMMAND", add_help=False)
    bus_flags.add_bus_arguments(parser, sdo=True)
    common.add_confirm_argument(parser)
    formatter = _Formatter(parser.prog)
    for group in parser._action_groups:
        formatter.add_group(group)
    return formatter.format_help()


def lines(summaries: Mapping[str, str]) -> str:
    """Return the help text of the actions, one line each."""
    width = max(map(len, summaries))
    return "\n".join(f"  {name:{width}}  {text}" for name, text in summaries.items())


def add_choice(parser: argparse.ArgumentParser, dest: str, summaries: Mapping[str, str]) -> None:
    """Add the first positional word of a command: one of ``summaries``, each with a line of help before the epilog."""
    parser.epilog = f"{dest}s:\n{lines(summaries)}\n\n{parser.epilog or ''}"
    parser.add_argument(dest, choices=tuple(summaries))
    if isinstance(parser, CommandParser):
        parser.choice, parser.choice_name = summaries, dest


def parser_of(path: str, place: str | Actions, summary: str) -> CommandParser:
    """Return the parser of the words after `tipforce PATH`; of a command with actions, of the action alone. The flags
    of an action belong to its own parser: the bus flags alone take a fifth of a second to build."""
    parser = CommandParser(prog=f"tipforce {path}", description=summary[0].upper() + summary[1:] + ".")
    # argparse's own pattern takes -1.5e-3 and -1,0,0 for unknown flags.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    if isinstance(place, str):
        add_flags = functions(place)[0]
        parser.epilog = textwrap.dedent(f"    {add_flags.__doc__ or ''}").removeprefix("    ").strip("\n")
        add_flags(parser)
        return parser
    parser.choice = {name: text for name, (_, text) in place.items()}
    parser.epilog = (
        f"actions:\n{lines(parser.choice)}\n\n`tipforce {path} ACTION --help` lists the options of an action."
    )
    parser.add_argument("action", choices=place, metavar="ACTION", help=", ".join(place))
    return parser
