"""The extreme cases: each claim holds, each area can notice a fault, and the report's record is of these cases."""

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pytest

from stability.case import Case, plain, shortened
from stability.record import AREAS, cases, recorded
from tipforce.device.node import Device
from tipforce.device.storage import Storage
from tipforce.fingertip import calibration, filters
from tipforce.fingertip.application import Fingertip
from tipforce.fingertip.channels import Channels
from tipforce.host.decoding import columns, decoder
from tipforce.host.logs import candump
from tipforce.sensor.calibration import fit as fitting
from tipforce.sensor.contact import estimate, scalar, scalar_condition, scalar_redundancy
from tipforce.sensor.dynamics import first_order_hold, model
from tipforce.sensor.structure import plane_frame
from tipforce_lab.dynamics import integrators, switched
from tipforce_lab.report.cases import all_cases

CASES = {case.key: case for case in cases()}
RECORD = {case.key: case for case in all_cases()}
OUTCOMES = {"pass", "bounded", "flagged", "refused"}


@pytest.mark.parametrize("case", CASES.values(), ids=lambda case: case.key)
def test_claim(case: Case) -> None:
    observed = case.check()
    assert observed.held, f"{case.claim}: {observed.figures}"
    # Times and sizes of errors vary by machine: the record has those of one.
    assert {**recorded(case, observed), "figures": RECORD[case.key].figures} == asdict(RECORD[case.key])
    assert observed.figures
    assert "\n" not in observed.figures
    assert not re.search(r"[{}]|'\S*'|\bTrue\b|\bFalse\b|\bNone\b|(?<![\w\])])\[", plain(observed.figures))


def test_figures_are_plain_words() -> None:
    assert plain("accepted [True, False], none: ['06h', '8210h'], {'timestamp': 7}") == (
        "accepted yes, no, none: 06h, 8210h, timestamp: 7"
    )
    assert plain("strain[17, 1] = nan; (1, 8); P inf N; 0.0e+00 (1 N, say)") == (
        "strain[17, 1] = NaN; 1, 8; P infinity N; 0 (1 N, say)"
    )
    assert shortened("a message of several words, that ends", 30) == "a message of several words ..."
    assert shortened("short", 27) == "short"


def test_rows() -> None:
    found = cases()
    assert len(found) == len(CASES)  # keys are unique
    assert list(RECORD) == list(CASES), "make report writes the record"
    assert len(found) > 100
    for case in found:
        assert case.outcome in OUTCOMES
        assert "." in case.key
        assert case.situation
        assert case.claim
    assert {case.outcome for case in found} == OUTCOMES
    assert len({case.claim for case in found}) == len(found)


@dataclass(frozen=True)
class Fault:
    """A fault planted in the code, and the case that must notice it."""

    key: str
    place: Any
    name: str
    replacement: Callable[[Any], Any]
    """From the right attribute to the faulty one."""


def _naive_triangle(_right: Any) -> Any:
    def triangle(f: Any) -> Any:
        a1, a2, a3 = np.moveaxis(np.abs(f), -1, 0)
        hypotenuse = np.sqrt(a1 * a1 + a3 * a3)
        squared = hypotenuse * hypotenuse - a2 * a2
        excess = np.maximum(a2 - hypotenuse, 0.0)
        return hypotenuse, np.sqrt(np.maximum(squared, 0.0)), excess

    return triangle


def _unscaled(_right: Any) -> Any:
    return lambda F: (F, np.zeros(F.shape[:-1], dtype=np.int64))


def _first_order_slope(_right: Any) -> Any:
    return lambda _x, cosine, _step: 1.0 / np.maximum(cosine, scalar.SMALLEST_COSINE)


def _no_unknown(right: Any) -> Any:
    def number(words: Any, signal: Any) -> Any:
        values = right(words, signal)
        return np.where(np.isnan(values), signal.unknown * signal.scale, values) if signal.unknown else values

    return number


def _wrong_unwrap(_right: Any) -> Any:
    return lambda counter: np.asarray(counter, dtype=np.int64)


def _never(_right: Any) -> Any:
    return lambda *_arguments: False


def _always(_right: Any) -> Any:
    return lambda *_arguments: True


def _stale_is_news(right: Any) -> Any:
    def latch(self: Any, now_us: int, number: int = 0) -> None:
        right(self, now_us, number)
        self.sample.stale = False
        self.sample._status = self.sample._early = self.sample._unknown = -1

    return latch


def _clock_as_given(_right: Any) -> Any:
    def step(self: Any, now_us: int, frames: Any = ()) -> Any:
        self.now_us = now_us
        if not self._booted:
            self._booted = True
            self._restart(True)
        for can_id, data in frames:
            handler = self._routes.get(can_id)
            if handler is not None:
                handler(data)
        due_us = self._expire(now_us)
        sent, self._outbox = self._outbox, []
        return sent, due_us

    return step


def _without_crc(right: Any) -> Any:
    def commit(self: Any, value: Any) -> int:
        self._od.values[0x210301] = calibration.crc32(self.staged_record())
        abort: int = right(self, value)
        return abort

    return commit


def _unchecked(_right: Any) -> Any:
    return lambda self, name: (self._load(name) or b"")[4:] if self._load else b""


def _times(factor: float) -> Callable[[Any], Any]:
    return lambda right: lambda *arguments, **named: factor * right(*arguments, **named)


def _silently_clamped(right: Any) -> Any:
    def status(self: Any, sub: int) -> int:
        found: int = right(self, sub)
        return 0 if found in (3, 5) else found

    return status


def _truncating(right: Any) -> Any:
    """A float state that forgets a little at each reading."""

    def push(self: Any, counts: Any) -> bool:
        right(self, counts)
        self._states = [int(state * (1.0 - 1e-9)) for state in self._states]
        return True

    return push


def _plain_residual(_right: Any) -> Any:
    return lambda *_arguments: np.zeros(0)


def _phase_error(right: Any) -> Any:
    def hold(x: float, zeta: float) -> Any:
        found = right(x, zeta)
        return found._replace(p12=found.p12 * (1.0 + 1e-6))

    return hold


def _no_event(_right: Any) -> Any:
    return lambda *_arguments: None


def _any_time(_right: Any) -> Any:
    return lambda _self, _stamp: 0


FAULTS = (
    Fault("contact.nearly_tangential", estimate, "_triangle", _naive_triangle),
    Fault("contact.magnitudes", estimate, "_scaled", _unscaled),
    Fault("contact.angle_wrap", estimate, "_wrapped", lambda _right: lambda angle: angle),
    Fault("contact.node_agrees", scalar, "sqrt", _times(1.0 + 1e-14)),
    Fault("uncertainty.tangential", estimate, "_finite_slope", _first_order_slope),
    Fault("uncertainty.enormous_noise", scalar, "THETA_RESOLVED_DEG", lambda _right: 1e9),
    Fault("layout.thickness", plane_frame, "_surface_strain", _times(1.0 + 1e-9)),
    Fault("layout.condition_graded", scalar_condition, "_sweep", _never),
    Fault("gauge.stuck", Fingertip, "watch", lambda right: lambda self, *rest: right(self, *rest) & ~(1 << 9)),
    Fault("gauge.swapped_six", scalar_redundancy, "chi_square_threshold", _times(1e6)),
    Fault("gauge.silent", Fingertip, "_silent", _never),
    Fault("filter.first_order_settles", filters.FirstOrder, "push", _truncating),
    Fault("filter.saturated", filters.Filtering, "_restart", lambda _right: lambda _self: None),
    Fault("calibration.impossible_noise", calibration, "_is_covariance", _always),
    Fault("calibration.condition", calibration, "condition_number", lambda _right: lambda _rows: 1.0),
    Fault("calibration.flipped_in_transit", calibration.Calibration, "commit", _without_crc),
    Fault("calibration.flipped_in_store", Storage, "read_blob", _unchecked),
    Fault("fit.plane_of_loads", fitting, "require_seen", _plain_residual),
    Fault("wire.unknown", columns, "_number", _no_unknown),
    Fault("wire.integer16_overflow", Channels, "_status", _silently_clamped),
    Fault("wire.short_pdo", decoder.Decoder, "_drop_short", lambda _right: lambda *_arguments: None),
    Fault("clock.counter_wrap", decoder, "unwrap_counter", _wrong_unwrap),
    Fault("clock.sync_twice_rate", Fingertip, "_latch", _stale_is_news),
    Fault("clock.live_backwards", Device, "step", _clock_as_given),
    Fault("clock.log_beyond", candump.CandumpParser, "_time", _any_time),
    Fault("dynamics.stiffness_ratio", model, "jacobi", lambda right: lambda A: (right(A)[0] * (1 + 1e-9), right(A)[1])),
    Fault("dynamics.step_1s", first_order_hold, "hold", _phase_error),
    Fault("integrator.rk4_unstable", integrators, "runge_kutta_4", lambda _right: integrators.newmark),
    Fault("impact.linear_rigid", switched, "_root", _times(1.0 + 1e-9)),
    Fault("impact.linear_energy", switched.March, "_first_event", _no_event),
)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.key)
def test_a_planted_fault_is_noticed(fault: Fault, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fault.place, fault.name, fault.replacement(getattr(fault.place, fault.name)))
    with np.errstate(all="ignore"):
        assert not CASES[fault.key].check().held


def test_every_area_has_a_planted_fault() -> None:
    assert {case.key.split(".")[0] for case in CASES.values()} - {"front_end"} == {
        fault.key.split(".")[0] for fault in FAULTS
    }
    assert len(AREAS) == 12
