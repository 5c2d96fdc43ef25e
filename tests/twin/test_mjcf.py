"""`tipforce export mjcf`: the body loads in MuJoCo, and has the mass, the outline and the modes of the sensor."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from tipforce.errors import InputError
from tipforce.sensor import FABRICATED
from tipforce.sensor.dynamics.model import half_cylinder, modes
from tipforce_robots.mujoco import fingertip_mjcf
from tipforce_tools.cli.main import main


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
    from tipforce.sensor.dynamics.model import compliances
    from tipforce.sensor.structure.plane_frame import Frame

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


def test_bad_input_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match=r"prefix 'a b': allowed are letters, digits, _, - and \."):
        fingertip_mjcf("a b")
    assert main(["export", "mjcf", "--damping-ratio", "nan"]) == 2
    assert "damping_ratio = nan: allowed is 0 to 1e+06" in capsys.readouterr().err
