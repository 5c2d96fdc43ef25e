"""`tipforce node`: one fingertip node on a bus; its gauges are simulated, Linux converters, or a recording.

A recording (`--source replay:FILE`) is calibration data (CSV) with times, or a candump log. A simulated finger is
calibrated as a delivered one.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import math
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.dictionary import table
from tipforce.errors import InputError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from canopen_device.core.node import Device
    from canopen_device.running.store import FileStore
    from tipforce.arrays import FloatArray
    from tipforce.fingertip.source import Source
    from tipforce.sensor.structure.gauges import Gauge
    from tipforce.sensor.structure.geometry import Geometry
    from tipforce.sources.replay import ReplaySource

EPILOG = """\
examples:
  tipforce node --node-id 5 -i socketcan -c vcan0 --layout I --load 4.4,90,45 --store node-5.json
  tipforce node --node-id 5 -i socketcan -c can0 --layout finger.toml --source iio:device0/voltage0,0-0051,0-0052
  tipforce node --node-id 5 -i socketcan -c vcan0 --source replay:session.csv --speed 2 --loop

The node waits for NMT start (cansend vcan0 000#0105), unless 1F80h makes it start by itself. SIGTERM and Ctrl-C end
it: its last frame is a heartbeat with the state STOPPED (7xx#04).
"""

KINDS = "sim, iio:DEVICE[,DEVICE...], replay:FILE"
_ENDS_16, _ENDS_24 = (-0x8000, 0x7FFF), (-0x800000, 0x7FFFFF)


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


def _add_source_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("Industrial I/O source")
    group.add_argument(
        "--capture", choices=("auto", "poll", "buffer"), default="auto",
        help="direct: read each value on demand; buffer: a trigger fills a buffer; auto: buffer if there is a trigger "
        "(default %(default)s)",
    )  # fmt: skip
    group.add_argument("--trigger", metavar="NAME", help="of the buffer (default: the device's own, else a timer)")
    rate = common.number_within(0.0, 100_000.0, "is above 0 up to 100000 Hz", over=True)
    common.add_numbers(group, ("--scan-rate", 1000.0, "HZ", "of that timer (default 1000)", rate))
    group = parser.add_argument_group("replayed source")
    common.add_numbers(group, ("--speed", 1.0, "X", "times the recorded speed (default 1)", float))
    group.add_argument("--loop", action="store_true", help="repeat at the end; otherwise the node reports no data")
    group = parser.add_argument_group("simulated source")
    noise = common.number_within(0.0, 1e6, "is 0 to 1e+06 microstrain")
    common.add_numbers(
        group,
        ("--noise", 0.5, "UE", "noise of each gauge, microstrain (default %(default)s)", noise),
        ("--noise-1f", 0.0, "UE", "1/f noise: microstrain at 1 Hz (default none)", noise),
    )
    group.add_argument("--bits", type=int, choices=(16, 24), default=16, help="of the converter (default %(default)s)")
    group.add_argument("--offset", default="", metavar="UE,UE,...", help="unloaded reading of each gauge, microstrain")
    group.add_argument(
        "--load", default="0,0,0", metavar="P,PHI,THETA", help="newtons and degrees (default %(default)s)"
    )
    group.add_argument("--seed", type=common.whole_number, default=0, help="of the noise (default %(default)s)")
    group.add_argument(
        "--uncalibrated", action="store_true",
        help="as before its first calibration; otherwise a node that has stored none has that of beam theory, in the "
        "sense (push or pull) of --load",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Run the node until Ctrl-C or SIGTERM; return 0."""
    from tipforce_tools.cli import service

    service.mark_levels_for_journal()
    device, source = _device(args)
    with contextlib.closing(source):  # stop a started capture in every case
        port, place = service.open_port(args)
        if args.priority is not None:
            service.set_priority(args.priority)
            gc.freeze()  # keep present objects out of later collections
        if args.lock_memory:
            service.lock_memory()
        origin = "" if args.source == "sim" else f"source {args.source}, "
        who, what = common.shown_node(args.node_id), f"layout {args.layout}, {origin}{place}"
        service.serve(args, who, what, [device], [device], port)
    return 0


def _device(args: argparse.Namespace) -> tuple[Device, Source]:
    from canopen_device.running.store import FileStore
    from tipforce.dictionary.eds import eds_text
    from tipforce.fingertip.node import fingertip_node
    from tipforce.sources.layout_file import read_layout

    geometry, gauges = read_layout(args.layout)
    source = _source(args, geometry, gauges)
    store = FileStore(args.store) if args.store else None
    device = fingertip_node(
        args.node_id,
        source,
        len(gauges),
        args.serial or args.node_id,
        store.save if store else None,
        _load(args, store, source, geometry, gauges),
        eds_text(len(gauges), simulated=args.source == "sim", converter=source.converter).encode(),
    )
    return device, source


def _load(
    args: argparse.Namespace, store: FileStore | None, source: Source, geometry: Geometry, gauges: tuple[Gauge, ...]
) -> Callable[[str], bytes | None] | None:
    """Return what loads stored parameters: of a simulated finger as of a delivered one."""
    from tipforce.sources.simulated import SimulatedSource

    if args.uncalibrated or not isinstance(source, SimulatedSource):
        return store.load if store else None
    from tipforce.scene.delivered import CALIBRATION, LARGEST_NEWTONS, pulls, stored_calibration, structure_calibration

    try:
        calibration = structure_calibration(
            geometry, gauges, args.noise, 1.0 / source.converter[1], source.offset_microstrain,
            serial=args.serial or args.node_id, pull=pulls(source.load), calibrated_force_newtons=LARGEST_NEWTONS,
        )  # fmt: skip
        delivered = stored_calibration(calibration)
    except InputError as error:
        common.note(args, f"{common.shown_node(args.node_id)}: not calibrated: {error}")
        return store.load if store else None

    def load(group: str) -> bytes | None:
        """Return what is stored; a restored default (1011h) is empty bytes, and no delivered calibration."""
        stored = store.load(group) if store else None
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
        return _open_replay(rest, len(gauges), args.speed, args.loop, args.bits)
    raise InputError(f"--source {args.source}: allowed are {KINDS}")


def _simulated(args: argparse.Namespace, geometry: Geometry, gauges: tuple[Gauge, ...]) -> Source:
    from tipforce.host.configuration.measurements import LARGEST_MICROSTRAIN, MOST_LOAD_NEWTONS
    from tipforce.sensor.structure.gauges import gauge_matrix
    from tipforce.sources.front_end import FrontEnd
    from tipforce.sources.simulated import SimulatedSource

    load = _numbers("--load", args.load, 3)
    if not abs(load[0]) <= MOST_LOAD_NEWTONS:
        raise InputError(f"--load {args.load}: allowed is a force up to {MOST_LOAD_NEWTONS:g} N")
    offset = _numbers("--offset", args.offset, len(gauges)) if args.offset else [0.0] * len(gauges)
    if max(map(abs, offset)) > LARGEST_MICROSTRAIN:
        raise InputError(f"--offset {args.offset}: allowed is up to {LARGEST_MICROSTRAIN:g} microstrain")
    rows = gauge_matrix(geometry, gauges).tolist()
    front_end = None  # an ideal 16-bit converter
    if args.bits != 16 or args.noise_1f:
        front_end = FrontEnd(args.bits, one_over_f=args.noise_1f or None, seed=args.seed)
    source = SimulatedSource(rows, args.noise, offset, args.seed, front_end=front_end)
    source.load = (load[0], load[1], load[2])
    return source


def _numbers(flag: str, text: str, count: int) -> Sequence[float]:
    """Parse ``count`` finite numbers separated by commas. Raises InputError."""
    numbers = [common.number(part) for part in text.split(",")]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InputError(f"{flag} {text!r}: expected {count} numbers separated by commas")
    return numbers


# --- a recording ----------------------------------------------------------------------------------------------------


def _open_replay(text: str, gauges: int, speed: float, loop: bool, bits: int) -> ReplaySource:
    """Read the recording ``FILE``, or ``FILE@ID`` for one node of a log. Raises InputError naming file and place.

    A CSV file needs ``t_s`` and SG1..SGn in microstrain; a log needs the gauge PDOs (0x180 + node-id) of three
    gauges. Counts are those of a converter of ``bits`` bits with a full scale of 3276.8 microstrain.
    """
    from tipforce.sources.replay import ReplaySource

    path, node_id = _split(text)
    is_csv = node_id is None and _looks_like_csv(path)
    t_s, microstrain, degC = _from_csv(path) if is_csv else _from_log(path, node_id)
    if microstrain.shape[1] != gauges:
        raise InputError(f"replay:{text}: {microstrain.shape[1]} gauges; the layout has {gauges}")
    converter, ends = (table.CONVERTER_24, _ENDS_24) if bits == 24 else (table.CONVERTER_16, _ENDS_16)
    times_us = [round(1e6 * t) for t in t_s.tolist()]
    try:
        rows = [_counts(row, converter[1], ends) for row in microstrain.tolist()]
        hundredths = None
        if degC is not None:
            hundredths = [round(100.0 * t) if -327.67 < t < 327.67 else table.UNKNOWN_I16 for t in degC.tolist()]
        return ReplaySource(times_us, rows, converter, ends, speed, loop, hundredths)
    except ValueError as error:
        raise InputError(f"replay:{text}: {error}") from None


def _split(text: str) -> tuple[str, int | None]:
    path, at, number = text.rpartition("@")
    if not at or Path(text).exists():
        return text, None
    try:
        return path, common.node_id(number)
    except argparse.ArgumentTypeError:
        raise InputError(f"replay:{text}: {number!r} after @: allowed are node-ids from 1 to 127") from None


def _looks_like_csv(path: str) -> bool:
    """Return whether the file has a header with a gauge column; the reader of the file reports an unreadable file."""
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            head = file.readline()
    except OSError as error:
        raise InputError(f"replay:{path}: {error.strerror}") from None
    names = [name.strip().strip('"') for name in head.lstrip("\ufeff").split(",")]
    return any(name in ("SG1", "e1_ue") for name in names)


def _from_csv(path: str) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    from tipforce.host.configuration.measurements import read_measurements

    data = read_measurements(path, loads=False)
    if data.t_s is None:
        raise InputError(f"replay:{path}: column t_s is missing; a replay needs the time of each row in seconds")
    if data.bad:
        raise InputError(f"replay:{path}: {data.bad[0]}")
    return data.t_s, 1e6 * data.strain, data.temperature_degC


def _from_log(path: str, node_id: int | None) -> tuple[FloatArray, FloatArray, None]:
    import numpy as np

    from tipforce.host.decoding.decoder import Decoder
    from tipforce.host.logs.candump import read_candump

    decoder = Decoder()
    readings: dict[int, list[tuple[FloatArray, FloatArray]]] = {}
    names = ("SG1", "SG2", "SG3", "stale", "fault")
    with open(path, encoding="utf-8", errors="replace") as file:
        for block in read_candump(file):
            for (sender, _message), samples in decoder.decode(block.frames, names).items():
                columns = samples.columns
                if all(name in columns for name in names):
                    strain = np.column_stack([columns[name] for name in names[:3]]).astype(np.float64)
                    strain[columns["stale"] | columns["fault"]] = np.nan
                    readings.setdefault(sender, []).append((np.multiply(samples.t_ns, 1e-9, dtype=np.float64), strain))
    if node_id is None and len(readings) > 1:
        ids = ", ".join(map(str, sorted(readings)))
        raise InputError(f"replay:{path}: contains gauges of the nodes {ids}; choose one: {path}@{min(readings)}")
    chosen = node_id if node_id is not None else next(iter(readings), None)
    if chosen not in readings:
        whose = "" if node_id is None else f" of node {node_id}"
        raise InputError(
            f"replay:{path}: no gauge PDO{whose}, and no CSV header with SG1; "
            "a recording is a CSV file with t_s,SG1,SG2,SG3 or a candump log with frames 0x180 + node-id"
        )
    t_s, microstrain = map(np.concatenate, zip(*readings[chosen], strict=True))
    return t_s, microstrain, None


def _counts(row: list[float], per_microstrain: float, ends: tuple[int, int]) -> tuple[int, ...] | None:
    """Return a row in counts; None if a gauge is unknown. The limits of a PDO (+-3276.7) mean saturation."""
    from tipforce.fingertip.source import convert

    if any(value - value != 0.0 for value in row):
        return None
    counts = [convert(per_microstrain * value, *ends) for value in row]
    return tuple([ends[0] if count == -ends[1] else count for count in counts])
