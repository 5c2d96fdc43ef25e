"""Sources of the PDOs to decode: the dictionary, DCF files, a DBC, or nodes read over SDO."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from tipforce.errors import InputError
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.decoding.health_rows import SERVICES
from tipforce.host.frames.frame_array import FRAME

EdsFiles: TypeAlias = tuple[tuple[int, str], ...]
"""Of devices of any manufacturer: (node-id, EDS or DCF)."""

_SUFFIXES = ("_N", "_deg", "_ue", "_degC")
COUNTER = "counter"


@dataclass(frozen=True, slots=True)
class Layouts:
    """A description that can be sent to another process. ``nodes`` None means all of them.

    ``pdos``: by node-id the PDOs that differ from the default, as (message name, can_id, mapping). ``eds``: (node-id,
    EDS or DCF) of devices of any manufacturer; then only their PDOs are decoded.
    """

    gauges: int = 3
    nodes: tuple[int, ...] | None = None
    dbc: str | None = None
    pdos: tuple[tuple[int, tuple[tuple[str, int, tuple[tuple[int, int, int], ...]], ...]], ...] = ()
    eds: EdsFiles = ()

    def decoder(self, services: bool = False) -> Decoder:
        """Return a separate decoder for each bus. Raises InputError for incompatible layouts.

        ``services``: of EMCY and heartbeats too (health_rows), except for a DBC.
        """
        if self.dbc is not None:
            from tipforce.host.decoding.pdo_layout import dbc_messages

            wanted = None if self.nodes is None else {*self.nodes}
            found = dbc_messages(self.dbc)
            return Decoder.of_messages({k: v for k, v in found.items() if wanted is None or k[0] in wanted})
        if self.eds:
            from tipforce.host.decoding.eds_decoder import EdsDecoder

            return EdsDecoder((node, path) for node, path in self.eds if self.nodes is None or node in self.nodes)
        nodes = range(1, 128) if self.nodes is None else self.nodes
        decoder = Decoder(self.gauges, nodes)
        for message in SERVICES if services else ():
            decoder.add(message, nodes)
        for node, pdos in self.pdos:
            if self.nodes is None or node in self.nodes:
                for name, can_id, mapping in pdos:
                    decoder.remap(node, name, can_id, mapping)
        return decoder


def with_dcf(layouts: Layouts, files: Iterable[str]) -> Layouts:
    """Use the PDOs of the nodes that DCF files describe. Raises InputError."""
    from tipforce.host.decoding.pdo_layout import dcf_layout

    return _with(layouts, [dcf_layout(path) for path in files])


def with_asked(layouts: Layouts, nodes: Sequence[int], options: dict[str, object]) -> Layouts:
    """Read the PDOs of nodes on a bus over SDO. Raises the errors of a connection."""
    from tipforce.host.decoding.pdo_layout import node_layout
    from tipforce.host.network.bus import Bus
    from tipforce.host.network.open_bus import open_bus

    with Bus(open_bus(**options)) as connection:
        return _with(layouts, [node_layout(connection.sdo(node)) for node in nodes])


def _with(layouts: Layouts, found: Sequence[object]) -> Layouts:
    from tipforce.host.decoding.pdo_layout import NodeLayout

    nodes = [layout for layout in found if isinstance(layout, NodeLayout)]
    gauges = {layout.gauges for layout in nodes}
    ids = [layout.node_id for layout in nodes]
    if len(set(ids)) < len(ids):
        raise InputError(f"node-ids {ids}: each node has one layout")
    if len(gauges) > 1:
        raise InputError(f"nodes with {sorted(gauges)} gauges: one decode needs nodes with the same number")
    pdos = tuple((n.node_id, tuple((name, i, mapping) for name, (i, mapping) in n.pdos.items())) for n in nodes)
    return Layouts(gauges.pop() if gauges else layouts.gauges, layouts.nodes, layouts.dbc, layouts.pdos + pdos)


def signals_named(decoder: Decoder, names: Iterable[str]) -> tuple[str, ...]:
    """Return the signals for some names: `P` and `P_N` are the same. Raises InputError for an unknown name."""
    found = []
    for name in names:
        bare = next((name.removesuffix(suffix) for suffix in _SUFFIXES if name.endswith(suffix)), name)
        signal = name if bare == name or has_signal(decoder, name) else bare
        if signal not in found:
            found.append(signal)
    decoder.decode(np.zeros(0, dtype=FRAME), found)
    return tuple(found)


def has_signal(decoder: Decoder, name: str) -> bool:
    """Return whether any message of the decoder has a signal."""
    try:
        decoder.decode(np.zeros(0, dtype=FRAME), [name])
    except InputError:
        return False
    return True
