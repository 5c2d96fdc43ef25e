"""`tipforce view`: serve a web page with the force on each fingertip, live or from a log."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import bus_flags, common, log_flags
from tipforce_tools.page.guard import page_guard

if TYPE_CHECKING:
    from tipforce_tools.page.sources import Source


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
      tipforce view hand.toml                   commission the hand, and show it
      tipforce view -i socketcan -c can0        listen only: show all fingers on the bus
      tipforce view grasp                       run a scene, and show its log
    The page is read-only and reachable from this machine only, unless --allow-writes and --host are given.
    """
    from tipforce_tools.cli.listening import add_sync_argument

    parser.add_argument(
        "source",
        nargs="?",
        # A hand file that is missing must not become the shipped scene of its name, whose forces are simulated.
        type=common.InputFile("", "no such file", lambda text: "." in text),
        metavar="HAND.toml|LOG|SCENE",
        help="a hand file, a log, a scene, or the name of a shipped scene (default: listen to the bus)",
    )
    parser.add_argument("--no-bring-up", action="store_true", help="with a hand file: only listen, change nothing")
    parser.add_argument("--nodes", type=common.node_ids, metavar="IDS", help="show only these: 1,2,5-9")
    parser.add_argument("--gauges", type=int, default=3, metavar="N", help="of each finger, 3 to 8 (default 3)")
    parser.add_argument("--layout", metavar="I|II|III|FILE", help="gauge layout of fingers that do not report it")
    add_sync_argument(parser)
    group = parser.add_argument_group("log or scene")
    what, moment = "start, seconds from its beginning", common.number_within(0.0, 1e9, "is 0 to 1e+09 s")
    group.add_argument("--from", dest="start_s", type=moment, default=0.0, metavar="S", help=what)
    group.add_argument("--to", dest="end_s", type=moment, metavar="S", help="end, likewise")
    common.add_page_arguments(parser).add_argument("--allow-writes", action="store_true", help="allow the page to tare")
    bus_flags.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C or SIGTERM; return 0. Raises InputError and EnvironmentLackError."""
    from tipforce_tools.page.server import serve_page

    guard = page_guard(args)
    path = log_flags.scene_or_file(args.source) if args.source else None
    with contextlib.closing(_source(args, path)) as source:
        return serve_page(args, source, guard)


def _source(args: argparse.Namespace, path: Path | None) -> Source:
    from tipforce.sources.layout_file import read_layout
    from tipforce.watching.feeds import finger_maker
    from tipforce_tools.cli.listening import check_sync, commissioned, listening
    from tipforce_tools.page.sources import LiveSource, LogSource, is_scene, scene_source

    is_table = path is not None and path.suffix == ".toml"
    if args.no_bring_up and not is_table:
        raise InputError("--no-bring-up: needs a hand file")
    fallback = (args.layout, *read_layout(args.layout)) if args.layout else None
    maker = finger_maker(args.nodes, fallback)
    check_sync(args, None if args.no_bring_up else path)
    if path is None or args.no_bring_up:
        feed, channel = listening(args, path, fallback)
        title = f"{path.name} on {channel}" if path else channel
        return LiveSource(feed, f"{title}, listening", "this page only listens to the bus")
    if is_table and is_scene(path):
        common.note(f"{path}: running the scene")
        return scene_source(path, maker, args.start_s, args.end_s)
    if is_table:
        return LiveSource(commissioned(args, path, fallback), path.name)
    if str(path) == "-":
        raise InputError("-: a log is read more than once; pass a file instead of stdin")
    return LogSource(path, maker, args.gauges, args.start_s, args.end_s)
