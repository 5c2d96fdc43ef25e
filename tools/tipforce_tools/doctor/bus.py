"""Check python-can's configuration and its sources, open the bus, and listen to it."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canopen_device.core.codes import EMCY_BASE, ERROR_FLAG, EXTENDED_FLAG, HEARTBEAT_BASE, NODE_ID_MASK, REMOTE_FLAG
from tipforce.errors import TipforceError
from tipforce_tools.doctor import Check

if TYPE_CHECKING:
    from tipforce.host.frames.frame_array import FrameArray

VARIABLES = ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG")
BEATS_S = 5.0
"""Listen so much longer where a node sends a few heartbeats: two nodes may send them."""
_FEW_BEATS = range(2, 11)
_LOADED = 0.8


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
    import can

    from tipforce.host.frames.frame_array import FrameBuffer
    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, exact_bits
    from tipforce.host.network.open_bus import open_bus

    try:
        bus = open_bus(**options)
    except TipforceError as error:
        yield Check("bus", "fail", str(error), "`tipforce doctor` without -i -c lists the interfaces")
        return
    buffer = FrameBuffer()
    notifier = can.Notifier(bus, [buffer], timeout=0.1)
    try:
        time.sleep(listen_s)
        if _is_undecided(buffer.can_ids()):
            listen_s += BEATS_S
            time.sleep(BEATS_S)
    finally:
        notifier.stop()
        bus.shutdown()
    if notifier.exception is not None:
        yield Check("bus", "fail", f"failed while listening: {notifier.exception}", "is the adapter plugged in?")
        return
    frames = buffer.take_all()
    if not len(frames):
        step = "power the nodes; they send heartbeats once a second; `tipforce scan` polls them"
        yield Check("traffic", "note", f"opened; no frames for {listen_s:g} s", step)
        return
    rate = int(options.get("bitrate") or DEFAULT_BIT_RATE)
    load = float(exact_bits(frames).sum()) / listen_s / rate
    finding = f"{len(frames) / listen_s:.0f} frames/s, load {100 * load:.1f} % of {rate} bit/s"
    if load > _LOADED:
        yield Check("traffic", "note", finding, "a lower SYNC rate or fewer PDOs: `tipforce load --help`")
    else:
        yield Check("traffic", "ok", finding)
    yield from heard(frames)


def _is_undecided(can_ids: Iterable[int]) -> bool:
    """Return whether a node sent more heartbeats than one, and too few to tell whether two nodes send them."""
    counts = Counter(can_id for can_id in can_ids if can_id > HEARTBEAT_BASE)
    return any(count in _FEW_BEATS for count in counts.values())


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
