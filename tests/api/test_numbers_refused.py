"""Arguments that no sensor can have: an error that names them, or NaN; never a warning of numpy, and never a wait."""

import inspect
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, TypeAlias

import canopen
import numpy as np
import pytest

import tipforce
import tipforce_lab
from tipforce import sensor
from tipforce.host import PolledHand
from tipforce.samples import reasons
from tipforce.scene import beam_calibration
from tipforce.sensor import FABRICATED

NAN, INF = float("nan"), float("inf")
CALIBRATION = beam_calibration("I", pull=True)
SQUARE = np.eye(3)
ESTIMATE, ROOM = partial(tipforce.Estimator(CALIBRATION), np.zeros((2, 3))), tipforce.Contacts.empty(2)
MODES = sensor.modes(FABRICATED, 0.02)
SLIT = tipforce_lab.slit_stop(FABRICATED, MODES)


def readings(**factors: float) -> tipforce.Readings:
    """Enough good rows, with some columns multiplied."""
    rng = np.random.default_rng(1)
    P, phi, theta = np.full(30, 4.0), rng.uniform(-3, 3, 30), rng.uniform(-3, 3, 30)
    strain = sensor.force_vector(P, phi, theta) @ sensor.strain_matrix(FABRICATED, "I").T
    good = tipforce.Readings(strain + 1e-7 * rng.normal(size=(30, 3)), P, phi, theta)
    return replace(good, **{name: factor * getattr(good, name) for name, factor in factors.items()})


def made(**changes: object) -> tipforce.Calibration:
    """From a good matrix in newtons per microstrain and a good covariance, but for the changes."""
    good = {"matrix": CALIBRATION.C * 1e-6, "covariance": SQUARE}
    return tipforce.Calibration.from_microstrain(**(good | changes))  # type: ignore[arg-type]


CORRELATED, UNEQUAL = np.eye(3), np.eye(3)
CORRELATED[0, 1] = CORRELATED[1, 0] = 2.0
UNEQUAL[0, 1] = 0.5
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
    "a matrix of nothing": (lambda: sensor.condition_number(np.zeros((0, 3))), "(0, 3): allowed are"),
    "beyond any float": (lambda: sensor.contacts([10**400, 0, 0], pull=True), "is no array of numbers"),
    "C of NaN": (lambda: sensor.parity(np.full((3, 4), NAN), np.eye(4)), "C holds nan"),
    "linear fit": (lambda: sensor.linear_fit(NAN * SQUARE, SQUARE), "finite"),
    "closing load": (lambda: sensor.closing_load(FABRICATED, NAN, 0.0), "finite angles"),
    "gap": (lambda: sensor.closing_load(FABRICATED, 0.0, 0.0, gap_m=-1.0), "a gap above 0"),
    "wrench": (lambda: sensor.apparent_force(FABRICATED, "I", np.zeros(5)), "(1, 5): allowed is (m, 6)"),
    "layout": (lambda: sensor.layout(3), "3 is not known"),  # type: ignore[arg-type]
    "damping": (lambda: tipforce_lab.rk4_stability_limit(-1.0), "-1.0: allowed is 0 to"),
    "noise": (lambda: tipforce.simulated_finger(5, noise_microstrain=-1.0), "-1.0: allowed is 0 to"),
    "load": (lambda: tipforce.simulated_finger(5, load=(1e300, 0.0, 0.0)), "theta degrees), finite"),
    "rank": (lambda: made(matrix=np.zeros((3, 3))), "rank below 3"),
    "two gauges": (lambda: made(matrix=np.ones((3, 2))), "shape (3, 2), allowed (3, 3) to (3, 8)"),
    "matrix of NaN": (lambda: made(matrix=np.full((3, 3), NAN)), "not finite"),
    "two offsets": (lambda: made(offset=[1.0, 2.0]), "offset: shape (2,), allowed is (3,)"),
    "variance below 0": (lambda: made(covariance=-SQUARE), "variance is -1e-12: allowed is above 0"),
    "correlation": (lambda: made(covariance=CORRELATED), "no correlation may be over 1"),
    "asymmetry": (lambda: made(covariance=UNEQUAL), "not symmetric"),
    "variance of 0": (lambda: made(covariance=np.zeros((3, 3))), "variance is 0: allowed is above 0"),
    "no covariance": (lambda: made(covariance=None), "give covariance"),
    "two noises": (lambda: made(covariance=None, noise=[1.0, 2.0]), "noise: shape (2,)"),
    "a noise of 1e308": (lambda: made(covariance=None, noise=1e308), "1e+308 microstrain, allowed is above 0 to 1e+06"),
    "no node": (lambda: tipforce.simulated_hand(0), "different ones from 1 to 127"),
    "one node twice": (lambda: tipforce.simulated_hand([1, 1]), "different ones from 1 to 127"),
    "load of no node": (lambda: tipforce.simulated_hand(2, {3: (1.0, 90.0, 45.0)}), "loads of nodes [3]"),
    "two numbers": (lambda: tipforce.simulated_finger(5, (1.0, 90.0)), "load (1.0, 90.0) of node 5"),  # type: ignore[arg-type]
    "layout of a finger": (lambda: tipforce.simulated_finger(5, layout="X"), "layout 'X' is not known"),
    "five gauges": (lambda: tipforce.estimate(CALIBRATION, np.zeros((4, 5))), "allowed are (k, 3) and (3,)"),
    "not connected": (lambda: tipforce.open(canopen.Network()), "connect() first"),
    "time-out": (lambda: tipforce.open("x", "virtual", timeout_s=NAN), "timeout_s = nan: allowed is 0 s or more"),
    "retries": (lambda: tipforce.open("x", "virtual", retries=-1), "retries = -1: allowed are"),
    "noise as text": (lambda: beam_calibration(noise_microstrain="1"), "'1': allowed is 0 to"),  # type: ignore[arg-type]
    "seed": (lambda: tipforce.simulated_hand(2, seed=1.5), "seed 1.5: allowed are integers"),  # type: ignore[arg-type]
    "no fingers": (lambda: tipforce.Hand.open(5), "fingers 5: allowed are a hand file, node-ids, or"),  # type: ignore[arg-type]
    "names of fingers": (lambda: tipforce.Hand.open({1: "thumb"}), "finger 1: allowed are node-ids by name"),  # type: ignore[dict-item]
    "node-id of a finger": (lambda: tipforce.Hand.open({"thumb": 1.5}), "'thumb': node-id 1.5: allowed are integers"),  # type: ignore[dict-item]
    "room of integers": (lambda: ESTIMATE(out=replace(ROOM, P_newtons=np.zeros(2, "i1"))), "is Contacts.empty(2)"),
    "room of 8 bits": (lambda: ESTIMATE(out=replace(ROOM, status=np.zeros(2, "u1"))), "is Contacts.empty(2)"),
    "read-only room": (lambda: ESTIMATE(out=replace(ROOM, phi_deg=np.broadcast_to(0.0, 2))), "is Contacts.empty(2)"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_number_that_cannot_be_is_refused_by_name(case: str) -> None:
    call, text = REFUSED[case]
    before = set(threading.enumerate())
    with pytest.raises(tipforce.InputError) as refused:
        call()
    assert text in str(refused.value)
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize("reading", [NAN, INF, -INF, 1e300, 1.7e308, 1.1e6])
def test_a_reading_that_no_gauge_can_have_makes_the_contact_unknown(reading: float) -> None:
    contacts = tipforce.estimate(CALIBRATION, [[reading, 700.0, 300.0], [-125.0, 728.7, 323.6]])
    assert np.isnan([contacts.P_newtons[0], contacts.phi_deg[0], contacts.theta_deg[0], contacts.u_P_newtons[0]]).all()
    assert contacts.P_newtons[1] == pytest.approx(4.4, abs=0.01)
    assert contacts.has(tipforce.Status.CONTACT).tolist() == [False, True]


def test_an_uncertainty_that_is_too_large_is_no_warning() -> None:
    """Readings in columns and, up to FEW, one by one."""
    noisy = replace(CALIBRATION, covariance_strain2=1e4 * SQUARE)
    readings = np.random.default_rng(2).normal(size=(60, 3)) * 1e-299
    many, few = tipforce.estimate(noisy, readings), tipforce.estimate(noisy, readings[:5])
    np.testing.assert_array_equal(many.status[:5], few.status)
    assert not many.has(tipforce.Status.CONTACT).any()


def test_what_is_not_known_is_nan() -> None:
    assert np.isnan(sensor.condition_number(NAN * SQUARE))
    assert np.isnan(sensor.force_vector(1.0, INF, 0.0)).all()
    warm, rows = replace(CALIBRATION, gain_temperature_per_K=1e-3), np.random.default_rng(2).normal(size=(50, 3)) * 100
    found = [tipforce.estimate(warm, rows, temperature_degC=degC) for degC in (NAN, INF, -INF)]
    assert all(np.array_equal(contacts.values, found[0].values, equal_nan=True) for contacts in found)
    assert found[1].has(tipforce.Status.TEMPERATURE).all()


def test_node_ids_of_any_integer_type() -> None:
    ids: Any = np.array([2, 100], dtype=np.int8)
    with tipforce.simulated_hand(list(ids), seed=ids[0]) as bus:
        assert bus.node_ids == (2, 100)
        assert bus.finger(ids[1]).sdo["identity.serial"] == 1100
        assert PolledHand(bus, ids).node_ids == (2, 100)
        with tipforce.Hand.open(ids, bus=bus) as hand:
            assert [type(node_id) for node_id in hand.node_ids] == [int, int]
            assert hand.state(2) == hand.state("finger 2") == "operational"
            with pytest.raises(tipforce.InputError, match="finger 9: the hand has finger 2"):
                hand.state(9)
            with pytest.raises(tipforce.InputError, match="timeout_s = nan: allowed is 0 s or more"):
                hand.rows(NAN)
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
            lambda: bus.inject_fault(5, "drift", magnitude=INF),
            lambda: bus.inject_fault(5, "open", gauge=1.5),  # type: ignore[arg-type]
            lambda: PolledHand(bus, [5]).sample(NAN),
            lambda: finger.read(timeout_s="1"),  # type: ignore[arg-type]
        ):
            with pytest.raises(tipforce.InputError):
                call()


STRAIN4 = np.vstack((sensor.strain_matrix(FABRICATED, "I"), [[1e-4, 0.0, 1e-4]]))
C4 = np.linalg.pinv(STRAIN4)
PARITY = sensor.parity(C4, 1e-12 * np.eye(4))
GOOD = readings()
OUTPUTS = {"Contacts", "NodeLog", "Fit"}
"""What tipforce makes, not users."""


def fit(**columns: object) -> object:
    """A fit of good readings with one column replaced."""
    return tipforce.fit_calibration(replace(GOOD, **columns))  # type: ignore[arg-type]


Given: TypeAlias = tuple[Callable[..., object], dict[str, object]]


def given(call: Callable[..., object], **arrays: object) -> Given:
    """What is called, and numbers that it takes."""
    return call, arrays


ARRAYS: dict[str, Given] = {
    "estimate": given(partial(tipforce.estimate, CALIBRATION), microstrain=[[1.0, 2.0, 3.0]], temperature_degC=[20.0]),
    "Estimator": given(tipforce.Estimator(CALIBRATION), microstrain=[1.0, 2.0, 3.0], temperature_degC=20.0),
    "Calibration.from_microstrain": given(
        tipforce.Calibration.from_microstrain, matrix=CALIBRATION.C * 1e-6, offset=[0.0, 1.0, 2.0], covariance=SQUARE),
    "Calibration.from_microstrain noise": given(
        partial(tipforce.Calibration.from_microstrain, CALIBRATION.C * 1e-6), noise=[1.0, 2.0, 1.0]),
    "Calibration": given(
        tipforce.Calibration, C=CALIBRATION.C, offset_strain=[0.0, 0.0, 0.0], covariance_strain2=1e-12 * SQUARE,
        converter_limit_strain=[1.0, 1.0, 1.0], offset_temperature_strain_per_K=[0.0, 0.0, 0.0],
        parameter_covariance=np.zeros((3, 4, 3, 4)), tip_radius_m=0.015, model_uncertainty=0.01,
        calibrated_force_newtons=5.0),
    "Readings": given(fit, **{name: getattr(GOOD, name) for name in ("strain", "P_newtons", "phi_rad", "theta_rad")}),
    "Readings by time": given(fit, t_s=np.arange(30.0), weight=np.ones(30), temperature_degC=np.full(30, 20.0)),
    "Model": given(
        lambda **given: tipforce.fit_calibration(GOOD, sensor.Model(**given)),
        noise_strain=[1e-6, 1e-6, 1e-6], saturation_strain=[1.0, 1.0, 1.0]),
    "Prior": given(
        lambda A: tipforce.fit_calibration(GOOD, sensor.Model(prior=sensor.Prior(A))),
        A=sensor.strain_matrix(FABRICATED, "I")),
    "apparent_force": given(partial(sensor.apparent_force, FABRICATED, "I"), wrenches=np.zeros((1, 6))),
    "condition_number": given(sensor.condition_number, matrix=SQUARE),
    "contacts": given(partial(sensor.contacts, pull=True), F_newtons=[1.0, 0.0, 2.0]),
    "covariance_of_estimate": given(
        sensor.covariance_of_estimate, C=CALIBRATION.C, noise_covariance=1e-12 * SQUARE,
        parameter_covariance=np.zeros((3, 4, 3, 4)), F_newtons=[1.0, 0.0, 2.0]),
    "curvature": given(sensor.curvature, F_newtons=[1.0, 0.0, 2.0], covariance_F=SQUARE),
    "detect": given(partial(sensor.detect, PARITY), strain=np.zeros((2, 4)), variance_factor=[1.0, 1.0]),
    "first_order_holds": given(sensor.first_order_holds, F_newtons=[1.0, 0.0, 2.0], covariance_F=SQUARE),
    "force_from_strain": given(
        sensor.force_from_strain, C=SQUARE, strain=[1.0, 2.0, 3.0], offset_strain=[0.0] * 3, tare_newtons=[0.0] * 3),
    "force_vector": given(sensor.force_vector, P_newtons=[1.0], phi_rad=[0.0], theta_rad=[0.0]),
    "linear_fit": given(sensor.linear_fit, strain=SQUARE, F_newtons=SQUARE),
    "noise_gain": given(sensor.noise_gain, C=SQUARE),
    "off_axis_wrenches": given(partial(sensor.off_axis_wrenches, FABRICATED), theta_rad=[0.1, 0.2]),
    "overload": given(
        partial(tipforce_lab.overload, MODES, SLIT), times_s=np.arange(3) * 1e-4, loads_newtons=np.zeros((3, 3))),
    "parity": given(sensor.parity, C=C4, covariance_strain2=1e-12 * np.eye(4)),
    "respond": given(partial(sensor.respond, MODES, step_s=1e-4), loads_newtons=np.zeros((5, 3))),
    "standard_uncertainties": given(
        partial(sensor.standard_uncertainties, pull=True), F_newtons=[1.0, 0.0, 2.0], covariance_F=SQUARE),
}  # fmt: skip


def masked(values: object) -> object:
    """The same numbers, the first of them masked."""
    array = np.ma.array(values, dtype=np.float64, copy=True)
    array[(0,) * array.ndim] = np.ma.masked
    return array


NO_NUMBERS: dict[str, Callable[[object], object]] = {
    "masked": masked,
    "complex": lambda values: np.asarray(values) + 1j,
    "text": lambda values: np.asarray(values).astype(str),
    "truth": lambda values: np.ones(np.asarray(values).shape, dtype=np.bool_),
    "objects": lambda values: np.full(np.asarray(values).shape, object()),
    "rows of different lengths": lambda _: [[1.0, 2.0], [3.0]],
}


@pytest.mark.parametrize("kind", NO_NUMBERS)
@pytest.mark.parametrize(("name", "argument"), [(name, key) for name, (_, arrays) in ARRAYS.items() for key in arrays])
def test_what_is_no_array_of_numbers_is_refused_by_name(name: str, argument: str, kind: str) -> None:
    call, arrays = ARRAYS[name]
    with pytest.raises(tipforce.InputError) as refused:
        call(**{**arrays, argument: NO_NUMBERS[kind](arrays[argument])})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ARRAYS)
def test_these_arrays_are_numbers(name: str) -> None:
    call, arrays = ARRAYS[name]
    call(**arrays)
    plain: dict[str, Any] = {key: np.ma.array(value) for key, value in arrays.items()}  # nothing is masked
    call(**plain)


def test_every_public_name_with_arrays_is_tried() -> None:
    tried = {name.split(" ")[0] for name in ARRAYS} | OUTPUTS
    timed = {"impact", "strain_row"}  # their arrays are times and places of a simulation
    for module in (tipforce, sensor):
        for name in module.__all__:
            public = getattr(module, name)
            with suppress(TypeError, ValueError):
                annotations = [str(p.annotation) for p in inspect.signature(public).parameters.values()]
                assert name in tried | timed or not any("Array" in annotation for annotation in annotations), name


@pytest.mark.parametrize("noise", [-1.0, 0.0, NAN, INF, [1.0, -1.0, 1.0], [], [[1.0, 1.0, 1.0]], "1", True, None])
def test_noise_that_no_gauge_has_is_refused(noise: object) -> None:
    with pytest.raises(tipforce.InputError, match=r"calibration.*noise"):
        tipforce.Calibration.from_microstrain(CALIBRATION.C * 1e-6, noise=noise)  # type: ignore[arg-type]


def test_without_a_force_range_no_value_is_plainly_ok() -> None:
    """The value stays up to a strain that no structure survives, and its status says that nothing bounds it."""
    unranged = tipforce.Calibration.from_microstrain(CALIBRATION.C * 1e-6, noise=0.5, pull=True)
    for microstrain in (2e4, 3.1e4, 1e5, 9.9e5):
        reading = [-125.0, 728.7, microstrain]
        contact = tipforce.estimate(unranged, reading)
        ranged = tipforce.estimate(replace(unranged, calibrated_force_newtons=1e6), reading)
        assert contact.has(tipforce.Status.UNRANGED).tolist() == [microstrain <= 3e4]
        assert contact.has(tipforce.Status.OVERLOAD).tolist() == [microstrain > 3e4]
        assert np.isnan(contact.P_newtons[0]) == np.isnan(ranged.P_newtons[0]) == (microstrain > 3e4)
        assert not ranged.has(tipforce.Status.UNRANGED).any()
    small = tipforce.estimate(unranged, [-125.0, 728.7, 323.6])
    assert small.P_newtons[0] == pytest.approx(4.4, abs=0.01)
    assert "the calibration states no force range" in reasons.doubts(int(small.status[0]))
    assert not reasons.doubts(int(tipforce.estimate(CALIBRATION, [-125.0, 728.7, 323.6]).status[0]))


def test_a_gauge_that_is_left_out_is_no_overload() -> None:
    """Four gauges, one at the end of its converter: the others give the force."""
    four = tipforce.Calibration(C4, np.zeros(4), 1e-12 * np.eye(4), pull=True)
    strain = STRAIN4 @ sensor.force_vector(2.0, 1.0, 1.0) * 1e6
    strain[3] = 9e5
    contact = tipforce.estimate(four, [strain], lost=np.array([8]))
    assert contact.P_newtons[0] == pytest.approx(2.0, rel=1e-6)
    assert not contact.has(tipforce.Status.OVERLOAD).any()
