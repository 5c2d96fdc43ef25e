"""One latched sample: from counts to strain, force, contact and uncertainty, each computed when first asked for."""

from canopen_device.core.codes import NEVER_US
from canopen_device.core.object_dictionary import real32
from tipforce.dictionary import table
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.scalar_uncertainty import magnitude_uncertainty, miss_uncertainty, uncertainty

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    from .calibration import Active, Covariance
    from .judgement import Judgement
    from .source import Reading

NAN = float("nan")
NO_TARE = (0.0, 0.0, 0.0)
# Faults that cost one gauge, which is left out where it can be spared: frozen, and a broken wire at the range's end.
_OF_ONE_GAUGE = 1 << table.FAULT_FROZEN | 1 << table.FAULT_WIRE_BREAK
_FRONT_END = 1 << table.FAULT_NO_DATA | 1 << table.FAULT_FROZEN | 1 << table.FAULT_WIRE_BREAK | 1 << table.FAULT_SUPPLY
_ALL_GAUGES = 1 << table.FAULT_NO_DATA | 1 << table.FAULT_SUPPLY
_GAUGES = (1 << table.FAULT_NO_DATA) - 1
_ALL_KNOWN = scalar.CONTACT_PRESENT | scalar.CALIBRATED | scalar.OUTSIDE_PAD
_CONTRADICTION, _OVERLOAD = 1 << table.FAULT_CONTRADICTION, 1 << table.FAULT_OVERLOAD


class Sample:
    """A reading with the calibration, scaling and tare that hold for it; without a reading there is only a status.

    ``scaling``: microstrain = gain * counts + bias per gauge; ``was_present``, ``was_overloaded``: of the sample
    before; ``frozen``: bits of gauges that stand still; ``filtered``: counts; ``ends``: of the converter. A gauge that
    is saturated, outside its span, frozen or contradicts the others is lost. With more than three, the others give the
    force while they have rank 3 (``spared``); status bit 2 and 2124h show the loss."""

    __slots__ = (
        "_contact", "_covariance", "_early", "_force", "_uncertainty", "_unknown", "_was_present", "active",
        "counter", "faults", "filtered", "frozen", "judgement", "known_status", "latched_us", "lost", "microstrains",
        "overloaded", "overloads", "reading", "seen", "solver", "spared", "stale", "tare", "values",
    )  # fmt: skip

    def __init__(
        self, reading: "Reading | None", scaling: "list[tuple[float, float]]", active: "Active | None",
        tare: "tuple[float, float, float]" = NO_TARE, was_present: bool = False, faults: int = 0, stale: bool = False,
        latched_us: int = -NEVER_US, frozen: int = 0, filtered: "list[float] | None" = None,
        ends: "tuple[int, int]" = (0, 0), was_overloaded: bool = False, spans: "Sequence[tuple[float, float]]" = (),
    ) -> None:  # fmt: skip
        self.reading, self.active, self.tare = reading, active, tare
        self.stale, self.counter, self.latched_us = stale, 0, latched_us
        self._was_present = was_present
        self._force: "tuple[float, float, float] | None"
        self._contact: "tuple[float, float, float, float] | None"
        self._uncertainty: "tuple[float, float, float] | None"
        self._covariance: "Covariance | None"
        self._force = self._contact = self._uncertainty = self._covariance = None
        self.values: "list[float]" = []  # of ``find_values``
        self.known_status = self._unknown = -1  # not found yet
        self.frozen = self.lost = frozen
        self.filtered = filtered
        self.overloads: "list[int]"
        self.microstrains: "list[float]"
        faults &= _FRONT_END  # the other bits are found here, from the reading
        if reading is None:
            self.overloads, self.microstrains = [], []
        else:
            counts = reading.counts
            self.overloads = [0] * len(counts)
            lowest, highest = ends
            for count in counts:
                if not lowest < count < highest:
                    self.overloads = [(c >= highest) - (c <= lowest) for c in counts]
                    faults |= self._saturated()
                    break
            shown = counts if filtered is None else filtered
            self.microstrains = [g * c + b for c, (g, b) in zip(shown, scaling)]  # noqa: B905
        self.seen = faults  # all that a source can say by itself
        limits = None if active is None else active.converter
        if reading is not None and (limits is not None or spans):
            if limits is not None:
                self._limit(limits, scaling)
            for k, (start, end) in enumerate(spans):  # a gauge outside its span (6148h, 6149h) is saturated too
                if not start <= self.microstrains[k] <= end:
                    self.overloads[k] = self.overloads[k] or outside(self.microstrains[k], start, end)
            faults |= self._saturated()
        self.lost |= faults & _GAUGES
        self.solver = None if active is None else (active.left.get(self.lost) or active.without(self.lost))[0]
        self.judgement: "Judgement | None" = None
        if active is not None and active.checked and reading is not None and not faults & _ALL_GAUGES:
            from .judgement import Judgement  # a calibration of which nothing is known does without

            degC = NAN if reading.temperature == table.UNKNOWN_I16 else 0.01 * reading.temperature
            self.judgement = Judgement(active, self.microstrains, self.lost, degC, was_overloaded)
            self.lost |= self.judgement.left_out
            self.solver = self.judgement.solver
            faults |= self.judgement.bits
        self.spared = self.lost != 0 and self.solver is not None
        self.faults = faults | self.lost if self.spared else faults
        self.overloaded = faults & _OVERLOAD != 0
        # The common case, CALIBRATED and no other early bit.
        self._early = -1 if self.faults or stale or active is None or reading is None else 0

    def _saturated(self) -> int:
        return sum([1 << k for k, over in enumerate(self.overloads) if over])

    def _limit(self, limits: "list[float]", scaling: "list[tuple[float, float]]") -> None:
        """A reading (before any filter) at 2113h or beyond is at the converter's end too."""
        assert self.reading is not None
        for k, (gain, bias) in enumerate(scaling):
            limit = 1e6 * limits[k]
            microstrain = gain * self.reading.counts[k] + bias
            if limit > 0.0 and not self.overloads[k]:
                self.overloads[k] = (microstrain >= limit) - (microstrain <= -limit)

    def status(self) -> int:
        """The status byte 2120h of this sample."""
        if self.known_status < 0:
            self.known_status = self._find_status()
        return self.known_status

    def present(self) -> bool:
        """Contact present, for the hysteresis of the next sample: as it was before where this one cannot tell."""
        if self._unknown == 0:
            return True
        if self.known_status < 0 or self.unknown() & scalar.UNKNOWN_FORCE:
            return self._was_present
        return bool(self.known_status & scalar.CONTACT_PRESENT)

    def unknown(self) -> int:
        """What the status makes unknown, in the bits of ``sensor.scalar``."""
        if self._unknown < 0:
            self._unknown = scalar.unknown(self.status(), self._determined())
        return self._unknown

    def unknown_early(self) -> int:
        """UNKNOWN_GAUGES and UNKNOWN_FORCE of ``unknown``: no contact is needed for these; it hides angles only."""
        if self._early < 0:
            bits = self._early_status()
            # CALIBRATED alone is the only one that gives 0.
            self._early = 0 if bits == scalar.CALIBRATED else scalar.unknown(bits, self._determined())
        return self._early

    def hidden(self) -> bool:
        """Stale, or the front end failed: nothing of this sample is live."""
        return bool(self.unknown_early() & scalar.UNKNOWN_GAUGES)

    def _determined(self) -> bool:
        return self.spared and not self.overloaded

    def force(self) -> "tuple[float, float, float]":
        """F1, F2, F3 in newtons, tare taken off; NaN while the status leaves them unknown or there is no reading."""
        if self._force is None:
            if self.active is None or self.solver is None or self.reading is None:
                self._force = (NAN, NAN, NAN)
            else:
                if self.judgement is not None:
                    f1, f2, f3 = self.judgement.force or (NAN, NAN, NAN)
                else:
                    f1, f2, f3 = self.active.force(self.solver[0], self.microstrains)
                t1, t2, t3 = self.tare
                self._force = (f1 - t1, f2 - t2, f3 - t3)
        return self._force

    def covariance(self) -> "Covariance":
        """Covariance of F, N^2, upper triangle; NaN without calibration."""
        if self._covariance is None:
            if self.judgement is not None:
                self._covariance = self.judgement.covariance()
            else:
                self._covariance = (NAN,) * 6 if self.solver is None else self.solver[1]
        return self._covariance

    def contact(self) -> "tuple[float, float, float, float]":
        """P newtons, phi and theta radians, and by how much the line of action misses the tip."""
        if self._contact is None:
            f1, f2, f3 = self._force or self.force()
            pull = self.active is not None and self.active.pull
            self._contact = scalar.contact_of(scalar.scaled_force(f1, f2, f3), pull)
        return self._contact

    def uncertainty(self) -> "tuple[float, float, float]":
        """Standard uncertainties of P (N), phi and theta (radians), see ``covariance``; NaN without calibration."""
        if self._uncertainty is None:
            if self.active is None or self.solver is None:
                self._uncertainty = (NAN, NAN, NAN)
            else:
                f1, f2, f3 = self.force()
                self._uncertainty = uncertainty(f1, f2, f3, self.covariance(), self.active.pull)
        return self._uncertainty

    def magnitude_uncertainty(self) -> float:
        """Standard uncertainty of P (N) alone; NaN without calibration."""
        if self._uncertainty is not None or self.active is None or self.solver is None:
            return self.uncertainty()[0]
        f1, f2, f3 = self.force()
        return magnitude_uncertainty(f1, f2, f3, self.covariance())

    def find_values(self, sub: int) -> "list[float]":
        """The channels in the unit of 6131h, NaN where hidden: gauges, forces, contact, as far as ``sub`` needs."""
        if self._unknown == 0 == self._early:
            P, phi, theta, _miss = self._contact or self.contact()
            F1, F2, F3 = self._force or self.force()
            self.values = self.microstrains + [F1, F2, F3, P, phi * scalar.DEGREES, theta * scalar.DEGREES]
            return self.values
        values, n = self.values, len(self.microstrains)
        if not n:  # no reading
            return [NAN] * sub
        if not values:
            values += self.microstrains
            if self._early:
                hidden = self.hidden()
                for k, over in enumerate(self.overloads):
                    if over or hidden:
                        values[k] = NAN
        if sub > n and len(values) == n:
            values += (NAN, NAN, NAN) if self._early and self.unknown_early() & scalar.UNKNOWN_FORCE else self.force()
        if sub > n + 3 and len(values) == n + 3:
            unknown = self.unknown()
            if unknown & scalar.UNKNOWN_FORCE:
                values += (NAN, NAN, NAN)
                return values
            P, phi, theta, _miss = self.contact()
            values += (P, NAN if unknown & scalar.UNKNOWN_PHI else phi * scalar.DEGREES)
            values.append(NAN if unknown & scalar.UNKNOWN_THETA else theta * scalar.DEGREES)
        return values

    def _early_status(self) -> int:
        """The bits that are known before any force is: calibrated, saturated, stale, front-end fault."""
        bits = 0 if self.active is None else scalar.CALIBRATED
        if self.stale or self.reading is None:
            bits |= scalar.STALE
        if not self.faults:  # which has the bits of saturated gauges, too
            return bits
        if any(self.overloads) or self.spared or self.overloaded:
            bits |= scalar.SATURATED
        faults = self.faults & _FRONT_END
        if self.spared:
            faults &= ~_OF_ONE_GAUGE
        if faults or (self.faults & _CONTRADICTION and self.solver is None):
            bits |= scalar.FRONT_END_FAULT
        return bits

    def _find_status(self) -> int:
        bits = self._early_status() if self._early else scalar.CALIBRATED
        if self.active is None or self.solver is None:
            return bits
        if bits == scalar.CALIBRATED:
            self._early = 0
        elif scalar.unknown(bits, self.spared) & scalar.UNKNOWN_FORCE:
            return bits
        P, _phi, theta, miss = self._contact or self.contact()
        force = self._force or self.force()
        covariance = self.solver[1] if self.judgement is None else self.covariance()
        u_P = u_theta = NAN  # below the contact-off force no bit depends on them
        if P >= self.active.limits[1]:
            u_P = u_theta = 0.0  # of these the bits need no more than that theta is resolved
            if not scalar.clearly_resolved(P, force[1], covariance):
                u_P, _u_phi, u_theta = self.uncertainty()
        u_miss = 0.0
        if miss > 0.0:
            u_miss = miss_uncertainty(force[0], force[1], force[2], covariance)
        bits |= scalar.status_bits(P, u_P, u_theta, miss, u_miss, theta, self.active.limits, self._was_present)
        if bits | scalar.OUTSIDE_PAD == _ALL_KNOWN:
            self._unknown = 0
        return bits


def outside(value: float, start: float, end: float) -> int:
    """1 for a value above the end of a span, -1 below its start, else 0: all three as the REAL32 that a client reads.
    Nothing checks that the start is below the end: where it is not, a value may be both, and counts as above."""
    shown = real32(value)
    return 1 if shown > end else -(shown < start)
