"""`tipforce node`: one fingertip node on a bus."""

from __future__ import annotations

import argparse
import contextlib
import gc
import math
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tipforce.device.node import Device
    from tipforce.fingertip.source import Source
    from tipforce.running.loop import Port
    from tipforce.sensor.structure.gauge_positions import Gauge
    from tipforce.sensor.structure.geometry import Geometry
    from tipforce.sources.front_end import FrontEnd

EPILOG = """\
examples:
  tipforce node --node-id 5 -i socketcan -c vcan0 --layout I --store node-5.json
  tipforce node --node-id 5 -i socketcan -c can0 --layout finger.toml --source iio:device0/voltage0,0-0051,0-0052
  tipforce node --node-id 5 -i socketcan -c vcan0 --source replay:session.csv --speed 2 --loop

The node waits for NMT start (cansend vcan0 000#0105), unless 1F80h makes it start by itself. SIGTERM and Ctrl-C end
it: its last frame is a heartbeat with the state STOPPED (7xx#04).
"""

KINDS = "sim, iio:DEVICE[,DEVICE...], replay:FILE"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce node`."""
    parser.epilog = EPILOG
    parser.add_argument("--node-id", type=common.node_id, required=True, metavar="ID", help="1 to 127")
    parser.add_argument("--source", default="sim", help=f"source of the gauge readings: {KINDS} (default %(default)s)")
    parser.add_argument("--layout", default="I", metavar="I|II|III|FILE", help="gauge layout (default %(default)s)")
    parser.add_argument("--store", metavar="FILE", help="file of stored parameters; without it 1010h refuses")
    parser.add_argument(
        "--serial", type=common.unsigned32, default=0, metavar="N", help="serial number, 1018h:4 (default: node-id)"
    )
    _add_source_arguments(parser)
    group = parser.add_argument_group("operation")
    group.add_argument(
        "--priority", type=int, metavar="N", help="real-time scheduling, SCHED_FIFO 1 to 99 (80 is usual)"
    )
    group.add_argument("--lock-memory", action="store_true", help="lock the process in memory (mlockall)")
    common.add_bus_arguments(parser)
    common.add_output_arguments(parser)


def _add_source_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("Industrial I/O source")
    group.add_argument(
        "--capture", choices=("auto", "poll", "buffer"), default="auto",
        help="direct: read each value on demand; buffer: a trigger fills a buffer; auto: buffer if there is a trigger "
        "(default %(default)s)",
    )  # fmt: skip
    group.add_argument("--trigger", metavar="NAME", help="of the buffer (default: the device's own, else a timer)")
    group.add_argument("--scan-rate", type=float, default=1000.0, metavar="HZ", help="of that timer (default 1000)")
    group = parser.add_argument_group("replayed source")
    group.add_argument("--speed", type=float, default=1.0, metavar="X", help="times the recorded speed (default 1)")
    group.add_argument("--loop", action="store_true", help="repeat at the end; otherwise the node reports no data")
    group = parser.add_argument_group("simulated source")
    group.add_argument(
        "--noise", type=float, default=0.5, metavar="UE", help="noise of each gauge, microstrain (default %(default)s)"
    )
    group.add_argument(
        "--noise-1f", type=float, default=0.0, metavar="UE", help="1/f noise: microstrain at 1 Hz (default none)"
    )
    group.add_argument("--bits", type=int, choices=(16, 24), default=16, help="of the converter (default %(default)s)")
    group.add_argument("--offset", default="", metavar="UE,UE,...", help="unloaded reading of each gauge, microstrain")
    group.add_argument(
        "--load", default="0,0,0", metavar="P,PHI,THETA", help="newtons and degrees (default %(default)s)"
    )
    group.add_argument("--seed", type=common.seed, default=0, help="of the noise (default %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Run the node until Ctrl-C or SIGTERM; return 0."""
    from tipforce_tools.cli import service
    from tipforce_tools.cli.port import open_port

    common.set_up_logging(args)
    service.mark_levels_for_journal()
    device, source = _device(args)
    with contextlib.closing(source):  # stop a started capture in every case
        port, place = open_port(args)
        if args.priority is not None:
            service.set_priority(args.priority)
            gc.freeze()  # keep present objects out of later collections
        if args.lock_memory:
            service.lock_memory()
        _serve(args, device, port, place)
    return 0


def _serve(args: argparse.Namespace, device: Device, port: Port, place: str) -> None:
    """Run until a signal; report start and end to the service manager, the bus and the terminal."""
    from tipforce.running import loop
    from tipforce_tools.cli import service

    who = f"node {common.shown_id(args.node_id)}"
    stop, notifier = service.StopSignal(), service.Notifier()
    common.note(args, f"{who}: layout {args.layout}, {_shown_source(args)}{place}; Ctrl-C ends it")

    def ended() -> bool:
        notifier.alive()
        return stop()

    try:
        notifier.send("READY=1", f"STATUS={who} on {place}, source {args.source}")
        loop.run([device], port, ended)
    except KeyboardInterrupt:
        pass
    finally:
        notifier.send("STOPPING=1", f"STATUS={who} stopped")
        loop.say_stopped([device], port)
        notifier.close()
        stop.restore()
    common.note(args, f"{who}: stopped")


def _shown_source(args: argparse.Namespace) -> str:
    return "" if args.source == "sim" else f"source {args.source}, "


def _device(args: argparse.Namespace) -> tuple[Device, Source]:
    from tipforce.dictionary.eds import eds_text
    from tipforce.fingertip.node import fingertip_node
    from tipforce.running.store import FileStore
    from tipforce_tools.cli.layout_file import read_layout

    geometry, gauges = read_layout(args.layout)
    source = _source(args, geometry, gauges)
    store = FileStore(args.store) if args.store else None
    device = fingertip_node(
        args.node_id,
        source,
        len(gauges),
        args.serial or args.node_id,
        store.save if store else None,
        store.load if store else None,
        eds_text(len(gauges), simulated=args.source == "sim", converter=source.converter).encode(),
    )
    return device, source


def _source(args: argparse.Namespace, geometry: Geometry, gauges: tuple[Gauge, ...]) -> Source:
    kind, _, rest = args.source.partition(":")
    if args.source == "sim":
        return _simulated(args, geometry, gauges)
    if kind == "iio" and rest:
        from tipforce_tools.cli.layout_file import read_bridge
        from tipforce_tools.node.source import open_iio

        if not 0.0 < args.scan_rate <= 100_000.0:
            raise InputError(f"--scan-rate {args.scan_rate:g}: allowed is above 0 up to 100000 Hz")
        return open_iio(args, len(gauges), read_bridge(args.layout))
    if kind == "replay" and rest:
        from tipforce_tools.node.replay_file import open_replay

        return open_replay(rest, len(gauges), args.speed, args.loop, args.bits)
    raise InputError(f"--source {args.source}: allowed are {KINDS}")


def _simulated(args: argparse.Namespace, geometry: Geometry, gauges: tuple[Gauge, ...]) -> Source:
    from tipforce.host.configuration.measurement_rows import LARGEST_MICROSTRAIN, MOST_LOAD_NEWTONS
    from tipforce.sensor.structure.gauge_positions import gauge_matrix
    from tipforce.sources.simulated import SimulatedSource

    load = _numbers("--load", args.load, 3)
    if not abs(load[0]) <= MOST_LOAD_NEWTONS:
        raise InputError(f"--load {args.load}: allowed is a force up to {MOST_LOAD_NEWTONS:g} N")
    offset = _numbers("--offset", args.offset, len(gauges)) if args.offset else [0.0] * len(gauges)
    for flag, value in (("--noise", args.noise), ("--noise-1f", args.noise_1f)):
        if not 0.0 <= value <= LARGEST_MICROSTRAIN:
            raise InputError(f"{flag} {value}: allowed is 0 to {LARGEST_MICROSTRAIN:g} microstrain")
    if max(map(abs, offset)) > LARGEST_MICROSTRAIN:
        raise InputError(f"--offset {args.offset}: allowed is up to {LARGEST_MICROSTRAIN:g} microstrain")
    rows = gauge_matrix(geometry, gauges).tolist()
    source = SimulatedSource(rows, args.noise, offset, args.seed, front_end=_front_end(args))
    source.load = (load[0], load[1], load[2])
    return source


def _front_end(args: argparse.Namespace) -> FrontEnd | None:
    """Return the front end, if a flag names one that differs from an ideal 16-bit converter."""
    if args.bits == 16 and not args.noise_1f:
        return None
    from tipforce.sources.front_end import FrontEnd

    return FrontEnd(args.bits, one_over_f=args.noise_1f or None, seed=args.seed)


def _numbers(flag: str, text: str, count: int) -> Sequence[float]:
    """Parse ``count`` finite numbers separated by commas. Raises InputError."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise InputError(f"{flag} {text!r}: expected {count} numbers separated by commas")
    return found
