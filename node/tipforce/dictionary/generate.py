"""Write every file that is made from the table: ``python -m tipforce.dictionary.generate [ROOT]``. Besides EDS and DBC:
the object reference as Markdown, and ``objects.py``, a constant for each name in it (add ``NAME: Final``)."""

import itertools
import re
import sys
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from canopen_device import types
from canopen_device.core import communication
from tipforce.dictionary import indices, signals, table
from tipforce.dictionary.dbc import dbc_text
from tipforce.dictionary.eds import default_text, eds_text, value_text
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import Object, objects

_HEADER = '''\
"""Entries of the dictionary as typed constants, those that are used. Written by ``tipforce.dictionary.generate``.
Made for 3 gauges, simulated, with program slots. More gauges: the arrays are longer, names and indices are the same."""

from typing import Final

from tipforce.dictionary.entries import Array, Entry
'''


def accessors_text() -> str:
    """The module ``objects.py`` for its constants: an Entry, or an Array where several sub-indices share a name."""
    named = set(re.findall(r"^(\w+): Final", Path(__file__).with_name("objects.py").read_text("ascii"), re.M))
    lines = {"": _HEADER}
    for each in objects(table.MIN_GAUGES, True, programs=True):
        for entry in each.entries:
            name = entry.stem.replace(".", "_").upper()
            if name in named:
                kind, place = ("Array", "") if entry.is_counted else ("Entry", f"{entry.sub}, ")
                line = f"{name}: Final = {kind}[{types.data_type(entry.type).python.__name__}]("
                line += f'0x{entry.index:04X}, {place}"{entry.type}", "{entry.stem}", "{entry.access}", "{entry.unit}")'
                lines.setdefault(entry.stem, line)
    return "\n".join(lines.values()) + "\n"


_AREAS = (
    ("Communication area (CiA 301)", communication.FIRST, communication.LAST),
    ("Manufacturer area", communication.FIRST_MANUFACTURER, communication.LAST_MANUFACTURER),
    ("Profile area (CiA 404, analogue input)", communication.FIRST_PROFILE, 0xFFFF),
)
_INTRODUCTION = """\
# Object reference

Generated from `node/tipforce/dictionary/table_objects.py` by `make generate`, for a node with {n} gauges.

- A dotted name and its sub-index (`calibration.matrix:3`) works wherever an index does. Sub-indices and sizes are
  decimal, everything is little-endian. 2200h and 2201h are on a simulated node only, 1F50h to 1F57h on firmware with
  program slots only.
- Notes: *T* or *R*, the direction in which an entry may be mapped; *staged*, part of the calibration record, in this
  order; *state*, never stored; *counted*, a change counts in 2126h.
- A value of the profile area is 6xxxh as REAL32 and, where a note names it, 7xxxh as INTEGER16 and 9xxxh as INTEGER32:
  the same in the resolution of 6132h (field values: counts), with `_int16` or `_int32` after its dotted name.
- Unknown is 0x8000 in INTEGER16, 0x80000000 in INTEGER32, 0xFFFF in UNSIGNED16 and NaN in REAL32.
- Sub-index 0 of an array or record without a row is the highest sub-index (UNSIGNED8, const)."""
_HEAD, _BIT = ("index", "name", "dotted name", "type", "default", "notes"), ("bit", "signal", "meaning")
_CHANNEL = ("sub", "channel", "what", "unit", "INTEGER16 and INTEGER32 resolution")


def reference_markdown(n: int = 3) -> str:
    """The reference for ``n`` gauges, with the objects of a simulated node. Raises InputError outside 3..8."""
    declared = objects(n, True, programs=True)
    views = {each.index for each in declared if each.entries[-1].flags & table.VIEW}
    channels: list[tuple[object, ...]] = [
        (k, c[0], c[1], c[5], f"{types.format_value('f', 10.0 ** -c[3])} {c[5]}")
        for k, c in enumerate(table.channels(n), 1)
    ]
    parts = [_INTRODUCTION.format(n=n), f"## Channels of the profile area\n\n{_table(_CHANNEL, channels)}"]
    for title, first, last in _AREAS:
        lines = [
            line for o in declared if first <= o.index <= last and o.index not in views for line in _object(o, views)
        ]
        start = f'<details markdown="1" open>\n<summary>{len(lines)} entries</summary>'
        parts += [f"## {title}", start, _table(_HEAD, lines), "</details>"]
    for title, index in (("Status byte 2120h", indices.STATUS), ("Front-end faults 2124h", indices.FAULTS)):
        bits = signals.mapping_signals([(index, 0, table.mapped_bits(index))], n)
        parts.append(f"## {title}\n\n{_table(_BIT, [(s.start_bit, f'`{s.name}`', s.description) for s in bits])}")
    parts += [_pdo(message) for message in signals.tpdo_messages(n) + signals.rpdo_messages()]
    return "\n\n".join(parts) + "\n"


def _table(head: tuple[str, ...], lines: list[tuple[object, ...]]) -> str:
    shown = [" | ".join(head), "|".join("---" for _ in head), *(" | ".join(map(str, line)) for line in lines)]
    return "\n".join(f"|{line}|" if line.startswith("---") else f"| {line} |" for line in shown)


def _object(each: Object, views: Collection[int]) -> list[tuple[object, ...]]:
    """One line for each run of sub-indices that differ in name and default alone; those of a record carry its name."""
    runs: list[list[Entry[Any]]] = []
    for entry in each.entries:
        if entry.title == "Highest sub-index supported":
            continue  # the introduction says it once for all
        if entry.is_counted and runs and runs[-1][0].stem == entry.stem:
            runs[-1].append(entry)
        else:
            runs.append([entry])
    title = "" if each.code == table.VAR else f"**{each.name}**: "
    return [_line(title * (run is runs[0]), run, views) for run in runs]


def _line(title: str, run: list[Entry[Any]], views: Collection[int]) -> tuple[object, ...]:
    first, last = run[0], run[-1]
    sub = str(first.sub) if first is last else f"{first.sub}..{last.sub}"
    place = f"{first.index:04X}h" + (f":{sub}" if sub != "0" or title else "")
    shown = first.stem + (":SUB" if first is not last else f":{sub}" if first.is_counted else "")
    name = title + (f"{first.title} .. {last.title}" if len(run) > 3 else ", ".join(entry.title for entry in run))
    kind = f"{types.data_type(first.type).name} {first.access}"
    defaults = [default_text(entry) for entry in run]
    while len(defaults) > 1 and (len(set(defaults)) == 1 or defaults[-1] == defaults[-2] == "0x00000000"):
        defaults.pop()
    default = ", ".join(defaults).replace("$NODEID+", "node-id + ")
    return place, name, f"`{shown}`" if shown else "", kind, default, _notes(first, views)


def _notes(entry: Entry[Any], views: Collection[int]) -> str:
    flags = (
        (table.TPDO, "T"), (table.RPDO, "R"), (table.STAGED, "staged"), (table.NOT_STORED, "state"),
        (table.COUNTED, "counted"),
    )  # fmt: skip
    is_profile = entry.index >= communication.FIRST_PROFILE
    forms = [entry.index + form for form in (table.INT16_FORM, table.INT32_FORM)] if is_profile else []
    low, high = ("" if limit is None else value_text(entry.type, limit) for limit in (entry.low, entry.high))
    notes = [
        f"{low} to {high}" if low or high else "",
        entry.unit,
        *(text for flag, text in flags if entry.flags & flag),
    ]
    return ", ".join(filter(None, [*notes, *(f"{index:04X}h" for index in forms if index in views)]))


def _pdo(message: signals.Message) -> str:
    state = "enabled" if message.enabled else "disabled"
    cob_id = f"0x{message.cob_id_base:03X} + node-id" if message.cob_id_base else "none assigned"
    timer = f", event timer {message.event_timer_ms} ms" if message.event_timer_ms else ""
    title = f"## {message.kind.upper()}{message.number} {message.name.lower()}"
    facts = f"COB-ID {cob_id}, {state}, transmission type {message.transmission_type}{timer}"
    head = ("byte", "signal", "type", "resolution", "minimum", "maximum", "unknown", "object")
    return f"{title}\n\n{facts}, {message.length_bytes} bytes.\n\n{_table(head, list(_signal_lines(message.signals)))}"


def _signal_lines(mapped: Sequence[signals.Signal]) -> Iterator[tuple[object, ...]]:
    """A line for each signal; the bits of one object, whose meanings the tables above have, share one."""
    for (index, sub), group in itertools.groupby(mapped, lambda signal: (signal.index, signal.sub)):
        run = list(group)
        first, last = run[0].start_bit // 8, (run[-1].start_bit + run[-1].bits - 1) // 8
        byte = str(first) if first == last else f"{first}..{last}"
        place = f"{index:04X}h:{sub}"
        for signal in run:
            if signal.bits == 1:
                yield byte, ", ".join(f"`{bit.name}`" for bit in run), "bits", "", "", "", "", place
                break
            kind = f"{'I' if signal.signed else 'U'}{signal.bits}"
            unknown = "" if signal.unknown is None else signal.unknown
            measured = (f"{signal.scale} {signal.unit}".strip(), signal.minimum, signal.maximum, unknown)
            yield byte, f"`{signal.name}`", kind, *measured, place


def generated_files() -> dict[str, str]:
    """The text of each generated file by its path from the root of the project, with forward slashes."""
    return {
        "eds/tipforce-3.eds": eds_text(3, False),
        "dbc/tipforce.dbc": dbc_text(),
        "docs/objects.md": reference_markdown(3),
        "node/tipforce/dictionary/objects.py": accessors_text(),
    }


def main(arguments: list[str]) -> int:
    """Write the files that differ, below the root, and print them, one a line; 0 done, 2 usage. Raises OSError."""
    if len(arguments) > 1 or arguments[:1] in (["-h"], ["--help"]):
        print("usage: python -m tipforce.dictionary.generate [ROOT]", file=sys.stderr)
        return 2
    for name, text in generated_files().items():
        path, data = Path(*arguments) / name, text.encode("ascii")
        if not path.is_file() or path.read_bytes() != data:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
