"""`tipforce doctor`: what this machine and its bus lack, with the next step for each."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canopen_device.core.codes import STOPPED
from tipforce.errors import EnvironmentLackError, TipforceError
from tipforce_tools.cli import bus_flags, common

if TYPE_CHECKING:
    from tipforce.host.frames.frame_array import FrameArray
    from tipforce.host.hand.file import FingerPlan
    from tipforce.watching.findings import Finding

VARIABLES = ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG")
BEATS_S = 5.0
"""Listen so much longer to a stopped node: it has no SDO, and two may send its heartbeats."""
_LOADED = 0.8
_STYLES = {"ok": "green", "note": "yellow", "fail": "bold red"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce doctor`."""
    parser.epilog = (
        "Checks the kernel, the interfaces, the source of the bus name, and the installed packages. On a bus (of the\n"
        "flags, or the only CAN interface that is up) it listens, requests the identity of every node as `tipforce\n"
        "scan` does, and says what stands between it and forces; with HAND.toml also swapped serial numbers. Without\n"
        "a bus it tries `tipforce vcan`. Exit code 1: something is wrong."
    )
    parser.add_argument("hand", nargs="?", type=common.InputFile(), metavar="HAND.toml", help="compare the bus with it")
    an_hour = common.number_within(0.0, 3600.0, "are 0 to 3600 s")
    common.add_numbers(parser, ("--listen", 1.2, "S", "listen for S (default %(default)s s)", an_hour))
    bus_flags.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the findings; return 1 if something is wrong."""
    failed = False
    out = None if common.OUTPUT.json else common.console()
    for check in _findings(args):
        failed |= check.state == "fail"
        if out is None:
            common.print_json(asdict(check))
            continue
        step = f" -> {check.next_step}" if check.next_step else ""
        out.print(f"{check.state:4}", style=_STYLES[check.state], end=" ", highlight=False)
        out.print(f"{check.topic}: {check.finding}{step}", highlight=False, soft_wrap=True)
    return 1 if failed else 0


def _findings(args: argparse.Namespace) -> Iterator[Finding]:
    from tipforce.host.hand.file import read_hand
    from tipforce.watching.findings import Finding
    from tipforce_tools.doctor import machine

    hand = read_hand(args.hand) if args.hand else None
    flags = bus_flags.bus_options(args)
    options: dict[str, Any] = {}
    try:
        options = bus_flags.find_bus(args, hand.bus if hand else None)
        configuration = configuration_check(options, flags)
    except EnvironmentLackError as error:
        configuration = Finding("configuration", "note", *str(error).split(": ", 1))
    for check in machine.kernel_checks():
        # Of the kernel, only what the wanted bus needs is wrong.
        topics = ("kernel", f"interface {options.get('channel')}")
        wanted = options.get("interface") == "socketcan" and check.topic in topics
        yield check if wanted or check.state != "fail" else replace(check, state="note")
    yield configuration
    if configuration.state != "ok":
        yield from machine.vcan_checks()
        yield from machine.multicast_checks()
    yield from machine.iio_checks()
    yield from machine.software_checks()
    if configuration.state == "ok":
        yield from bus_findings(options, args.listen, hand.finger if hand else ())


def configuration_check(options: Mapping[str, Any], flags: Mapping[str, Any]) -> Finding:
    """Return where the name of the bus comes from: flags, environment, configuration files, or the only interface."""
    import can.util

    from tipforce.watching.findings import Finding

    sources = [f"flags ({' '.join(f'--{name} {value}' for name, value in flags.items())})"] if flags else []
    sources += [f"{name}={os.environ[name]}" for name in VARIABLES if os.environ.get(name)]
    sources += [str(path) for p in can.util.CONFIG_FILES if (path := Path(p).expanduser()).is_file()]
    try:
        config = can.util.load_config(config=dict(options))
    except (can.CanError, ValueError) as error:
        return Finding("configuration", "fail", f"{error}", "name the bus: -i socketcan -c can0")
    named = f"{config['interface']} {config.get('channel', '')}".strip()
    return Finding("configuration", "ok", f"{named}, from {'; '.join(sources) or 'the interfaces that are up'}")


def bus_findings(options: Mapping[str, Any], listen_s: float, wanted: tuple[FingerPlan, ...] = ()) -> Iterator[Finding]:
    """Open the bus, listen, ask every node-id for its identity, and yield what was found."""
    import numpy as np

    from tipforce.host.network.bus import Bus
    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, range_of_bits
    from tipforce.host.network.find import find_nodes
    from tipforce.host.network.interfaces import links
    from tipforce.host.network.open_bus import open_bus
    from tipforce.watching.findings import Finding, Observed, findings, shown

    received: list[FrameArray] = []
    nodes = []
    link = links().get(str(options.get("channel")))
    try:
        with Bus(open_bus(**options)) as connection:
            begun_s, seen = time.monotonic(), Observed(duplicates=connection.duplicates, link=link)
            try:
                nodes = find_nodes(connection, range(1, 128), listen_s, received.append)
            except TipforceError as error:  # the bus takes no frames
                yield Finding("bus", "fail", str(error))
                time.sleep(listen_s)
            if any(connection.heartbeats.state(node.node_id) == STOPPED for node in nodes):
                time.sleep(BEATS_S)
            received.append(connection.buffer.take_all())
            seen.heard_s = time.monotonic() - begun_s
    except TipforceError as error:
        yield Finding("bus", "fail", str(error), "`tipforce doctor` without -i -c lists the interfaces")
        return
    frames = np.concatenate(received)
    seen.count(frames)
    seen.add_nodes(nodes)
    if seen.frames:
        rate = int(options.get("bitrate") or (link.bit_rate if link else 0) or DEFAULT_BIT_RATE)
        least, most = (bits / seen.heard_s / rate for bits in range_of_bits(frames))
        load = f"load {100 * least:.0f} to {100 * most:.0f} % of {rate} bit/s"
        finding = f"{len(frames) / seen.heard_s:.0f} frames/s, {load}"
        step = "a lower SYNC rate or fewer PDOs: `tipforce hand check` computes them" if most > _LOADED else ""
        yield Finding("traffic", "note" if step else "ok", finding, step)
    for node in nodes:
        if not node.duplicate:
            serial = f", serial {node.serial}" if node.product else ""
            yield Finding(shown([node.node_id]), "ok", f"{node.state}, {node.device}{serial}")
    yield from findings(seen, wanted=wanted)
