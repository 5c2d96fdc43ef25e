"""Publish each fingertip's force and contact at each SYNC, and diagnostics once a second and at each event, as ROS 2
topics on DDS. ROS need not be installed. Stamps are those of the SYNC."""

from __future__ import annotations

import argparse
import math
import time
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.errors import EnvironmentLackError, InputError, LogError
from tipforce_tools.cli import bus_flags, common
from tipforce_tools.cli.listening import add_sync_argument, check_sync, commissioned, counted, listening

if TYPE_CHECKING:
    from tipforce.watching.feeds import Feed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """topics, for a finger named thumb:
      /tipforce/thumb/wrench    geometry_msgs/WrenchStamped, frame thumb_tip; none while the force is unknown
      /tipforce/thumb/contact   tipforce_msgs/Contact: P, phi, theta, their uncertainties, status
      /tipforce/thumb/info      tipforce_msgs/Fingertip, transient local
      /tipforce/thumb/tare      std_msgs/Empty, with --allow-tare: takes the present force as zero
      /diagnostics              diagnostic_msgs/DiagnosticArray
    A hand is commissioned, on a bus the command listens only, and a log is published with its recorded timing.
    ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_LOCALHOST_ONLY and CYCLONEDDS_URI apply.
    """
    parser.description = __doc__
    what = "a hand file, or a log (default: listen to the bus)"
    parser.add_argument("source", nargs="?", type=common.InputFile(), metavar="HAND.toml|LOG", help=what)
    parser.add_argument("--namespace", default="/tipforce", metavar="NS", help="of the topics (default %(default)s)")
    parser.add_argument("--domain", type=int, metavar="N", help="ROS 2 domain (default: ROS_DOMAIN_ID, else 0)")
    parser.add_argument("--allow-tare", action="store_true", help="hand file: subscribe to the topics .../tare")
    parser.add_argument("--no-bring-up", action="store_true", help="hand file: only listen, change nothing")
    parser.add_argument("--nodes", type=common.node_ids, metavar="IDS", help="bus or log: only these, 1,2,5-9")
    parser.add_argument("--gauges", type=int, choices=range(3, 9), default=3, metavar="N", help="3 (default) to 8")
    add_sync_argument(parser)
    common.add_number(parser, "--speed", 1.0, "X", "log: times recorded speed (default 1)", common.speed)
    parser.add_argument("--seconds", type=common.seconds, metavar="S", help="end after this time")
    bus_flags.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Publish until Ctrl-C, SIGTERM, the end of the log, or --seconds; return 0. Raises TipforceError."""
    is_hand = args.source is not None and Path(args.source).suffix == ".toml"
    _check(args, is_hand)
    from tipforce_robots.ros2.bridge import OK, Bridge
    from tipforce_robots.ros2.dds import RosDomain, domain_id, namespace

    prefix, domain = namespace(args.namespace), domain_id(args.domain)
    with closing(_feed(args, Path(args.source) if is_hand else None)) as feed:
        bridge = Bridge(feed, RosDomain(domain), prefix, args.allow_tare)
        end_s = math.inf if args.seconds is None else time.monotonic() + args.seconds
        try:
            common.note(f"publishing {prefix or '/'} in ROS 2 domain {domain}; Ctrl-C ends it")
            while not feed.ended and time.monotonic() < end_s:
                for status in bridge.step():
                    if common.OUTPUT.verbose or status["level"] > OK:
                        common.note(f"{status['name']}: {status['message']}")
            bridge.report(feed.now_ns())
        except KeyboardInterrupt:
            pass
        finally:
            if bridge.rows or not feed.ended:
                wrenches = {tip.ros_name: tip.wrenches for tip in bridge.tips.values()}
                if common.OUTPUT.json:
                    common.print_json({"rows": bridge.rows, "wrenches": wrenches})
                fingers = counted(len(wrenches), "finger")
                common.note(f"{bridge.rows} rows, {bridge.wrenches} wrenches of {fingers} published")
        if feed.ended and not bridge.rows:
            raise LogError(f"{args.source}: no sample of a fingertip in it; `tipforce decode` says what it holds")
    return 0


def _check(args: argparse.Namespace, is_hand: bool) -> None:
    if find_spec("cyclonedds") is None:
        raise EnvironmentLackError("ros2 needs cyclonedds: `pip install 'tipforce[ros2]'`")
    check_sync(args, None if args.no_bring_up else args.source)
    if args.no_bring_up and not is_hand:
        raise InputError("--no-bring-up: needs a hand file")
    if args.allow_tare and (not is_hand or args.no_bring_up):
        raise InputError("--allow-tare: needs a hand file that is commissioned; a log or a bus is only listened to")


def _feed(args: argparse.Namespace, hand_file: Path | None) -> Feed:
    if args.source is None or args.no_bring_up:
        return listening(args, hand_file)[0]
    if hand_file is not None:
        feed = commissioned(args, hand_file)
        feed.take(0.0)  # reported already
        return feed
    from tipforce.host.logs.reader import open_log
    from tipforce.watching.feeds import FrameFeed, finger_maker
    from tipforce.watching.frame_sources import LogSource
    from tipforce_robots.ros2.bridge import PERIOD_NS

    return FrameFeed(LogSource(open_log(args.source), args.speed, PERIOD_NS), finger_maker(args.nodes), args.gauges)
