"""One run of `tipforce log`: from the buses to the file, until an end condition."""

from __future__ import annotations

import math
import time
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce.host.live.receiver import InterfaceDownError
from tipforce_tools.cli import common
from tipforce_tools.cli.listening import StopSignals, counted, open_targets
from tipforce_tools.cli.main import INTERRUPTED
from tipforce_tools.dump.targets import split_targets
from tipforce_tools.log.recorder import Recorder, default_name

if TYPE_CHECKING:
    from tipforce.host.live.receive_group import ReceiverGroup

TICK_S = 0.02
"""Period of writes: saves work, and the socket's buffer holds many times as much."""

_SLICE_S = 0.2  # maximum delay of a signal
_LAST_S = 0.5  # time to read pending frames after a signal


def record(args: Namespace) -> int:
    """Record until -n, -T, --seconds or a signal; return 0, or 130 after a signal."""
    source, targets = split_targets(args.targets)
    if source is not None:
        raise InputError(f"{source}: allowed are buses; `tipforce replay` reads a file")
    path = Path(args.output or default_name(time.time()))
    with (
        StopSignals() as stop,
        open_targets(targets, args, tick_s=TICK_S) as receiver,
        Recorder(path, limit_bytes=args.rotate_size, limit_s=args.rotate_time, overwrite=args.overwrite) as recorder,
    ):
        common.note(args, f"tipforce log: recording to {recorder.paths[0]}")
        begun_s = time.monotonic()
        try:
            _record(args, receiver, recorder, stop)
        finally:
            _report(args, recorder, receiver.dropped, time.monotonic() - begun_s)
    return INTERRUPTED if stop.stopped else 0


def _record(args: Namespace, receiver: ReceiverGroup, recorder: Recorder, stop: StopSignals) -> None:
    limit_s = math.inf if args.timeout_ms is None else args.timeout_ms / 1000
    last_s = time.monotonic()
    end_s = math.inf if args.seconds is None else last_s + args.seconds
    while not stop.stopped and (now_s := time.monotonic()) < end_s:
        try:
            block = receiver.receive_block(min(_SLICE_S, limit_s, end_s - now_s))
        except InterfaceDownError as error:
            if not args.stay:
                raise
            common.note(args, f"tipforce log: {error}")
            continue
        if len(block):
            last_s = time.monotonic()
        elif time.monotonic() - last_s >= limit_s:
            return
        if args.count is not None:
            block = block.head(args.count - recorder.frames)
        recorder.write(block)
        if recorder.frames == args.count:
            return
    # Frames received until then are recorded, too.
    end_s = time.monotonic() + _LAST_S
    while time.monotonic() < end_s and len(block := receiver.receive_block(0)):
        recorder.write(block if args.count is None else block.head(args.count - recorder.frames))


def _report(args: Namespace, recorder: Recorder, dropped: int, seconds: float) -> None:
    files = str(recorder.paths[0]) if len(recorder.paths) == 1 else f"{len(recorder.paths)} files"
    common.note(
        args, f"tipforce log: {counted(recorder.frames, 'frame')} in {seconds:.1f} s to {files}, {dropped} dropped"
    )
    if args.json:
        common.print_json(
            {
                "frames": recorder.frames,
                "dropped": dropped,
                "seconds": round(seconds, 3),
                "files": [str(path) for path in recorder.paths],
            }
        )
