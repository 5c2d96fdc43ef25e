"""Write tables as MCAP: a channel of JSON messages per node, with a schema, for Foxglove and other MCAP readers."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mcap.writer

from tipforce.host.decoding.sample_table import NODE_BITS, Column, Table
from tipforce.output_file import MCAP, NewFile
from tipforce_tools.decode import text_rows

_TYPES = {"real": "number", "flag": "boolean", "integer": "integer", "word": "string"}


class McapWriter:
    """Channels ``/tipforce/can0/node_5``, one message per sample, logged at its receive time."""

    def __init__(self, path: Path, base: tuple[str, ...], inputs: Iterable[str] = ()) -> None:
        """Raises InputError."""
        self._file = NewFile(path, MCAP, inputs)
        self._base = base
        self._stream = self._file.partial.open("wb")
        self._writer = mcap.writer.Writer(self._stream)
        self._writer.start(profile="", library="tipforce")
        self._ids: dict[tuple[str, int, tuple[Column, ...]], int] = {}
        self._sequence: dict[int, int] = {}

    def write(self, table: Table) -> None:
        """Append the rows of a table."""
        lines = text_rows.json_rows(table, self._base).splitlines()
        for line, t_ns, key in zip(lines, table.t_ns.tolist(), table.key.tolist(), strict=True):
            node, name = key & ((1 << NODE_BITS) - 1), table.channels[key >> NODE_BITS]
            place = self._channel(name, node, table.columns)
            number = self._sequence[place] = self._sequence.get(place, -1) + 1
            self._writer.add_message(place, t_ns, line, t_ns, number)

    def _channel(self, name: str, node: int, columns: tuple[Column, ...]) -> int:
        known = self._ids.get((name, node, columns))
        if known is not None:
            return known
        properties: dict[str, Any] = {base: {"type": ["number", "null"]} for base in self._base}
        for column in columns:
            properties[column.name] = {"type": [_TYPES[column.kind], "null"]}
            if column.unit:
                properties[column.name]["description"] = column.unit
        schema = json.dumps({"title": "tipforce.Sample", "type": "object", "properties": properties}).encode()
        schema_id = self._writer.register_schema(name="tipforce.Sample", encoding="jsonschema", data=schema)
        topic = f"/tipforce/{name}/node_{node}"
        found = self._writer.register_channel(topic=topic, message_encoding="json", schema_id=schema_id)
        self._ids[name, node, columns] = found
        return int(found)

    def close(self) -> None:
        """Complete the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()
        self._file.keep()

    def abort(self) -> None:
        """Remove the file."""
        self._stream.close()
        self._file.drop()
