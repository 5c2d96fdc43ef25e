"""The samples of live frames, as soon as they are complete: the PDOs of a latch by ``SampleRule``."""

from collections.abc import Mapping, Sequence

import numpy as np

from canopen_device.core import codes
from tipforce.dictionary.signals import Message
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.health import NAMES, Health
from tipforce.host.decoding.sample_rule import SampleRule, follows_sync
from tipforce.host.frames.frame_array import FIELDS, FrameArray
from tipforce.samples.record import Column, JoinedSamples, Pdo


class _Sample:
    __slots__ = ("counter", "ended", "faults", "node_id", "row", "time_ns", "words")

    def __init__(self, row: int, node_id: int, t_ns: int, counter: int) -> None:
        self.row, self.node_id, self.time_ns, self.counter = row, node_id, t_ns, counter
        self.words: dict[Pdo, int] = {}
        self.faults = 0
        self.ended = False


class Assembler:
    """Samples of the nodes whose PDOs are ``pdos`` (node-id and layout by identifier). ``needed``: PDOs that complete a
    sample, timed by the last; empty: all that can join, timed by the first. TPDO4 and EMCY tell the faults (2124h)."""

    def __init__(
        self, pdos: Mapping[int, tuple[int, Message]], needed: Sequence[str] = (), gauges: int = 0,
        calibrations: Mapping[int, Calibration | None] | None = None,
    ) -> None:  # fmt: skip
        self.pdos = {can_id: (node_id, Pdo(message)) for can_id, (node_id, message) in pdos.items()}
        self._needed, self._gauges, self._calibrations = frozenset(needed), gauges, calibrations or {}
        self._latest: dict[int, _Sample] = {}  # by node-id, of PDOs that follow SYNC
        self._complete: list[_Sample] = []
        self._rule, self._frames = SampleRule(), 0
        self._health = Health()
        bases = codes.EMCY_BASE, codes.HEARTBEAT_BASE
        self.services = {base + node_id: (node_id, base) for node_id, _ in self.pdos.values() for base in bases}
        """By identifier of an EMCY or a heartbeat: the node-id and the base."""

    def feed(self, frames: FrameArray, now_ns: int | None = None) -> JoinedSamples:
        """Process frames, FRAME (n,), in the order of the bus; return the samples that are complete, often none.
        ``now_ns``: the time on their clock, after which an incomplete sample is old; None: that of the last frame."""
        last_ns = None
        for t_ns, can_id, length, word in FIELDS.iter_unpack(frames.tobytes()):
            last_ns = t_ns
            place = self.pdos.get(can_id)
            if place is not None:
                if length >= place[1].message.length_bytes:
                    self._pdo(*place, t_ns, word)
            elif can_id in self.services:
                self.service(can_id, t_ns, word.to_bytes(8, "little")[:length])
        now_ns = last_ns if now_ns is None else now_ns
        if now_ns is not None and not self._needed:
            for node_id, sample in self._latest.items():
                if not self._rule.is_open(node_id, now_ns, self._frames):
                    self._end(sample)
        return self._take()

    def finish(self) -> JoinedSamples:
        """Return the samples that more PDOs could have joined."""
        for sample in self._latest.values():
            self._end(sample)
        return self._take()

    def _pdo(self, node_id: int, pdo: Pdo, t_ns: int, word: int) -> None:
        self._frames += 1
        if pdo.fault_mask:
            self._health.pdo(node_id, t_ns, word >> pdo.fault_shift & pdo.fault_mask)
        counter = word >> pdo.counter_shift & 0xFF if pdo.counter_shift >= 0 else -1
        cyclic = counter >= 0 and follows_sync(pdo.message)
        number, last = pdo.message.number, self._latest.get(node_id)
        row = self._rule.row(node_id, number, counter, cyclic, t_ns, self._frames, self._frames)
        sample = last if last is not None and row == last.row else _Sample(row, node_id, t_ns, counter)
        if cyclic and sample is not last:
            if last is not None:
                self._end(last)
            self._latest[node_id] = sample
        if not sample.ended:
            sample.words[pdo], sample.faults = word, self._health.now(node_id)[0]
        if self._needed and not sample.ended and self._has_needed(sample):
            sample.time_ns = t_ns
            self._end(sample)
        elif not cyclic and sample is not last:
            self._end(sample)

    def _has_needed(self, sample: _Sample) -> bool:
        return self._needed <= {pdo.message.name for pdo in sample.words}

    def _end(self, sample: _Sample) -> None:
        if not sample.ended and self._has_needed(sample):
            self._complete.append(sample)
        sample.ended = True

    def service(self, can_id: int, t_ns: int, data: bytes) -> None:
        """Process an EMCY or a heartbeat, whose identifier is one of ``services``."""
        node_id, base = self.services[can_id]
        self._health.service(node_id, t_ns, base, data)

    def _take(self) -> JoinedSamples:
        samples, self._complete = self._complete, []
        heads = [(sample.time_ns, sample.node_id, sample.counter, sample.faults) for sample in samples]
        t_ns, node, counter, faults = np.array(heads, dtype=np.int64).reshape(-1, 4).T
        columns = _columns(samples) | {name: faults >> bit & 1 for name, bit in NAMES.items()}
        node_id = node.astype(np.uint8)
        return JoinedSamples(t_ns, node_id, counter, columns, self._calibrations, self._gauges)


def _columns(samples: Sequence[_Sample]) -> dict[str, Column]:
    """Return every signal (n,) of samples; the first PDO that has it counts: all are of one latch."""
    columns: dict[str, Column] = {}
    for pdo in dict.fromkeys(pdo for sample in samples for pdo in sample.words):
        places = [at for at, sample in enumerate(samples) if pdo in sample.words]
        of_pdo = pdo.columns([samples[at].words[pdo] for at in places])
        for name in pdo.names:
            values = of_pdo[name]
            if name not in columns:
                missing = np.nan if values.dtype.kind == "f" else 0
                columns[name] = np.full(len(samples), missing, dtype=values.dtype)
            columns[name][places] = values
    return columns
