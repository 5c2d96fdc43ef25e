"""Listeners on the buses of a command line, and the signals that end a command between two steps."""

from __future__ import annotations

import argparse
import math
import signal
import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, Self

from canopen_device.core import codes
from tipforce.errors import InputError
from tipforce_tools.cli import bus_flags, common

if TYPE_CHECKING:
    import socket
    from pathlib import Path

    from tipforce.host.frames.frame_block import CandumpBlock
    from tipforce.host.hand.bring_up import FingerReport
    from tipforce.host.live.receiver import ReceiverGroup, Selection
    from tipforce.watching.feeds import Fallback, FrameFeed, HandFeed
    from tipforce.watching.findings import Finding, Observed

_HINT_S = 0.5
_SLICE_S = 0.2  # maximum delay of a signal
_LAST_S = 0.5  # time to read pending frames after a signal
_sync_hz = common.number_within(1e-6, 10_000.0, "is 1e-6 to 10000 Hz")


def add_sync_argument(parser: argparse.ArgumentParser) -> None:
    """`--sync HZ`, of all that listen to a bus."""
    parser.add_argument("--sync", type=_sync_hz, metavar="HZ", help="bus: also send SYNCs, where nobody else does")


def check_sync(args: Namespace, source: object) -> None:
    """Raise InputError for --sync with a source that is no bus."""
    if args.sync is not None and source is not None:
        raise InputError(f"--sync: {source} is no bus to listen to; leave the flag out")


class Hints:
    """What a bus lacks to which a command listens; ``seen``: by interface. ``say`` gets each line once."""

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self.seen: dict[str, Observed] = {}
        self._errors: dict[str, socket.socket] = {}
        self._said: set[str] = set()
        self._begun_s = self._due_s = time.monotonic()

    def watch(self, buses: Sequence[Mapping[str, Any]], opened: ExitStack) -> None:
        """Watch also for silence, and for error frames on SocketCAN, which the filters of the listener exclude."""
        from tipforce.host.live.receive import open_socket
        from tipforce.host.live.receiver import Filter, Selection
        from tipforce.watching.findings import Observed

        for options in buses:
            channel = str(options.get("channel") or "")
            self.seen[channel] = Observed()
            if options.get("interface") == "socketcan" and channel not in ("", "any"):
                no_frame = Selection((Filter(0, 0, inverse=True),), error_mask=codes.EXTENDED_MASK)
                self._errors[channel] = opened.enter_context(open_socket(channel, no_frame))

    def take(self, block: CandumpBlock) -> None:
        """Take frames as they arrive; twice a second say what is new."""
        from tipforce.arrays import occurring
        from tipforce.watching.findings import Observed

        channel = block.frames["channel"]
        for number in occurring(channel):
            seen = self.seen.setdefault(block.names[number], Observed())
            seen.take(block.frames[channel == number])
        if time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + _HINT_S
            for finding in self.findings():
                if finding.next_step not in self._said:  # numbers in the text change
                    self._said.add(finding.next_step)
                    self._say(str(finding))

    def findings(self) -> list[Finding]:
        """Return what is missing now."""
        import socket

        from tipforce.host.network.interfaces import links
        from tipforce.watching.findings import OWN_SYNC, SILENT_S, findings

        named = {name: seen for name, seen in self.seen.items() if name or len(self.seen) == 1}
        missing = []
        for name, seen in named.items():
            seen.heard_s = time.monotonic() - self._begun_s
            with suppress(OSError, KeyError):  # none is waiting, or the interface is down
                while self._errors[name].recv(72, socket.MSG_DONTWAIT):
                    seen.errors += 1
            if name in self._errors and (seen.errors or (not seen.frames and seen.heard_s >= SILENT_S)):
                seen.link = seen.link or links().get(name)
            missing += [finding for finding in findings(seen, OWN_SYNC) if finding.topic != "faults"]
        return missing


def _group(
    args: Namespace, buses: Sequence[tuple[dict[str, Any], Selection | None]], tick_s: float, hints: Hints | None
) -> ReceiverGroup:
    from tipforce.host.live.receive import open_receiver
    from tipforce.host.live.receiver import ReceiverGroup

    class HintingGroup(ReceiverGroup):
        """Shows ``hints`` what it receives; returns from a wait for them."""

        def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
            assert hints is not None
            end_s = math.inf if timeout_s is None else time.monotonic() + timeout_s
            while True:
                left_s = max(end_s - time.monotonic(), 0.0)
                block = super().receive_block(min(left_s, _HINT_S))
                hints.take(block)
                if len(block) or left_s <= _HINT_S:
                    return block

    with ExitStack() as opened:
        receivers = [opened.enter_context(open_receiver(*each, tick_s=tick_s)) for each in buses]
        if hints is not None:
            hints.watch([options for options, _ in buses], opened)
        if sync_hz := getattr(args, "sync", None):
            from tipforce.host.hand.link import kernel_sync
            from tipforce.host.network.interfaces import open_bus

            for options, _ in buses:
                kernel_sync(opened.enter_context(open_bus(**options)), 1.0 / sync_hz, [b""])
        at_end = opened.pop_all()
    group = ReceiverGroup if hints is None else HintingGroup
    return group(receivers, tick_s=tick_s, at_end=[at_end.close])


def open_targets(
    targets: Sequence[Selection], args: Namespace, *, tick_s: float | None = None, hints: Hints | None = None
) -> ReceiverGroup:
    """Listen to ``targets``, each on its channel, or to the bus of the flags; ``tick_s``: least time between batches
    (None: of a live display). ``hints`` see buses without filters. Raises EnvironmentLackError, closing all buses."""
    from tipforce.host.live.receiver import TICK_S, Selection

    options = bus_flags.find_bus(args, named=bool(targets))
    buses = [({**options, "channel": target.channel}, target) for target in targets] or [(options, Selection())]
    if any(target.filters for target in targets):
        hints = None  # what a filter leaves out is not missing
    return _group(args, buses, TICK_S if tick_s is None else tick_s, hints)


def received(
    receiver: ReceiverGroup, args: Namespace, command: str, stop: Callable[[], bool] = lambda: False
) -> Iterator[CandumpBlock]:
    """Yield blocks until ``stop``, --seconds, or -T without a frame; with -D also after an interface went down. Frames
    received until ``stop`` are yielded, too. Raises EnvironmentLackError for a bus that fails."""
    from tipforce.host.live.receiver import InterfaceDownError

    limit_s = math.inf if args.timeout_ms is None else args.timeout_ms / 1000
    last_s, seconds = time.monotonic(), getattr(args, "seconds", None)
    end_s = math.inf if seconds is None else last_s + seconds
    while not stop() and (now_s := time.monotonic()) < end_s:
        left_s = last_s + limit_s - now_s  # before the look: it sees all that came by then
        try:
            block = receiver.receive_block(max(min(_SLICE_S, left_s, end_s - now_s), 0.0))
        except InterfaceDownError as error:
            if not args.stay:
                raise
            common.note(f"tipforce {command}: {error}")
            continue
        if len(block):
            last_s = time.monotonic()
            yield block
        elif left_s <= 0.0:
            return
    end_s = time.monotonic() + _LAST_S
    while len(block := receiver.receive_block(0)):
        yield block
        if time.monotonic() >= end_s:
            return


def listening(
    args: Namespace, hand_file: Path | None = None, fallback: Fallback | None = None
) -> tuple[FrameFeed, str]:
    """Listen to the bus that the flags name, or to that of a hand file; return the feed and the channel's name. Without
    a hand file --nodes and --gauges apply. Raises as ``open_targets`` does."""
    from tipforce.host.hand.file import read_hand
    from tipforce.host.live.receiver import TICK_S
    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE
    from tipforce.watching.feeds import Finger, FrameFeed, finger_maker, hand_fingers
    from tipforce.watching.frame_sources import BusSource

    fingers: tuple[Finger, ...] = ()
    if hand_file is None:
        options, gauges, maker = bus_flags.find_bus(args), args.gauges, finger_maker(args.nodes, fallback)
    else:
        file = read_hand(hand_file)
        options, gauges, maker = bus_flags.find_bus(args, file.bus), file.finger[0].gauges, finger_maker(())
        fingers = hand_fingers(file, fallback)

    def say(text: str) -> None:
        common.note(text)
        feed.hints.append(text)

    source = BusSource(_group(args, [(options, None)], TICK_S, Hints(say)))
    feed = FrameFeed(source, maker, gauges, fingers, int(options.get("bitrate") or DEFAULT_BIT_RATE))
    return feed, str(options.get("channel") or options.get("interface") or "bus")


def note_missing(report: FingerReport) -> None:
    """Print on stderr what a finger lacks that came up."""
    from tipforce.samples.reasons import NOT_CALIBRATED
    from tipforce.watching.findings import not_calibrated

    if NOT_CALIBRATED in report.note:
        common.note(str(not_calibrated(report.plan.node_id)))


def commissioned(args: Namespace, path: Path, fallback: Fallback | None = None) -> HandFeed:
    """Commission and start the hand of a file: reports go to stderr and to the feed's events."""
    from tipforce.host.hand.file import read_hand
    from tipforce.host.hand.hand import Hand
    from tipforce.watching.feeds import HandFeed, hand_fingers

    hand = Hand.from_file(path, **bus_flags.find_bus(args, read_hand(path).bus))
    try:
        feed = HandFeed(hand, ())
        for report in hand.bring_up():
            common.note(str(report))
            note_missing(report)
        feed.fingers = hand_fingers(hand, fallback)
        hand.start()
    except BaseException:
        hand.close()
        raise
    return feed


def counted(number: int, what: str) -> str:
    """Return `1 frame`, `2 frames`."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


class StopSignals:
    """A context manager that records SIGINT and SIGTERM instead of raising, so that no received frame is lost. The
    second signal raises KeyboardInterrupt, in case the command hangs, if its number is one of ``interrupts``."""

    def __init__(self, interrupts: Sequence[int] = (signal.SIGINT, signal.SIGTERM)) -> None:
        self._stopped = False
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
        return self._stopped

    def _stop(self, number: int, _frame: object) -> None:
        if self._stopped and number in self._interrupts:
            raise KeyboardInterrupt
        self._stopped = True
