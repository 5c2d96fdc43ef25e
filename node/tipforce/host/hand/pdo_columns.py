"""The PDOs of a hand: where their counter is, and their signals from data words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import HEARTBEAT_BASE, SDO_RESPONSE_BASE
from tipforce.dictionary import indices
from tipforce.dictionary.signals import Message
from tipforce.host.decoding.columns import columns_of
from tipforce.host.decoding.decoder import FEW
from tipforce.host.decoding.packed_rows import packed_row

COUNTER = "counter"


class PdoColumns:
    """The signals of one PDO except its counter, for few words and for many."""

    def __init__(self, message: Message) -> None:
        self.cob_id_base, self.length_bytes = message.cob_id_base, message.length_bytes
        self.counter_shift = next(signal.start_bit for signal in message.signals if signal.name == COUNTER)
        self.stale_mask = sum(1 << signal.start_bit for signal in message.signals if signal.name == "stale")
        self._signals = tuple(signal for signal in message.signals if signal.name != COUNTER)
        self._pack, self._dtype = packed_row(self._signals)

    def columns(self, words: list[int]) -> dict[str, npt.NDArray[Any]]:
        """Return each signal (n,) of words (n,)."""
        if len(words) > FEW:
            return columns_of(np.array(words, dtype="<u8"), self._signals)
        pack = self._pack
        record = np.frombuffer(bytearray().join([pack(0, 0, word) for word in words]), self._dtype)
        return {signal.name: record[signal.name] for signal in self._signals}


def health_places(message: Message, node_ids: Sequence[int]) -> tuple[dict[int, tuple[int, int]], int]:
    """Return the identifiers that tell of changes, with finger and length; and the place of 2126h in a health PDO.

    These are health PDOs, SDO responses and heartbeats.
    """
    found = {}
    for k, node_id in enumerate(node_ids):
        found[HEARTBEAT_BASE + node_id] = k, 1
        found[SDO_RESPONSE_BASE + node_id] = k, 8
        found[message.cob_id_base + node_id] = k, message.length_bytes
    return found, next(s.start_bit for s in message.signals if s.index == indices.CONFIGURATION_COUNTER)
