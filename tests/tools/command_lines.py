"""Every command line of tipforce, from the parsers."""

import argparse
from collections.abc import Iterator

from tipforce_tools.cli.completion import root_parser
from tipforce_tools.cli.main import all_parsers


def lines(parser: argparse.ArgumentParser, path: str = "tipforce") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Each command line with its parser, before those of its commands or actions."""
    yield path, parser
    for name, below in choices(parser).items():
        yield from lines(below, f"{path} {name}")


def choices(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands or actions of a parser; none where flags and values follow."""
    return next((dict(a.choices) for a in parser._actions if isinstance(a, argparse._SubParsersAction)), {})


ALL = dict(lines(root_parser("bash", all_parsers())))
LINES = {path: list(choices(parser)) for path, parser in ALL.items()}
PARSERS = {path: parser for path, parser in ALL.items() if not choices(parser)}
