"""Rows to blocks: the uncertainty is the sensor's own; what the node does not send is computed as it would."""

from __future__ import annotations

import numpy as np
import pytest

from host.bus_with_nodes import beam_calibration
from tipforce.samples.reasons import NO_ANSWER
from tipforce.samples.record import Rows
from tipforce.sensor.contact import estimate as contact_model
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.contact.scalar import CALIBRATED, CONTACT_PRESENT
from tipforce_tools.view.messages import drawing
from tools.view.support import fingers


def rows(columns: dict[str, np.ndarray], missing: np.ndarray | None = None) -> Rows:
    shape = next(iter(columns.values())).shape
    flags = {name: np.ones(shape, dtype=bool) for name in ("contact", "calibrated")}
    reason = np.zeros(shape, dtype=np.uint8) if missing is None else missing.astype(np.uint8)
    t_ns = np.arange(shape[0], dtype=np.int64)
    made = Rows(0, [], range(1, 1 + shape[1]), ())
    vars(made).update(sync_ns=t_ns, counter=np.where(reason, -1, 0), reason=reason, columns=flags | columns)
    return made


@pytest.mark.parametrize("pull", [False, True])
def test_uncertainties_are_those_of_the_sensor(pull: bool) -> None:
    generator = np.random.default_rng(7)
    P, theta = generator.uniform(0.5, 5, (6, 2)), generator.uniform(40, 140, (6, 2))
    phi = theta + generator.uniform(-30, 30, (6, 2)) + (0 if pull else 180)
    who = fingers(2, pull)
    found = rows({"P": P, "phi": phi, "theta": theta}).block([finger.calibration for finger in who], 3)
    F = force_vector(P[:, 1], np.radians(phi[:, 1]), np.radians(theta[:, 1]))
    calibration = who[1].calibration
    assert calibration is not None
    expected = contact_model.standard_uncertainties(F, calibration.covariance_F, pull=pull)
    expected[:, 1:] *= 180 / np.pi
    assert found.u[:, 1] == pytest.approx(expected, rel=1e-5)
    assert (found.status == CONTACT_PRESENT | CALIBRATED).all()


def test_what_is_unknown_has_no_uncertainty_and_what_is_known_keeps_its_own() -> None:
    nan = np.nan
    P = np.array([[1.0, nan], [1.0, 0.01]])
    phi, theta = np.array([[-90.0, nan], [-90.0, nan]]), np.array([[90.0, nan], [nan, nan]])
    found = rows({"P": P, "phi": phi, "theta": theta}, np.isnan(P)).block(
        [finger.calibration for finger in fingers(2)], 3
    )
    assert found.status[0, 1] & NO_ANSWER
    assert np.isnan(found.u[0, 1]).all()
    # Without the contact angle, force and direction are as uncertain as with it.
    assert found.u[1, 0, :2] == pytest.approx(found.u[0, 0, :2], rel=1e-6)
    assert np.isnan(found.u[1, 0, 2])
    assert found.u[1, 1, 0] > 0
    assert np.isnan(found.u[1, 1, 1:]).all()


def test_without_a_calibration_only_health_tells() -> None:
    columns = {"P": np.ones((1, 2)), "phi": np.full((1, 2), -90.0), "theta": np.full((1, 2), 90.0)}
    assert np.isnan(rows(columns).block([None, None], 3).u).all()
    found = rows(columns).block([None, None], 3, np.array([[0.02, np.nan]]))
    assert found.u[0, 0, 0] == pytest.approx(0.02)
    assert np.isnan(found.u[0, 0, 1:]).all()
    assert np.isnan(found.u[0, 1]).all()


def test_gauges_alone_give_the_contact_by_the_calibration() -> None:
    calibration = beam_calibration(pull=False)
    F = force_vector(2.0, np.radians(-80.0), np.radians(95.0))
    strain = np.linalg.solve(calibration.C, F) * 1e6
    columns = {f"SG{k + 1}": np.array([[strain[k]]]) for k in range(3)}
    found = rows(columns).block([calibration], 3)
    assert found.contact[0, 0] == pytest.approx([2.0, -80.0, 95.0], rel=1e-5)
    assert found.gauges[0, 0] == pytest.approx(strain, rel=1e-5)
    assert np.isnan(rows(columns).block([None], 3).contact).all()


def test_forces_alone_give_the_contact() -> None:
    F = force_vector(2.0, np.radians(-80.0), np.radians(95.0))
    columns = {f"F{k + 1}": np.array([[F[k]]]) for k in range(3)}
    found = rows(columns).block([None], 3)
    assert found.contact[0, 0] == pytest.approx([2.0, -80.0, 95.0], rel=1e-5)


def test_the_drawing_has_the_strain_of_the_beams() -> None:
    """At the gauges of case I the ends of the faces strain as Table 1 says."""
    (finger,) = fingers(1)
    calibration = finger.calibration
    assert calibration is not None
    drawn = drawing(finger, 3)
    faces = {(f["beam"], f["side"], f["face"]): f["microstrain_per_newton"] for f in drawn["faces"]}
    table = np.linalg.inv(calibration.C) * 1e6
    assert faces["H", "left", "lower"][0] == pytest.approx(table[0])  # K_H
    assert faces["H", "right", "lower"][0] == pytest.approx(table[1])  # S_H
    assert faces["V", "right", "lower"][1] == pytest.approx(table[2])  # U
    assert [gauge["name"] for gauge in drawn["gauges"]] == ["K_H", "S_H", "U"]
    for gauge in drawn["gauges"]:
        assert np.hypot(*np.subtract(gauge["to"], gauge["from"])) == pytest.approx(1.0)
