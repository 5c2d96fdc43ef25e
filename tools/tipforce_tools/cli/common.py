"""Shared by the commands: standard streams, common flags, numbers and node-ids, printing of records."""

from __future__ import annotations

import argparse
import glob
import math
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from tipforce.errors import InputError
from tipforce_tools.cli import output

OUTPUT = output.OUTPUT
_LINE_S = 10.0


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add `--json`, `-q`, `-v`, `--color`."""
    group = parser.add_argument_group("output")
    group.add_argument("--json", action="store_true", help="print JSON lines on stdout")
    group.add_argument("-q", "--quiet", action="store_true", help="print only errors on stderr")
    group.add_argument("-v", "--verbose", action="store_true", help="print more on stderr")
    group.add_argument("--color", choices=("auto", "always", "never"), default="auto", help="auto follows NO_COLOR")


def number(text: str, read: Callable[[str], Any] = float) -> Any:
    """Return the number of a flag whose limits are checked later; NaN, which fails every limit, if it is not one."""
    try:
        return read(text)
    except ValueError:
        return math.nan


def number_that(
    accepted: Callable[[float], bool], allowed: str, read: Callable[[str], Any] = float, what: str = ""
) -> Callable[[str], Any]:
    """Return a parser for argparse of a number that is ``accepted``; ``allowed`` says what is: `are 0 to 9`."""

    def parse(text: str) -> Any:
        value = number(text, read)
        if not accepted(value):
            raise argparse.ArgumentTypeError(f"{what}{text!r}: allowed {allowed}")
        return value

    return parse


def number_within(low: float, high: float, allowed: str, *, over: bool = False) -> Callable[[str], float]:
    """Return a parser for argparse of a number from ``low``, or ``over`` it, to ``high``."""
    return number_that(lambda value: low < value <= high or (value == low and not over), allowed)


any_base = partial(int, base=0)
count = number_that(lambda value: value >= 1, "are whole numbers from 1", int)
whole_number = number_that(lambda value: value >= 0, "are whole numbers from 0", int)
unsigned32 = number_that(lambda value: 0 <= value <= 0xFFFFFFFF, "are 0 to 0xFFFFFFFF", any_base)
node_id = number_that(lambda value: 1 <= value <= 127, "are 1 to 127 (10 or 0x0A)", any_base, "node-id ")
above_0 = number_that(lambda value: 0 < value < math.inf, "is above 0")
seconds = number_that(lambda value: 0 < value < math.inf, "are seconds, more than 0")
speed = number_that(lambda value: value > 0, "are numbers over 0, and inf")
timeout = number_within(0.0, threading.TIMEOUT_MAX, "is a time over 0 s", over=True)  # for which a thread can wait


def add_number(
    parser: argparse._ActionsContainer, name: str, default: float | None, unit: str, text: str,
    parse: Callable[[str], float],
) -> None:  # fmt: skip
    """Add a flag of one number; ``parse`` knows what is allowed."""
    parser.add_argument(name, type=parse, default=default, metavar=unit, help=text)


class InputFile:
    """For argparse: the name of a file to read. ``kind`` precedes it in the error; ``names``: which texts are names.
    ``check`` is called after the parsing, before the command imports what reads the file."""

    def __init__(
        self, kind: str = "", lacks: str = "No such file or directory", names: Callable[[str], object] = lambda _: True
    ) -> None:
        self._kind, self._lacks, self._names = kind, lacks, names

    def __call__(self, text: str) -> str:
        """Return the name."""
        return text

    def check(self, text: str) -> None:
        """Raise InputError for a missing file; - is stdin."""
        if text != "-" and self._names(text) and not os.path.exists(text):
            raise InputError(f"{self._kind}{text}: {self._lacks}")


LOG = InputFile("", "no such file", lambda text: not glob.has_magic(text) and "://" not in text)
TARGET = InputFile("", "no such file", lambda text: "," not in text and re.search(r"\.(log|txt)$|/", text))
"""`vcan0,181:7FF`, or the name of a log."""


def node_ids(text: str) -> list[int]:
    """Parse a set of node-ids, `1,2,5-9`, for argparse; sorted, without duplicates."""
    ids: set[int] = set()
    for part in text.split(","):
        ends = re.fullmatch(r"\s*(\w+)\s*(?:-\s*(\w+)\s*)?", part)
        if ends is None:
            raise argparse.ArgumentTypeError(f"node-ids {text!r}: write 1,2,5-9")
        first = node_id(ends[1])
        last = node_id(ends[2]) if ends[2] else first
        if last < first:
            raise argparse.ArgumentTypeError(f"node-ids {part!r}: the second is smaller than the first")
        ids.update(range(first, last + 1))
    return sorted(ids)


def shown_id(number: int) -> str:
    """Return a node-id in the form `10 (0x0A)`."""
    return f"{number} (0x{number:02X})"


def shown_node(number: int) -> str:
    """Return a node in a message: `node 10 (0x0A)`."""
    return f"node {shown_id(number)}"


def print_json(record: dict[str, Any]) -> None:
    """Print one JSON line, in one write, because other threads print, too; NaN and infinity become null."""
    sys.stdout.write(json_line(record) + "\n")


def print_record(record: dict[str, Any], text: str) -> None:
    """Print the record as a JSON line with --json, otherwise the text that shows it."""
    if OUTPUT.json:
        print_json(record)
    else:
        print(text)


def json_line(record: dict[str, Any]) -> str:
    """Return the line of print_json() without the newline."""
    import json

    return json.dumps(_plain(record))


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def note(text: str) -> None:
    """Print a line on stderr; nothing with -q."""
    if not OUTPUT.quiet:
        print(text, file=sys.stderr)


@contextmanager
def progress(
    what: str, total: float, *, absolute: bool = False, refresh_hz: float = 10.0
) -> Iterator[Callable[..., None]]:
    """Show a progress bar on stderr, or if that is no terminal a line each 10 s; nothing with -q. Call the result after
    each of ``total`` steps, or with the number of steps since the last call, with ``absolute`` of all so far."""
    if OUTPUT.quiet or not sys.stderr.isatty():
        begun_s = said_s = time.monotonic()
        done = 0.0

        def count(steps: float = 1) -> None:
            nonlocal done, said_s
            done = steps if absolute else done + steps
            if not OUTPUT.quiet and time.monotonic() >= said_s + _LINE_S:
                said_s = time.monotonic()
                note(f"{what.strip()}: {done:g} of {total:g}, {said_s - begun_s:.0f} s")

        yield count
        return
    from rich.progress import Progress

    from tipforce_tools.cli.tables import console

    screen = console(stderr=True)
    # rich takes over the streams, and shows a control sequence as a colour: escape before that.
    with Progress(transient=True, console=screen, refresh_per_second=refresh_hz) as bar, output.visible_streams():
        task = bar.add_task(what, total=total)
        yield lambda steps=1: bar.update(task, **{"completed" if absolute else "advance": steps})


def add_confirm_argument(parser: argparse.ArgumentParser) -> None:
    """`--yes`."""
    group = parser.add_argument_group("changes")
    group.add_argument("-y", "--yes", action="store_true", help="do not ask before persistent changes")


def add_page_arguments(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the flags of the page's server; return their group."""
    group = parser.add_argument_group("page")
    text, host = "default %(default)s; 0: any free port", "address to serve on, default loopback; others need --token"
    port = number_that(lambda value: 0 <= value <= 65535, "are 0 (any free port) to 65535", int)
    group.add_argument("--port", type=port, default=8404, metavar="N", help=text)
    group.add_argument("--host", default="", metavar="ADDRESS", help=host)
    group.add_argument("--token", metavar="TOKEN|auto", help="required to open the page; auto generates one")
    group.add_argument("--open", action="store_true", help="open the page in the browser")
    return group
