"""The parts of a scene: the key that names each, why it is left out, its modules, and the frames that a run sends.
``parts`` is the one list: for a run, `tipforce run --explain` and the measurement of costs."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec, resolve_name
from pathlib import Path

from canopen_device.can_frame import least_bits, most_bits
from canopen_device.core.codes import HEARTBEAT_BASE, NMT_COB_ID, SYNC_COB_ID
from tipforce.dictionary import indices, table
from tipforce.scene import schema
from tipforce.sensor.structure.layouts import layout

SYNCHRONOUS = ("gauges", "contact", "force")
_STATUS = (indices.STATUS, 0)
_OWN = ("tipforce", "canopen_device")
_CONFIGURED = "python-can's configuration"

Mapping = tuple[tuple[int, int, int], ...]  # (index, sub, bits)


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a scene."""

    name: str
    built: bool
    why: str
    """The key that names it, or the missing key."""
    imports: tuple[str, ...] = ()
    on_demand_imports: tuple[str, ...] = ()

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules that it loads; third-party packages by package name."""
        return loaded_by(*self.imports)

    @property
    def on_demand(self) -> tuple[str, ...]:
        """Modules that it may load during the run."""
        return loaded_by(*self.on_demand_imports)


# Modules imported for a part in addition to those already loaded.
_STRUCTURE = ("tipforce.sensor.structure.strain",)
_BUS = ("tipforce.scene.realtime", "canopen_device.running.ports")
_DYNAMICS = (
    "tipforce.sensor.dynamics.first_order_hold", "tipforce.sensor.dynamics.model", "tipforce.sources.dynamic_load",
)  # fmt: skip
_NODES = (  # the dictionary imports its tables where a node is made
    "tipforce.scene.run", "tipforce.scene.reader", "tipforce.dictionary.table_objects",
)  # fmt: skip
# In the order in which they are built: of each node, and of the run.
_OF_A_NODE = (
    "nodes", "filter", "noise", "front end", "1/f noise", "temperature", "structure", "load history", "dynamics",
    "calibration", "calibration file",
)  # fmt: skip
_OF_THE_RUN = (
    "recording", "SYNC", "faults", "slit", "log", "bus", "decoder", "expectations", "table", "plot",
)  # fmt: skip


def parts(scene: schema.Scene, node_id: int | None = None) -> list[Part]:
    """Return every possible part of the scene, or of one node in it, built or not, in signal order."""
    node_ids = scene.node_ids if node_id is None else (node_id,)
    groups = scene.nodes if node_id is None else (scene.group(node_id),)
    loads = [scene.load(each) for each in node_ids]
    return [*_load_parts(scene, loads), *_electronics(scene), *_node_parts(scene, groups), *_frame_parts(scene, groups)]


def chosen_parts(scene: schema.Scene, node_id: int | None = None) -> frozenset[str]:
    """Return the names of the parts that the scene, or one node in it, needs."""
    return frozenset(part.name for part in parts(scene, node_id) if part.built)


def built_parts(scene: schema.Scene, *more: str) -> tuple[str, ...]:
    """Return the names of the parts that a run makes, with ``more``, in the order in which it first does."""
    of_nodes = (chosen_parts(scene, node_id) for node_id in scene.node_ids)
    built = [name for chosen in of_nodes for name in _OF_A_NODE if name in chosen]
    chosen = chosen_parts(scene).union(more)
    return tuple(dict.fromkeys([*built, *(name for name in _OF_THE_RUN if name in chosen)]))


def computes(group: schema.Nodes) -> tuple[str, str]:
    """Return why a node computes force and contact: the first reason of each, empty if it does not. The status byte
    2120h contains the contact bit, so a calibrated node that sends it must compute the contact."""
    if group.calibration == "none" or not group.pdos:
        return "", ""
    status = "status byte 2120h" if group.status and set(group.pdos) & set(SYNCHRONOUS) else ""
    contact = "contact PDO" if "contact" in group.pdos else status
    force = next((f"{name} PDO" for name in ("force", "contact") if name in group.pdos), status)
    if not force and "health" in group.pdos:
        force = "health PDO (2123h)"
    return force, contact


def _part(name: str, why: str | None, without: str, *modules: str) -> Part:
    return Part(name, bool(why), why or without, modules)


def _keyed(name: str, key: str, value: object, *modules: str, without: str = "") -> Part:
    """Return a part that a key of the scene names by its value; ``without`` follows the key where there is none."""
    shown = f'"{value}"' if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else value
    return _part(name, f"{key} = {shown}" if value else "", f"no {key}{without}", *modules)


def _listed(name: str, key: str, items: Sequence[object]) -> Part:
    return _part(name, f"{key}: {len(items)}" if items else "", f"no {key}")


def _load_parts(scene: schema.Scene, loads: Sequence[schema.LoadHistory | None]) -> Iterator[Part]:
    loaded = any(load is not None for load in loads)
    moving = any(load is not None and not load.constant for load in loads)
    swinging = scene.dynamics is not None and loaded
    why = "[[loads]] that change" if moving else "[dynamics]" if swinging else ""
    yield _part("structure", "[[loads]]" if loaded else "", "no [[loads]]: the gauges are unloaded", *_STRUCTURE)
    yield _part("load history", why, "every load is static" if loaded else "no [[loads]]")
    without = "no [[loads]]" if scene.dynamics else "no [dynamics]: the gauges follow the load without delay"
    yield _part("dynamics", "[dynamics]" if swinging else "", without, *_DYNAMICS)


def _electronics(scene: schema.Scene) -> Iterator[Part]:
    front, noise = scene.front_end, scene.noise or schema.Noise()
    white, pink, temperature = noise.gauge_microstrain, noise.one_over_f_microstrain, "front_end.temperature_degC"
    why = "[front_end]" if front else "noise.one_over_f_microstrain" if pink else ""
    yield _keyed("noise", "noise.gauge_microstrain", white, "random", without=": no random numbers")
    yield _keyed("1/f noise", "noise.one_over_f_microstrain", pink, "random")
    yield _part("front end", why, "no [front_end]: an ideal converter of 16 bits", "tipforce.sources.front_end")
    known = front is not None and front.temperature_degC is not None
    yield _part("temperature", temperature if known else "", f"no {temperature}")


def _node_parts(scene: schema.Scene, groups: Sequence[schema.Nodes]) -> Iterator[Part]:
    calibrated = [group.calibration for group in groups if group.calibration != "none"]
    file = next((name for name in calibrated if name != "model"), None)
    filtered = next((group.filter for group in groups if group.filter), None)
    force, contact = (next((why for why in reasons if why), "") for reasons in zip(*map(computes, groups), strict=True))
    modules = ["tipforce.host.configuration.calibration"] if calibrated else []
    modules += _STRUCTURE if "model" in calibrated else ()
    why = f'nodes.calibration = "{calibrated[0]}"' if calibrated else ""
    named = "" if file is None else f'"{file}"'
    nobody = "" if calibrated else "no node is calibrated"
    yield _part("nodes", f"[[nodes]]: {len(scene.node_ids)}", "", *_NODES)
    yield _part("calibration", why, 'nodes.calibration = "none"', *modules)
    yield _part("calibration file", named, "none is named", "tipforce.host.configuration.calibration_file")
    yield _keyed("filter", "nodes.filter", filtered, "tipforce.fingertip.filters")
    yield _part("force in the node", force, nobody or "no PDO that has or needs it")
    yield _part("contact in the node", contact, nobody or "no contact PDO, and no status byte 2120h that needs it")
    spare = any(group.calibration != "none" and len(layout(group.layout)) > 3 for group in groups)
    why = "a calibrated layout of more than 3 gauges; used after the loss of one"
    redundancy = ("tipforce.sensor.contact.scalar_redundancy",)
    yield Part("spare gauges", spare, why if spare else "no calibrated node has more than 3", (), redundancy)
    yield _keyed("SYNC", "sync_hz", scene.sync_hz)
    yield _listed("faults", "[[faults]]", scene.faults)


def _frame_parts(scene: schema.Scene, groups: Sequence[schema.Nodes]) -> Iterator[Part]:
    out, bus, gap_mm = scene.outputs, scene.bus, scene.slit.gap_mm if scene.slit else None
    pdos = list(dict.fromkeys(pdo for group in groups for pdo in group.pdos))
    named = f"[bus]: {bus.interface or bus.channel or _CONFIGURED}" if bus else ""
    sent = f"nodes.pdos: {', '.join(pdos)}" if pdos else ""
    slit = f"slit.gap_mm = {gap_mm:g}" if gap_mm else ""
    yield _part("bus", named, "no [bus]: simulated time, no bus at all", *_BUS)
    yield _part("recording", "every frame, for the parts below", "", "tipforce.scene.results")
    yield _part("decoder", sent, "no nodes.pdos", "tipforce.host.decoding.decoder")
    yield _part("slit", slit, "no [slit]: not checked", "tipforce.sensor.structure.plane_frame")
    yield _listed("expectations", "[[expect]]", scene.expect)
    yield _keyed("log", "outputs.log", out.log, "tipforce.host.logs.candump_format", without=": no file")
    yield _keyed("table", "outputs.table", out.table, without=": no file")
    yield _keyed("plot", "outputs.plot", out.plot, "matplotlib", without=": no matplotlib")


@dataclass(frozen=True, slots=True)
class Pdo:
    """A TPDO that a node sends: ``mapping`` is set only if it is not the default one."""

    name: str
    number: int
    can_id: int
    mapping: Mapping
    remapped: bool
    transmission: int
    event_ms: int

    @property
    def length(self) -> int:
        """Data bytes."""
        return sum(bits for _, _, bits in self.mapping) // 8


def node_pdos(group: schema.Nodes, node_id: int) -> tuple[Pdo, ...]:
    """Return the TPDOs that a node sends, in order."""
    wanted = {name.capitalize() for name in group.pdos}
    sent = []
    for number, name, base, _enabled, transmission, event_ms, mapped in table.tpdos(len(layout(group.layout))):
        if name in wanted:
            default = tuple((index, sub, table.mapped_bits(index)) for index, sub in mapped)
            mapping = default if group.status else tuple(entry for entry in default if entry[:2] != _STATUS)
            sent.append(Pdo(name, number, base + node_id, mapping, mapping != default, transmission, event_ms))
    return tuple(sent)


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
        return least_bits(self.data_bytes), most_bits(self.data_bytes)


def identifiers(scene: schema.Scene) -> list[Identifier]:
    """Return every COB-ID that a run is certain to send, in order."""
    sent = [Identifier(NMT_COB_ID, "NMT start", 0.0, 2)]
    if scene.sync_hz is not None:
        sent.append(Identifier(SYNC_COB_ID, "SYNC", scene.sync_hz, 0))
    for node_id in scene.node_ids:
        group = scene.group(node_id)
        for pdo in node_pdos(group, node_id):
            rate_hz = 1e3 / pdo.event_ms if pdo.event_ms else scene.sync_hz or 0.0
            sent.append(Identifier(pdo.can_id, f"node {node_id} {pdo.name}", rate_hz, pdo.length))
        beat = 1e3 / group.heartbeat_ms if group.heartbeat_ms else 0.0
        what = "boot-up, heartbeat" if beat else "boot-up"
        sent.append(Identifier(HEARTBEAT_BASE + node_id, f"node {node_id} {what}", beat, 1))
    return sorted(sent, key=lambda identifier: identifier.can_id)


def bus_load(scene: schema.Scene) -> tuple[float, float]:
    """Return the share of the scene's bit rate, without stuff bits and with the maximum; above 1 it does not fit."""
    sent = identifiers(scene)
    sums = [sum(identifier.rate_hz * identifier.bits[k] for identifier in sent) for k in (0, 1)]
    return sums[0] / scene.bit_rate, sums[1] / scene.bit_rate


def loaded_by(*names: str) -> tuple[str, ...]:
    """Return the project's modules and the third-party packages (by top-level name) that importing ``names`` loads:
    sorted, without imports in functions and under ``if TYPE_CHECKING``; of the standard library only ``names``."""
    modules: set[str] = set()
    pending = list(names)
    while pending:
        name = pending.pop()
        if name in modules:
            continue
        modules.add(name)
        if name.partition(".")[0] in _OWN:
            pending += _imports(name)
    return tuple(sorted(modules))


@cache
def _imports(name: str) -> tuple[str, ...]:
    spec = find_spec(name)
    assert spec is not None, name
    assert spec.origin is not None, name
    parent = name.rpartition(".")[0]
    package = name if spec.submodule_search_locations is not None else parent
    modules = {parent} if parent else set()
    for node in _statements(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            module = resolve_name("." * node.level + (node.module or ""), package)
            inside = [f"{module}.{alias.name}" for alias in node.names]
            names = [inner if _is_module(inner) else module for inner in inside]
        roots = {name: name.partition(".")[0] for name in names}
        modules |= {name for name, root in roots.items() if root in _OWN}
        modules |= {root for root in roots.values() if root not in _OWN and root not in sys.stdlib_module_names}
    return tuple(modules)


def _statements(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            continue
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from _statements(node)


def _is_module(name: str) -> bool:
    folder = Path(__file__).parents[2].joinpath(*name.split("."))
    return name.partition(".")[0] in _OWN and (folder.with_suffix(".py").exists() or (folder / "__init__.py").exists())
