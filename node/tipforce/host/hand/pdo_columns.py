"""The PDOs of a hand: where their counter is, and their signals from data words."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

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
