"""`tipforce node`: one fingertip node on a bus."""

from __future__ import annotations

import argparse
import math
import sys
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools import common

if TYPE_CHECKING:
    from tipforce.device.node import Device
    from tipforce.fingertip.front_end import FrontEnd
    from tipforce.fingertip.loop import Port


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `tipforce node`."""
    parser.epilog = (
        "example: tipforce node --node-id 5 -i socketcan -c vcan0 --layout I --store node-5.json   "
        "(it waits for NMT start: cansend vcan0 000#0105)"
    )
    parser.add_argument("--node-id", type=common.node_id, required=True, metavar="ID", help="1 to 127")
    parser.add_argument("--source", default="sim", help="where gauge readings come from: sim (default %(default)s)")
    parser.add_argument("--layout", default="I", metavar="I|II|III|FILE", help="gauge layout (default %(default)s)")
    parser.add_argument("--store", metavar="FILE", help="keep parameters here; without it storing is refused")
    parser.add_argument("--serial", type=int, default=0, metavar="N", help="serial number, 1018h:4 (default: node-id)")
    group = parser.add_argument_group("simulated source")
    group.add_argument(
        "--noise", type=float, default=0.5, metavar="UE", help="of each gauge, microstrain (default %(default)s)"
    )
    group.add_argument(
        "--noise-1f", type=float, default=0.0, metavar="UE", help="1/f noise: microstrain at 1 Hz (default none)"
    )
    group.add_argument("--bits", type=int, choices=(16, 24), default=16, help="of the converter (default %(default)s)")
    group.add_argument("--offset", default="", metavar="UE,UE,...", help="what each gauge reads unloaded, microstrain")
    group.add_argument(
        "--load", default="0,0,0", metavar="P,PHI,THETA", help="newtons and degrees (default %(default)s)"
    )
    group.add_argument("--seed", type=int, default=0, help="of the noise (default %(default)s)")
    common.add_bus_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the node until Ctrl-C or SIGTERM; 0 then."""
    from tipforce.fingertip import loop
    from tipforce_tools.main import terminate_as_interrupt

    common.set_up_logging(args)
    device = _device(args)
    port, place = _port(args)
    terminate_as_interrupt()
    common.note(args, f"node {common.shown_id(args.node_id)}: layout {args.layout}, {place}; Ctrl-C ends it")
    try:
        loop.run([device], port)
    except KeyboardInterrupt:
        common.note(args, f"node {common.shown_id(args.node_id)}: stopped")
    return 0


def _device(args: argparse.Namespace) -> Device:
    from tipforce.dictionary.eds import eds_text
    from tipforce.fingertip.node import fingertip_node
    from tipforce.fingertip.simulated import SimulatedSource
    from tipforce.fingertip.store import FileStore
    from tipforce.sensor.gauge_positions import gauge_matrix
    from tipforce_tools.layout_file import read_layout

    if args.source != "sim":
        raise InputError(f"--source {args.source}: allowed is sim")
    geometry, gauges = read_layout(args.layout)
    load = _numbers("--load", args.load, 3)
    offset = _numbers("--offset", args.offset, len(gauges)) if args.offset else [0.0] * len(gauges)
    if not 0 <= args.noise < math.inf:
        raise InputError(f"--noise {args.noise}: allowed is 0 or more")
    if not 0 <= args.noise_1f < math.inf:
        raise InputError(f"--noise-1f {args.noise_1f}: allowed is 0 or more")
    front_end = _front_end(args)
    rows = gauge_matrix(geometry, gauges).tolist()
    source = SimulatedSource(rows, args.noise, offset, args.seed, front_end=front_end)
    source.load = (load[0], load[1], load[2])
    store = FileStore(args.store) if args.store else None
    return fingertip_node(
        args.node_id,
        source,
        len(gauges),
        args.serial or args.node_id,
        store.save if store else None,
        store.load if store else None,
        eds_text(len(gauges), simulated=True, converter=source.converter).encode(),
    )


def _front_end(args: argparse.Namespace) -> FrontEnd | None:
    """What lies before the counts, where a flag names something besides an ideal 16-bit converter."""
    if args.bits == 16 and not args.noise_1f:
        return None
    from tipforce.fingertip.front_end import FrontEnd

    return FrontEnd(args.bits, one_over_f=args.noise_1f or None, seed=args.seed)


def _numbers(flag: str, text: str, count: int) -> list[float]:
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise InputError(f"{flag} {text!r}: write {count} numbers with commas between them")
    return found


def _port(args: argparse.Namespace) -> tuple[Port, str]:
    """The shortest way to the bus: the kernel's own sockets for SocketCAN, python-can for every other interface."""
    from tipforce.errors import EnvironmentLackError
    from tipforce.fingertip.ports import PythonCanPort, SocketCanPort

    options = common.bus_options(args)
    if sys.platform == "linux" and options.get("interface") == "socketcan" and "channel" in options:
        try:
            return SocketCanPort(options["channel"]), options["channel"]
        except OSError as error:
            raise EnvironmentLackError(
                f"interface socketcan, channel {options['channel']}: {error.strerror}; `ip -br link` lists interfaces; "
                "for a kernel that has vcan: `tipforce vcan -- ...`"
            ) from error
    bus = common.open_bus(args)
    return PythonCanPort(bus), str(bus.channel_info)
