"""Send the frames of a log with their recorded timing. LOG is as for `tipforce decode`; - reads candump text on stdin.
Remote, CAN FD and error frames are sent if the bus supports them; frames left out are counted on stderr."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import count, islice
from typing import TYPE_CHECKING

from canopen_device.core.codes import ERROR_FLAG
from tipforce.errors import InputError
from tipforce_tools.cli import bus_flags, common
from tipforce_tools.cli.listening import StopSignals, counted
from tipforce_tools.cli.main import INTERRUPTED

if TYPE_CHECKING:
    from tipforce.host.frames.frame_block import Frame
    from tipforce.host.live.send import Sender
    from tipforce.host.logs.notes import LogNotes

_gap = common.number_that(lambda gap_s: 0 <= gap_s < math.inf, "are 0 or more seconds")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """WRITE=LOG sends to WRITE the frames recorded from LOG, as canplayer does; frames of other interfaces are left
    out. Without assignments frames go to the interface named in the log, or with -c all to that one. The command asks
    before it sends on a bus that is not virtual.
      tipforce replay run.log                           to the interfaces of the log
      tipforce replay run.log.gz vcan1=vcan0 --speed 10
      tipforce replay --loop inf --max-gap 0.5 run.log vcan0=can0 vcan1=can1
    """
    parser.description = __doc__
    what = "a log file, or - for candump text on stdin"
    parser.add_argument("log", type=common.InputFile(), metavar="LOG", help=what)
    parser.add_argument("assignments", nargs="*", type=_assignment, metavar="WRITE=LOG", help="interfaces")
    common.add_number(parser, "--speed", 1.0, "X", "times recorded speed (inf: no waiting)", common.speed)
    parser.add_argument("--loop", type=_loop, default=1, metavar="N", help="number of passes, or inf (default: 1)")
    parser.add_argument("--max-gap", type=_gap, metavar="S", help="shorten gaps of the log that are longer than S")
    parser.add_argument("--strict", action="store_true", help="end at the first bad line of candump text")
    common.add_confirm_argument(parser)
    bus_flags.add_bus_arguments(parser)


def _assignment(text: str) -> str:
    write, equals, log = text.partition("=")
    if not (write and equals and log):
        raise argparse.ArgumentTypeError(f"{text!r}: expected WRITE=LOG, for instance vcan1=vcan0")
    return text


def _loop(text: str) -> int | None:
    return None if text in {"inf", "i"} else common.count(text)


def run(args: argparse.Namespace) -> int:
    """Send the frames; return 0, 1 for a bad line with --strict, or 130 after a signal. Raises InputError, also for the
    answer "no", and EnvironmentLackError for a bus that fails."""
    from tipforce.host.logs.notes import BadLineError, LogNotes, no_frame

    if args.log == STDIN and args.loop != 1:
        raise InputError("--loop: stdin can be read only once; pass a file")
    if args.assignments and getattr(args, "channel", None):
        raise InputError("-c and WRITE=LOG: allowed is one of them: -c sends all frames to one bus")
    notes = LogNotes()
    late_s, started = 0.0, True
    with StopSignals() as stop, ExitStack() as opened:
        buses, start_s = Buses(args, opened), time.monotonic()
        try:
            for due_s, name, frame in timed_frames(args, notes, stop):
                while (rest_s := start_s + due_s - time.monotonic()) > 0 and not stop():
                    time.sleep(min(rest_s, _SLICE_S))
                if stop():
                    break
                late_s = max(late_s, -rest_s)
                buses.send(name, frame)
            if not (stop() or buses.sent or buses.left_out):
                raise no_frame(args.log, notes.first_bad)
        except BadLineError as error:
            print(f"tipforce replay: {error}", file=sys.stderr)
            return 1
        except InputError:
            started = buses.sent > 0  # otherwise the error is the whole report
            raise
        finally:
            if started:
                _report(buses, notes, time.monotonic() - start_s, late_s)
    return INTERRUPTED if stop() else 0


def timed_frames(
    args: argparse.Namespace, notes: LogNotes, stop: Callable[[], bool] | None = None
) -> Iterator[tuple[float, str, Frame]]:
    """Yield all frames in order, --loop times: seconds after the start, interface, frame. The steps of time are those
    of the log, none backwards and none longer than --max-gap, divided by --speed; ``stop`` ends stdin. Raises
    InputError."""
    from tipforce.host.logs.notes import UNREADABLE
    from tipforce.host.logs.reader import LogReader

    due_s = 0.0
    longest_ns = math.inf if args.max_gap is None else args.max_gap * 1e9
    for _ in islice(count(), args.loop):
        last_ns = None  # the first frame of a pass is due with the last of the one before
        log = LogReader(args.log, strict=args.strict, stop=stop)
        try:
            for block in log.blocks():
                if not block.timed:
                    raise InputError(f"{args.log} has no timestamps: record it with candump -L or `tipforce log`")
                for frame in block.in_order():
                    step_ns = 0 if last_ns is None else max(frame[0] - last_ns, 0)
                    due_s, last_ns = due_s + min(step_ns, longest_ns) * 1e-9 / args.speed, frame[0]
                    yield due_s, block.names[frame[4]], frame
        finally:
            notes.append(log)
        if UNREADABLE in log.bad:
            raise InputError(f"{args.log}: damaged or truncated: {log.first_bad}")
        if last_ns is None:
            return


def _report(buses: Buses, notes: LogNotes, seconds: float, late_s: float) -> None:
    late = f", at most {late_s * 1000:.1f} ms late" if common.OUTPUT.verbose else ""
    common.note(f"tipforce replay: {counted(buses.sent, 'frame')} sent in {seconds:.1f} s{late}")
    for reason, number in buses.left_out.items():
        common.note(f"tipforce replay: {counted(number, 'frame')} left out: {reason}")
    if notes.bad:
        reasons = ", ".join(f"{number} {reason}" for reason, number in notes.bad.items())
        common.note(f"tipforce replay: bad lines left out ({reasons}), first {notes.first_bad}")
    if common.OUTPUT.json:
        common.print_json(
            {"sent": buses.sent, "seconds": round(seconds, 3), "latest_s": round(late_s, 6),
             "left_out": dict(buses.left_out), "bad_lines": notes.bad}
        )  # fmt: skip


STDIN = "-"
_SLICE_S = 0.2  # maximum delay of a signal
_VIRTUAL = ("virtual", "udp_multicast")


class Buses:
    """The output buses, opened with the first frame for each, and the counts of frames left out."""

    def __init__(self, args: argparse.Namespace, opened: ExitStack) -> None:
        self._args = args
        self._opened = opened
        self._senders: dict[str, Sender] = {}
        self._targets_of: dict[str, list[str]] = {}
        for pair in args.assignments:
            write, _, log = pair.partition("=")
            self._targets_of.setdefault(log, []).append(write)
        self._options = bus_flags.find_bus(args, named=bool(args.assignments) or not getattr(args, "channel", None))
        self._only = self._options.get("channel") if not args.assignments else None
        self.sent = 0
        self.left_out: Counter[str] = Counter()
        # Buses known before reading the log are confirmed and opened now, not during the replay.
        known = [str(self._only)] if self._only else [one for some in self._targets_of.values() for one in some]
        for target in dict.fromkeys(known):
            self._open(target)

    def send(self, name: str, frame: Frame) -> None:
        """Send one frame to the bus of its interface, or count the reason. Raises EnvironmentLackError."""
        from tipforce.host.live.send import NotCarriedError

        own = self._targets_of.get(name, []) if self._targets_of else [name]
        targets = [self._only] if self._only else own
        _, can_id, length, data, _, _, fd_flags = frame
        for target in targets:
            sender = self._senders.get(target) or self._open(target)
            virtual = self._options.get("interface") in _VIRTUAL or "vcan" in target
            if can_id & ERROR_FLAG and not virtual:
                self.left_out["error frames, which only a virtual bus can send"] += 1
                continue
            try:
                sender.send(can_id, length, data, fd_flags)
                self.sent += 1
            except NotCarriedError as error:
                self.left_out[f"because {error}"] += 1
        if not targets:
            self.left_out[f"of {name}, which no assignment names"] += 1

    def _open(self, target: str) -> Sender:
        from tipforce.host.live.send import open_sender

        options = {**self._options, "channel": target}
        asked = argparse.Namespace(**{**vars(self._args), "channel": target, "interface": options.get("interface")})
        bus_flags.confirm(asked, f"this sends the frames of {self._args.log} on {target}")
        sender = self._senders[target] = open_sender(options)
        self._opened.enter_context(sender)
        return sender
