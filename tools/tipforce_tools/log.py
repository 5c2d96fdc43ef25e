"""Record frames until Ctrl-C, SIGTERM, -n, -T or --seconds. The file then holds all received frames in every case;
stderr reports the number of frames, and of frames dropped by the kernel."""

from __future__ import annotations

import argparse
import re
import time
from pathlib import Path

from tipforce.errors import InputError
from tipforce_tools.cli import bus_flags, common
from tipforce_tools.cli.listening import Hints, StopSignals, add_sync_argument, counted, open_targets, received
from tipforce_tools.cli.main import INTERRUPTED


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """CHANNEL[,FILTER...] as for `tipforce dump` and candump; without #MASK no error frames. The suffix of FILE sets
    the format: .log (candump's, for canplayer, Wireshark, `tipforce replay` and `decode`), .asc .blf .csv .trc .db .mf4
    .txt (python-can's writers), and .gz after .log .asc .csv .trc .txt. With a --rotate flag, files are numbered:
    run-0001.log.
      tipforce log vcan0                                candump-2026-05-17_093000.log, as candump -l
      tipforce log -o run.log.gz vcan0,180:780 vcan1
      tipforce log -o hand.log --rotate-size 100M --rotate-time 3600 any,0:0,#FFFFFFFF
    """
    parser.description = __doc__
    what = "buses with their filters"
    parser.add_argument("targets", nargs="*", type=common.TARGET, metavar="CHANNEL[,FILTER...]", help=what)
    parser.add_argument("-o", "--output", metavar="FILE", help="default: a name as of candump -l, by date and time")
    parser.add_argument("--overwrite", action="store_true", help="overwrite existing files")
    parser.add_argument("-n", dest="count", type=common.count, metavar="COUNT", help="end after COUNT frames")
    parser.add_argument("-T", dest="timeout_ms", type=common.count, metavar="MS", help="end after MS without a frame")
    parser.add_argument("--seconds", type=common.seconds, metavar="S", help="end after S seconds")
    parser.add_argument("-D", dest="stay", action="store_true", help="continue when an interface goes down")
    add_sync_argument(parser)
    parser.add_argument("--rotate-size", type=_bytes, metavar="SIZE", help="a new file after SIZE bytes: 500K 100M 1G")
    parser.add_argument("--rotate-time", type=common.seconds, metavar="S", help="a new file after S seconds")
    bus_flags.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Record until an end condition; return 0, or 130 after a signal. The file holds what was received until then.
    Raises InputError for a target or a file, EnvironmentLackError for a bus, WriteError for a full disk."""
    from tipforce.host.live.targets import split_targets
    from tipforce.host.logs.recorder import Recorder

    source, targets = split_targets(args.targets)
    if source is not None:
        raise InputError(f"{source}: allowed are buses; `tipforce replay` reads a file")
    path = Path(args.output or default_name(time.time()))
    with (
        StopSignals() as stop,
        open_targets(targets, args, tick_s=TICK_S, hints=Hints(common.note)) as receiver,
        Recorder(path, limit_bytes=args.rotate_size, limit_s=args.rotate_time, overwrite=args.overwrite) as recorder,
    ):
        common.note(f"tipforce log: recording to {recorder.paths[0]}")
        begun_s = time.monotonic()
        try:
            for block in received(receiver, args, "log", stop):
                recorder.write(block if args.count is None else block.head(args.count - recorder.frames))
                if recorder.frames == args.count:
                    break
        finally:
            seconds, paths = time.monotonic() - begun_s, [str(path) for path in recorder.paths]
            to, dropped = paths[0] if len(paths) == 1 else f"{len(paths)} files", receiver.dropped
            frames = counted(recorder.frames, "frame")
            common.note(f"tipforce log: {frames} in {seconds:.1f} s to {to}, {dropped} dropped")
            if common.OUTPUT.json:
                record = {"frames": recorder.frames, "dropped": dropped, "seconds": round(seconds, 3), "files": paths}
                common.print_json(record)
    return INTERRUPTED if stop() else 0


def _bytes(text: str) -> int:
    match = re.fullmatch(r"([1-9]\d*)([KMG]?)", text, re.IGNORECASE)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r}: expected bytes, or a number with K, M or G: 100M")
    return int(match[1]) << {"": 0, "K": 10, "M": 20, "G": 30}[match[2].upper()]


TICK_S = 0.02
"""Period of writes: saves work, and the socket's buffer holds many times as much."""


def default_name(second: float) -> str:
    """Return the file name of candump -l for a log that begins at this time, in seconds since 1970."""
    return time.strftime("candump-%Y-%m-%d_%H%M%S.log", time.localtime(second))
