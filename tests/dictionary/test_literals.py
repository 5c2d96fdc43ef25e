"""A wire fact has one declaration: a hexadecimal literal of one elsewhere fails here, with its place and its name."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from canopen_device.core import codes, communication, emcy
from tipforce.dictionary import indices, table
from tipforce.dictionary.entries import objects
from tipforce.sensor.contact import scalar

ROOT = Path(__file__).resolve().parents[2]
WALKED = (
    "node/canopen_device", "node/tipforce", "node/firmware", "tools/tipforce_lab", "tools/tipforce_robots",
    "tools/tipforce_tools",
)  # fmt: skip

COMMUNICATION, OWN_INDEX, IDENTIFIER = "index of the communication area", "index of the fingertip", "11-bit identifier"
WIDE, EMCY = "flag, mask, abort code, signature or product code", "EMCY error code"
ALLOWED = {
    "node/canopen_device/core/codes.py": (IDENTIFIER, WIDE),
    "node/canopen_device/core/communication.py": (COMMUNICATION, OWN_INDEX),  # also the ends of the other areas
    "node/canopen_device/core/emcy.py": (EMCY, IDENTIFIER),  # of IDENTIFIER: error classes of linux/can/error.h
    "node/canopen_device/core/sdo_block.py": (COMMUNICATION, EMCY),  # remainders of a polynomial
    "node/tipforce/dictionary/table.py": (OWN_INDEX, IDENTIFIER, WIDE, EMCY),  # of IDENTIFIER: offsets, product options
    "node/tipforce/dictionary/objects.py": (COMMUNICATION, OWN_INDEX),  # generated
    "node/tipforce/dictionary/indices.py": (OWN_INDEX,),
}
INDEPENDENT = "tools/tipforce_tools/fingertip_cases/"
"""The conformance cases state the standard's numbers a second time: a wrong one in ``codes`` must not pass them."""


def _integers(module: object) -> dict[int, str]:
    where = getattr(module, "__name__", "").removeprefix("tipforce.")
    found: dict[int, str] = {}
    for name, value in vars(module).items():
        for one in value if isinstance(value, tuple) else (value,):
            if name.isupper() and type(one) is int:
                found.setdefault(one, f"{where}.{name}")
    return found


NAMES_OF_INDICES = _integers(indices) | _integers(communication)
for view in objects(table.MAX_GAUGES, True):
    for form in ("INT16_FORM", "INT32_FORM"):
        real32 = view.index - getattr(table, form)
        if view.entries[-1].flags & table.VIEW and real32 in NAMES_OF_INDICES:
            NAMES_OF_INDICES[view.index] = f"{NAMES_OF_INDICES[real32]} + table.{form}"
ERROR_FRAME = (".CONTROLLER", ".BUS_OFF", ".RESTARTED", ".OVERFLOW", ".PASSIVE", ".WARNING", ".ACTIVE")  # no EMCY codes
NAMES_OF_EMCY = {
    value: name
    for value, name in (_integers(table) | _integers(emcy)).items()
    if (".emcy." in name or ".EMCY_" in name) and not name.endswith(ERROR_FRAME)
}
NAMES_OF_WIDE = {v: n for v, n in (_integers(table) | _integers(codes)).items() if v > 0xFFFFFF}
NAMES_OF_IDENTIFIERS = {v: n for v, n in _integers(codes).items() if n.endswith(("COB_ID", "BASE", "BASES", "MASK"))}


def wire_fact(text: str) -> tuple[str, str] | None:
    """(kind, name) of a hexadecimal literal that is a wire fact by its value and number of digits."""
    value, digits = int(text, 16), len(text.replace("_", "")) - 2
    index = value >> 8 if digits == 6 else value if digits == 4 else 0  # six digits: a key, index and sub-index
    name = NAMES_OF_INDICES.get(index, "")
    if communication.FIRST <= index <= communication.LAST:
        return COMMUNICATION, name or "core.communication"
    if name:
        return OWN_INDEX, name
    if digits == 4 and value in NAMES_OF_EMCY:
        return EMCY, NAMES_OF_EMCY[value]
    if digits == 8 and value in NAMES_OF_WIDE:
        return WIDE, NAMES_OF_WIDE[value]
    if digits == 3 and value <= codes.STANDARD_MASK:
        return IDENTIFIER, NAMES_OF_IDENTIFIERS.get(value, "a base of core.codes and a node-id")
    return None


def complaints(source: str, place: str, allowed: tuple[str, ...] = ()) -> Iterator[str]:
    """One line for each literal of a wire fact.

    The lower end of INTEGER32, -0x80000000, is none. 0x80 is one in a sum only (EMCY and a node-id): it is also an SDO
    and an LSS command and a bit.
    """
    nodes, lines = list(ast.walk(ast.parse(source))), source.splitlines()
    negated = {node.operand for node in nodes if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub)}
    sums = [node for node in nodes if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add)]
    added = {part for node in sums for part in (node.left, node.right)}
    for node in nodes:
        if not isinstance(node, ast.Constant) or type(node.value) is not int or node in negated:
            continue
        text = lines[node.lineno - 1].encode()[node.col_offset : node.end_col_offset].decode()
        base = node in added and node.value == codes.EMCY_BASE
        fact = wire_fact("0x080" if base else text) if text[:2] in ("0x", "0X") else None
        if fact is not None and fact[0] not in allowed:
            yield f"{place}:{node.lineno}: {text} is declared elsewhere ({fact[0]}): use {fact[1]}"


@pytest.mark.parametrize("folder", WALKED)
def test_no_literal_outside_its_declaration(folder: str) -> None:
    found: list[str] = []
    files = 0
    for path in sorted((ROOT / folder).rglob("*.py")):
        place = path.relative_to(ROOT).as_posix()
        if not place.startswith(INDEPENDENT):
            found += complaints(path.read_text(encoding="utf-8"), place, ALLOWED.get(place, ()))
            files += 1
    assert not found, "\n".join(found)
    assert files > 10


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("values[0x101400]", "core.communication.COB_ID_EMCY"),
        ("index in range(0x9130, n)", "dictionary.indices.PROCESS_VALUE + table.INT32_FORM"),
        ("can_id == node_id + 0x80", "core.codes.SYNC_COB_ID"),
        ("abort == 0x06090030", "core.codes.INVALID_VALUE"),
        ("code == 0x8130", "core.emcy.HEARTBEAT_LOST"),
    ],
)
def test_a_new_literal_is_found(line: str, name: str) -> None:
    source = f'"""Object 0x1017."""\n\nx = 0x7F  # not 0x1018\ny = {line}\n'.replace("y = SYNC", "SYNC")
    found = list(complaints(source, "sample"))
    assert len(found) == 1, found
    assert found[0].startswith("sample:4: 0"), found
    assert name in found[0]


def test_the_declarations_agree_with_the_table() -> None:
    found = objects(table.MAX_GAUGES, True)
    declared = set(NAMES_OF_INDICES)
    first_of_runs = {communication.RPDO, communication.RPDO_MAPPING, communication.TPDO, communication.TPDO_MAPPING}
    for one in found:
        pdo = communication.RPDO <= one.index <= communication.LAST_TPDO_MAPPING
        assert one.index in declared or (pdo and max(k for k in first_of_runs if k <= one.index) + 8 > one.index)
    own = {one.index for one in found if one.index > communication.LAST}
    views = {one.index for one in found if one.entries[-1].flags & table.VIEW}
    assert own - views == set(_integers(indices))
    assert views <= set(NAMES_OF_INDICES)


def test_status_bits_are_in_the_order_of_the_table() -> None:
    bits = (
        scalar.CONTACT_PRESENT, scalar.CALIBRATED, scalar.SATURATED, scalar.STALE,
        scalar.THETA_UNRESOLVED, scalar.MISSES_TIP, scalar.OUTSIDE_PAD, scalar.FRONT_END_FAULT,
    )  # fmt: skip
    assert bits == tuple(1 << k for k in range(len(table.STATUS_BITS)))
    names = ["contact", "calibrated", "saturated", "stale", "theta_unresolved", "misses_tip", "outside_pad", "fault"]
    assert [name for name, _ in table.STATUS_BITS] == names
