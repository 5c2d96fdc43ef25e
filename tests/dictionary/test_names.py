"""Names that people write, names of signals; and a wire fact has one declaration: no literal of one elsewhere."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from canopen_device.core import codes, communication, emcy
from tipforce.dictionary import indices, names, table
from tipforce.dictionary.names import entries, objects
from tipforce.dictionary.signals import mapping_signals, rpdo_messages, tpdo_messages
from tipforce.errors import InputError
from tipforce.sensor.contact import scalar


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("calibration.generation", (0x2103, 4)), (" Calibration.Generation ", (0x2103, 4)),
        ("calibration.matrix:3", (0x2100, 3)), ("calibration.matrix.3", (0x2100, 3)),
        ("calibration.matrix:03", (0x2100, 3)), ("0x2103:04", (0x2103, 4)), ("0x2103:4", (0x2103, 4)),
        ("0x2103:0x04", (0x2103, 4)), ("2103h:04h", (0x2103, 4)), ("0x2103:00", (0x2103, 0)), ("0x2120", (0x2120, 0)),
        ("2120h", (0x2120, 0)), ("status", (0x2120, 0)), ("u_p", (0x2123, 0)), ("0x1A00:0", (0x1A00, 0)),
        ("tpdo1.mapping:2", (0x1A00, 2)), ("simulation.fault", (0x2200, 1)),
    ],
)  # fmt: skip
def test_resolves(text: str, place: tuple[int, int]) -> None:
    entry = names.resolve(text)
    assert (entry.index, entry.sub) == place


@pytest.mark.parametrize("n", [3, 5, 8])
def test_every_entry_resolves_from_both_of_its_names(n: int) -> None:
    for (index, sub), row in entries(n, True).items():
        for text in (row.name, f"0x{index:04X}:{sub:02X}"):
            entry = names.resolve(text, n)
            assert (entry.index, entry.sub, entry.type, entry.name) == (index, sub, row.type, row.name)
    # Decimal after a name, hexadecimal after an index.
    assert [names.resolve(text, 8).sub for text in ("calibration.matrix:10", "0x2100:0A", "0x2106:10")] == [10, 10, 16]


@pytest.mark.parametrize(
    ("text", "help_"),
    [
        ("calibraton.matrx:3", "calibration.matrix"), ("generation", "calibration.generation"),
        ("temprature", "temperature"), ("xyzzy", "write a name such as"), ("", "write a name such as"),
        ("8451", "write a name such as"), ("calibration.matrix", "SUB is 1-9"), ("calibration.matrix:10", "SUB is 1-9"),
        ("autotare:1", "SUB is 4"), ("0x2100:10", r"no sub-index 16 \(0x10\); allowed, in hex, with 3 gauges: 00-09"),
        ("0x1800:04", "00-03, 05-06"), ("0x2103", "several sub-indices"), ("0x2999", "no object 0x2999.*nearest"),
    ],
)  # fmt: skip
def test_suggestions(text: str, help_: str) -> None:
    with pytest.raises(InputError, match=help_):
        names.resolve(text)


def test_all_names() -> None:
    found = names.all_names(3)
    assert len(set(found)) == len(found)
    assert {"calibration.generation", "calibration.matrix:9"} <= set(found)
    assert "calibration.matrix:10" not in found


@pytest.mark.parametrize("n", range(3, 9))
def test_default_mappings_are_mappable_and_signals_lie_side_by_side_with_unique_names(n: int) -> None:
    messages = tpdo_messages(n) + rpdo_messages()
    assert sum(m.kind == "tpdo" for m in messages) == len(table.tpdos(n))
    for message in messages:
        taken: set[int] = set()
        for index, sub, bits in message.mapping:
            assert entries(n)[index, sub].flags & (table.TPDO if message.kind == "tpdo" else table.RPDO)
            assert table.mapped_bits(index) == bits
        for signal in message.signals:
            own = set(range(signal.start_bit, signal.start_bit + signal.bits))
            assert not own & taken
            taken |= own
        assert max(taken) < 8 * message.length_bytes <= 64
        assert len({s.name for s in message.signals}) == len(message.signals)


def test_other_mappings() -> None:
    real, wide = mapping_signals([(0x6130, 7, 32), (0x9130, 9, 32)])
    assert (real.name, real.real, real.scale, real.unknown) == ("P", True, 1.0, None)
    assert (wide.name, wide.bits, wide.start_bit, wide.unknown) == ("theta", 32, 32, -0x80000000)
    u_phi, status = mapping_signals([(0x2107, 2, 32), (0x6150, 8, 8)])
    assert (u_phi.name, u_phi.unit, u_phi.real, status.name) == ("u_phi", "degree", True, "phi_status")
    counts, clock = mapping_signals([(0x7100, 1, 16), (0x1013, 0, 32)])
    assert (counts.name, counts.unit) == ("SG1_counts", "counts")
    assert (clock.name, clock.start_bit, clock.unit) == ("time_high_resolution_us", 16, "us")


def test_channels_move_with_the_gauges_one_quantity_twice_gets_two_names_and_dummies_are_gaps() -> None:
    assert [mapping_signals([(0x7130, 7, 16)], n)[0].name for n in (3, 8)] == ["P", "SG7"]
    found = mapping_signals([(0x7130, 7, 16), (0x6130, 7, 32), (0x7130, 7, 16)])
    assert [s.name for s in found] == ["P", "P_6130", "P_7130"]
    assert len({s.name for s in mapping_signals([(0x2121, 0, 8)] * 4)}) == 4
    (force,) = mapping_signals([(0x0005, 0, 8), (0x7130, 7, 16)])
    assert force.start_bit == 8
    assert mapping_signals([]) == ()


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        ([(0x7130, 10, 16)], "0x7130:0A: no such object with 3 gauges"),
        ([(0x2100, 1, 32)], "can't be mapped"),
        ([(0x7130, 1, 8)], "8 bits, allowed is 16"),
        ([(0x6130, 1, 32)] * 3, "96 bits, allowed are at most 64"),
    ],
)
def test_impossible_mappings(mapping: list[tuple[int, int, int]], said: str) -> None:
    with pytest.raises(InputError, match=said):
        mapping_signals(mapping)


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
    and an LSS command and a bit."""
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
