"""A prepared estimator: one reading, a table and `estimate` agree; what a call computes, and what it does not."""

from typing import Any

import numpy as np
import pytest

from tipforce import Calibration, Contacts, Estimator, InputError, Status, estimate
from tipforce.fingertip.calibration import Active
from tipforce.host.decoding import estimator as module
from tipforce.samples import reasons
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.contact.redundancy import weighted_inverse
from tipforce.sensor.contact.scalar_redundancy import chi_square_threshold

ROWS = 90
VALUES = ("P_newtons", "phi_deg", "theta_deg", "u_P_newtons", "u_phi_deg", "u_theta_deg")


def random_calibration(seed: int) -> tuple[Calibration, Any]:
    """(calibration, strain per newton); what it states, its size and how near it is to singular go with the seed."""
    rng = np.random.default_rng(seed)
    n = 3 + seed % 6
    A = 2e-4 * rng.normal(size=(n, 3))
    if seed % 7 == 0:
        A[:, 2] = A[:, 1] * (1.0 + 1e-3 * rng.normal(size=n))
    B = rng.normal(size=(n, n))
    Sigma = 1e-12 * (0.2 * B @ B.T / n + np.eye(n))
    newtons = 10.0 ** rng.integers(-80, 80) if seed % 11 == 0 else 1.0
    stated: dict[str, Any] = {"pull": seed % 4 < 2}
    if seed % 2:
        stated |= {"calibrated_force_newtons": 3.0 * newtons, "model_uncertainty": 0.01 * (seed % 3)}
    if seed % 3 == 0:
        stated |= {"overload_force_newtons": 4.0 * newtons}
    if seed % 4 == 0:
        stated |= {"offset_temperature_strain_per_K": 1e-7 * rng.normal(size=n), "gain_temperature_per_K": 3e-4}
        stated |= {"temperature_min_degC": 10.0, "temperature_max_degC": 30.0}
    if seed % 5 == 0:
        stated |= {"converter_limit_strain": np.full(n, 1.5e-3)}
    if n > 3 and seed % 3 != 1:
        stated |= {"redundancy_limit": chi_square_threshold(1e-4, n - 3)}
    if seed % 6 < 2:
        D = rng.normal(size=(4 * n, 4 * n))
        stated |= {"parameter_covariance": (1e-15 / n * (D @ D.T)).reshape(n, 4, n, 4)}
    C = weighted_inverse(A, Sigma) * newtons
    return Calibration(C, 1e-5 * rng.normal(size=n), Sigma, **stated), A


def readings(seed: int) -> tuple[Calibration, Any, Any, Any]:
    """(calibration, microstrain, temperature, lost gauges): pulls, pushes, misses, and every fault."""
    calibration, A = random_calibration(seed)
    rng, n = np.random.default_rng([seed, 1]), calibration.gauges
    theta, P = rng.uniform(0.1, 3.0, ROWS), rng.uniform(0.0, 5.0, ROWS)
    phi = theta + rng.uniform(-1.57, 1.57, ROWS) + np.pi * (not calibration.pull)
    noise = rng.multivariate_normal(np.zeros(n), calibration.covariance_strain2, size=ROWS)
    microstrain = 1e6 * (force_vector(P, phi, theta) @ A.T + calibration.offset_strain + noise)
    for k, row in enumerate(microstrain[20:60]):
        row[k % n] += (30.0 * rng.normal(), np.nan, 5e4, 3e6, -1600.0, np.inf)[k % 6]
    microstrain[60:63] = 1e6 * calibration.offset_strain
    microstrain[63] = 0.0
    temperature = np.where(rng.random(ROWS) < 0.1, np.nan, rng.uniform(5.0, 35.0, ROWS)) if seed % 8 != 1 else None
    lost = np.where(rng.random(ROWS) < 0.1, 1 << rng.integers(0, n, ROWS), 0) if seed % 3 == 2 else None
    return calibration, microstrain, temperature, lost


@pytest.mark.parametrize("seed", range(48))
def test_one_reading_a_table_and_the_function_agree(seed: int) -> None:
    """To 1e-12, and each bit of the status. Of an ill-conditioned covariance u(theta) shows the last bit of asin, and
    in numpy 1, whose asin differs from the one of ``math`` by two bits, four times as much."""
    calibration, microstrain, temperature, lost = readings(seed)
    estimator = Estimator(calibration)
    table = estimator(microstrain, temperature_degC=temperature, lost=0 if lost is None else lost)
    whole = estimate(calibration, microstrain, temperature_degC=temperature, lost=lost)
    np.testing.assert_array_equal(table.values, whole.values)
    np.testing.assert_array_equal(table.status, whole.status)
    tolerance = np.full(6, 1e-12)
    tolerance[5] += (4e-16 if np.__version__ < "2" else 1e-16) * np.linalg.cond(calibration.covariance_F)
    present = overloaded = False
    for k, row in enumerate(microstrain.tolist()):
        contact = estimator(
            row, temperature_degC=None if temperature is None else float(temperature[k]),
            lost=0 if lost is None else int(lost[k]), was_present=present, was_overloaded=overloaded,
        )  # fmt: skip
        assert contact.status == Status(int(table.status[k])), k
        values, expected = np.array([getattr(contact, name) for name in VALUES]), table.values[k]
        np.testing.assert_array_equal(np.isnan(values), np.isnan(expected))
        assert not (np.abs(values - expected) > tolerance * np.abs(expected)).any(), (k, values, expected)
        if not np.isnan(contact.P_newtons) or not contact.status & (Status.OVERLOAD | Status.FAULT | Status.SATURATED):
            present = contact.present
        overloaded = Status.OVERLOAD in contact.status
    few = estimator(  # in batches without what a table shows of gauges that stand still
        microstrain[: module.FEW], temperature_degC=None if temperature is None else temperature[: module.FEW],
        lost=0 if lost is None else lost[: module.FEW], out=Contacts.empty(module.FEW),
    )  # fmt: skip
    np.testing.assert_array_equal(few.status, table.status[: module.FEW])
    np.testing.assert_allclose(few.values, table.values[: module.FEW], rtol=tolerance.max(), atol=0.0)


def test_the_seeds_cover_every_status() -> None:
    status = 0
    for seed in range(48):
        calibration, microstrain, temperature, lost = readings(seed)
        found = estimate(calibration, microstrain, temperature_degC=temperature, lost=lost).status
        status |= int(np.bitwise_or.reduce(found))
    assert status | Status.STALE | Status.NO_ANSWER == sum(Status)
    assert set(reasons.flags(status)) >= {reasons.WORDS[bit] for bit in (reasons.LEFT_OUT, reasons.CONTRADICTION)}


@pytest.mark.parametrize("seed", [0, 7, 9, 13, 22])
def test_without_uncertainties_the_rest_is_the_same(seed: int) -> None:
    """But for the bit that judges the uncertainties."""
    calibration, microstrain, temperature, _ = readings(seed)
    bare, full = Estimator(calibration, uncertainty=False), Estimator(calibration)
    given, expected = (one(microstrain, temperature_degC=temperature) for one in (bare, full))
    np.testing.assert_array_equal(given.values[:, :3], expected.values[:, :3])
    assert np.isnan(given.values[:, 3:]).all()
    np.testing.assert_array_equal(given.status, expected.status & ~np.uint16(Status.BEYOND_FIRST_ORDER))
    for row in microstrain[:20].tolist():
        contact, same = bare(row), full(row)
        assert (contact.status, contact.P_newtons) == (same.status & ~Status.BEYOND_FIRST_ORDER, same.P_newtons)
        assert np.isnan(contact.u_P_newtons)


def test_given_arrays_are_filled() -> None:
    calibration, microstrain, _, _ = readings(3)
    estimator, out = Estimator(calibration), Contacts.empty(ROWS)
    assert estimator(microstrain, out=out) is out
    np.testing.assert_array_equal(out.values, estimator(microstrain).values)
    np.testing.assert_array_equal(out.status, estimator(microstrain).status)
    with pytest.raises(InputError, match="out: allowed is Contacts"):
        estimator(microstrain[1:], out=out)
    with pytest.raises(InputError, match="microstrain has the shape"):
        estimator(microstrain[0], out=out)
    with pytest.raises(InputError, match="out: allowed is Contacts"):
        estimator(microstrain[1 : module.FEW], out=out)
    assert len(estimator(microstrain[:0])) == 0


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (([1.0, 2.0],), r"shape \(2,\): allowed are \(k, 3\) and \(3,\)"),
        ((np.zeros((2, 3, 3)),), "allowed are"),
        ((["1", "2", "3"],), "no array of numbers"),
        (([True, False, True],), "no array of numbers"),
        (([1.0, 2.0, 3.0], [20.0]), r"temperature_degC has the shape \(1,\)"),
        (([1.0, 2.0, 3.0], 20.0, 1.5), "allowed are integers"),
    ],
)
def test_a_reading_that_is_none_is_refused(given: tuple[Any, ...], text: str) -> None:
    estimator: Any = Estimator(random_calibration(0)[0])
    with pytest.raises(InputError, match=text):
        estimator(given[0], **dict(zip(("temperature_degC", "lost"), given[1:], strict=False)))


def test_one_reading_needs_no_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    calibration, microstrain, _, _ = readings(9)
    estimator, row = Estimator(calibration), microstrain[0].tolist()
    plain = Estimator(Calibration(calibration.C, calibration.offset_strain, calibration.covariance_strain2))
    expected = plain(row)
    monkeypatch.setattr(module, "np", None)
    assert plain(row) == expected
    assert estimator(row, temperature_degC=20.0).P_newtons > 0.0


def test_what_a_set_of_gauges_needs_is_worked_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calibration, microstrain, _, _ = readings(11)
    estimator = Estimator(calibration)
    estimator(microstrain)
    monkeypatch.delattr(Active, "_check")
    estimator(microstrain)
    estimator(microstrain[0].tolist())
