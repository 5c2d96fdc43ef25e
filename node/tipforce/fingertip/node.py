"""A fingertip node: dictionary, device and source, and the application that latches samples and serves live objects."""

from canopen_device.core import codes, communication, emcy
from canopen_device.core.node import Application, Device
from canopen_device.core.object_dictionary import ObjectDictionary
from canopen_device.core.sync import OVERFLOW
from tipforce.dictionary import indices, table, table_objects
from tipforce.sensor.contact import scalar

from .calibration import CALIBRATION_GROUP, Calibration
from .channels import Channels
from .reporting import Reports, interrupted
from .sample import NO_TARE, Sample

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from canopen_device.core.object_dictionary import Entry, Value
    from canopen_device.core.program import Programs
    from tipforce.dictionary.table import Converter

    from .filters import Filtering
    from .interrupts import Interrupts
    from .source import Reading, Source

REFRESH_US = 100000  # without SYNC, a live value that is read is at most this old
SYNC_ABSENT_US = 1000000  # after this time, or three SYNC intervals, without a SYNC the node latches by itself
LONGEST_INTERVAL_US = 10000000  # a longer time between two SYNCs is a pause
NO_DATA_US = 100000  # a front end silent for so long has failed (2124h bit 8)
FROZEN_READINGS = 32  # equal readings in a row that noise of a count or more cannot explain (2124h bit 9)


class Fingertip(Application):
    """Everything between a gauge source and the object dictionary of one node."""

    live = frozenset((
        communication.MANUFACTURER_STATUS, indices.UNCERTAINTY, indices.STATUS, indices.COUNTER, indices.TEMPERATURE,
        indices.U_P, indices.FAULTS, indices.CONFIGURATION_COUNTER, indices.CHANNEL_STATUS,
    ) + table.forms(indices.FIELD_VALUE) + table.forms(indices.PROCESS_VALUE))  # fmt: skip

    def __init__(self, device: Device, n: int, source: "Source") -> None:
        self.device = device
        self.n = n
        self.source = source
        self.ends = source.count_min, source.count_max
        self.filtering: "Filtering | None" = None
        self.calibration = Calibration(device.od, n)
        self.channels = Channels(device.od, n, self)
        self._tared_us = self._counter = self._waiting_faults = 0
        self._forget(0)
        self.interrupts: "Interrupts | None" = None
        self._interrupted: "dict[int, list[int]]" = {}  # channels with interrupts -> numbers of their TPDOs
        self.reports = Reports(device)
        device.application = self
        device.storage.add_group(CALIBRATION_GROUP, "calibration", self.calibration.dump, self.calibration.restore)
        device.storage.after_communication = self.calibration.drop_old_mapping
        readers, writers = device.od.readers, device.od.writers
        readers[communication.MANUFACTURER_STATUS] = lambda _sub: self.sample.status() | self.sample.faults << 16
        readers[indices.UNCERTAINTY] = self._read_uncertainty
        readers[indices.TARE] = self._read_tare
        readers[indices.STATUS] = lambda _sub: self.sample.status()
        readers[indices.COUNTER] = lambda _sub: self.sample.counter
        readers[indices.TEMPERATURE] = self._read_temperature
        readers[indices.U_P] = self._read_u_P
        readers[indices.FAULTS] = lambda _sub: self.sample.faults
        writers[indices.CALIBRATION_COMMIT] = self._write_commit
        writers[indices.COMMAND] = lambda _sub, value: self.command(value)  # type: ignore[arg-type]
        tara = table.SIGNATURE_TARA
        writers[indices.AUTOTARE] = lambda _sub, value: self.tare() if value == tara else codes.NOT_TRANSFERRED

    def _forget(self, now_us: int) -> None:
        self._tare = NO_TARE
        self._read_us = now_us
        self._equal: "list[int]" = []  # equal readings in a row by gauge; empty for none
        self.frozen = 0  # bit k: the reading of gauge k + 1 stands still
        self._latches_by_sync_until_us = 0  # until this time only SYNCs latch
        self._synced_us = -LONGEST_INTERVAL_US
        self._waiting: "Reading | None" = None  # read for a tare or zero; the next latch has not taken it yet
        self.sample = Sample(None, self.channels.scaling, self.calibration.active)

    def on_reset(self, now_us: int) -> None:
        """Parameters are restored: forget tare and samples, take the scaling as it stands."""
        self.channels.load()
        self.channels.one_filter()
        self.source.reset(self.device)
        self.device.od.values[indices.COMMAND << 8] = 0
        self._forget(now_us)
        self.load_filter()
        self.reports.reset()
        # With a scaling that is lost the calibration, which stays, may mean another force.
        if set(self.device.storage.damaged) & {"calibration", "application"} or self.calibration.refused:
            self.device.emcy.raise_error(table.EMCY_CALIBRATION_INVALID, emcy.MANUFACTURER)

    def on_settings(self) -> None:
        """Find the channels whose interrupts are enabled."""
        self._interrupted = interrupted(self.device)
        if self._interrupted and self.interrupts is None:
            from .interrupts import Interrupts  # a node without interrupts does without

            self.interrupts = Interrupts(self.device, self.channels.exact)
        wanted = self.filtering is not None or self._watching() or self.source.watch_us
        self.due_us = self.device.now_us if wanted else codes.NEVER_US

    def _watching(self) -> bool:
        return self.device.nmt.state == codes.OPERATIONAL and bool(self._interrupted)

    def load_filter(self) -> None:
        """Start the filter of 61A0h and 61A1h again; an average of one conversion is no filter."""
        od = self.device.od
        kind, constant = od.integer(indices.FILTER_TYPE, 1), od.integer(indices.FILTER_CONSTANT, 1)
        self.filtering = None
        if kind and constant > 1:
            from .filters import Filtering  # a node without a filter does without

            self.filtering = Filtering(self, kind, constant, self.device.now_us)
        self.on_settings()

    def on_sync(self, now_us: int, number: int) -> None:
        """Latch a sample for the PDOs of this SYNC; ``number`` becomes its counter (2121h)."""
        interval_us = now_us - self._synced_us
        if interval_us > LONGEST_INTERVAL_US:
            interval_us = 0
        self._synced_us = now_us
        absent_us = 3 * interval_us
        self._latches_by_sync_until_us = now_us + (absent_us if absent_us > SYNC_ABSENT_US else SYNC_ABSENT_US)
        self._latch(now_us, number)

    def refresh(self, now_us: int) -> None:
        """A live value is read: latch a sample if the last one is old and no SYNCs come."""
        if now_us < self._latches_by_sync_until_us or now_us - self.sample.latched_us < REFRESH_US:
            return
        if self._news(now_us) or self.sample.stale:
            self._latch(now_us)

    def _news(self, now_us: int) -> bool:
        """False while nothing but a SYNC could call the last sample old: what comes next is not due yet."""
        if self.filtering is not None:
            self.filtering.take(now_us)
            return self.filtering.news() or self._silent(now_us)
        return self.sample.reading is None or now_us - self._read_us >= self.source.period_us

    def expire(self, now_us: int) -> None:
        """Take a conversion into the filter; without SYNC take samples for interrupts, and look after the source."""
        new = self.filtering is None or self._news(now_us)
        if self.filtering is not None:
            self.due_us = self.filtering.due_us
        elif self._watching():
            self.due_us = now_us + self.device.od.integer(indices.SAMPLE_PERIOD_US, 1)
        else:
            self.due_us = now_us + self.source.watch_us
        by_sync = now_us < self._latches_by_sync_until_us
        if new and not by_sync and self._watching():
            self._latch(now_us, waits=True)
        elif self.source.watch_us and now_us - self.sample.latched_us >= self.source.watch_us:
            seen = self.source.look(now_us)
            # What the application itself calls frozen shows in a row of readings only.
            own = 1 << table.FAULT_FROZEN if self.frozen else 0
            if seen is not None and seen | own != self.sample.seen | own:
                self._latch(now_us, self._counter if by_sync else 0, not by_sync)

    def _latch(self, now_us: int, number: int = 0, counts: bool = True, waits: bool = False) -> None:
        """Take the newest reading; without one the last sample stands: stale, but not if ``waits`` and no fault. 2121h
        is the SYNC's number with 1019h (0 without SYNC), else it counts samples; a stale one repeats it."""
        before = self.sample
        sample = self._sampled(now_us)
        if waits and sample.stale and sample.faults == before.faults:
            return
        if self.device.od.values.get(OVERFLOW):
            self._counter = number
        elif counts and not sample.stale:
            self._counter = (self._counter + 1) & 0xFF
        sample.counter = self._counter
        self._waiting = None
        self.sample = sample
        self.reports.sampled(sample, before.faults)
        if self.interrupts is not None:
            self.interrupts.check(self._interrupted)

    def _sampled(self, now_us: int) -> Sample:
        filtered = None
        if self.filtering is None:
            reading = self.source.read(now_us)
            # What the last reading showed stands until a new one says otherwise.
            faults = self.sample.faults if reading is None else self.watch(reading, self.sample.reading, now_us)
            if reading is None and self._waiting is not None:
                reading, faults = self._waiting, self._waiting_faults
            stale = reading is None
            if stale:
                reading = self.sample.reading
        else:
            self.filtering.take(now_us)
            reading, faults = self.filtering.reading, self.filtering.faults
            stale, filtered = not self.filtering.fresh, self.filtering.algorithm.output()
            self.filtering.fresh = False
        if stale:
            no_data = 1 << table.FAULT_NO_DATA
            faults = faults & ~no_data | (no_data if self._silent(now_us) else 0) | self.source.faults
        return Sample(
            reading, self.channels.scaling, self.calibration.active, self._tare, self.sample.present(), faults, stale,
            now_us, self.frozen, filtered, self.ends, self.sample.overloaded, self.channels.spans,
        )  # fmt: skip

    def _newest(self) -> Sample:
        """Return a sample younger than REFRESH_US for tare and zero; one that a SYNC latched stays the last latch."""
        now_us = self.device.now_us
        self.refresh(now_us)
        if now_us - self.sample.latched_us < REFRESH_US or now_us >= self._latches_by_sync_until_us:
            return self.sample
        sample = self._sampled(now_us)
        if self.filtering is not None:
            self.filtering.fresh = not sample.stale
        elif not sample.stale:
            self._waiting, self._waiting_faults = sample.reading, sample.faults
        return sample

    def _silent(self, now_us: int) -> bool:
        return now_us - self._read_us > max(NO_DATA_US, 2 * self.source.period_us)

    def watch(self, reading: "Reading", before: "Reading | None", now_us: int) -> int:
        """The front-end faults that show in a reading and the one before, joined to those the source reports."""
        self._read_us = now_us
        faults: int = reading.faults
        self.frozen = 0
        counts = reading.counts
        old = () if before is None else before.counts
        for count, last in zip(counts, old):  # noqa: B905 (not in MicroPython)
            if count == last:
                break
        else:
            self._equal = []  # nearly always: noise changes every gauge
            return faults
        self._equal = equal = self._equal or [0] * self.n
        lowest, highest = self.ends
        for k in range(self.n):
            # The end of the range repeats itself without being frozen: that gauge is saturated.
            if counts[k] != old[k] or not lowest < counts[k] < highest:
                equal[k] = 0
                continue
            equal[k] += 1
            if equal[k] >= FROZEN_READINGS and self.channels.noise_counts(k, self.calibration.active) >= 1.0:
                self.frozen |= 1 << k
        return faults | 1 << table.FAULT_FROZEN if self.frozen else faults

    def command(self, value: int) -> int:
        """2130h: 1 tare, 2 clear tare, 3 zero gauges. Returns the abort code of one that cannot be done now."""
        if value == table.COMMAND_TARE:
            return self.tare()
        if value == table.COMMAND_CLEAR_TARE:
            self._set_tare(NO_TARE)
        elif value == table.COMMAND_ZERO:
            return self.zero(range(self.n))
        return 0

    def tare(self) -> int:
        """Take the present force as zero; refused while the force is unknown."""
        now = self._untared(self._newest())
        if now.unknown() & scalar.UNKNOWN_FORCE:
            return codes.DEVICE_STATE
        self._set_tare(now.force())
        self._tared_us = self.device.now_us
        return 0

    def _untared(self, last: Sample) -> Sample:
        """The same reading once more, without tare and with what holds now: a tare that follows another, a zero or a
        commit within one sample must not count anything twice."""
        return Sample(
            last.reading, self.channels.scaling, self.calibration.active, faults=last.faults, stale=last.stale,
            frozen=last.frozen, filtered=last.filtered, ends=self.ends, was_overloaded=last.overloaded,
            spans=self.channels.spans,
        )  # fmt: skip

    def _set_tare(self, tare: "tuple[float, float, float]") -> None:
        if tare != self._tare:
            self._tare = tare
            self.reports.changed()

    def zero(self, gauges: "range | list[int]") -> int:
        """Make gauges (from 0) read zero now, by x124h; refused while contact is present, tared or not, or cannot be
        ruled out."""
        sample = self._newest()
        status = sample.status() | (0 if self._tare == NO_TARE else self._untared(sample).status())
        loaded = status & scalar.CONTACT_PRESENT or sample.overloaded or any(sample.overloads)  # any gauge at its end
        if loaded or sample.reading is None or sample.unknown() & scalar.UNKNOWN_GAUGES:
            return codes.DEVICE_STATE
        scaling = self.channels.scaling
        abort = self.channels.zero(gauges, sample.reading.counts if sample.filtered is None else sample.filtered)
        if self.channels.scaling != scaling:
            self.reports.changed()
        return abort

    def _read_uncertainty(self, sub: int) -> float:
        if sub == 1:
            hidden = self.sample.unknown_early() & scalar.UNKNOWN_FORCE
            return scalar.NAN if hidden else self.sample.magnitude_uncertainty()
        _u_P, u_phi, u_theta = self.sample.uncertainty()
        unknown = self.sample.unknown()
        if sub == 2:
            return scalar.NAN if unknown & scalar.UNKNOWN_PHI else u_phi * scalar.DEGREES
        return scalar.NAN if unknown & scalar.UNKNOWN_THETA else u_theta * scalar.DEGREES

    def _read_u_P(self, _sub: int) -> int:
        u_P = self._read_uncertainty(1)
        # Bounded before rounding: where floats are single precision u_P may be infinite.
        return round(min(1000.0 * u_P, table.UNKNOWN_U16 - 1.0)) if u_P >= 0.0 else table.UNKNOWN_U16

    def _read_temperature(self, _sub: int) -> int:
        reading = self.sample.reading
        known = reading is not None and not self.sample.unknown_early() & scalar.UNKNOWN_GAUGES
        return reading.temperature if known and reading is not None else table.UNKNOWN_I16

    def _read_tare(self, sub: int) -> "Value":
        age_s = 0 if self._tare == NO_TARE else (self.device.now_us - self._tared_us) // 1000000
        return self._tare[sub - 1] if sub < 4 else age_s

    def _write_commit(self, _sub: int, value: "Value") -> int:
        before, tare = self.calibration.active_record(), self._tare
        abort = self.calibration.commit(value)
        if not abort:
            self._tare = NO_TARE  # it was a force by the calibration before
            if self.calibration.active_record() != before or tare != NO_TARE:
                self.reports.changed()
        return abort


def build(
    n: int, node_id: int, simulated: bool, serial: int = 0, eds: bytes = b"",
    converter: "Converter" = table.CONVERTER_16, programs: bool = False,
) -> ObjectDictionary:  # fmt: skip
    """The dictionary of ``n`` gauges at its defaults; ``eds``: of 1021h, or empty; ``programs``: with slots."""
    od = ObjectDictionary(node_id)
    shared: "dict[Entry, Entry]" = {}  # equal entries are one tuple: a microcontroller has no room for all of them
    for index, _code, _name, _slug, entries in table_objects.declared(n, simulated, converter, programs):
        if index in (communication.STORED_EDS, communication.EDS_FORMAT) and not eds:
            continue
        for first, count, _label, _part, kind, access, flags, default, low, high, _unit in entries:
            stored_elsewhere = table.NOT_STORED if flags & (table.STAGED | table.VIEW) else 0
            for k in range(count):
                value: "Value" = default[k] if isinstance(default, tuple) else default
                if kind == "D":
                    value = b""
                entry = (kind, access, flags | stored_elsewhere, value, low, high)
                shared[entry] = od.add(index, first + k, shared.get(entry, entry))
    if eds:
        od.readers[communication.STORED_EDS] = lambda _sub: eds
    first = communication.IDENTITY << 8
    od.readers[communication.IDENTITY] = lambda sub: serial if sub == 4 else od.values[first | sub]
    return od


def fingertip_node(
    node_id: int, source: "Source", n: int = 3, serial: int = 0, save: "Callable[[str, bytes], bool] | None" = None,
    load: "Callable[[str], bytes | None] | None" = None, eds: bytes = b"", programs: "Programs | None" = None,
) -> Device:  # fmt: skip
    """A device that measures with ``source`` (n gauges). ``node_id`` 255 waits for LSS; without ``save`` and ``load``
    1010h and 1011h refuse. Raises ValueError for a node-id or number of gauges that is not allowed."""
    if not (1 <= node_id <= 127 or node_id == codes.LSS_UNCONFIGURED):
        raise ValueError("node-id: %r, allowed 1 to 127, and 255 for none yet" % node_id)
    od = build(n, node_id, source.simulated, serial, eds, source.converter, programs is not None)
    device = Device(od, save, load)
    if programs is not None:
        from canopen_device.core.program import ProgramDownload

        ProgramDownload(device, programs)
    Fingertip(device, n, source)
    source.attach(device)
    return device
