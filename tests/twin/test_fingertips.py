"""Contacts of a MuJoCo model as strain, counts, status and contact, held against MuJoCo's own wrench and the node; and
the body of `tipforce export mjcf`: it has the mass, the outline and the modes of the sensor."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from tipforce import Calibration, InputError, Status, estimate
from tipforce.scene import beam_calibration
from tipforce.sensor import FABRICATED, strain_matrix
from tipforce.sensor.dynamics.model import compliances, half_cylinder, modes
from tipforce.sensor.structure.plane_frame import Frame
from tipforce_robots.mujoco import Fingertips, Load, fingertip_mjcf
from tipforce_tools.cli.main import main
from twin.models import R, external_wrench, pressed, push, samples

SITES = {"thumb": "thumb_tip"}


@pytest.mark.parametrize("theta_deg", [25.0, 90.0, 140.0])
@pytest.mark.parametrize("option", ["", 'cone="elliptic"'])
def test_the_strain_is_that_of_the_contact_force(theta_deg: float, option: str) -> None:
    model, data = pressed({"ball": (theta_deg, 0.0, 0.02)}, option=option)
    theta = np.radians(theta_deg)
    push(model, data, "ball", np.array([-3.0 * np.cos(theta) + 0.4, -3.0 * np.sin(theta), 0.7]))
    tips = Fingertips(model, SITES, noise_microstrain=0.0)
    compared = 0
    for sample in samples(model, data, tips, 60):
        if not data.ncon:
            continue
        assert data.ncon == sample.load.contacts == 1
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, 0, wrench)
        contact, turn = data.contact[0], data.site("thumb_tip").xmat.reshape(3, 3)
        on_tip = (1.0 if model.geom("thumb_tip").id == contact.geom2 else -1.0) * contact.frame.reshape(3, 3).T
        force = turn.T @ (on_tip @ wrench[:3])
        lever = turn.T @ (contact.pos - data.site("thumb_tip").xpos)
        moment = np.cross(lever, force) + turn.T @ (on_tip @ wrench[3:])
        strain = strain_matrix(FABRICATED, "I") @ [force[1], moment[2] / R, force[0]]
        assert sample.load.microstrain == pytest.approx(1e6 * strain, rel=1e-12, abs=1e-9)
        assert sample.counts == tuple(np.rint(10.0 * 1e6 * strain))
        assert sample.load.moment_newton_metres == pytest.approx(moment, abs=1e-15)
        assert sample.load.unseen_newtons == pytest.approx(abs(force[2]), rel=1e-12)
        assert sample.load.unseen_newton_metres == pytest.approx(np.hypot(*moment[:2]), rel=1e-9)
        assert sample.load.sum_newtons == pytest.approx(np.linalg.norm(wrench[:3]))
        compared += sample.load.P_newtons > 1.0
    assert compared > 10


def test_several_contacts_add_up_to_the_wrench_of_mujoco() -> None:
    model, data = pressed({"a": (40.0, 0.003, 0.02), "b": (90.0, -0.002, 0.02), "c": (150.0, 0.0, 0.02)}, rigid=False)
    push(model, data, "a", np.array([-2.0, -1.5, 0.2]))
    push(model, data, "b", np.array([0.3, -1.0, -0.4]))
    push(model, data, "c", np.array([2.2, -1.0, 0.1]))
    tips = Fingertips(model, SITES)
    seen = 0
    for _ in range(200):
        mujoco.mj_step(model, data)
        force, moment = external_wrench(model, data, "thumb_tip")
        load = tips.loads(data)["thumb"]
        assert load.force_newtons == pytest.approx(force, abs=1e-12)
        assert load.moment_newton_metres == pytest.approx(moment, abs=1e-13)
        seen = max(seen, load.contacts)
        if load.contacts == 3:
            assert load.cancelled_newtons > 1.0  # they press against each other
    assert seen == 3


def test_the_values_are_those_of_the_host_for_the_same_strain() -> None:
    """The node's code on the one side, the host's estimator in double precision on the other."""
    model, data = pressed({"ball": (70.0, 0.0, 0.02)})
    push(model, data, "ball", np.array([-1.0, -2.0, 0.0]))
    tips = Fingertips(model, SITES, seed=3)
    *_, sample = samples(model, data, tips, 100)
    found = estimate(beam_calibration("I"), sample.microstrain)
    contact = sample.contact
    for name in ("P_newtons", "phi_deg", "theta_deg", "u_P_newtons", "u_phi_deg", "u_theta_deg"):
        assert getattr(contact, name) == pytest.approx(getattr(found, name)[0], rel=1e-6), name
    assert contact.status == sample.status == Status.CONTACT | Status.CALIBRATED
    assert contact.ok
    assert (contact.name, contact.node_id) == ("thumb", 1)
    assert contact.t_s == pytest.approx(data.time)
    assert (sample.P_newtons, sample.phi_deg, sample.theta_deg) == (
        contact.P_newtons, contact.phi_deg, contact.theta_deg,
    )  # fmt: skip
    load = sample.load
    assert abs(sample.P_newtons - load.P_newtons) < 4.0 * sample.u_P_newtons
    assert abs(sample.theta_deg - 70.0) < 4.0 * contact.u_theta_deg + 3.0
    assert sample.F_newtons == pytest.approx(load.F_newtons, abs=0.1)


def test_noise_and_quantisation_are_those_of_the_source() -> None:
    model, data = pressed({"ball": (90.0, 0.0, 0.02)})
    runs = []
    for seed in (1, 1, 2):
        mujoco.mj_resetData(model, data)
        tips = Fingertips(model, SITES, noise_microstrain=2.0, seed=seed)
        runs.append(np.array([sample.counts for sample in samples(model, data, tips, 400)]))
    assert (runs[0] == runs[1]).all()
    assert (runs[0] != runs[2]).any()
    assert runs[0].std(axis=0) == pytest.approx([20.0] * 3, rel=0.15)  # counts, 10 for a microstrain
    tips.reset(seed=1)
    with pytest.raises(InputError, match=r"went back from 200000 to 0 us: call reset\(\)"):
        tips.read(data), mujoco.mj_resetData(model, data), tips.read(data)


def test_what_the_node_does_not_know_is_not_a_number() -> None:
    model, data = pressed({"ball": (90.0, 0.0, 0.02)})
    tips = Fingertips(model, SITES)
    [sample] = samples(model, data, tips, 1)
    assert sample.load.contacts == 0
    assert np.isnan([sample.phi_deg, sample.theta_deg]).all()
    assert sample.P_newtons < 0.05
    assert sample.contact.reason == "no contact"
    again = tips.read(data)["thumb"]  # no conversion since
    assert Status.STALE in again.status
    assert np.isnan([again.P_newtons, again.u_P_newtons, *again.F_newtons]).all()
    push(model, data, "ball", np.array([0.0, -200.0, 0.0]))
    beyond = [one for one in samples(model, data, tips, 50) if one.load.P_newtons > 100.0]
    assert len(beyond) > 5
    assert all(Status.SATURATED in one.status and np.isnan(one.P_newtons) for one in beyond)
    assert np.isnan(Load([1.0] * 9, (*[np.nan] * 7, 2), 0.01, []).cancelled_newtons)  # type: ignore[arg-type]


FOUR = Calibration(np.ones((3, 4)), np.zeros(4), np.eye(4))
BAD: list[tuple[dict[str, str], dict[str, Any], str]] = [
    ({"thumb": "tip"}, {}, r"finger thumb: site 'tip': allowed are thumb_tip"),
    ({"thumb": "thumb_tip", "index": "thumb_tip"}, {}, r"fingers thumb and index: allowed is one finger for each body"),
    ({}, {}, r"sites: allowed is one finger or more"),
    (SITES, {"node_ids": {"thumb": 128}}, r"node_ids \[128\]: allowed are different ones from 1 to 127"),
    (SITES, {"node_ids": {"index": 1}}, r"node_ids of index: allowed are those of thumb"),
    *((SITES, {"node_ids": {"thumb": node_id}}, r"allowed are different ones from 1 to 127") for node_id in (1.5, "1")),
    *((SITES, {"noise_microstrain": noise}, r"= .*: allowed is 0 to 1e\+06") for noise in (-1.0, np.nan, 1e300, "1")),
    (SITES, {"calibration": beam_calibration("II")}, r"calibration of another layout: allowed is one of 'I'"),
    (SITES, {"calibration": FOUR}, r"calibration of 4 gauges: the layout has 3"),
]


@pytest.mark.parametrize(("sites", "options", "message"), BAD)
def test_bad_input_is_one_line(sites: dict[str, str], options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Fingertips(pressed({})[0], sites, **options)


def test_data_that_no_simulation_of_the_model_has_is_refused() -> None:
    model, data = pressed({"ball": (90.0, 0.0, 0.02)})
    tips = Fingertips(model, SITES)
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><site name='a'/></worldbody></mujoco>")
    with pytest.raises(InputError, match=r"data of 0 geoms and 1 sites: the model of the fingertips has"):
        tips.read(mujoco.MjData(other))
    data.time = np.nan
    with pytest.raises(InputError, match=r"the time of data is nan"):
        tips.read(data)


def test_without_mujoco_it_is_one_line() -> None:
    code = (
        "import sys; sys.modules['mujoco'] = None\n"
        "from tipforce.errors import EnvironmentLackError\n"
        "from tipforce_robots.mujoco import fingertip_mjcf; fingertip_mjcf()\n"
        "try:\n    from tipforce_robots.mujoco import Fingertips\n"
        "except EnvironmentLackError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == 'MuJoCo is not installed: pip install "tipforce[mujoco]"\n'


def test_the_modes_are_those_of_the_beams() -> None:
    """Eigenvalues of MuJoCo's own mass matrix, and sensor.dynamics: two ways to one number."""
    model = mujoco.MjModel.from_xml_string(fingertip_mjcf("thumb_"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    columns = np.eye(model.nv)
    mass = np.empty_like(columns)
    for k in range(model.nv):
        mujoco.mj_mulM(model, data, mass[k], columns[k])
    omega2 = np.linalg.eigvals(np.linalg.solve(mass, np.diag(model.jnt_stiffness)))
    found = modes(FABRICATED)
    assert np.sqrt(np.sort(omega2.real)) == pytest.approx(found.omega_rad_s, rel=2e-4)  # a circle of 64 facets
    ratio = 0.5 * model.dof_damping / model.jnt_stiffness * found.omega_rad_s[0]
    assert ratio == pytest.approx(0.05, rel=1e-6)
    assert model.body("thumb_tip").mass[0] == pytest.approx(half_cylinder(FABRICATED).mass_kg)


def test_a_static_load_moves_the_tip_as_the_beams_do() -> None:
    model = mujoco.MjModel.from_xml_string(fingertip_mjcf(damping_ratio=1.0))
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    F = np.array([-0.6, 0.02, 0.05])  # F1, F2, F3
    r = FABRICATED.r_m
    body = model.body("tip").id
    model.opt.timestep = 1e-4
    for _ in range(4000):
        # At the origin of the tip; xfrc_applied acts at the centre of mass.
        lever = data.site("tip").xpos - data.xipos[body]
        force, moment = np.array([F[2], F[0], 0.0]), np.array([0.0, 0.0, r * F[1]])
        data.xfrc_applied[body] = [*force, *(moment + np.cross(lever, force))]
        mujoco.mj_step(model, data)
    arms, vertical = compliances(Frame(FABRICATED))
    v, turned, u = (arms + vertical) @ F
    x, y, turn = data.qpos
    hinge_m = model.joint("turn").pos[1]
    # The hinge is below the origin: a turn moves the origin along x.
    assert (y, turn, x + hinge_m * turn) == pytest.approx((v, turned / r, u), rel=2e-3, abs=1e-9)


def test_without_springs_and_with_a_prefix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "tip.xml"
    assert main(["export", "mjcf", "--prefix", "index_", "--rigid", "-o", str(path), "-q"]) == 0
    model = mujoco.MjModel.from_xml_path(str(path))
    assert model.nv == 0
    assert [model.body(k).name for k in range(model.nbody)] == ["world", "index_fixture", "index_tip"]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    distance = data.site("index_tip").xpos[1]
    assert distance == pytest.approx(4e-3 + FABRICATED.d_m + 0.5 * FABRICATED.h1_m)
    assert main(["export", "mjcf"]) == 0
    assert capsys.readouterr().out == fingertip_mjcf()


def test_a_bad_prefix_or_damping_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match=r"prefix 'a b': allowed are letters, digits, _, - and \."):
        fingertip_mjcf("a b")
    assert main(["export", "mjcf", "--damping-ratio", "nan"]) == 2
    assert "damping_ratio = nan: allowed is 0 to 1e+06" in capsys.readouterr().err
