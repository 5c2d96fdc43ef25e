"""One run of `tipforce monitor`: from a source through the monitor to the screen, until an end condition."""

from __future__ import annotations

import math
import os
import select
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce.host.live.receiver import InterfaceDownError
from tipforce.watching.frame_sources import BusSource, FrameSource, LogSource, PipeSource
from tipforce_tools.cli import common
from tipforce_tools.cli.eds_flag import eds_files
from tipforce_tools.cli.empty_log import MESSAGES, PACKED, PCAP, TEXT, no_frame, no_sample
from tipforce_tools.cli.listening import StopSignals, counted, open_targets
from tipforce_tools.cli.main import INTERRUPTED
from tipforce_tools.dump.targets import STDIN, Target, split_targets
from tipforce_tools.monitor import display
from tipforce_tools.monitor.state import Monitor

if TYPE_CHECKING:
    from pathlib import Path

    from rich.live import Live

    from tipforce.host.logs.reader import LogReader

BITRATE = 1_000_000
_SCREEN_S, _LINE_S = 0.25, 1.0
_SLICE_S = 0.1  # maximum delay of a key or a signal

Show = Callable[[Monitor, int | None], None]


def monitor(args: Namespace) -> int:
    """Show the nodes until the source ends, q, a signal, or --once; return 0, or 130 after a signal."""
    log_name, targets = split_targets(args.targets)
    watched = Monitor(args.gauges, args.nodes, eds_files(args.eds or ()))
    screen = sys.stdout.isatty() and not args.json and args.once is None
    interval_s = args.interval or (_SCREEN_S if screen else _LINE_S)
    with ExitStack() as opened:
        stop = opened.enter_context(StopSignals())
        source, log = _source(args, log_name, targets, interval_s, opened)
        pressed = opened.enter_context(_keys(screen, log_name == STDIN))
        show = opened.enter_context(_screen(args, interval_s)) if screen else _lines(args)
        loop = Loop(args.once, interval_s, show if screen or (args.json and args.once is None) else None)
        loop.run(watched, source, lambda: stop.stopped or pressed())
        if log is not None and source.ended and log.bad and not watched.frames:
            raise no_frame(str(log_name), (TEXT, PACKED, MESSAGES, PCAP), log.first_bad)
        has_nodes = any(bus.nodes for bus in watched.views())
        if log is not None and source.ended and watched.frames and not args.nodes and not has_nodes:
            raise no_sample(str(log_name), watched.frames, log.extended)
        if not screen and not (args.json and args.once is None and loop.shown):
            _lines(args)(watched, source.now_ns())
    if log is not None and log.bad:
        reasons = ", ".join(f"{count} {reason}" for reason, count in log.bad.items())
        common.note(args, f"tipforce monitor: {counted(sum(log.bad.values()), 'bad line')} left out ({reasons})")
    return INTERRUPTED if stop.stopped else 0


class Loop:
    """Update the monitor, and show it at each interval of the frames' clock, so that a log gives the same lines."""

    def __init__(
        self, once_s: float | None, interval_s: float, show: Show | None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._once_ns = None if once_s is None else round(once_s * 1e9)
        self._interval_ns = round(interval_s * 1e9)
        self._show = show
        self._clock = clock
        self.shown = 0

    def run(self, watched: Monitor, source: FrameSource, stopped: Callable[[], bool]) -> None:
        """Run until the source ends, ``stopped`` is true, or --once is over."""
        begun_s, first_ns, due_ns = self._clock(), None, 0
        while not source.ended and not stopped():
            try:
                frames, names = source.take(_SLICE_S)
            except InterfaceDownError:  # it may recover; until then all values become stale
                continue
            watched.feed(frames, names)
            now_ns = source.now_ns()
            if now_ns is None:
                if self._once_ns is not None and (self._clock() - begun_s) * 1e9 >= self._once_ns:
                    return
                continue
            if first_ns is None or now_ns < first_ns:  # or a recording with a clock set back
                first_ns = int(frames["t_ns"][0]) if len(frames) else now_ns
                due_ns = first_ns + self._interval_ns
            if self._once_ns is not None and now_ns - first_ns >= self._once_ns:
                return
            if now_ns >= due_ns and self._show is not None:
                self._show(watched, now_ns)
                self.shown += 1
                due_ns = max(due_ns, now_ns - self._interval_ns) + self._interval_ns


def _source(
    args: Namespace, name: Path | str | None, targets: tuple[Target, ...], interval_s: float, opened: ExitStack
) -> tuple[FrameSource, LogReader | None]:
    if name is None:
        if args.follow or args.speed != math.inf:
            raise InputError("--follow and --speed: need a log")
        return BusSource(opened.enter_context(open_targets(targets, args))), None
    if targets:
        raise InputError(f"{targets[0].channel}: not allowed with the log {name}; --nodes selects from a log")
    from tipforce.host.logs.reader import open_log

    log = open_log(name, follow=args.follow)
    if name == STDIN or args.follow:
        return PipeSource(log), log  # not closed: its thread may read
    opened.enter_context(log)
    step_ns = round((args.once or interval_s) * 1e9)
    return LogSource(log, args.speed, step_ns), log


def _lines(args: Namespace) -> Show:
    """Print the state: a JSON line, or the plain table."""

    def show(watched: Monitor, now_ns: int | None) -> None:
        bitrate = getattr(args, "bitrate", BITRATE)
        buses = watched.views(now_ns)
        if args.json:
            common.print_json(display.record(buses, None if now_ns is None else now_ns / 1_000_000_000, bitrate))
        else:
            print("\n".join(display.plain(buses, bitrate)) or "no frames received")
        sys.stdout.flush()

    return show


@contextmanager
def _screen(args: Namespace, interval_s: float) -> Iterator[Show]:
    """Show the live table; the last one stays on the screen."""
    from rich.live import Live

    live: Live
    with Live(console=common.console(args), auto_refresh=False, transient=False) as live:

        def show(watched: Monitor, now_ns: int | None) -> None:
            foot = f"{counted(watched.frames, 'frame')}; every {interval_s:g} s; q ends"
            buses = watched.views(now_ns)
            picture = display.tables(buses, getattr(args, "bitrate", BITRATE), foot, live.console.width)
            live.update(picture, refresh=True)

        yield show


@contextmanager
def _keys(screen: bool, stdin_taken: bool) -> Iterator[Callable[[], bool]]:
    """Read keys one by one from the terminal, also if stdin is the log; yield a test whether q was pressed."""
    try:
        import termios
        import tty
    except ImportError:  # Windows: Ctrl-C ends
        screen = False
    descriptor = -1
    if screen:
        with suppress(OSError):
            descriptor = os.open("/dev/tty", os.O_RDONLY) if stdin_taken else os.dup(sys.stdin.fileno())
    if descriptor < 0 or not os.isatty(descriptor):
        yield lambda: False
        return
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield lambda: bool(select.select([descriptor], [], [], 0)[0]) and os.read(descriptor, 1) in (b"q", b"Q")
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
        os.close(descriptor)
