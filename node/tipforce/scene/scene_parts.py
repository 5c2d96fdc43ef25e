"""List the parts that a scene needs and omits: each with its key in the file and the modules that it loads.

`tipforce scene explain` prints this; the tests compare it with what a run built, loaded and sent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from tipforce.device.codes import HEARTBEAT_BASE, NMT_COB_ID, SYNC_COB_ID
from tipforce.scene import schema
from tipforce.scene.build import node_pdos
from tipforce.scene.check import SYNCHRONOUS
from tipforce.scene.imports import loaded_by
from tipforce.scene.loads import load_of
from tipforce.sensor.structure.layouts import layout

# Modules imported for a part in addition to those already loaded; imports.py follows each.
_STRUCTURE = ("tipforce.sensor.structure.strain",)
_CALIBRATION = ("tipforce.host.configuration.calibration",)
_OBJECTS = (  # the dictionary imports these where a node is made
    "tipforce.dictionary.table_communication", "tipforce.dictionary.table_fingertip",
    "tipforce.dictionary.table_profile",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a scene."""

    name: str
    built: bool
    why: str
    """The key that names it, or the missing key."""
    modules: tuple[str, ...] = ()
    """Modules that it loads; third-party packages by package name."""
    on_demand: tuple[str, ...] = ()
    """Modules that it may load during the run."""


@dataclass(frozen=True, slots=True)
class Identifier:
    """A COB-ID that a scene sends."""

    can_id: int
    what: str
    rate_hz: float
    """0: once, or on an event."""
    data_bytes: int

    @property
    def bits(self) -> tuple[int, int]:
        """Bits of one frame on the wire, interframe space included: without stuff bits, and with the maximum."""
        bits = 47 + 8 * self.data_bytes
        return bits, bits + (33 + 8 * self.data_bytes) // 4


def parts(scene: schema.Scene) -> list[Part]:
    """Return every possible part, built or not, in signal order."""
    return [*_loads(scene), *_electronics(scene), *_nodes(scene), *_after(scene)]


def computes(group: schema.Nodes) -> tuple[str, str]:
    """Return why a node computes force and contact: the first reason of each, empty if it does not.

    The status byte 2120h contains the contact bit, so a calibrated node that sends it must compute the contact.
    """
    if group.calibration == "none" or not group.pdos:
        return "", ""
    status = "status byte 2120h" if group.status and set(group.pdos) & set(SYNCHRONOUS) else ""
    contact = "contact PDO" if "contact" in group.pdos else status
    force = next((f"{name} PDO" for name in ("force", "contact") if name in group.pdos), status)
    if not force and "health" in group.pdos:
        force = "health PDO (2123h)"
    return force, contact


def _part(name: str, why: str | None, without: str, *modules: str) -> Part:
    """Return a part, built with the reason ``why``, or omitted with the reason ``without``."""
    return Part(name, bool(why), why or without, loaded_by(*modules))


def _loads(scene: schema.Scene) -> Iterator[Part]:
    found = [load_of(scene, node_id) for node_id in scene.node_ids]
    loaded = any(load is not None for load in found)
    moving = any(load is not None and not load.constant for load in found)
    swinging = scene.dynamics is not None and loaded
    published = any(isinstance(load, schema.Grooves) for load in scene.loads)
    yield _part("structure", "[[loads]]" if loaded else "", "no [[loads]]: the gauges are unloaded", *_STRUCTURE)
    yield _part(
        "load history",
        "[[loads]] that change" if moving else "[dynamics]" if swinging else "",
        "every load is static" if loaded else "no [[loads]]",
        *(("tipforce.sensor.structure.published",) if published else ()),
    )
    yield _part(
        "dynamics",
        "[dynamics]" if swinging else "",
        "no [[loads]]" if scene.dynamics else "no [dynamics]: the gauges follow the load without delay",
        "tipforce.scene.motion",
    )


def _electronics(scene: schema.Scene) -> Iterator[Part]:
    front, noise = scene.front_end, scene.noise or schema.Noise()
    white, pink = noise.gauge_microstrain, noise.one_over_f_microstrain
    named = "[front_end]" if front else "noise.one_over_f_microstrain" if pink else ""
    temperature = front is not None and front.temperature_degC is not None
    yield _part(
        "noise",
        f"noise.gauge_microstrain = {white:g}" if white else "",
        "no noise.gauge_microstrain: no random numbers",
        "random",
    )
    yield _part(
        "1/f noise",
        f"noise.one_over_f_microstrain = {pink:g}" if pink else "",
        "no noise.one_over_f_microstrain",
        "random",
    )
    yield _part("front end", named, "no [front_end]: an ideal converter of 16 bits", "tipforce.sources.front_end")
    yield _part("temperature", "front_end.temperature_degC" if temperature else "", "no front_end.temperature_degC")


def _nodes(scene: schema.Scene) -> Iterator[Part]:
    groups = scene.nodes
    calibrated = [group.calibration for group in groups if group.calibration != "none"]
    file = next((name for name in calibrated if name != "model"), "")
    filtered = next((group.filter for group in groups if group.filter), None)
    force, contact = (next((why for why in reasons if why), "") for reasons in zip(*map(computes, groups), strict=True))
    yield _part(
        "nodes", f"[[nodes]]: {len(scene.node_ids)}", "", "tipforce.scene.run", "tipforce.scene.check", *_OBJECTS
    )
    yield _part(
        "calibration",
        f'nodes.calibration = "{calibrated[0]}"' if calibrated else "",
        'nodes.calibration = "none"',
        *(_CALIBRATION if calibrated else ()),
        *(_STRUCTURE if "model" in calibrated else ()),
    )
    yield _part(
        "calibration file", f'"{file}"' if file else "", "none is named", "tipforce.host.configuration.calibration_file"
    )
    yield _part(
        "filter", f'nodes.filter = "{filtered}"' if filtered else "", "no nodes.filter", "tipforce.fingertip.filters"
    )
    nobody = "" if calibrated else "no node is calibrated"
    yield _part("force in the node", force, nobody or "no PDO that has or needs it")
    yield _part("contact in the node", contact, nobody or "no contact PDO, and no status byte 2120h that needs it")
    spare = any(group.calibration != "none" and len(layout(group.layout)) > 3 for group in groups)
    yield Part(
        "spare gauges",
        spare,
        "a calibrated layout of more than 3 gauges; used after the loss of one"
        if spare
        else "no calibrated node has more than 3",
        on_demand=loaded_by("tipforce.sensor.contact.scalar_redundancy"),
    )
    yield _part("SYNC", f"sync_hz = {scene.sync_hz:g}" if scene.sync_hz else "", "no sync_hz")
    yield _part("faults", f"[[faults]]: {len(scene.faults)}" if scene.faults else "", "no [[faults]]")


def _slit(scene: schema.Scene) -> Part:
    return _part(
        "slit",
        f"slit.gap_mm = {scene.slit.gap_mm:g}" if scene.slit else "",
        "no [slit]: not checked",
        "tipforce.scene.slit",
    )


def _after(scene: schema.Scene) -> Iterator[Part]:
    """Yield the parts that process the frames."""
    out, bus = scene.outputs, scene.bus
    pdos = list(dict.fromkeys(pdo for group in scene.nodes for pdo in group.pdos))
    named = bus.interface or bus.channel or "python-can's configuration" if bus else ""
    yield _part(
        "bus", f"[bus]: {named}" if bus else "", "no [bus]: simulated time, no bus at all", "tipforce.scene.realtime"
    )
    yield _part(
        "recording", "every frame, for the parts below", "", "tipforce.scene.recording", "tipforce.scene.results"
    )
    yield _part(
        "decoder", f"nodes.pdos: {', '.join(pdos)}" if pdos else "", "no nodes.pdos", "tipforce.host.decoding.decoder"
    )
    yield _slit(scene)
    yield _part(
        "expectations",
        f"[[expect]]: {len(scene.expect)}" if scene.expect else "",
        "no [[expect]]",
        "tipforce.scene.expectations",
    )
    yield _part(
        "log",
        f'outputs.log = "{out.log}"' if out.log else "",
        "no outputs.log: no file",
        "tipforce.host.logs.candump",
        "tipforce.host.logs.candump_format",
    )
    yield _part(
        "table", f'outputs.table = "{out.table}"' if out.table else "", "no outputs.table: no file",
        "tipforce.scene.table_file",
    )  # fmt: skip
    yield _part(
        "plot", f'outputs.plot = "{out.plot}"' if out.plot else "", "no outputs.plot: no matplotlib",
        "tipforce.scene.plot", "matplotlib",
    )  # fmt: skip


def identifiers(scene: schema.Scene) -> list[Identifier]:
    """Return every COB-ID that a run is certain to send, in order."""
    found = [Identifier(NMT_COB_ID, "NMT start", 0.0, 2)]
    if scene.sync_hz is not None:
        found.append(Identifier(SYNC_COB_ID, "SYNC", scene.sync_hz, 0))
    for node_id in scene.node_ids:
        group = scene.group(node_id)
        for pdo in node_pdos(group, node_id):
            rate_hz = 1e3 / pdo.event_ms if pdo.event_ms else scene.sync_hz or 0.0
            found.append(Identifier(pdo.can_id, f"node {node_id} {pdo.name}", rate_hz, pdo.length))
        beat = 1e3 / group.heartbeat_ms if group.heartbeat_ms else 0.0
        what = "boot-up, heartbeat" if beat else "boot-up"
        found.append(Identifier(HEARTBEAT_BASE + node_id, f"node {node_id} {what}", beat, 1))
    return sorted(found, key=lambda one: one.can_id)


def bus_load(scene: schema.Scene) -> tuple[float, float]:
    """Return the share of the scene's bit rate, without stuff bits and with the maximum; above 1 it does not fit."""
    sums = [sum(one.rate_hz * one.bits[k] for one in identifiers(scene)) for k in (0, 1)]
    return sums[0] / scene.bit_rate, sums[1] / scene.bit_rate
