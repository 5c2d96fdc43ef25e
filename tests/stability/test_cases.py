"""The extreme cases: each claim holds, each area can notice a fault, and the report's record is of these cases."""

import re
from binascii import crc32
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from canopen_device.core.node import Device
from canopen_device.core.storage import Storage
from stability.case import Case, cases, plain, recorded, shortened
from tipforce.fingertip import calibration, filters
from tipforce.fingertip.channels import Channels
from tipforce.fingertip.node import Fingertip
from tipforce.host.decoding import decoder, sample_table
from tipforce.host.logs import candump
from tipforce.sensor.calibration import regressors
from tipforce.sensor.contact import estimate, scalar, scalar_condition, scalar_redundancy
from tipforce.sensor.dynamics import first_order_hold, model
from tipforce.sensor.structure import plane_frame
from tipforce_lab.dynamics import integrators, switched
from tipforce_lab.report.study import all_cases

CASES = {case.key: case for case in cases()}
RECORD = {case.key: case for case in all_cases()}
OUTCOMES = {"pass", "bounded", "flagged", "refused"}


@pytest.mark.parametrize("case", CASES.values(), ids=lambda case: case.key)
def test_claim(case: Case) -> None:
    held, figures = observed = case.check()
    assert held, f"{case.claim}: {figures}"
    # Times and sizes of errors vary by machine: the record has those of one.
    assert {**recorded(case, observed), "figures": RECORD[case.key].figures} == asdict(RECORD[case.key])
    assert figures
    assert "\n" not in figures
    assert not re.search(r"[{}]|'\S*'|\bTrue\b|\bFalse\b|\bNone\b|(?<![\w\])])\[", plain(figures))


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
        assert "." in case.key
        assert case.situation
        assert case.claim
    assert {case.outcome for case in found} == OUTCOMES
    assert len({case.claim for case in found}) == len(found)


def _gives(value: Any) -> Any:
    return lambda _right, *_arguments: value


def _times(factor: float) -> Any:
    return lambda right, *arguments, **named: factor * right(*arguments, **named)


def _naive_triangle(right: Any, *F: Any) -> Any:
    scaled = right(*F)
    a2, hypotenuse = np.abs(scaled.f2), scaled.hypotenuse
    squared = hypotenuse * hypotenuse - a2 * a2
    return scaled._replace(cosine=np.sqrt(np.maximum(squared, 0.0)), excess=np.maximum(a2 - hypotenuse, 0.0))


def _no_unknown(right: Any, layout: Any, words: Any) -> Any:
    return right(sample_table.Layout(replace(one, unknown=None) for one in layout.signals), words)


def _any_length(right: Any, frames: Any, slots: Any, layouts: Any, *others: Any, **named: Any) -> Any:
    layouts = layouts.copy()
    layouts["length"] = 0
    return right(frames, slots, layouts, *others, **named)


def _stale_is_news(right: Any, tip: Any, now_us: int, number: int = 0) -> None:
    right(tip, now_us, number)
    tip.sample.stale = False
    tip.sample.known_status = tip.sample._early = tip.sample._unknown = -1


def _clock_as_given(right: Any, device: Any, now_us: int, frames: Any = ()) -> Any:
    device.now_us = now_us
    return right(device, now_us, frames)


def _without_crc(right: Any, active: Any, value: Any) -> Any:
    active._od.values[0x210301] = crc32(active.staged_record())
    return right(active, value)


def _silently_clamped(right: Any, channels: Any, sub: int) -> Any:
    found = right(channels, sub)
    return 0 if found in (3, 5) else found


def _truncating(right: Any, state: Any, counts: Any) -> bool:
    """A float state that forgets a little at each reading."""
    right(state, counts)
    state._sums = [int(each * (1.0 - 1e-9)) for each in state._sums]
    return True


# The case that must notice, the place and name of an attribute, and its fault: what a call of the right one gives, or
# what stands in place of a number.
FAULTS: tuple[tuple[str, Any, str, Any], ...] = (
    ("contact.nearly_tangential", estimate, "forces", _naive_triangle),
    ("contact.magnitudes", estimate, "_power_of_two", lambda _right, exponent, *_most: 0.0 * exponent + 1.0),
    ("contact.angle_wrap", estimate, "_wrapped", lambda _right, angle: angle),
    ("contact.node_agrees", scalar, "sqrt", _times(1.0 + 1e-14)),
    ("uncertainty.tangential", estimate, "_finite_slope",
     lambda _right, _x, cosine, _step: 1.0 / np.maximum(cosine, scalar.SMALLEST_COSINE)),
    ("uncertainty.enormous_noise", scalar, "THETA_RESOLVED_DEG", 1e9),
    ("layout.thickness", plane_frame, "_surface_strain", _times(1.0 + 1e-9)),
    ("layout.condition_graded", scalar_condition, "_sweep", _gives(False)),
    ("gauge.stuck", Fingertip, "watch", lambda right, *rest: right(*rest) & ~(1 << 9)),
    ("gauge.swapped_six", scalar_redundancy, "chi_square_threshold", _times(1e6)),
    ("gauge.silent", Fingertip, "_silent", _gives(False)),
    ("filter.first_order_settles", filters.FirstOrder, "push", _truncating),
    ("filter.saturated", filters.Filtering, "_restart", _gives(None)),
    ("calibration.impossible_noise", calibration, "_is_covariance", _gives(True)),
    ("calibration.condition", calibration, "condition_number", _gives(1.0)),
    ("calibration.flipped_in_transit", calibration.Calibration, "commit", _without_crc),
    ("calibration.flipped_in_store", Storage, "read_blob",
     lambda _right, storage, name: (storage._load(name) or b"")[4:] if storage._load else b""),
    ("fit.plane_of_loads", regressors, "require_seen", _gives(None)),
    ("wire.unknown", sample_table.Layout, "columns", _no_unknown),
    ("wire.integer16_overflow", Channels, "_status", _silently_clamped),
    ("wire.short_pdo", decoder, "join", _any_length),
    ("clock.counter_wrap", decoder, "unwrap_counter", lambda _right, counter: np.asarray(counter, dtype=np.int64)),
    ("clock.sync_twice_rate", Fingertip, "_latch", _stale_is_news),
    ("clock.live_backwards", Device, "step", _clock_as_given),
    ("clock.log_beyond", candump.CandumpParser, "_time", _gives(0)),
    ("dynamics.stiffness_ratio", model, "jacobi", lambda right, A: (right(A)[0] * (1 + 1e-9), right(A)[1])),
    ("dynamics.step_1s", first_order_hold, "hold",
     lambda right, *given: right(*given)._replace(p12=right(*given).p12 * (1.0 + 1e-6))),
    ("integrator.rk4_unstable", integrators, "runge_kutta_4", lambda _right, *given: integrators.newmark(*given)),
    ("impact.linear_rigid", switched, "_root", _times(1.0 + 1e-9)),
    ("impact.linear_energy", switched.March, "_first_event", _gives(None)),
)  # fmt: skip


@pytest.mark.parametrize(("key", "place", "name", "fault"), FAULTS, ids=[row[0] for row in FAULTS])
def test_a_planted_fault_is_noticed(key: str, place: Any, name: str, fault: Any, monkeypatch: Any) -> None:
    right = getattr(place, name)

    def wrong(*arguments: Any, **named: Any) -> Any:
        return fault(right, *arguments, **named)

    monkeypatch.setattr(place, name, wrong if callable(right) else fault)
    with np.errstate(all="ignore"):
        assert not CASES[key].check()[0]


def test_every_area_has_a_planted_fault() -> None:
    assert {key.split(".")[0] for key in CASES} - {"front_end"} == {key.split(".")[0] for key, *_ in FAULTS}
