"""Arguments that no sensor can have: an error that names them, or NaN; never a warning of numpy, and never a wait."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import tipforce
from tipforce import sensor
from tipforce.scene import beam_calibration
from tipforce.sensor import FABRICATED

NAN, INF = float("nan"), float("inf")
CALIBRATION = beam_calibration("I", pull=True)
SQUARE = np.eye(3)
MODES = sensor.modes(FABRICATED, 0.02)


def readings(**factors: float) -> tipforce.Readings:
    """Enough good rows, with some columns multiplied."""
    rng = np.random.default_rng(1)
    P, phi, theta = np.full(30, 4.0), rng.uniform(-3, 3, 30), rng.uniform(-3, 3, 30)
    strain = sensor.force_vector(P, phi, theta) @ sensor.strain_matrix(FABRICATED, "I").T
    good = tipforce.Readings(strain + 1e-7 * rng.normal(size=(30, 3)), P, phi, theta)
    return replace(good, **{name: factor * getattr(good, name) for name, factor in factors.items()})


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "text for numbers": (lambda: tipforce.estimate(CALIBRATION, ["a", "b", "c"]), "is no array of numbers"),
    "temperatures": (lambda: tipforce.estimate(CALIBRATION, [[1, 2, 3]], temperature_degC=[1, 2]), "(2,): allowed are"),
    "lost rows": (lambda: tipforce.estimate(CALIBRATION, [[1, 2, 3]] * 3, lost=np.array([1, 2])), "(2,): allowed are"),
    "lost bits": (lambda: tipforce.estimate(CALIBRATION, [1, 2, 3], lost=np.array([1.0])), "allowed are integers"),
    "sense": (lambda: replace(CALIBRATION, pull="push"), "allowed are True and False"),  # type: ignore[arg-type]
    "serial": (lambda: replace(CALIBRATION, serial=-1).check(), "-1 does not fit UNSIGNED32"),
    "matrix": (lambda: tipforce.Calibration.from_microstrain(1e305 * SQUARE, noise=1.0), "is not finite"),
    "strain": (lambda: tipforce.fit_calibration(readings(strain=1e300)), "-1e+50 to 1e+50"),
    "dead gauges": (lambda: tipforce.fit_calibration(readings(strain=0.0)), "dead or disconnected"),
    "force": (lambda: tipforce.fit_calibration(readings(P_newtons=1e300)), "1e-50 to 1e+50 N"),
    "degrees": (lambda: tipforce.fit_calibration(readings(phi_rad=57.3)), "np.radians()"),
    "shape of a matrix": (lambda: sensor.condition_number([1.0, 2.0, 3.0]), "(3,): allowed are"),
    "C of NaN": (lambda: sensor.parity(np.full((3, 4), NAN), np.eye(4)), "C holds nan"),
    "linear fit": (lambda: sensor.linear_fit(NAN * SQUARE, SQUARE), "finite"),
    "closing load": (lambda: sensor.closing_load(FABRICATED, NAN, 0.0), "finite angles"),
    "gap": (lambda: sensor.closing_load(FABRICATED, 0.0, 0.0, gap_m=-1.0), "a gap above 0"),
    "wrench": (lambda: sensor.apparent_force(FABRICATED, "I", np.zeros(5)), "(1, 5): allowed is (m, 6)"),
    "layout": (lambda: sensor.layout(3), "3 is not known"),  # type: ignore[arg-type]
    "damping": (lambda: sensor.rk4_stability_limit(-1.0), "-1.0: allowed is 0 to"),
    "noise": (lambda: tipforce.simulated_finger(5, noise_microstrain=-1.0), "-1.0: allowed is 0 to"),
    "load": (lambda: tipforce.simulated_finger(5, load=(1e300, 0.0, 0.0)), "theta degrees), finite"),
    "time-out": (lambda: tipforce.open("x", "virtual", timeout_s=NAN), "timeout_s = nan: allowed is 0 s or more"),
    "retries": (lambda: tipforce.open("x", "virtual", retries=-1), "retries = -1: allowed are"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_number_that_cannot_be_is_refused_by_name(case: str) -> None:
    call, text = REFUSED[case]
    before = threading.active_count()
    with pytest.raises(tipforce.InputError) as refused:
        call()
    assert text in str(refused.value)
    assert threading.active_count() == before


@pytest.mark.parametrize("reading", [NAN, INF, -INF, 1e300, 1.7e308, 1.1e6])
def test_a_reading_that_no_gauge_can_have_makes_the_contact_unknown(reading: float) -> None:
    contacts = tipforce.estimate(CALIBRATION, [[reading, 700.0, 300.0], [-125.0, 728.7, 323.6]])
    assert np.isnan([contacts.P_newtons[0], contacts.phi_deg[0], contacts.theta_deg[0], contacts.u_P_newtons[0]]).all()
    assert contacts.P_newtons[1] == pytest.approx(4.4, abs=0.01)
    assert contacts.has(tipforce.Status.CONTACT).tolist() == [False, True]


def test_what_is_not_known_is_nan() -> None:
    assert np.isnan(sensor.condition_number(NAN * SQUARE))
    assert np.isnan(sensor.standard_uncertainties([4.0, 1.0, 2.0], -SQUARE, pull=True)).all()
    assert sensor.noise_gain(1e200 * SQUARE) == pytest.approx(3**0.5 * 1e200)


def test_no_wait_without_a_limit_and_no_flood_of_syncs() -> None:
    with tipforce.simulated_finger(5) as bus:
        finger = bus.finger(5)
        for call in (
            lambda: finger.read(timeout_s=NAN),
            lambda: finger.samples(timeout_s=-1.0),
            lambda: finger.samples(rate_hz=INF),
            lambda: bus.wait_for({1}, NAN),
            lambda: bus.scan([5], NAN),
            lambda: bus.scan([200], 0.1),
            lambda: bus.nmt("start", 200),
            lambda: bus.apply_load(5, NAN, 0.0, 0.0),
        ):
            with pytest.raises(tipforce.InputError):
                call()
