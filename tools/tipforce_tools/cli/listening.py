"""Listeners on the buses of a command line, and the signals that end a command between two steps."""

from __future__ import annotations

import argparse
import signal
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, Self

from tipforce.errors import EnvironmentLackError, InputError
from tipforce_tools.cli import common
from tipforce_tools.cli.common import bus_options

if TYPE_CHECKING:
    from pathlib import Path

    import can

    from tipforce.host.frames.frame_array import FrameArray
    from tipforce.host.hand.hand import Hand
    from tipforce.host.live.receiver import ReceiverGroup, Selection
    from tipforce.host.live.targets import Target
    from tipforce.watching.feeds import FrameFeed, HandFeed
    from tipforce.watching.watcher import Fallback


_sync_hz = common.number_within(0.0, 10_000.0, "is above 0 up to 10000 Hz", over=True)


def add_sync_argument(parser: argparse.ArgumentParser) -> None:
    """`--sync HZ`, of all that listen to a bus."""
    parser.add_argument(
        "--sync", type=_sync_hz, metavar="HZ", help="bus: also send SYNCs, where no other device sends them"
    )


def check_sync(args: Namespace, source: object) -> None:
    """Raise InputError for --sync with a source that is no bus."""
    if args.sync is not None and source is not None:
        raise InputError(f"--sync: {source} is no bus to listen to; leave the flag out")


def _group(
    args: Namespace, buses: Sequence[dict[str, Any]], selections: Sequence[Selection | None], tick_s: float
) -> ReceiverGroup:
    """Listen to each bus for its selection; with --sync send SYNCs on each until the group is closed."""
    from tipforce.host.live.receive import open_receiver
    from tipforce.host.live.receiver import ReceiverGroup

    with ExitStack() as opened:
        receivers = [
            opened.enter_context(open_receiver(options, selection, tick_s=tick_s))
            for options, selection in zip(buses, selections, strict=True)
        ]
        sync_hz: float | None = getattr(args, "sync", None)
        stops: list[Callable[[], None]] = []
        if sync_hz:
            from tipforce.host.hand.link import kernel_sync
            from tipforce.host.network.open_bus import open_bus

            for options in buses:
                bus = opened.enter_context(open_bus(**options))
                kernel_sync(bus, 1.0 / sync_hz, [b""])
                stops.append(bus.shutdown)
        opened.pop_all()
    return ReceiverGroup(receivers, tick_s=tick_s, at_end=stops)


def open_targets(targets: Sequence[Target], args: Namespace, *, tick_s: float | None = None) -> ReceiverGroup:
    """Listen to ``targets``, each on its channel; without targets, to the bus that the flags name.

    ``tick_s`` is the minimum time between two batches (None: that of a live display).

    Raises EnvironmentLackError if a bus cannot be opened, after closing the others.
    """
    from tipforce.host.live.receiver import TICK_S, Selection

    options = resolved_options(args, named=bool(targets))
    buses = [{**options, "channel": target.channel} for target in targets] or [options]
    selections = [target.selection for target in targets] or [Selection()]
    return _group(args, buses, selections, TICK_S if tick_s is None else tick_s)


def frames_heard(
    bus: can.BusABC, listen_s: float, further_s: Callable[[Iterable[int]], float] = lambda _can_ids: 0.0
) -> tuple[FrameArray, float]:
    """Listen so long, then ``further_s`` of the identifiers heard; return the frames, FRAME (n,), and the time.

    Raises EnvironmentLackError for a bus that fails.
    """
    import can

    from tipforce.host.frames.frame_array import FrameBuffer

    buffer = FrameBuffer()
    notifier = can.Notifier(bus, [buffer], timeout=0.1)
    try:
        started_s = time.monotonic()
        time.sleep(listen_s)
        time.sleep(further_s(buffer.can_ids()))
        elapsed_s = time.monotonic() - started_s
    finally:
        notifier.stop()
    if notifier.exception is not None:
        raise EnvironmentLackError(f"failed while listening: {notifier.exception}; is the adapter plugged in?")
    return buffer.take_all(), elapsed_s


def listening(
    args: Namespace, hand_file: Path | None = None, fallback: Fallback | None = None
) -> tuple[FrameFeed, str]:
    """Listen to the bus that the flags name, or to that of a hand file; return the feed and the channel's name.

    Without a hand file --nodes and --gauges apply. Raises as ``open_targets`` does.
    """
    from tipforce.host.hand.file import read_hand
    from tipforce.host.live.receiver import TICK_S
    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE
    from tipforce.watching.feeds import FrameFeed
    from tipforce.watching.frame_sources import BusSource
    from tipforce.watching.watcher import Finger, finger_maker, hand_fingers

    fingers: tuple[Finger, ...] = ()
    if hand_file is None:
        options, gauges, maker = resolved_options(args, named=False), args.gauges, finger_maker(args.nodes, fallback)
    else:
        file = read_hand(hand_file)
        options, gauges, maker = {**file.bus, **bus_options(args)}, file.finger[0].gauges, finger_maker(())
        fingers = hand_fingers(file, fallback)
    source = BusSource(_group(args, [options], [None], TICK_S))
    feed = FrameFeed(source, maker, gauges, fingers, int(options.get("bitrate") or DEFAULT_BIT_RATE))
    return feed, str(options.get("channel") or options.get("interface") or "bus")


def commissioned(args: Namespace, hand: Hand, fallback: Fallback | None = None) -> HandFeed:
    """Commission and start a hand: reports go to stderr and to the feed's events. Closes the hand if that fails."""
    from tipforce.watching.feeds import HandFeed
    from tipforce.watching.watcher import hand_fingers

    try:
        feed = HandFeed(hand, ())
        remedies = common.Remedies(args)
        for report in hand.bring_up():
            common.note(args, str(report))
            remedies.note(report.plan.node_id, report.note)
        feed.fingers = hand_fingers(hand, fallback)
        hand.start()
    except BaseException:
        hand.close()
        raise
    return feed


def resolved_options(args: Namespace, *, named: bool) -> dict[str, Any]:
    """Return the bus options of the flags, completed from python-can's files and environment.

    A channel ``named`` on the command line is a SocketCAN interface by default, so that `dump vcan0` works as
    `candump vcan0` does.
    """
    import can

    options = bus_options(args)
    if "interface" in options and (named or "channel" in options):
        return options
    try:
        configured = can.util.load_config()
    except can.CanInterfaceNotImplementedError:
        return {"interface": "socketcan", **options} if named else options
    for key in ("interface", "channel"):
        if configured.get(key) is not None:
            options.setdefault(key, configured[key])
    return options


def counted(number: int, what: str) -> str:
    """Return `1 frame`, `2 frames`."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


class StopSignals:
    """A context manager that records SIGINT and SIGTERM instead of raising, so that no received frame is lost.

    The second signal raises KeyboardInterrupt, in case the command hangs, if its number is one of ``interrupts``.
    """

    def __init__(self, interrupts: Sequence[int] = (signal.SIGINT, signal.SIGTERM)) -> None:
        self.stopped = False
        self._interrupts = interrupts
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            with suppress(ValueError):  # not the main thread, which alone receives signals
                self._before[number] = signal.signal(number, self._stop)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Return whether a signal has arrived."""
        return self.stopped

    def _stop(self, number: int, _frame: object) -> None:
        if self.stopped and number in self._interrupts:
            raise KeyboardInterrupt
        self.stopped = True
