"""Sample counters of nodes over a whole recording in blocks: unwrapped, with gaps counted as lost samples."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.decoder import Samples, lost_samples, unwrap_counter
from tipforce.host.decoding.plan import Key
from tipforce.host.decoding.sync_modulus import SAMPLES

COUNTER = "counter"
_LAST_CYCLIC_TYPE = 240  # CiA 301, table 72: up to this type a PDO follows SYNC


class SampleCounters:
    """Continue counting from block to block, per message of each node.

    ``frames`` and ``lost`` count by (node-id, message name); ``lost`` only for PDOs sent on SYNC, for which each
    sample is due. Without a counter among the decoded columns, nothing is counted as lost.
    """

    def __init__(self) -> None:
        self.frames: dict[Key, int] = {}
        self.lost: dict[Key, int] = {}
        self._modulus = SAMPLES
        self._last: dict[Key, tuple[npt.NDArray[np.uint8], int]] = {}

    def add(self, found: Mapping[Key, Samples], modulus: int = SAMPLES) -> None:
        """Count the decoded samples of a block of frames; ``modulus`` of their counters: see ``SyncModulus``."""
        for key, samples in found.items():
            self.unwrapped(key, samples, modulus)

    def unwrapped(self, key: Key, samples: Samples, modulus: int = SAMPLES) -> npt.NDArray[np.int64] | None:
        """Count the samples of one message, and return their unwrapped counter: (k,), or None.

        It continues from the previous block, and starts with the very first value. Where the modulus is another one
        than before, nothing is counted as lost in between.
        """
        if modulus != self._modulus:
            self._modulus = modulus
            self._last.clear()
        self.frames[key] = self.frames.get(key, 0) + len(samples.row)
        counter = samples.columns.get(COUNTER)
        if counter is None or not len(counter):
            return None
        last, count = self._last.get(key, (counter[:1], int(counter[0])))
        joined = np.concatenate((last, counter))
        unwrapped = unwrap_counter(joined, modulus)[1:] + (count - int(last[0]))
        self._last[key] = counter[-1:].copy(), int(unwrapped[-1])
        if 1 <= samples.message.transmission_type <= _LAST_CYCLIC_TYPE:
            self.lost[key] = self.lost.get(key, 0) + lost_samples(joined, modulus)
        return unwrapped

    def lost_by_node(self) -> dict[int, int]:
        """Return lost samples by node-id: the maximum over its messages, which carry the same counter."""
        found: dict[int, int] = {}
        for (node_id, _), lost in self.lost.items():
            found[node_id] = max(found.get(node_id, 0), lost)
        return found
