"""Fingers as observations: of a node on a bus, of the twin, of a recording; and the grasp as an environment."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import tipforce
from tipforce.host import Decoder, open_log
from tipforce_robots.learning import observation, observation_space, recorded_observations
from tipforce_robots.mujoco import GraspEnv
from tipforce_tools.cli.main import main


def test_a_finger_on_a_bus_and_one_that_is_missing() -> None:
    with tipforce.simulated_finger(5, load=(2.0, -85, 95)) as bus:
        contact = replace(bus.finger(5).read(), name="thumb")
    unknown = replace(contact, node_id=6, name="index", P_newtons=np.nan, phi_deg=np.nan, theta_deg=np.nan)
    without_u = replace(contact, node_id=7, name="ring", u_P_newtons=np.nan, P_newtons=33.0)
    row = observation(tipforce.HandRow(0, 0.0, [contact, unknown, without_u]))
    space = observation_space(3)
    assert space.contains(row)
    values, u, valid = row["values"], row["uncertainties"], row["valid"]
    assert values[0] == pytest.approx(np.array([2.0, np.radians(-85), np.radians(95)]), abs=0.05)
    assert u[0] == pytest.approx([contact.u_P_newtons, *np.radians([contact.u_phi_deg, contact.u_theta_deg])], rel=1e-6)
    assert valid.tolist() == [[1, 1, 1], [0, 0, 0], [0, 1, 1]]  # 33 N is beyond the space
    assert not values[1].any()
    assert (u[1] == space["uncertainties"].high[1]).all()  # type: ignore[attr-defined]
    assert u[2, 0] == np.float32(32.767)
    with pytest.raises(tipforce.InputError, match=r"fingers = 0: allowed is 1 or more"):
        observation_space(0)


def test_the_grasp_is_an_environment_of_gymnasium() -> None:
    env = GraspEnv()
    check_env(env, skip_render_check=True)
    episodes = []
    for seed in (1, 1, 2):
        found, _info = env.reset(seed=seed)
        rewards, ended = [], False
        while not ended:
            found, reward, fallen, ended, info = env.step(found["asked_newtons"] / np.float32(6.0))
            rewards.append(reward)
            assert not fallen
            assert env.observation_space.contains(found)
        episodes.append(rewards)
        assert found["valid"].all()
        P, u = found["values"][:, 0], found["uncertainties"][:, 0]
        assert (np.abs(P - info["true_newtons"]) < 4.0 * u).all()
        assert (info["unseen_newtons"] < 0.01).all()
    assert episodes[0] == episodes[1] != episodes[2]
    env.reset(seed=1)
    fallen, reward = False, 0.0
    while not fallen:  # without a grip the hand leaves the ball on its plate
        _found, reward, fallen, ended, _info = env.step(np.full(1, 0.02, np.float32))
        assert not ended
    assert reward < -100.0
    with pytest.raises(tipforce.InputError, match=r"allowed is float32 of the shape \(1,\) from 0 to 1"):
        env.step(np.full(1, 1.5, np.float32))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("recording") / "run.log"
    assert main(["run", "grasp", "--duration", "1", "-o", str(found), "-q"]) == 0
    return found


@pytest.fixture(scope="module")
def log(path: Path) -> tipforce.Log:
    return tipforce.read_log(path)


def test_frames_and_logs_give_dlpack_without_copies(path: Path, log: tipforce.Log) -> None:
    with open_log(str(path)) as reader:
        decoded = Decoder(3, [1, 2]).decode(next(iter(reader)))
    assert set(decoded) == {(node_id, name) for node_id in (1, 2) for name in ("Gauges", "Contact")}
    arrays = [array for samples in decoded.values() for array in (samples.t_ns, *samples.columns.values())]
    for node in log.values():
        names = "P_newtons phi_deg theta_deg u_P_newtons t_s status microstrain F_newtons counter"
        arrays += [getattr(node, name) for name in names.split()]
        arrays += [array for array in node.columns.values() if array.dtype.kind in "iufb"]
    for array in arrays:
        taken = np.from_dlpack(array)
        assert np.shares_memory(taken, array)
        assert taken.dtype == array.dtype


def test_a_recording_becomes_windows(log: tipforce.Log) -> None:
    found = recorded_observations(log)
    assert found.values.shape == found.uncertainties.shape == found.valid.shape == (len(log[1]), 5, 3)
    assert [found.values.dtype.name, found.valid.dtype.name] == ["float32", "int8"]
    held = np.flatnonzero(found.t_s - found.t_s[0] > 0.7)
    assert found.valid[held].all()
    assert found.values[held, 0, 0] == pytest.approx(log[1].P_newtons[held], rel=1e-6)
    assert found.values[held, 2, 2] == pytest.approx(np.radians(log[3].theta_deg[held]), rel=1e-5)
    windows = found.windows(32, stride=8)
    assert windows.values.shape == ((len(found) - 32) // 8 + 1, 32, 5, 3)
    assert np.shares_memory(windows.values, found.values)
    assert (windows.values[3] == found.values[24:56]).all()
    assert (windows.t_s[3] == found.t_s[24:56]).all()
    assert np.shares_memory(np.from_dlpack(windows.values), found.values)


def test_no_window_crosses_a_gap_and_a_lost_sample_is_not_valid(log: tipforce.Log) -> None:
    keep = np.r_[0:100, 110:200]
    nodes = {node_id: _part(log[node_id], keep if node_id == 1 else np.r_[0:50, 51:200]) for node_id in (1, 2)}
    found = recorded_observations(tipforce.Log(nodes, {}, 0), [2, 1])
    assert len(found) == 199
    assert not found.valid[99:109, 1].any()  # node 1 lost ten, node 2 one before
    windows = found.windows(20)
    assert len(windows) == 31 + 130
    assert (np.diff(windows.t_s, axis=1) < 0.003).all()
    assert len(found.windows(300)) == 0
    assert found.windows(300).values.shape == (0, 300, 2, 3)
    with pytest.raises(tipforce.InputError, match=r"nodes \[9\]: the log has 1, 2"):
        recorded_observations(tipforce.Log(nodes, {}, 0), [9])
    with pytest.raises(tipforce.InputError, match=r"windows of length 0, stride 1: allowed is 1 or more"):
        found.windows(0)
    for times in (np.full(200, np.nan), np.r_[0:100, 50:150] * 0.002):
        with pytest.raises(tipforce.InputError, match="node 1: times that are missing or go back"):
            recorded_observations(tipforce.Log({1: replace(_part(log[1], np.r_[0:200]), t_s=times)}, {}, 0))
    assert observation({})["values"].shape == (0, 3)


def _part(node: tipforce.NodeLog, at: np.ndarray) -> tipforce.NodeLog:
    names = ("P_newtons", "phi_deg", "theta_deg", "u_P_newtons", "u_phi_deg", "u_theta_deg", "status")
    more = ("t_s", "counter", "microstrain", "F_newtons")
    first, last = ({name: getattr(node, name)[at] for name in group} for group in (names, more))
    return tipforce.NodeLog(**first, node_id=node.node_id, **last, columns={})


def test_without_gymnasium_it_is_one_line_and_torch_is_never_needed() -> None:
    code = (
        "import sys; sys.modules['gymnasium'] = sys.modules['torch'] = None\n"
        "import tipforce_robots.learning, tipforce.errors\n"
        "from tipforce_robots.learning import observation, recorded_observations\n"
        "for use in (lambda: tipforce_robots.learning.observation_space(1), lambda: tipforce_robots.mujoco.GraspEnv):\n"
        "    import tipforce_robots.mujoco\n"
        "    try: use()\n"
        "    except tipforce.errors.EnvironmentLackError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == 'gymnasium is not installed: pip install "tipforce[gymnasium]"\n' * 2
