"""The object reference as Markdown: every object, and the PDOs byte by byte."""

from __future__ import annotations

from tipforce.device import communication
from tipforce.dictionary import indices, signals, table, types
from tipforce.dictionary.eds import default_text, value_text
from tipforce.dictionary.rows import Object, Row, objects

_AREAS = (
    ("Communication area (CiA 301)", communication.FIRST, communication.LAST),
    ("Manufacturer area", communication.FIRST_MANUFACTURER, communication.LAST_MANUFACTURER),
    ("Profile area (CiA 404, analogue input)", communication.FIRST_PROFILE, 0xFFFF),
)
_INTRODUCTION = """\
# Object reference

Generated from `node/tipforce/dictionary/table.py` by `make generate`: change that, not this file.

For a node with {n} gauges; 2200h and 2201h are there on a simulated node only, 1F50h, 1F51h, 1F56h and 1F57h on
firmware with program slots only. A dotted name and its
sub-index (`calibration.matrix:3`) works wherever an index does. Sub-indices and sizes are decimal. PDO says
into which direction an entry may be mapped (T or R); *staged* entries form the calibration record, in this
order; a *state* is never stored; a change of a *counted* entry counts in 2126h. The numbers 6xxxh, 7xxxh and 9xxxh
of the profile area are one value as REAL32, INTEGER16 and INTEGER32. Everything is little-endian.

Unknown is 0x8000 in INTEGER16, 0x80000000 in INTEGER32, 0xFFFF in UNSIGNED16 and NaN in REAL32."""
_HEAD = (
    "| index | sub | name | dotted name | type | access | PDO | default | limits | unit | notes |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|"
)


def reference_markdown(n: int = 3) -> str:
    """The reference for ``n`` gauges, with the objects of a simulated node. Raises InputError outside 3..8."""
    found = objects(n, True, programs=True)
    parts = [_INTRODUCTION.format(n=n), _channels(n)]
    for title, first, last in _AREAS:
        lines = [line for o in found if first <= o.index <= last for line in _object(o)]
        parts.append("\n".join([f"## {title}", "", _HEAD, *lines]))
    parts.append(_status_bits(n))
    parts += [_pdo(message) for message in signals.tpdo_messages(n) + signals.rpdo_messages()]
    return "\n\n".join(parts) + "\n"


def _table(head: tuple[str, ...], lines: list[tuple[object, ...]]) -> str:
    shown = [" | ".join(head), "|".join("---" for _ in head), *(" | ".join(map(str, line)) for line in lines)]
    return "\n".join(f"|{line}|" if line.startswith("---") else f"| {line} |" for line in shown)


def _channels(n: int) -> str:
    head = ("sub", "channel", "what", "unit", "INTEGER16 and INTEGER32 resolution")
    lines: list[tuple[object, ...]] = [
        (k, c[0], c[1], c[5], f"{types.format_value('f', 10.0 ** -c[3])} {c[5]}")
        for k, c in enumerate(table.channels(n), 1)
    ]
    return f"## Channels of the profile area\n\n{_table(head, lines)}"


def _object(found: Object) -> list[str]:
    """One line for each run of sub-indices that differ in name and default alone."""
    lines = [] if found.code == table.VAR else [f"| {found.index:04X}h | | **{found.name}** | | | | | | | | |"]
    runs: list[list[Row]] = []
    for row in found.rows:
        if row.many and runs and runs[-1][0].slug == row.slug:
            runs[-1].append(row)
        else:
            runs.append([row])
    return lines + [_line(found, run) for run in runs]


def _line(found: Object, run: list[Row]) -> str:
    first, last = run[0], run[-1]
    sub = str(first.sub) if first is last else f"{first.sub}..{last.sub}"
    dotted = f"`{first.slug}`" if first.slug else ""
    if first.many:
        dotted = f"`{first.slug}:{sub}`" if first is last else f"`{first.slug}:SUB`"
    index = f"{first.index:04X}h" if found.code == table.VAR else ""
    name = first.name if first is last else _run_names(run)
    cells = (
        index, sub, name, dotted, types.data_type(first.letter).name, first.access, _pdo_cell(first),
        _defaults(run), _limits(first), first.unit, _notes(first),
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def _run_names(run: list[Row]) -> str:
    return f"{run[0].name} .. {run[-1].name}" if len(run) > 3 else ", ".join(row.name for row in run)


def _defaults(run: list[Row]) -> str:
    texts = [default_text(row) for row in run]
    if len(set(texts)) == 1:
        return texts[0].replace("$NODEID+", "node-id + ")
    while len(texts) > 1 and texts[-1] == texts[-2] == "0x00000000":
        texts.pop()
    return ", ".join(texts)


def _limits(row: Row) -> str:
    if row.low is None and row.high is None:
        return ""
    low = "" if row.low is None else value_text(row.letter, row.low)
    high = "" if row.high is None else value_text(row.letter, row.high)
    return f"{low} to {high}"


def _pdo_cell(row: Row) -> str:
    return ("T" if row.flags & table.TPDO else "") + ("R" if row.flags & table.RPDO else "")


def _notes(row: Row) -> str:
    notes = (
        (table.STAGED, "staged"),
        (table.NOT_STORED, "state"),
        (table.VIEW, "view of 6xxxh"),
        (table.COUNTED, "counted"),
    )
    return ", ".join(text for flag, text in notes if row.flags & flag)


def _status_bits(n: int) -> str:
    status: list[tuple[object, ...]] = [(k, f"`{bit[0]}`", bit[1]) for k, bit in enumerate(table.STATUS_BITS)]
    faults: list[tuple[object, ...]] = [
        (s.start_bit, f"`{s.name}`", s.description) for s in signals.mapping_signals([(indices.FAULTS, 0, 16)], n)
    ]
    head = ("bit", "signal", "meaning")
    return f"## Status byte 2120h\n\n{_table(head, status)}\n\n## Front-end faults 2124h\n\n{_table(head, faults)}"


def _pdo(message: signals.Message) -> str:
    state = "enabled" if message.enabled else "disabled"
    cob_id = f"0x{message.cob_id_base:03X} + node-id" if message.cob_id_base else "none assigned"
    timer = f", event timer {message.event_timer_ms} ms" if message.event_timer_ms else ""
    title = f"## {message.kind.upper()}{message.number} {message.name.lower()}"
    facts = f"COB-ID {cob_id}, {state}, transmission type {message.transmission_type}{timer}, " + (
        f"{message.length_bytes} bytes."
    )
    head = ("byte", "bit", "signal", "type", "resolution", "unit", "minimum", "maximum", "unknown (raw)", "object")
    return f"{title}\n\n{facts}\n\n{_table(head, [_signal_line(s) for s in message.signals])}"


def _signal_line(signal: signals.Signal) -> tuple[object, ...]:
    first, last = signal.start_bit // 8, (signal.start_bit + signal.bits - 1) // 8
    byte = str(first) if first == last else f"{first}..{last}"
    bit = str(signal.start_bit % 8) if signal.bits % 8 else ""
    kind = "bit" if signal.bits == 1 else f"{'I' if signal.signed else 'U'}{signal.bits}"
    unknown = "" if signal.unknown is None else signal.unknown
    place = f"{signal.index:04X}h:{signal.sub}"
    measured = (signal.scale, signal.unit, signal.minimum, signal.maximum) if signal.bits > 1 else ("", "", "", "")
    return (byte, bit, f"`{signal.name}`", kind, *measured, unknown, place)
