"""One run of `tipforce dump`: from a source through filters and decoder to stdout, and the final report."""

import json
import math
import sys
from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from canopen_device.core.codes import ERROR_FLAG, REMOTE_FLAG
from tipforce.dictionary.signals import Signal, rpdo_messages, tpdo_messages
from tipforce.errors import InputError
from tipforce.host.decoding.counters import SyncModulus, Tally
from tipforce.host.decoding.decoder import Decoder, Key, Samples
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.host.decoding.pdo_layout import EdsFiles, Layouts
from tipforce.host.decoding.sdo_conversation import eds_names, fingertip_names
from tipforce.host.decoding.service_frames import find_duplicates
from tipforce.host.decoding.services import Service, Services
from tipforce.host.frames.frame_block import BIT_RATE_SWITCH, ERROR_STATE, CandumpBlock
from tipforce.host.live.receiver import Selection
from tipforce.host.live.targets import select, split_targets
from tipforce.host.logs.candump_format import CandumpFormat, identifier_text
from tipforce.host.logs.notes import DROPPED, BadLineError, LogNotes, no_frame
from tipforce.host.logs.reader import LogReader
from tipforce_tools.cli import common, log_flags
from tipforce_tools.cli.listening import Hints, check_sync, counted, open_targets, received

_COUNTER = "counter"
_UNITS = {"degree": "deg"}
_HEX_WIDTH = 24  # of eight data bytes on candump's screen

Decoded = Mapping[Key, Samples]


def _decoder(gauges: int, eds: EdsFiles) -> Decoder:
    """Return a decoder of all PDOs of fingertips, also of those that they receive; of ``eds`` alone where given."""
    if eds:
        return Layouts(eds=eds).decoder()
    messages = (*tpdo_messages(gauges), *rpdo_messages())
    given = [message for message in messages if message.cob_id_base]
    known = {(number, one.name): (one.cob_id_base + number, one) for number in range(1, 128) for one in given}
    return Decoder.of_messages(known)


class Session:
    """Output and counters of a run."""

    def __init__(self, args: Namespace, targets: tuple[Selection, ...], *, live: bool) -> None:
        self._args = args
        self._live = live
        eds = log_flags.eds_files(args.eds or ())
        self.decoder = _decoder(args.gauges, eds) if args.decode or common.OUTPUT.verbose else None
        names = eds_names(eds, fingertip_names(args.gauges)) if eds else fingertip_names(args.gauges)
        self.services = Services(names) if args.decode else None
        self._duplicates: dict[int, DuplicateNodes] = {}  # by interface
        self.tally, self._modulus = Tally(), SyncModulus()
        self._counted = _decoder(args.gauges, eds) if common.OUTPUT.verbose else None  # of the parts of a block
        self._left = args.count
        self._needs_time = not common.OUTPUT.json and (args.log or bool(args.timestamps))
        self._text: Callable[[CandumpBlock, Decoded, Iterable[Service]], str] = json_text
        if not common.OUTPUT.json:
            width = max((len(target.channel) for target in targets), default=0)
            more = {"extra": args.extra, "errors": args.errors, "ascii": args.ascii}
            form = CandumpFormat(args.timestamps, log=args.log, width=width, **more)
            self._text = partial(screen_text, form, not args.log)

    def show(self, block: CandumpBlock) -> bool:
        """Print a block; return False when the requested number of frames is printed."""
        if self._needs_time and not block.timed:
            raise InputError("the text has no timestamps, which -t and -L need: record it with candump -L, or -ta")
        if self._left is not None:
            block = block.head(self._left)
            self._left -= len(block)
        if self.decoder is None:
            self._print(block)
        else:
            followed = [one.parts(block.frames) for one in (self.decoder, self._counted) if one is not None]
            for (start, end), *_ in zip(*followed, strict=True):
                self._print(block if (start, end) == (0, len(block.frames)) else block.between(start, end))
        return self._left is None or self._left > 0

    def _print(self, block: CandumpBlock) -> None:
        decoded = self.decoder.decode(block.frames) if self.decoder is not None else {}
        if self._counted is not None:  # each frame by the modulus in force where it was received
            parts = self._modulus.cuts(block.frames)
            for part in self._modulus.parts(block.frames):
                for samples in (self._counted.decode(part) if parts else decoded).values():
                    self.tally.add_samples(samples, self._modulus.modulus)
        services: Iterable[Service] = ()
        if self.services is not None:
            services = self.services.describe(block.frames, block.frames["channel"])
            for number in () if self._live else set(block.frames["channel"].tolist()):  # live the hints say it
                watch = self._duplicates.setdefault(number, DuplicateNodes())
                for duplicate in find_duplicates(watch, block.frames[block.frames["channel"] == number]):
                    common.note(f"tipforce dump: {duplicate}")
        text = self._text(block, decoded if self._args.decode else {}, services)
        if text:
            sys.stdout.write(text)
            sys.stdout.flush()


def dump(args: Namespace) -> int:
    """Print frames until the source, -n or -T ends it; return 0, or 1 for a bad line with --strict."""
    if args.log and (args.errors or args.ascii) and not common.OUTPUT.json:
        raise InputError(f"-L and -{'e' if args.errors else 'a'}: the log format has no field for text; leave one out")
    source, targets = split_targets(args.targets)
    check_sync(args, source)
    session = Session(args, targets, live=source is None)
    timeout_s = None if args.timeout_ms is None else args.timeout_ms / 1000
    if source is not None:
        return _dump_log(LogReader(source, strict=args.strict, timeout_s=timeout_s), targets, session, timeout_s)
    hints = Hints(common.note) if args.decode else None
    with open_targets(targets, args, hints=hints) as receiver:
        try:
            for block in received(receiver, args, "dump"):
                if not session.show(block):
                    break
        finally:
            _report(session, receiver.dropped, None)
    return 0


def _dump_log(log: LogReader, targets: tuple[Selection, ...], session: Session, timeout_s: float | None) -> int:
    frames = 0
    try:
        for block in log.blocks():
            frames += len(block)
            if not session.show(select(block, targets)):
                break
        if not frames and (log.bad or timeout_s is None):
            raise no_frame(log.source, log.first_bad)
    except BadLineError as error:
        print(f"tipforce dump: {error}", file=sys.stderr)
        return 1
    finally:
        if frames:  # otherwise the error is the whole report
            _report(session, log.skipped.get(DROPPED, 0), log)
    return 0


def _report(session: Session, dropped: int, log: LogNotes | None) -> None:
    notes = []
    if log is not None and log.bad:
        reasons = ", ".join(f"{count} {reason}" for reason, count in log.bad.items())
        notes.append(f"{counted(sum(log.bad.values()), 'bad line')} left out ({reasons}), first {log.first_bad}")
    if dropped:
        notes.append(f"{'candump' if log is not None else 'the kernel'} had dropped {counted(dropped, 'frame')}")
    for (node_id, name), count in (session.decoder.malformed if session.decoder is not None else {}).items():
        short = counted(count, "frame")
        notes.append(f"node {common.shown_id(node_id)} {name}: {short} shorter than the mapping, not decoded")
    if common.OUTPUT.verbose:
        for (_, node_id, name), message in session.tally.messages.items():
            lost = "" if message.lost is None else f", {counted(message.lost, 'sample')} lost"
            notes.append(f"node {common.shown_id(node_id)} {name}: {counted(message.frames, 'frame')}{lost}")
    for text in notes:
        common.note(f"tipforce dump: {text}")


def screen_text(
    form: CandumpFormat, aligned: bool, block: CandumpBlock, decoded: Decoded, services: Iterable[Service]
) -> str:
    """Return candump's lines; decoded values follow the data, if ``aligned`` in the same column for every length."""
    lines = form.lines(block)
    lengths = block.frames["length"].tolist()
    positions = block.positions().tolist()
    meanings: list[tuple[int, str]] = []
    for samples in decoded.values():
        meanings += zip(samples.row.tolist(), _words(samples), strict=True)
    for service in services:
        node = f"node {common.shown_id(service.node_id)} " if service.node_id else ""
        meanings.append((service.row, node + service.text))
    for row, meaning in meanings:
        gap = max(_HEX_WIDTH - 3 * lengths[row], 0) if aligned else 0
        lines[positions[row]] += " " * (gap + 2) + meaning
    return "\n".join(lines) + "\n" if lines else ""


def json_text(block: CandumpBlock, decoded: Decoded, services: Iterable[Service]) -> str:
    """Return one JSON object per frame."""
    records: list[dict[str, Any]] = []
    for t_ns, can_id, length, data, interface, _, fd_flags in block.in_order():
        record = {
            "t": t_ns / 1_000_000_000 if block.timed else None,  # integers: 1e9 would round t_ns first
            "interface": block.names[interface],
            "id": identifier_text(can_id),
            "data": data.hex().upper(),
        }
        if fd_flags is not None:
            switch, state = bool(fd_flags & BIT_RATE_SWITCH), bool(fd_flags & ERROR_STATE)
            record |= {"fd": True, "bit_rate_switch": switch, "error_state": state}
        elif can_id & ERROR_FLAG:
            record["error"] = True
        elif can_id & REMOTE_FLAG:
            record |= {"data": "", "remote": True, "length": length}
        records.append(record)
    classic = [records[position] for position in block.positions().tolist()]
    for samples in decoded.values():
        _add_values(classic, samples)
    for service in services:
        node_id = {"node": service.node_id} if service.node_id else {}
        classic[service.row] |= {**node_id, "service": service.name, "text": service.text}
    return "".join(json.dumps(record) + "\n" for record in records)


def _add_values(records: list[dict[str, Any]], samples: Samples) -> None:
    flags, numbers = _kinds(samples)
    columns = {name: column.tolist() for name, column in samples.columns.items()}
    for position, row in enumerate(samples.row.tolist()):
        record = records[row]
        values = ((signal.name, columns[signal.name][position]) for signal in numbers)
        record |= {
            "node": samples.node_id,
            "message": samples.message.name,
            "values": {n: None if isinstance(v, float) and not math.isfinite(v) else v for n, v in values},
            "status": [signal.name for signal in flags if columns[signal.name][position]],
        }
        if _COUNTER in columns:
            record[_COUNTER] = columns[_COUNTER][position]


def _words(samples: Samples) -> list[str]:
    flags, numbers = _kinds(samples)
    parts = [[_value(signal, value) for value in samples.columns[signal.name].tolist()] for signal in numbers]
    parts += [[signal.name if is_set else "" for is_set in samples.columns[signal.name].tolist()] for signal in flags]
    if _COUNTER in samples.columns:
        parts.append([f"#{count}" for count in samples.columns[_COUNTER].tolist()])
    start = f"node {common.shown_id(samples.node_id)} {samples.message.name}  "
    return [start + " ".join(filter(None, words)) for words in zip(*parts, strict=True)] if parts else []


def _kinds(samples: Samples) -> tuple[list[Signal], list[Signal]]:
    signals = [signal for signal in samples.message.signals if signal.name in samples.columns]
    flags = [signal for signal in signals if signal.bits == 1]
    return flags, [signal for signal in signals if signal.bits > 1 and signal.name != _COUNTER]


def _value(signal: Signal, value: float) -> str:
    if isinstance(value, int):
        return f"{signal.name}={value}"
    if math.isnan(value):
        return f"{signal.name}=unknown"
    text = f"{value:g}" if signal.real else f"{value:.{max(-math.floor(math.log10(signal.scale)), 0)}f}"
    return f"{signal.name}={text} {_UNITS.get(signal.unit, signal.unit)}".rstrip()
