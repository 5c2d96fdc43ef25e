"""One latched sample: from counts to strain, force, contact and uncertainty, each computed when first asked for."""

from tipforce.device.codes import NEVER_US
from tipforce.dictionary import table
from tipforce.sensor.contact import scalar

from .source import Source

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .calibration import Active
    from .source import Reading

NAN = float("nan")
NO_TARE = (0.0, 0.0, 0.0)
_MICRO = 1e-6
_ENDS = Source.count_min, Source.count_max
# Faults that cost one gauge, which is left out where it can be spared: frozen, and a broken wire at the range's end.
_OF_ONE_GAUGE = (1 << table.FAULT_FROZEN | 1 << table.FAULT_WIRE_BREAK) >> table.FAULT_NO_DATA


class Sample:
    """A reading with the calibration, the scaling and the tare that hold for it.

    ``scaling`` has (gain, bias) per gauge: microstrain = gain * counts + bias. ``was_present`` is bit 0 of the sample
    before, for the hysteresis of contact; ``frozen`` has a bit for each gauge whose reading stands still. ``filtered``
    is what a filter makes of the counts, in place of them; ``ends`` are the converter's ends. A sample without a
    reading has no values, only a status.

    A gauge that is saturated or frozen is lost. With more than three gauges the others go on giving the force as long
    as they have rank 3 (``spared``); status bit 2 and 2124h say that a gauge is missing.
    """

    __slots__ = (
        "_contact", "_early", "_force", "_status", "_uncertainty", "_unknown", "_was_present", "active", "counter",
        "faults", "filtered", "frozen", "latched_us", "lost", "microstrains", "overloads", "reading", "solver",
        "spared", "stale", "tare",
    )  # fmt: skip

    def __init__(
        self,
        reading: "Reading | None",
        scaling: "list[tuple[float, float]]",
        active: "Active | None",
        tare: "tuple[float, float, float]" = NO_TARE,
        was_present: bool = False,
        faults: int = 0,
        stale: bool = False,
        counter: int = 0,
        latched_us: int = -NEVER_US,
        frozen: int = 0,
        filtered: "list[float] | None" = None,
        ends: "tuple[int, int]" = _ENDS,
    ) -> None:
        self.reading = reading
        self.active = active
        self.tare = tare
        self.stale = stale
        self.counter = counter
        self.latched_us = latched_us
        self._was_present = was_present
        self._force: "tuple[float, float, float] | None" = None
        self._contact: "tuple[float, float, float, float] | None" = None
        self._uncertainty: "tuple[float, float, float] | None" = None
        self._status = self._early = self._unknown = -1
        self.frozen = self.lost = frozen
        self.filtered = filtered
        self.overloads: "list[int]" = []
        self.microstrains: "list[float]" = []
        if reading is not None:
            counts = reading.counts
            self.overloads = [0] * len(counts)
            lowest, highest = ends
            if max(counts) >= highest or min(counts) <= lowest:
                self.overloads = [(c >= highest) - (c <= lowest) for c in counts]
                for k in range(len(counts)):
                    if self.overloads[k]:
                        self.lost |= 1 << k
                faults |= self.lost & ~frozen
            shown = counts if filtered is None else filtered
            self.microstrains = [g * c + b for c, (g, b) in zip(shown, scaling)]  # noqa: B905
        self.faults = faults
        self.solver = None if active is None else active.solver(self.lost)
        self.spared = self.lost != 0 and self.solver is not None

    def status(self) -> int:
        """The status byte 2120h of this sample."""
        if self._status < 0:
            self._status = self._find_status()
        return self._status

    def present(self) -> bool:
        """Contact present, for the hysteresis of the next sample: as it was before where this one cannot tell."""
        if self._status < 0 or self.unknown() & scalar.UNKNOWN_FORCE:
            return self._was_present
        return bool(self._status & scalar.CONTACT_PRESENT)

    def unknown(self) -> int:
        """What the status makes unknown, in the bits of ``sensor.scalar``."""
        if self._unknown < 0:
            self._unknown = scalar.unknown(self.status(), self.spared)
        return self._unknown

    def unknown_early(self) -> int:
        """UNKNOWN_GAUGES and UNKNOWN_FORCE of ``unknown``: no contact is needed for these; it hides angles only."""
        if self._early < 0:
            self._early = scalar.unknown(self._early_status(), self.spared)
        return self._early

    def force(self) -> "tuple[float, float, float]":
        """F1, F2, F3 in newtons, tare taken off; NaN while the status leaves them unknown or there is no reading."""
        if self._force is None:
            if self.active is None or self.solver is None or self.reading is None:
                self._force = (NAN, NAN, NAN)
            else:
                f1, f2, f3 = self.active.force(self.solver[0], [_MICRO * m for m in self.microstrains])
                t1, t2, t3 = self.tare
                self._force = (f1 - t1, f2 - t2, f3 - t3)
        return self._force

    def contact(self) -> "tuple[float, float, float, float]":
        """P newtons, phi and theta radians, and by how much the line of action misses the tip."""
        if self._contact is None:
            f1, f2, f3 = self.force()
            self._contact = scalar.contact(f1, f2, f3, self.active is not None and self.active.pull)
        return self._contact

    def uncertainty(self) -> "tuple[float, float, float]":
        """Standard uncertainties of P (N), phi and theta (radians) from gauge noise; NaN without calibration."""
        if self._uncertainty is None:
            if self.active is None or self.solver is None:
                self._uncertainty = (NAN, NAN, NAN)
            else:
                f1, f2, f3 = self.force()
                self._uncertainty = scalar.uncertainty(f1, f2, f3, self.solver[1], self.active.pull)
        return self._uncertainty

    def _early_status(self) -> int:
        """The bits that are known before any force is: calibrated, saturated, stale, front-end fault."""
        bits = 0
        if self.active is not None:
            bits |= scalar.CALIBRATED
        if any(self.overloads) or self.spared:
            bits |= scalar.SATURATED
        if self.stale or self.reading is None:
            bits |= scalar.STALE
        faults = self.faults >> table.FAULT_NO_DATA
        if self.spared:
            faults &= ~_OF_ONE_GAUGE
        if faults:
            bits |= scalar.FRONT_END_FAULT
        return bits

    def _find_status(self) -> int:
        bits = self._early_status()
        if self.active is None or self.solver is None or scalar.unknown(bits, self.spared) & scalar.UNKNOWN_FORCE:
            return bits
        P, _phi, theta, miss = self.contact()
        u_P, _u_phi, u_theta = self.uncertainty()
        u_miss = 0.0
        if miss > 0.0:
            f1, f2, f3 = self.force()
            u_miss = scalar.miss_uncertainty(f1, f2, f3, self.solver[1])
        return bits | scalar.status_bits(P, u_P, u_theta, miss, u_miss, theta, self.active.limits, self._was_present)
