"""Capture many readings of one node's gauges under one constant load, and average them."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from canopen_device.core.codes import STANDARD_MASK, SYNC_COB_ID
from tipforce.arrays import BoolArray, FloatArray
from tipforce.dictionary import objects as od
from tipforce.dictionary import table
from tipforce.dictionary.signals import mapping_signals, tpdo_messages
from tipforce.errors import InputError, SdoAbortError
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.network.bus import Bus
from tipforce.sensor.contact import scalar

RESOLUTION_MICROSTRAIN = 0.1
"""One step of 7130h: the resolution of every reading by PDO."""
LARGEST_MICROSTRAIN = 0x7FFF * RESOLUTION_MICROSTRAIN
_ANSWER_S = 0.1  # wait for the PDO after a SYNC
_SILENT = 5  # consecutive SYNCs without a response after which the capture stops waiting
_UNSYNCED_S = 0.11  # without SYNC, a node latches a sample for a read every 100 ms
_TRIES = 20
_ROUNDS = 3  # number of attempts to replace stale samples
_FLAGS = ("counter", "saturated", "stale", "fault")


class Sample(NamedTuple):
    """One sample as received; the microstrain of the n gauges is NaN where the node reports unknown."""

    t_s: float
    microstrain: Sequence[float]
    counter: int
    saturated: bool
    stale: bool
    fault: bool


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Result of one capture: the valid readings, and the number of the others."""

    microstrain: FloatArray
    """(k, n), the valid readings."""
    t_s: FloatArray
    """(k,), their receive times."""
    asked: int
    saturated: tuple[int, ...]
    """Samples with this gauge saturated, (n,)."""
    stale: int
    repeated: int
    """Samples marked as new with the counter of the previous sample."""
    faulty: int
    faults: int
    """2124h, read after a faulty sample; 0 if there was none."""
    silent: int
    """SYNCs without a response."""
    temperature_degC: float | None

    @property
    def count(self) -> int:
        """Number of valid readings."""
        return len(self.microstrain)

    @property
    def duration_s(self) -> float:
        """From the first to the last valid reading."""
        return float(self.t_s[-1] - self.t_s[0]) if self.count else 0.0

    @property
    def mean(self) -> FloatArray:
        """(n,), microstrain."""
        return np.asarray(self.microstrain.mean(axis=0), dtype=np.float64)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of one reading, (n, n), microstrain^2; no variance below that of rounding."""
        matrix = np.atleast_2d(np.cov(self.microstrain, rowvar=False))
        np.fill_diagonal(matrix, np.maximum(np.diag(matrix), RESOLUTION_MICROSTRAIN**2 / 12.0))
        return matrix

    @property
    def std(self) -> FloatArray:
        """Standard deviation of each gauge, (n,), microstrain."""
        return np.asarray(self.microstrain.std(axis=0, ddof=1), dtype=np.float64)

    @property
    def drift(self) -> FloatArray:
        """(n,), microstrain: change of the line through the readings from the first to the last."""
        since = self.t_s - self.t_s.mean()
        squares = float(since @ since) or 1.0  # all at one time: no change
        # Less their mean: times of the epoch are rounded, so that the sum of ``since`` is not exactly zero.
        return np.asarray(since @ (self.microstrain - self.mean) / squares * self.duration_s, dtype=np.float64)


class GaugeReader:
    """Collect gauge readings of one node: by SYNC and a gauge PDO if one PDO carries all gauges, else by SDO reads, one
    each ``period_s``. Every method raises NoResponseError and SdoAbortError as SdoChannel does."""

    def __init__(self, connection: Bus, node_id: int, gauges: int, period_s: float = 0.005) -> None:
        self._connection = connection
        self._node_id = node_id
        self._n = gauges
        self._gauges = [f"SG{k + 1}" for k in range(gauges)]
        self._sdo = connection.sdo(node_id)
        self.period_s = max(period_s, self._sdo.read(od.SAMPLE_PERIOD_US[1]) * 1e-6)
        self._decoder = Decoder(gauges, (node_id,))
        self._can_id = self._gauge_pdo()
        if not self._can_id and not self._takes_sync():
            self.period_s = max(self.period_s, _UNSYNCED_S)
        self._started = False

    @property
    def how(self) -> str:
        """How the readings come, in words."""
        return f"SYNC and TPDO1 (0x{self._can_id:03X})" if self._can_id else "SYNC and SDO reads"

    def _gauge_pdo(self) -> int:
        """Return the identifier of TPDO1 if it is sent on each SYNC with all gauges, status and counter; else 0."""
        word = self._sdo.read(od.TPDO1_COB_ID)
        can_id = word & STANDARD_MASK
        on_sync = self._sdo.read(od.TPDO1_TRANSMISSION_TYPE) == 1 and self._takes_sync()
        if word >> 31 or not can_id or not on_sync:
            return 0
        words = [self._sdo.read(od.TPDO1_MAPPING[k + 1]) for k in range(self._sdo.read(od.TPDO1_MAPPED))]
        mapping = [(word >> 16, word >> 8 & 0xFF, word & 0xFF) for word in words]
        with suppress(InputError):  # a mapping that is not in this dictionary
            names = {signal.name for signal in mapping_signals(mapping, self._n)}
            if names >= {*self._gauges, *_FLAGS}:
                self._decoder.remap(self._node_id, tpdo_messages(self._n)[0].name, can_id, mapping)
                return can_id
        return 0

    def _takes_sync(self) -> bool:
        """Return whether the node consumes the SYNC that Bus sends; number it where the node asks for that (1019h)."""
        with suppress(SdoAbortError):
            self._connection.sync_overflow = self._sdo.read(od.SYNC_COUNTER_OVERFLOW)
        return self._sdo.read(od.SYNC_COB_ID) & STANDARD_MASK == SYNC_COB_ID

    def start(self) -> None:
        """Start the node by NMT if it is not OPERATIONAL, as after a power cycle, so that it sends PDOs."""
        if self._can_id and not len(self._ask()):
            self._connection.nmt("start", self._node_id)
            self._started = True

    def stop(self) -> None:
        """Return a node that was started here to PRE-OPERATIONAL."""
        if self._started:
            self._connection.nmt("preop", self._node_id)
            self._started = False

    def capture(self, samples: int, on_progress: Callable[[int], None] = lambda _count: None) -> Capture:
        """Take ``samples`` readings; stale ones are replaced, up to a limit. on_progress: number of samples so far.
        Returns all readings, valid or not; the caller decides whether to use them."""
        self.start()
        rows: list[Sample] = []
        silent = taken = 0
        for _ in range(_ROUNDS):
            in_a_row = 0
            for count in range(taken + 1, samples + 1):
                due_s = time.monotonic() + self.period_s
                sample = self._by_pdo() if self._can_id else self._by_sdo()
                if sample is not None:
                    rows.append(sample)
                in_a_row = in_a_row + 1 if sample is None and self._can_id else 0
                silent += in_a_row > 0
                if in_a_row >= _SILENT:
                    break
                on_progress(count)
                time.sleep(max(0.0, due_s - time.monotonic()))
            before, taken = taken, sum(_fresh(rows))
            if taken in (before, samples):
                break
        if silent and not taken:
            self._sdo.read(od.STATUS)  # raises NoResponseError if the node no longer responds
        return self._judged(rows, samples, silent)

    def moves(self) -> bool:
        """Return whether the sample counter (2121h) increments, and not only by the number of the SYNC."""
        before = self._sdo.read(od.COUNTER)
        for _ in range(_TRIES):
            self._connection.sync()
            time.sleep(max(self.period_s, 0.01))
            if self._sdo.read(od.COUNTER) != before and not self._sdo.read(od.STATUS) & scalar.STALE:
                return True
        return False

    def temperature_degC(self) -> float | None:
        """Return the temperature of the fingertip (2122h), degrees Celsius; None if the node does not know it."""
        for _ in range(_SILENT):
            value = self._sdo.read(od.TEMPERATURE)
            if value != table.UNKNOWN_I16:
                return value / 100.0
            time.sleep(self.period_s)  # the last sample may be stale
            self._connection.sync()
        return None

    def _judged(self, rows: list[Sample], samples: int, silent: int) -> Capture:
        microstrain = np.array([row.microstrain for row in rows], dtype=np.float64).reshape(-1, self._n)
        flags: BoolArray = np.array([row[3:] for row in rows], dtype=np.bool_).reshape(-1, 3)
        saturated, stale, fault = flags.T
        hit = np.isnan(microstrain) & (saturated & ~stale)[:, np.newaxis]
        if self._can_id:
            hit |= np.abs(np.nan_to_num(microstrain)) >= LARGEST_MICROSTRAIN - 0.5 * RESOLUTION_MICROSTRAIN
        fresh = np.array(_fresh(rows), dtype=np.bool_)
        good = fresh & ~saturated & ~fault & ~hit.any(axis=1) & np.isfinite(microstrain).all(axis=1)
        faulty = int(fault.sum())
        return Capture(
            microstrain=microstrain[good],
            t_s=np.array([row.t_s for row in rows], dtype=np.float64)[good],
            asked=samples,
            saturated=tuple(int(count) for count in hit.sum(axis=0)),
            stale=int(stale.sum()),
            repeated=int((~fresh & ~stale).sum()),
            faulty=faulty,
            faults=self._sdo.read(od.FAULTS) if faulty else 0,
            silent=silent,
            temperature_degC=self.temperature_degC(),
        )

    def _ask(self) -> FrameArray:
        self._connection.buffer.clear()
        self._connection.sync()
        frames = self._connection.buffer.take({self._can_id}, time.monotonic() + _ANSWER_S)
        mine: FrameArray = frames[frames["can_id"] == self._can_id][-1:]
        return mine

    def _by_pdo(self) -> Sample | None:
        for samples in self._decoder.decode(self._ask()).values():
            gauges = [float(samples.columns[name][0]) for name in self._gauges]
            return Sample(float(samples.t_ns[0]) * 1e-9, gauges, *(samples.columns[name][0].item() for name in _FLAGS))
        return None

    def _by_sdo(self) -> Sample | None:
        """Return the sample of one SYNC, None where another one was latched while it was read."""
        self._connection.sync()
        counter = self._sdo.read(od.COUNTER)
        gauges = [self._sdo.read(od.PROCESS_VALUE[k + 1]) for k in range(self._n)]
        status = self._sdo.read(od.STATUS)
        if self._sdo.read(od.COUNTER) != counter:
            return None
        bits = {name: bool(status >> bit & 1) for bit, (name, _) in enumerate(table.STATUS_BITS)}
        return Sample(time.monotonic(), gauges, counter, *(bits[name] for name in _FLAGS[1:]))


def _fresh(rows: list[Sample]) -> list[bool]:
    before = [-1, *(row.counter for row in rows)]
    return [not row.stale and row.counter != last for row, last in zip(rows, before, strict=False)]
