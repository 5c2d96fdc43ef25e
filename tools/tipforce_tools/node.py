"""`tipforce node` and `simulate`: devices that run on a bus until a signal, fingers with gauges that are simulated
(then calibrated as delivered), Linux converters or a recording, and devices of an EDS, a DCF or a machine in TOML."""

from __future__ import annotations

import argparse
import contextlib
import gc
import math
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import bus_flags, common

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from canopen_device.machine.device import SimulatedDevice
    from canopen_device.running.store import FileStore
    from tipforce.fingertip.source import Source
    from tipforce.sensor.structure.strain import Gauge, Geometry

KINDS = "sim, iio:DEVICE[,DEVICE...], replay:FILE"


def add_node_arguments(parser: argparse.ArgumentParser) -> None:
    """examples:
      tipforce node --node-id 5 -i socketcan -c vcan0 --layout I --load 4.4,90,45 --store node-5.json
      tipforce node --node-id 5 -i socketcan -c can0 --layout finger.toml --source iio:device0/voltage0,0-0051,0-0052

    The node waits for NMT start (cansend vcan0 000#0105), unless 1F80h makes it start by itself. SIGTERM and Ctrl-C end
    it: its last frame is a heartbeat with the state STOPPED (7xx#04).
    """
    parser.add_argument("--node-id", type=common.node_id, required=True, metavar="ID", help="1 to 127")
    parser.add_argument("--source", default="sim", metavar="SOURCE", help=f"{KINDS} (default %(default)s)")
    parser.add_argument("--layout", default="I", metavar="I|II|III|FILE", help="gauge layout (default %(default)s)")
    parser.add_argument("--store", metavar="FILE", help="of stored parameters; without it 1010h refuses")
    parser.add_argument("--serial", type=common.unsigned32, default=0, metavar="N", help="1018h:4 (default: node-id)")
    group = parser.add_argument_group("Industrial I/O source")
    what = "poll: on demand; buffer: by a trigger (default %(default)s)"
    group.add_argument("--capture", choices=("auto", "poll", "buffer"), default="auto", help=what)
    group.add_argument("--trigger", metavar="NAME", help="default: the device's own, else a timer")
    rate = common.number_within(0.0, 100_000.0, "is above 0 up to 100000 Hz", over=True)
    common.add_number(group, "--scan-rate", 1000.0, "HZ", "of that timer (default 1000)", rate)
    group = parser.add_argument_group("replayed source")
    common.add_number(group, "--speed", 1.0, "X", "times the recorded speed (default 1)", float)
    group.add_argument("--loop", action="store_true", help="repeat; otherwise no data at the end")
    group = parser.add_argument_group("simulated source")
    noise = common.number_within(0.0, 1e6, "is 0 to 1e+06 microstrain")
    common.add_number(group, "--noise", 0.5, "UE", "noise of each gauge, microstrain (default %(default)s)", noise)
    common.add_number(group, "--noise-1f", 0.0, "UE", "1/f noise: microstrain at 1 Hz (default none)", noise)
    group.add_argument("--bits", type=int, choices=(16, 24), default=16, help="of the converter (default %(default)s)")
    group.add_argument("--offset", default="", metavar="UE,UE,...", help="unloaded reading of each gauge, microstrain")
    group.add_argument("--load", default="0,0,0", metavar="P,PHI,THETA", help="newtons, degrees (default %(default)s)")
    group.add_argument("--seed", type=common.whole_number, default=0, help="of the noise (default %(default)s)")
    what = "as before its first calibration; otherwise a node that has stored none has that of beam theory, in the "
    group.add_argument("--uncalibrated", action="store_true", help=f"{what}sense (push or pull) of --load")
    group = parser.add_argument_group("operation")
    group.add_argument("--priority", type=int, metavar="N", help="SCHED_FIFO, 1 to 99 (80 is usual)")
    group.add_argument("--lock-memory", action="store_true", help="lock the process in memory (mlockall)")
    bus_flags.add_bus_arguments(parser)


def run_node(args: argparse.Namespace) -> int:
    """Run the node until Ctrl-C or SIGTERM; return 0."""
    from canopen_device.running.store import FileStore
    from tipforce.dictionary.eds import eds_text
    from tipforce.fingertip.node import fingertip_node
    from tipforce.host.network.interfaces import open_port
    from tipforce.sources.layout_file import read_layout
    from tipforce_tools.cli import service

    service.mark_levels_for_journal()
    geometry, gauges = read_layout(args.layout)
    source = _source(args, geometry, gauges)
    store = FileStore(args.store) if args.store else None
    save, load = store.save if store else None, _load(args, store, source, geometry, gauges)
    eds = eds_text(len(gauges), simulated=args.source == "sim", converter=source.converter).encode()
    device = fingertip_node(args.node_id, source, len(gauges), args.serial or args.node_id, save, load, eds)
    with contextlib.closing(source):  # stop a started capture in every case
        port, place = open_port(**bus_flags.find_bus(args))
        if args.priority is not None:
            service.set_priority(args.priority)
            gc.freeze()  # keep present objects out of later collections
        if args.lock_memory:
            service.lock_memory()
        origin = "" if args.source == "sim" else f"source {args.source}, "
        who, what = common.shown_node(args.node_id), f"layout {args.layout}, {origin}{place}"
        with contextlib.closing(port):
            service.serve(who, what, [device], [device], port)
    return 0


def _load(
    args: argparse.Namespace, store: FileStore | None, source: Source, geometry: Geometry, gauges: tuple[Gauge, ...]
) -> Callable[[str], bytes | None] | None:
    """Return what loads stored parameters: of a simulated finger as of a delivered one."""
    from tipforce.sources.simulated import SimulatedSource

    stored_only = store.load if store else None
    if args.uncalibrated or not isinstance(source, SimulatedSource):
        return stored_only
    from tipforce.scene.delivered import CALIBRATION, LARGEST_NEWTONS, pulls, stored_calibration, structure_calibration

    try:
        calibration = structure_calibration(
            geometry, gauges, args.noise, 1.0 / source.converter[1], source.offset_microstrain,
            serial=args.serial or args.node_id, pull=pulls(source.load), calibrated_force_newtons=LARGEST_NEWTONS,
        )  # fmt: skip
        delivered = stored_calibration(calibration)
    except InputError as error:
        common.note(f"{common.shown_node(args.node_id)}: not calibrated: {error}")
        return stored_only

    def load(group: str) -> bytes | None:
        """Return what is stored; a restored default (1011h) is empty bytes, and no delivered calibration."""
        stored = stored_only(group) if stored_only else None
        return delivered if stored is None and group == CALIBRATION else stored

    return load


def _source(args: argparse.Namespace, geometry: Geometry, gauges: tuple[Gauge, ...]) -> Source:
    kind, _, rest = args.source.partition(":")
    if args.source == "sim":
        return _simulated(args, geometry, gauges)
    if kind == "iio" and rest:
        from tipforce.sources.iio_gauges import Capture, open_iio
        from tipforce.sources.layout_file import read_bridge

        capture = Capture(args.capture, args.trigger, args.scan_rate)
        return open_iio(rest, args.layout, len(gauges), read_bridge(args.layout), capture)
    if kind == "replay" and rest:
        from tipforce.host.logs.gauge_recording import open_recording

        return open_recording(rest, len(gauges), args.speed, args.loop, args.bits)
    raise InputError(f"--source {args.source}: allowed are {KINDS}")


def _simulated(args: argparse.Namespace, geometry: Geometry, gauges: tuple[Gauge, ...]) -> Source:
    from tipforce.host.configuration.measurements import LARGEST_MICROSTRAIN, MOST_LOAD_NEWTONS
    from tipforce.sensor.structure.strain import gauge_matrix
    from tipforce.sources.front_end import FrontEnd
    from tipforce.sources.simulated import SimulatedSource

    load = _numbers("--load", args.load, 3)
    if not abs(load[0]) <= MOST_LOAD_NEWTONS:
        raise InputError(f"--load {args.load}: allowed is a force up to {MOST_LOAD_NEWTONS:g} N")
    offset = _numbers("--offset", args.offset, len(gauges)) if args.offset else [0.0] * len(gauges)
    if max(map(abs, offset)) > LARGEST_MICROSTRAIN:
        raise InputError(f"--offset {args.offset}: allowed is up to {LARGEST_MICROSTRAIN:g} microstrain")
    ideal = args.bits == 16 and not args.noise_1f
    front_end = None if ideal else FrontEnd(args.bits, one_over_f=args.noise_1f or None, seed=args.seed)
    rows = gauge_matrix(geometry, gauges).tolist()
    source = SimulatedSource(rows, args.noise, offset, args.seed, front_end=front_end)
    source.load = (load[0], load[1], load[2])
    return source


def _numbers(flag: str, text: str, count: int) -> Sequence[float]:
    numbers = [common.number(part) for part in text.split(",")]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InputError(f"{flag} {text!r}: expected {count} numbers separated by commas")
    return numbers


def add_simulate_arguments(parser: argparse.ArgumentParser) -> None:
    """
      tipforce simulate cia402 --node-id 5 -i socketcan -c vcan0        the drive that tipforce ships
      tipforce simulate drive.eds io.eds --node-id 5,10 --set 10:0x6000:01=0x0F -i socketcan -c vcan0
      tipforce simulate press.toml -i socketcan -c vcan0                a machine: values, signals, faults, applications

    Where an EDS leaves CiA 306 or contradicts itself, a warning names the line and how it is read. docs/simulate.md
    describes the TOML file and applications in Python.
    """
    parser.add_argument("files", nargs="+", metavar="FILE", help="EDS, DCF or XDD files, cia402, or one TOML file")
    parser.add_argument("--node-id", type=common.node_ids, metavar="IDS", help="5, or 1,2,5-9: one for each file")
    parser.add_argument("--application", default="", metavar="NAME", help="cia402, or FILE:CLASS")
    parser.add_argument("--store", metavar="FILE", default="", help="file of stored parameters, for one node")
    metavar = "[ID:]OBJECT=VALUE"
    parser.add_argument("--set", action="append", default=[], metavar=metavar, dest="values", help="initial value")
    bus_flags.add_bus_arguments(parser)


def run_simulate(args: argparse.Namespace) -> int:
    """Run the devices until Ctrl-C or SIGTERM; return 0."""
    from tipforce.host.network.interfaces import open_port
    from tipforce_tools.cli.service import serve

    devices = _devices(args)
    for device in devices:
        for warning in device.description.warnings:
            common.note(f"warning: {warning}")
    port, place = open_port(**bus_flags.find_bus(args))
    shown = ", ".join(f"{common.shown_id(device.node_id)} {device.description.product_name}" for device in devices)
    with contextlib.closing(port):
        serve(f"node {shown}", f"on {place}", devices, [device.core for device in devices], port)
    return 0


def _devices(args: argparse.Namespace) -> list[SimulatedDevice]:
    from canopen_device.machine.file import check_node_ids, read_machine
    from canopen_device.machine.running import made_device

    if any(file.endswith(".toml") for file in args.files):
        if len(args.files) > 1 or args.node_id or args.values or args.application or args.store:
            raise InputError("a machine in TOML stands alone: its devices have their node-ids, values and applications")
        return read_machine(args.files[0])
    ids: list[int | None] = args.node_id or [None] * len(args.files)  # a DCF names its own
    files = args.files * len(ids) if len(args.files) == 1 else args.files  # one file may have many node-ids
    if len(files) != len(ids):
        raise InputError(f"--node-id: {len(ids)} for {len(files)} files; give one for each")
    if args.store and len(ids) > 1:
        raise InputError("--store: one file belongs to one node; use a TOML file for several")
    values, pairs = _values(args.values, ids), zip(files, ids, strict=True)
    made = [made_device(file, each, args.application, values.get(each), store=args.store) for file, each in pairs]
    check_node_ids(made)
    return made


def _values(given: list[str], node_ids: list[int | None]) -> dict[int | None, dict[str, str]]:
    by_node: dict[int | None, dict[str, str]] = {}
    for text in given:
        place, equal, value = text.partition("=")
        head, colon, rest = place.partition(":")
        own = head.isdigit() and bool(colon)
        if not equal or not (rest if own else place):
            raise InputError(f"--set {text!r}: the form is OBJECT=VALUE, or ID:OBJECT=VALUE")
        if own and int(head) not in node_ids:
            raise InputError(f"--set {text!r}: no node {head} here")
        if not own and len(node_ids) > 1:
            raise InputError(f"--set {text!r}: several nodes; write ID:OBJECT=VALUE")
        by_node.setdefault(int(head) if own else node_ids[0], {})[rest if own else place] = value
    return by_node
