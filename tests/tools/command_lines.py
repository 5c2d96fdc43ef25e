"""Every command line of tipforce, from the parsers."""

import argparse
from collections.abc import Iterator

from tipforce_tools.cli.completion import root_parser
from tipforce_tools.cli.main import all_parsers


def parsers(
    parser: argparse.ArgumentParser, path: str = "tipforce"
) -> Iterator[tuple[str, argparse.ArgumentParser, list[str]]]:
    """Each command line, its parser, and its commands or actions; none where flags and values follow."""
    subparsers = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    choices = subparsers[0].choices if subparsers else {}
    yield path, parser, list(choices)
    for name, one in choices.items():
        yield from parsers(one, f"{path} {name}")


_ALL = list(parsers(root_parser("bash", all_parsers())))
LINES = {path: names for path, _, names in _ALL}
PARSERS = {path: parser for path, parser, names in _ALL if not names}
