"""Read a scene file, and check it beyond its types: unique node-ids, one load per finger, PDOs that need a SYNC."""

from collections.abc import Iterable
from datetime import UTC
from itertools import pairwise
from pathlib import Path

import msgspec

from canopen_device.paths_below import below
from canopen_device.toml_table import convert, read_table
from tipforce.dictionary.table import STATUS_BITS
from tipforce.errors import InputError, placed
from tipforce.fingertip.filters import LONGEST_WINDOW
from tipforce.scene import schema
from tipforce.scene.registry import SYNCHRONOUS
from tipforce.sensor.structure.layouts import layout


def read_scene(path: str | Path) -> schema.Scene:
    """Read and check a scene file. Raises InputError naming the place, the value and what is allowed."""
    scene = convert(schema.Scene, read_table(path, f"scene {path}"), f"scene {path}")
    if not 1970 <= scene.start.astimezone(UTC).year < 2262:
        raise InputError(f"scene {path}: start is {scene.start}: allowed are the years 1970 to 2261")
    for check in (_check_nodes, _check_loads, _check_faults, _check_expectations):
        check(scene, f"scene {path}")
    for key, output in msgspec.structs.asdict(scene.outputs).items():
        if output is not None:
            below("", output, f"scene {path}: outputs.{key}")
    return scene


def _check_nodes(scene: schema.Scene, place: str) -> None:
    ids = scene.node_ids
    twice = sorted({node_id for node_id in ids if ids.count(node_id) > 1})
    if twice:
        raise InputError(f"{place}: nodes: node-id {twice[0]} is given more than once")
    if not 1 <= len(ids) <= 32:
        raise InputError(f"{place}: nodes: {len(ids)} node-ids: allowed are 1 to 32")
    for number, group in enumerate(scene.nodes, 1):
        at = f"{place}: nodes[{number}]"
        if group.names and len(group.names) != len(group.ids):
            raise InputError(f"{at}.names has {len(group.names)} names: allowed are as many as ids, {len(group.ids)}")
        with placed(f"{at}.layout"):
            gauges = len(layout(group.layout))
        if group.offset_microstrain and len(group.offset_microstrain) != gauges:
            raise InputError(f"{at}.offset_microstrain has {len(group.offset_microstrain)} values: allowed is {gauges}")
        apparent = None if scene.front_end is None else scene.front_end.apparent_microstrain_per_degC
        if isinstance(apparent, tuple) and len(apparent) != gauges:
            has = f"has {len(apparent)} values: allowed is one number, or {gauges}, the gauges of nodes[{number}]"
            raise InputError(f"{place}: front_end.apparent_microstrain_per_degC {has}")
        if scene.dynamics is not None and group.sample_period_us % scene.dynamics.step_us:
            has = f"{group.sample_period_us}: allowed are multiples of the step of [dynamics], "
            raise InputError(f"{at}.sample_period_us is {has}{scene.dynamics.step_us} us")
        if group.filter == "moving_average" and group.filter_constant > LONGEST_WINDOW:
            raise InputError(f"{at}: moving_average of {group.filter_constant}: allowed are 1 to {LONGEST_WINDOW}")
        needs = [pdo for pdo in group.pdos if pdo in SYNCHRONOUS]
        if needs and scene.sync_hz is None:
            raise InputError(f"{at}.pdos: {needs[0]} is sent on SYNC: set sync_hz")


def _check_ids(scene: schema.Scene, ids: Iterable[int], at: str) -> None:
    for node_id in ids:
        if node_id not in scene.node_ids:
            known = ", ".join(map(str, scene.node_ids))
            raise InputError(f"{at}: node {node_id} is not in [[nodes]]; allowed: {known}")


def _check_loads(scene: schema.Scene, place: str) -> None:
    loaded: dict[int, int] = {}
    for number, load in enumerate(scene.loads, 1):
        at = f"{place}: loads[{number}]"
        _check_ids(scene, load.nodes, f"{at}.nodes")
        if isinstance(load, schema.Grasp):
            _check_ids(scene, (finger.node for finger in load.fingers), f"{at}.fingers")
        if isinstance(load, schema.Ramp) and not load.end_s > load.start_s:
            raise InputError(f"{at}.end_s is {load.end_s}: allowed is a time after start_s, {load.start_s}")
        if isinstance(load, schema.Tap):
            lasts_s, times = 1e-3 * (load.rise_ms + load.fall_ms), sorted(load.at_s)
            if not times or any(later - earlier < lasts_s for earlier, later in pairwise(times)):
                raise InputError(f"{at}.at_s is {times}: allowed are one or more times at least {lasts_s:g} s apart")
        for node_id in load.nodes or scene.node_ids:
            with placed(at):
                acts = load.history(node_id) is not None
            if acts and node_id in loaded:
                raise InputError(f"{at}: node {node_id} already has a load, loads[{loaded[node_id]}]: allowed is one")
            if acts:
                loaded[node_id] = number


def _check_faults(scene: schema.Scene, place: str) -> None:
    spans: dict[int, list[tuple[float, float]]] = {}
    for number, fault in enumerate(scene.faults, 1):
        at = f"{place}: faults[{number}]"
        _check_ids(scene, fault.nodes, f"{at}.nodes")
        until = scene.duration_s if fault.until_s is None else fault.until_s
        if not until > fault.at_s:
            raise InputError(f"{at}: it ends at {until} s: allowed is a time after at_s, {fault.at_s}")
        if not fault.nodes:
            raise InputError(f"{at}.nodes is []: allowed are one node or more")
        if fault.microstrain_per_s and fault.kind != "drift":
            raise InputError(f"{at}.microstrain_per_s: allowed only for a drift, this fault is {fault.kind!r}")
        for node_id in fault.nodes:
            gauges = len(layout(scene.group(node_id).layout))
            if fault.gauge > gauges:
                raise InputError(f"{at}.gauge is {fault.gauge}: node {node_id} has the gauges 1 to {gauges}")
            if any(start < until and fault.at_s < end for start, end in spans.get(node_id, ())):
                raise InputError(f"{at}: node {node_id} has another fault at that time: allowed is one (object 2200h)")
            spans.setdefault(node_id, []).append((fault.at_s, until))


def _check_expectations(scene: schema.Scene, place: str) -> None:
    flags = [name for name, _ in STATUS_BITS]
    for number, expect in enumerate(scene.expect, 1):
        at = f"{place}: expect[{number}]"
        _check_ids(scene, expect.nodes, f"{at}.nodes")
        for name in (*expect.status_seen, *expect.status_never):
            if name not in flags:
                raise InputError(f"{at}: {name!r} is not a bit of the status byte; allowed: {', '.join(flags)}")
        if expect.slit_closes is not None and scene.slit is None:
            raise InputError(f"{at}.slit_closes: needs a table [slit]")
        for code in expect.emcy_seen:
            if len(code) != 4 or not all(digit in "0123456789ABCDEF" for digit in code):
                raise InputError(f"{at}.emcy_seen: {code!r}: allowed are four hexadecimal digits, as 5010")
        until = scene.duration_s if expect.to_s is None else expect.to_s
        if not expect.from_s < until <= scene.duration_s:
            raise InputError(f"{at}: from {expect.from_s} s to {until} s: allowed are times within duration_s")
