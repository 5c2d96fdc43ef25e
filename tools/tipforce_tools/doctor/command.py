"""`tipforce doctor`: what this machine and its bus lack, with the next step for each."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canopen_device.core.codes import EMCY_BASE, ERROR_FLAG, EXTENDED_FLAG, HEARTBEAT_BASE, NODE_ID_MASK, REMOTE_FLAG
from tipforce.errors import TipforceError
from tipforce_tools.cli import common
from tipforce_tools.doctor import machine
from tipforce_tools.doctor.machine import Check

if TYPE_CHECKING:
    from tipforce.host.frames.frame_array import FrameArray

VARIABLES = ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG")
BEATS_S = 5.0
"""Listen so much longer where a node sends a few heartbeats: two nodes may send them."""
_FEW_BEATS = range(2, 11)
_LOADED = 0.8
_STYLES = {"ok": "green", "note": "yellow", "fail": "bold red"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce doctor`."""
    parser.epilog = (
        "Checks the kernel, the interfaces, the source of the bus name, and the installed packages. With a bus it\n"
        "also opens it and listens; it never sends. It listens 5 s longer where a node sends a few heartbeats: two\n"
        "nodes with one node-id may send them. Without a bus it tries `tipforce vcan`. Exit code 1: a check failed."
    )
    an_hour = common.number_within(0.0, 3600.0, "are 0 to 3600 s")
    common.add_numbers(parser, ("--listen", 1.2, "S", "listen for S (default %(default)s s)", an_hour))
    common.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the findings; return 1 if a check failed."""
    failed = False
    out = None if args.json else common.console(args)
    for check in _checks(args):
        failed |= check.state == "fail"
        if out is None:
            common.print_json(asdict(check))
            continue
        step = f"\n      -> {check.next_step}" if check.next_step else ""
        style = _STYLES[check.state]
        out.print(f"{check.state:4}", style=style, end=" ", highlight=False)
        out.print(f"{check.topic}: {check.finding}{step}", highlight=False, soft_wrap=True)
    return 1 if failed else 0


def _checks(args: argparse.Namespace) -> Iterator[Check]:
    options = common.bus_options(args)
    configuration = configuration_check(options)
    named = configuration.state == "ok"
    for check in machine.kernel_checks():
        # If no bus of this kernel is wanted, a kernel without CAN is only a note.
        wanted = options.get("interface") == "socketcan"
        yield check if wanted or check.state != "fail" else replace(check, state="note")
    yield configuration
    if named:
        yield from bus_checks(options, args.listen)
    else:
        yield from machine.vcan_checks()
        yield from machine.multicast_checks()
    yield from machine.iio_checks()
    yield from machine.software_checks()


# --- the bus ----------------------------------------------------------------------------------------------------------


def configuration_check(flags: Mapping[str, Any]) -> Check:
    """Return the check of the configuration: from flags, environment, or a configuration file."""
    import can.util

    sources = []
    given = [f"--{name} {value}" for name, value in flags.items() if value is not None]
    if given:
        sources.append("flags (" + " ".join(given) + ")")
    sources += [f"{name}={os.environ[name]}" for name in VARIABLES if os.environ.get(name)]
    sources += [str(path) for p in can.util.CONFIG_FILES if (path := Path(p).expanduser()).is_file()]
    if flags.get("interface") is None and not sources[len(given) and 1 :]:
        return Check("configuration", "note", "no bus given", "name it: -i socketcan -c can0, or write ~/.canrc")
    try:
        config = can.util.load_config(config={k: v for k, v in flags.items() if v is not None})
    except (can.CanError, ValueError) as error:
        return Check("configuration", "fail", f"{error}", "name the bus: -i socketcan -c can0")
    named = f"{config['interface']} {config.get('channel', '')}".strip()
    return Check("configuration", "ok", f"{named}, from {'; '.join(sources) or 'defaults'}")


def bus_checks(options: Mapping[str, Any], listen_s: float) -> Iterator[Check]:
    """Open the bus, listen, and yield the findings. An unnamed bus is not opened."""
    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, range_of_bits
    from tipforce.host.network.open_bus import open_bus
    from tipforce_tools.cli.listening import frames_heard

    try:
        with open_bus(**options) as bus:
            frames, listen_s = frames_heard(bus, listen_s, _further_s)
    except TipforceError as error:
        yield Check("bus", "fail", str(error), "`tipforce doctor` without -i -c lists the interfaces")
        return
    if not len(frames):
        step = "power the nodes; they send heartbeats once a second; `tipforce scan` polls them"
        yield Check("traffic", "note", f"opened; no frames for {listen_s:.3g} s", step)
        return
    rate = int(options.get("bitrate") or DEFAULT_BIT_RATE)
    least, most = (bits / listen_s / rate for bits in range_of_bits(frames))
    finding = f"{len(frames) / listen_s:.0f} frames/s, load {100 * least:.0f} to {100 * most:.0f} % of {rate} bit/s"
    step = "a lower SYNC rate or fewer PDOs: `tipforce hand check` computes them" if most > _LOADED else ""
    yield Check("traffic", "note" if step else "ok", finding, step)
    yield from heard(frames)


def _further_s(can_ids: Iterable[int]) -> float:
    """Return the time to listen longer: a node sent more heartbeats than one, too few to tell whether two send them."""
    counts = Counter(can_id for can_id in can_ids if can_id > HEARTBEAT_BASE)
    return BEATS_S if any(count in _FEW_BEATS for count in counts.values()) else 0.0


def heard(frames: FrameArray) -> Iterator[Check]:
    """Yield what frames, FRAME (n,), say: error frames, nodes, and their faults in words."""
    import numpy as np

    from canopen_device.core.emcy import SYNC_LENGTH
    from tipforce.host.decoding.decoder import Decoder
    from tipforce.host.decoding.duplicates import DuplicateNodes
    from tipforce.host.decoding.health import Health
    from tipforce.samples import reasons

    errors = int(((frames["can_id"] & ERROR_FLAG) != 0).sum())
    if errors:
        yield Check("traffic", "fail", f"{errors} error frames", "`tipforce dump -e CHANNEL,#FFFFFFFF` shows them")
    flags = EXTENDED_FLAG | REMOTE_FLAG | ERROR_FLAG
    standard = frames["can_id"][(frames["can_id"] & flags) == 0].tolist()
    beats = sorted({i - HEARTBEAT_BASE for i in standard if 0 < i - HEARTBEAT_BASE <= NODE_ID_MASK})
    emergencies = {i - EMCY_BASE for i in standard if 0 < i - EMCY_BASE <= NODE_ID_MASK}
    health = Health()
    health.take(frames, Decoder().decode(frames).values())
    faults = {node: words for node in health.nodes if (words := reasons.of_faults(health.now(node)[0]))}
    for duplicate in {pair.node_id: pair for pair in DuplicateNodes().add(frames)}.values():
        cause, _, step = str(duplicate).partition(": ")
        yield Check("nodes", "fail", cause, step)
    if beats:
        yield Check("nodes", "ok", f"heartbeats of {', '.join(map(str, beats))}", "`tipforce scan` identifies them")
    for node, words in sorted(faults.items()):
        yield Check("nodes", "note", f"node {node}: {', '.join(words)}", "`tipforce sdo read` of 2124h")
    emcy = frames[np.isin(frames["can_id"], [EMCY_BASE + node for node in emergencies])]
    code = emcy["data"][:, 0].astype(np.int64) | emcy["data"][:, 1].astype(np.int64) << 8
    numbered = {int(can_id) - EMCY_BASE for can_id in emcy["can_id"][code == SYNC_LENGTH]}
    if numbered:
        finding = f"{', '.join(map(str, sorted(numbered)))} reject the SYNC (EMCY 8240h): it does not fit their 1019h"
        step = f"after a killed hand: `tipforce sdo write {min(numbered)} 0x1019 0 u8 0`, or reset the node"
        yield Check("nodes", "fail", finding, step)
    others = sorted(emergencies - {*faults} - numbered)
    if others:
        yield Check("nodes", "note", f"EMCY from {', '.join(map(str, others))}", "`tipforce scan`, object 1003h")
