"""One run of `tipforce dump`: from a source through filters and decoder to stdout, and the final report."""

import os
import sys
from argparse import Namespace
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from select import select as readable
from typing import TYPE_CHECKING

from tipforce.dictionary.signals import rpdo_messages, tpdo_messages
from tipforce.errors import InputError
from tipforce.host.decoding.counters import Tally
from tipforce.host.decoding.decoder import Decoder, Samples
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.host.decoding.pdo_layout import EdsFiles, Layouts
from tipforce.host.decoding.plan import Key
from tipforce.host.decoding.sdo_conversation import eds_names, fingertip_names
from tipforce.host.decoding.services import Service, Services
from tipforce.host.decoding.sync_modulus import SyncModulus
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.live.receiver import InterfaceDownError
from tipforce.host.logs.candump import BadLineError, CandumpParser, text_blocks
from tipforce.host.logs.candump_format import CandumpFormat
from tipforce_tools.cli import common
from tipforce_tools.cli.eds_flag import eds_files
from tipforce_tools.cli.listening import counted
from tipforce_tools.dump.output import STDIN, JsonWriter, Target, TextWriter, Writer, select, split_targets

if TYPE_CHECKING:
    from tipforce.host.live.receiver import ReceiverGroup


def _decoder(gauges: int, eds: EdsFiles) -> Decoder:
    """Return a decoder of all PDOs of fingertips, also of those that they receive; of ``eds`` alone where given."""
    if eds:
        return Layouts(eds=eds).decoder()
    messages = (*tpdo_messages(gauges), *rpdo_messages())
    given = [message for message in messages if message.cob_id_base]
    return Decoder.of_messages(
        {(node_id, one.name): (one.cob_id_base + node_id, one) for node_id in range(1, 128) for one in given}
    )


class Session:
    """Output and counters of a run."""

    def __init__(self, args: Namespace, targets: tuple[Target, ...]) -> None:
        self._args = args
        eds = eds_files(args.eds or ())
        self.decoder = _decoder(args.gauges, eds) if args.decode or args.verbose else None
        names = eds_names(eds, fingertip_names(args.gauges)) if eds else fingertip_names(args.gauges)
        self.services = Services(names) if args.decode else None
        self._duplicates: dict[int, DuplicateNodes] = {}  # by interface
        self.tally, self._modulus = Tally(), SyncModulus()
        self._counted = _decoder(args.gauges, eds) if args.verbose else None  # of the parts of a block
        self._left = args.count
        self._needs_time = not args.json and (args.log or bool(args.timestamps))
        self._writer: Writer = JsonWriter()
        if not args.json:
            width = max((len(target.channel) for target in targets), default=0)
            text = CandumpFormat(
                args.timestamps, log=args.log, extra=args.extra, errors=args.errors, ascii=args.ascii, width=width
            )
            self._writer = TextWriter(text, aligned=not args.log)

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
        if self._args.verbose:
            self._count(block.frames, decoded)
        services: Iterable[Service] = ()
        if self.services is not None:
            services = self.services.describe(block.frames, block.interface)
            for number in set(block.interface.tolist()):
                watch = self._duplicates.setdefault(number, DuplicateNodes())
                for duplicate in watch.add(block.frames[block.interface == number]):
                    common.note(self._args, f"tipforce dump: {duplicate}")
        text = self._writer.text(block, decoded if self._args.decode else {}, services)
        if text:
            sys.stdout.write(text)
            sys.stdout.flush()

    def _count(self, frames: FrameArray, decoded: dict[Key, Samples]) -> None:
        """Count the decoded frames, each by the modulus in force where it was received."""
        assert self._counted is not None
        parts = self._modulus.cuts(frames)
        for part in self._modulus.parts(frames):
            for samples in (self._counted.decode(part) if parts else decoded).values():
                self.tally.add("", samples, self._modulus.modulus)


def dump(args: Namespace) -> int:
    """Print frames until the source ends, or -n or -T ends it; return 0, or 1 for a bad line with --strict.

    Raises InputError for unusable targets, EnvironmentLackError if a bus cannot be opened or fails.
    """
    if args.log and (args.errors or args.ascii) and not args.json:
        raise InputError(f"-L and -{'e' if args.errors else 'a'}: the log format has no field for text; leave one out")
    source, targets = split_targets(args.targets)
    session = Session(args, targets)
    if source is not None:
        return _dump_text(args, source, targets, session)
    _dump_buses(args, targets, session)
    return 0


def _dump_text(args: Namespace, source: Path | str, targets: tuple[Target, ...], session: Session) -> int:
    parser = CandumpParser(strict=args.strict)
    with ExitStack() as opened:
        if source == STDIN:
            descriptor = sys.stdin.fileno()
        else:
            try:
                descriptor = os.open(source, os.O_RDONLY)
            except OSError as error:
                raise InputError(f"{source}: {error.strerror}") from error
            opened.callback(os.close, descriptor)

        def read(count: int) -> bytes:
            """Return what has arrived; nothing after --timeout without it."""
            waits = args.timeout_ms is not None
            ready = not waits or readable([descriptor], [], [], args.timeout_ms / 1000)[0]
            return os.read(descriptor, count) if ready else b""

        frames = 0
        try:
            for block in text_blocks(read, parser):
                frames += len(block)
                if not session.show(select(block, targets)):
                    break
            if parser.bad and not frames:
                from tipforce_tools.cli.empty_log import TEXT, no_frame

                raise no_frame(str(source), (TEXT, "other formats: `tipforce decode`"), parser.bad_lines[0])
        except BadLineError as error:
            print(f"tipforce dump: {error}", file=sys.stderr)
            return 1
        finally:
            if frames or not parser.bad:  # otherwise the error is the whole report
                _report(args, session, parser.dropped, parser)
    return 0


def _dump_buses(args: Namespace, targets: tuple[Target, ...], session: Session) -> None:
    from tipforce_tools.cli.listening import open_targets

    with open_targets(targets, args) as receiver:
        try:
            for block in _live_blocks(receiver, args):
                if not session.show(block):
                    break
        finally:
            _report(args, session, receiver.dropped, None)


def _live_blocks(receiver: "ReceiverGroup", args: Namespace) -> Iterator[CandumpBlock]:
    """Yield frames as they arrive, until none arrives for --timeout. With -D, an interface may go down."""
    timeout_s = None if args.timeout_ms is None else args.timeout_ms / 1000
    while True:
        try:
            block = receiver.receive_block(timeout_s)
        except InterfaceDownError as error:
            if not args.stay:
                raise
            common.note(args, f"tipforce dump: {error}")
            continue
        if len(block):
            yield block
        elif timeout_s is not None:
            return


def _report(args: Namespace, session: Session, dropped: int, parser: CandumpParser | None) -> None:
    """Report on stderr the frames left out, and with -v the counts."""
    notes = []
    if parser is not None and parser.bad:
        reasons = ", ".join(f"{count} {reason}" for reason, count in parser.bad.items())
        notes.append(
            f"{counted(sum(parser.bad.values()), 'bad line')} left out ({reasons}), first {parser.bad_lines[0]}"
        )
    if dropped:
        notes.append(f"{'candump' if parser is not None else 'the kernel'} had dropped {counted(dropped, 'frame')}")
    for (node_id, name), count in (session.decoder.malformed if session.decoder is not None else {}).items():
        short = counted(count, "frame")
        notes.append(f"node {common.shown_id(node_id)} {name}: {short} shorter than the mapping, not decoded")
    if args.verbose:
        for (_, node_id, name), message in session.tally.messages.items():
            lost = "" if message.lost is None else f", {counted(message.lost, 'sample')} lost"
            notes.append(f"node {common.shown_id(node_id)} {name}: {counted(message.frames, 'frame')}{lost}")
    for text in notes:
        common.note(args, f"tipforce dump: {text}")
