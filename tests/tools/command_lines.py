"""Every command line of tipforce, from the parsers."""

import argparse
from collections.abc import Iterator

from tipforce_tools.cli.completion import root_parser
from tipforce_tools.cli.main import all_parsers


def command_lines(parser: argparse.ArgumentParser, path: str = "tipforce") -> Iterator[tuple[str, list[str]]]:
    """Each command line, with its commands or actions; empty where flags and values follow."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield path, list(action.choices)
            for name, one in action.choices.items():
                yield from command_lines(one, f"{path} {name}")
            return
    yield path, []


def parsers(parser: argparse.ArgumentParser, path: str = "tipforce") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Each command line without further commands or actions, with its parser."""
    subparsers = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not subparsers:
        yield path, parser
    for action in subparsers:
        for name, one in action.choices.items():
            yield from parsers(one, f"{path} {name}")


LINES = dict(command_lines(root_parser("bash", all_parsers())))
PARSERS = dict(parsers(root_parser("bash", all_parsers())))
