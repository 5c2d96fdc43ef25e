"""What the subcommands share: flags that hold everywhere, node-ids, buses, and how records are printed."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

from tipforce.errors import InputError

if TYPE_CHECKING:
    import can
    from rich.console import Console
    from rich.table import Table

    from tipforce.host.network.connection import Connection


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """`--json`, `-q`, `-v`, `--color`."""
    group = parser.add_argument_group("output")
    group.add_argument("--json", action="store_true", help="JSON lines on stdout")
    group.add_argument("-q", "--quiet", action="store_true", help="errors only on stderr")
    group.add_argument("-v", "--verbose", action="store_true", help="more on stderr")
    group.add_argument(
        "--color", choices=("auto", "always", "never"), default="auto", help="default: auto, NO_COLOR is honoured"
    )


def set_up_logging(args: argparse.Namespace) -> None:
    """Warnings of tipforce to stderr, all with -v, errors only with -q; the libraries' own only with -v."""
    import logging

    level = logging.ERROR if args.quiet else logging.DEBUG if args.verbose else logging.WARNING
    logging.basicConfig(stream=sys.stderr, level=level, format="%(levelname)s %(name)s: %(message)s")
    if not args.verbose:
        # canopen logs each abort as an error although it also raises it; python-can warns of what open_bus reports.
        logging.getLogger("canopen").setLevel(logging.CRITICAL)
        logging.getLogger("can").setLevel(logging.CRITICAL)


def add_bus_arguments(parser: argparse.ArgumentParser) -> None:
    """python-can's own bus flags: -i -c -b --fd --data-bitrate --timing --bus-kwargs."""
    from tipforce_tools.cli import bus_flags

    bus_flags.add_bus_arguments(parser)


def add_sdo_arguments(parser: argparse.ArgumentParser) -> None:
    """Bus flags, and the time-out and retries of SDO transfers."""
    add_bus_arguments(parser)
    group = parser.add_argument_group("SDO")
    group.add_argument(
        "--timeout", type=float, default=0.5, metavar="S", help="wait for an answer (default %(default)s s)"
    )
    group.add_argument("--retries", type=int, default=2, metavar="N", help="further tries (default %(default)s)")


def bus_options(args: argparse.Namespace) -> dict[str, Any]:
    """What the bus flags said, as keywords of ``can.Bus``."""
    names = ("interface", "channel", "bitrate", "fd", "data_bitrate", "timing", "can_filters")
    options = {name: getattr(args, name) for name in names if hasattr(args, name)}
    options.update(getattr(args, "bus_kwargs", {}))
    return options


def open_bus(args: argparse.Namespace) -> can.BusABC:
    """The bus that the flags, python-can's configuration files and the environment name."""
    from tipforce.host.network.bus import open_bus as open_bus_by_options

    return open_bus_by_options(**bus_options(args))


def open_connection(args: argparse.Namespace) -> Connection:
    """A host connection on that bus."""
    import threading

    from tipforce.host.network.connection import Connection

    if not 0 < args.timeout < threading.TIMEOUT_MAX or args.retries < 0:
        raise InputError(
            f"--timeout {args.timeout:g}, --retries {args.retries}: allowed are a time over 0 s and 0 or more retries"
        )
    return Connection(open_bus(args), args.timeout, args.retries)


def number(text: str) -> float:
    """A number of a flag that has limits of its own: NaN, which no limit allows, for what is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def count(text: str) -> int:
    """How many of something, for argparse: a whole number from 1 on."""
    try:
        found = int(text)
    except ValueError:
        found = 0
    if found < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed are whole numbers from 1 on")
    return found


def seconds(text: str) -> float:
    """A time, for argparse: more than 0."""
    found = number(text)
    if not 0 < found < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed are seconds, more than 0")
    return found


def node_id(text: str) -> int:
    """A node-id as `10` or `0x0A`, for argparse."""
    try:
        number = int(text, 0)
    except ValueError:
        number = 0
    if not 1 <= number <= 127:
        raise argparse.ArgumentTypeError(f"node-id {text!r}: allowed are 1 to 127 (10 or 0x0A)")
    return number


def node_ids(text: str) -> list[int]:
    """A set of node-ids as `1,2,5-9`, for argparse; sorted, each once."""
    found: set[int] = set()
    for part in text.split(","):
        ends = re.fullmatch(r"\s*(\w+)\s*(?:-\s*(\w+)\s*)?", part)
        if ends is None:
            raise argparse.ArgumentTypeError(f"node-ids {text!r}: write 1,2,5-9")
        first = node_id(ends[1])
        last = node_id(ends[2]) if ends[2] else first
        if last < first:
            raise argparse.ArgumentTypeError(f"node-ids {part!r}: the second is smaller than the first")
        found.update(range(first, last + 1))
    return sorted(found)


def shown_id(number: int) -> str:
    """A node-id as people read it: `10 (0x0A)`."""
    return f"{number} (0x{number:02X})"


def print_json(record: dict[str, Any]) -> None:
    """One JSON line; NaN and infinity become null, because JSON has none."""
    print(json_line(record))


def json_line(record: dict[str, Any]) -> str:
    """What print_json() prints, without the line's end."""
    import json

    return json.dumps(_plain(record))


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def note(args: argparse.Namespace, text: str) -> None:
    """A line for the person at the terminal, on stderr; silent with -q."""
    if not args.quiet:
        print(text, file=sys.stderr)


@contextmanager
def progress(args: argparse.Namespace, what: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar on stderr if that is a terminal, nothing elsewhere and with -q; call it after each of ``total`` steps."""
    if args.quiet or not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.progress import Progress

    with Progress(transient=True, console=console(args, stderr=True)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)


def console(args: argparse.Namespace, *, stderr: bool = False) -> Console:
    """A rich console that follows --color and NO_COLOR; into a pipe tables keep a fixed width."""
    from rich.console import Console

    class QuietConsole(Console):
        def on_broken_pipe(self) -> None:  # rich's own ends with exit code 1; `| head` is no failure
            raise BrokenPipeError

    plain = args.color == "never" or (args.color == "auto" and bool(os.environ.get("NO_COLOR")))
    width = None if (sys.stderr if stderr else sys.stdout).isatty() else 120
    always = True if args.color == "always" else None
    # Without a colour system there are no bold letters, either: what is plain is text and nothing else.
    system: Literal["auto"] | None = None if plain else "auto"
    return QuietConsole(stderr=stderr, force_terminal=always, color_system=system, no_color=plain, width=width)


def print_table(args: argparse.Namespace, table: Table) -> None:
    """A table on stdout. Where the terminal is too narrow it loses its lines, and words wrap; a number never does.

    A number that is cut (`4.…`) says nothing, and one that wraps stands beside the label of another. A word that is
    longer than its column goes on in the next line: names are there to be copied.
    """
    screen = console(args)
    unbounded = screen.options.update(width=1000)
    if screen.measure(table, options=unbounded).maximum > screen.width:
        table.box, table.padding, table.pad_edge = None, (0, 1, 0, 0), False
        for column in table.columns:
            column.overflow = "fold"
            if column.justify == "right":
                column.no_wrap, column.header = True, str(column.header).replace(" ", "\n")
        # What does not fit even so is for the terminal to wrap.
        screen.width = max(screen.width, screen.measure(table, options=unbounded).minimum)
    screen.print(table)


def add_confirm_argument(parser: argparse.ArgumentParser) -> None:
    """`--yes`."""
    parser.add_argument("-y", "--yes", action="store_true", help="do not ask before something persists")


def confirm(args: argparse.Namespace, what: str) -> None:
    """Ask before something persists on a real bus; virtual buses and --yes do not ask.

    Raises InputError when the answer is no, or when there is nobody to ask.
    """
    options = bus_options(args)
    virtual = options.get("interface") in ("virtual", "udp_multicast") or "vcan" in str(options.get("channel", ""))
    if args.yes or virtual:
        return
    if not sys.stdin.isatty():
        raise InputError(f"{what}; nobody is there to ask: add --yes to do it")
    print(f"{what}. Go on? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise InputError("not done")
