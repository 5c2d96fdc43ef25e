"""Read several fingertips on one bus on request: each call sends one SYNC and waits for the answers."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tipforce.arrays import BoolArray, FloatArray
from tipforce.dictionary.signals import tpdo_messages
from tipforce.errors import InputError
from tipforce.host.decoding.decoder import Decoder, Samples
from tipforce.host.network.bus import Bus
from tipforce.host.network.sdo import checked_time


@dataclass(frozen=True, eq=False)
class HandSample:
    """Answers of the fingers to one SYNC; one element per finger, in the order of the hand's node-ids."""

    P_newtons: FloatArray
    phi_deg: FloatArray
    theta_deg: FloatArray
    """NaN where the node marks a value unknown, or where the finger is missing."""
    missing: BoolArray
    """No contact PDO of this finger arrived in time."""
    messages: dict[tuple[int, str], Samples]
    """All decoded values, by (node-id, message name): status flags, counters, gauges."""


class PolledHand:
    """Fingertips with ``node_ids`` on one connection. ``messages`` names the PDOs to wait for on each SYNC. Raises
    InputError for no node-id, a repeated one, or a message that the dictionary does not have."""

    def __init__(
        self, connection: Bus, node_ids: Sequence[int], gauges: int = 3, messages: Sequence[str] = ("Contact",)
    ) -> None:
        bases = {message.name: message.cob_id_base for message in tpdo_messages(gauges)}
        unknown = [name for name in messages if not bases.get(name)]
        if unknown:
            raise InputError(f"message {unknown[0]!r}: allowed are {', '.join(name for name in bases if bases[name])}")
        self.connection = connection
        self.fingers = {finger.node_id: finger for finger in map(connection.finger, node_ids)}
        self.node_ids = tuple(self.fingers)
        if not 0 < len(self.fingers) == len(node_ids):
            raise InputError(f"node-ids {list(node_ids)}: allowed is each node-id once")
        self._expected = {bases[name] + n for name in messages for n in self.node_ids}
        self._decoder = Decoder(gauges, self.node_ids)

    def start(self) -> None:
        """Send NMT start to each finger."""
        for node_id in self.node_ids:
            self.connection.nmt("start", node_id)

    def stop(self) -> None:
        """Return the fingers to PRE-OPERATIONAL: no more PDOs."""
        for node_id in self.node_ids:
            self.connection.nmt("preop", node_id)

    def sample(self, timeout_s: float = 0.1) -> HandSample:
        """Send one SYNC and collect the answers; a finger without one is marked missing. Raises InputError for NaN."""
        timeout_s = checked_time("timeout_s", timeout_s)
        self.connection.buffer.clear()
        self.connection.sync()
        frames = self.connection.buffer.take(self._expected, time.monotonic() + timeout_s)
        messages = self._decoder.decode(frames)
        values = np.full((3, len(self.node_ids)), np.nan)
        missing = np.ones(len(self.node_ids), dtype=np.bool_)
        for k, node_id in enumerate(self.node_ids):
            if (node_id, "Contact") in messages:
                missing[k] = False
                columns = messages[node_id, "Contact"].columns
                values[:, k] = [columns[name][-1] for name in ("P", "phi", "theta")]
        P, phi, theta = values
        return HandSample(P, phi, theta, missing, messages)
