"""`tipforce view`: serve a web page with the force on each fingertip, live or from a log."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from collections.abc import Callable

    from tipforce.host.hand.file import HandFile
    from tipforce.host.hand.hand import Hand
    from tipforce.sensor.structure.gauge_positions import Gauge
    from tipforce.sensor.structure.geometry import Geometry
    from tipforce_tools.view.fingers import Finger
    from tipforce_tools.view.sources import Source

DEFAULT_PORT = 8404
_MOST_SECONDS = 1e9


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce view`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        "  tipforce view hand.toml                   commission the hand, and show it\n"
        "  tipforce view -i socketcan -c can0        listen only: show all fingers on the bus\n"
        "  tipforce view run.log                     replay a log\n"
        "  tipforce view grasp                       run a scene, and show its log\n"
        "  tipforce demo --view                      a simulated hand, without CAN\n"
        "The page is read-only and reachable from this machine only, unless --allow-writes and --host are given."
    )
    parser.add_argument(
        "source",
        nargs="?",
        metavar="HAND.toml|LOG|SCENE",
        help="a hand file, a log, a scene, or the name of a shipped scene (default: listen to the bus)",
    )
    parser.add_argument("--no-bring-up", action="store_true", help="with a hand file: only listen, change nothing")
    parser.add_argument("--nodes", type=common.node_ids, metavar="IDS", help="show only these: 1,2,5-9")
    parser.add_argument("--gauges", type=int, default=3, metavar="N", help="of each finger, 3 to 8 (default 3)")
    parser.add_argument("--layout", metavar="I|II|III|FILE", help="gauge layout of fingers that do not report it")
    group = parser.add_argument_group("log or scene")
    group.add_argument(
        "--from", dest="start_s", type=float, default=0.0, metavar="S", help="start, seconds from its beginning"
    )
    group.add_argument("--to", dest="end_s", type=float, metavar="S", help="end, likewise")
    add_server_arguments(parser)
    common.add_bus_arguments(parser)
    common.add_output_arguments(parser)


def add_server_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the page's server, which `demo --view` has, too."""
    group = parser.add_argument_group("page")
    group.add_argument(
        "--port", type=int, default=DEFAULT_PORT, metavar="N", help="default %(default)s; 0: any free port"
    )
    group.add_argument(
        "--host", default="", metavar="ADDRESS", help="address to serve on, default loopback; others need --token"
    )
    group.add_argument("--token", metavar="TOKEN|auto", help="required to open the page; auto generates one")
    group.add_argument("--allow-writes", action="store_true", help="allow the page to tare")
    group.add_argument("--open", action="store_true", help="open the page in the browser")


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C or SIGTERM; return 0. Raises InputError and EnvironmentLackError."""
    common.set_up_logging(args)
    check_server_arguments(args)
    with _source(args) as source:
        return serve(args, source)


def check_server_arguments(args: argparse.Namespace) -> None:
    """Check the arguments before opening anything. Raises InputError."""
    from tipforce_tools.view.guard import access_token, host_names

    if not 0 <= args.port <= 65535:
        raise InputError(f"--port {args.port}: allowed are 0 (any free port) to 65535")
    for flag, value in (("--from", getattr(args, "start_s", None)), ("--to", getattr(args, "end_s", None))):
        if value is not None and not 0.0 <= value <= _MOST_SECONDS:
            raise InputError(f"{flag} {value:g}: allowed is 0 to {_MOST_SECONDS:g} s from the beginning")
    access_token(args.host or "127.0.0.1", args.token)
    host_names(args.host or "127.0.0.1")


def serve(args: argparse.Namespace, source: Source) -> int:
    """Serve the page of a source until Ctrl-C or SIGTERM."""
    from tipforce_tools.cli.main import terminate_as_interrupt
    from tipforce_tools.view.guard import Guard, access_token, host_names
    from tipforce_tools.view.server import ViewServer

    host = args.host or "127.0.0.1"
    guard = Guard(host_names(host), access_token(host, args.token), args.allow_writes)
    server = ViewServer(source, guard, (host,) if args.host else ("127.0.0.1", "::1"), args.port)
    terminate_as_interrupt()
    server.start()
    try:
        if args.json:
            common.print_json({"url": server.url})
        else:
            print(server.url)
        sys.stdout.flush()
        common.note(args, f"{source.title}: {'read and tare' if args.allow_writes else 'read-only'}; Ctrl-C ends it")
        if args.open:
            import webbrowser

            webbrowser.open(server.url)
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        return 0
    finally:
        server.close()


@contextlib.contextmanager
def _source(args: argparse.Namespace) -> Iterator[Source]:
    from tipforce.shipped_files import file_or_shipped

    path = file_or_shipped(args.source, "scenes") if args.source else None
    if args.no_bring_up and (path is None or path.suffix != ".toml"):
        raise InputError("--no-bring-up: needs a hand file")
    if path is None or (args.no_bring_up and path is not None):
        source = _listen(args, path)
    elif path.suffix == ".toml" and _is_scene(path):
        source = _scene(args, path)
    elif path.suffix == ".toml":
        source = _hand(args, path)
    else:
        source = _log(args, path)
    try:
        yield source
    finally:
        source.close()


def _log(args: argparse.Namespace, path: Path) -> Source:
    from tipforce_tools.view.log_source import LogSource

    if str(path) == "-":
        raise InputError("-: a log is read more than once; pass a file instead of stdin")
    return LogSource(path, finger_maker(args), args.gauges, (), args.start_s, args.end_s)


def _is_scene(path: Path) -> bool:
    from tipforce_tools.view.scene_source import is_scene

    return is_scene(path)


def _scene(args: argparse.Namespace, path: Path) -> Source:
    from tipforce_tools.view.scene_source import scene_source

    common.note(args, f"{path}: running the scene")
    return scene_source(path, finger_maker(args), args.gauges, args.start_s, args.end_s)


def _listen(args: argparse.Namespace, path: Path | None) -> Source:
    from tipforce.host.hand.file import read_hand
    from tipforce.host.live.receive import open_receiver
    from tipforce_tools.cli.listening import resolved_options
    from tipforce_tools.view.sources import ListenSource

    options = resolved_options(args, named=False)
    fingers: tuple[Finger, ...] = ()
    gauges = args.gauges
    if path is not None:
        file = read_hand(path)
        fingers, gauges = hand_fingers(args, file), file.finger[0].gauges
        options = {**file.bus, **{name: value for name, value in options.items() if value is not None}}
    channel = str(options.get("channel") or options.get("interface") or "bus")
    receiver = open_receiver(options)
    maker = (lambda _node_id: None) if fingers else finger_maker(args)
    title = f"{path.name} on {channel}" if path else channel
    return ListenSource(
        receiver, f"{title}, listening", maker, gauges, fingers, int(options.get("bitrate") or 1_000_000)
    )


def _hand(args: argparse.Namespace, path: Path) -> Source:
    from tipforce.host.hand.hand import Hand

    return hand_source(args, Hand.from_file(path, **common.bus_options(args)), path.name)


def hand_source(args: argparse.Namespace, hand: Hand, title: str) -> Source:
    """Commission and start a hand: reports go to stderr and to the page's event list."""
    from tipforce_tools.view.sources import HandSource

    try:
        source = HandSource(hand, hand_fingers(args, hand.file), title)
        for report in hand.bring_up():
            common.note(args, str(report))
        hand.start()
    except BaseException:
        hand.close()
        raise
    return source


def hand_fingers(args: argparse.Namespace, file: HandFile) -> tuple[Finger, ...]:
    """Return the fingers of a hand file, with calibrations and gauge positions. Raises InputError."""
    from tipforce_tools.view.fingers import Finger, with_layout

    fallback = _fallback(args)
    return tuple(
        with_layout(Finger(plan.node_id, plan.name, file.calibration(plan)), plan.layout, fallback)
        for plan in file.finger
    )


def finger_maker(args: argparse.Namespace) -> Callable[[int], Finger | None]:
    """Return what makes a finger of a node-id found on the bus: None for one that --nodes leaves out."""
    from tipforce_tools.view.fingers import Finger, with_layout

    fallback, wanted = _fallback(args), args.nodes

    def make(node_id: int) -> Finger | None:
        return with_layout(Finger(node_id), "", fallback) if wanted is None or node_id in wanted else None

    return make


def _fallback(args: argparse.Namespace) -> tuple[str, Geometry, tuple[Gauge, ...]] | None:
    from tipforce_tools.cli.layout_file import read_layout

    layout = getattr(args, "layout", None)
    return (layout, *read_layout(layout)) if layout else None
