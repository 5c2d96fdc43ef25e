"""`tipforce ros2` beside a simulated hand, read by rosless in another process, both in a network namespace."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tipforce.samples.reasons import Status

LOOPBACK = 'ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && exec "$@"'


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    assert shutil.which("unshare"), "install util-linux and iproute2"
    folder = tmp_path_factory.mktemp("ros2")
    reader = [sys.executable, str(Path(__file__).with_name("loopback_reader.py")), str(folder)]
    # ROS_LOCALHOST_ONLY: the configuration that users choose for one machine.
    environment = {
        **os.environ, "ROS_DOMAIN_ID": "7", "ROS_LOCALHOST_ONLY": "1", "PYTHONPATH": os.pathsep.join(sys.path),
    }  # fmt: skip
    done = subprocess.run(
        ["unshare", "-rn", "sh", "-c", LOOPBACK, "sh", *reader],
        env=environment, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + done.stdout
    found: dict[str, Any] = json.loads(done.stdout)
    assert found["code"] == 0, found["stderr"]
    return found


def test_names_types_and_quality_of_service(seen: dict[str, Any]) -> None:
    kinds = {
        "wrench": "geometry_msgs/msg/WrenchStamped", "contact": "tipforce_msgs/msg/Contact",
        "info": "tipforce_msgs/msg/Fingertip", "tare": "std_msgs/msg/Empty",
    }  # fmt: skip
    expected = {f"/left/{finger}/{what}": kind for finger in ("thumb", "index") for what, kind in kinds.items()}
    assert seen["topics"] == {**expected, "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray"}
    # A late subscription gets the static message; one that asks for a reliable wrench gets none: it is sensor data.
    assert (seen["info"]["node_id"], seen["info"]["name"], seen["info"]["tip_radius"]) == (2, "index", 0.015)
    assert seen["refused"] == 0


def test_every_sync_has_a_contact_and_a_wrench_of_the_load(seen: dict[str, Any]) -> None:
    contacts, wrenches = seen["contacts"], seen["wrenches"]
    numbers = [one["number"] for one in contacts]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    known = [one for one in contacts if np.isfinite(one["force"])]
    values = np.array([[one[name] for name in ("force", "direction", "angle")] for one in known])
    np.testing.assert_allclose(values, np.broadcast_to([2.2, *np.radians([-100.0, 70.0])], values.shape), atol=0.15)
    assert all(0.0 < one["force_uncertainty"] < 0.05 for one in known)
    assert {one["header"]["frame_id"] for one in contacts} == {"index_tip"}
    # On a loaded machine an answer can be late. The two subscriptions begin apart; the last wrench may be on its way.
    assert all(one["status"] & (Status.NO_ANSWER | Status.STALE) for one in contacts if one not in known)
    first = next(k for k, wrench in enumerate(wrenches) if wrench is not None)
    pairs = list(zip(contacts, wrenches, strict=True))[first:-1]
    assert len(pairs) > 30
    for contact, wrench in pairs:
        assert (wrench is not None) == (contact in known)
        if wrench is None:
            continue
        assert wrench["header"] == contact["header"]
        P, phi, theta = contact["force"], contact["direction"], contact["angle"]
        expected = [P * np.cos(phi), P * np.sin(phi), 0.015 * P * np.sin(phi - theta)]
        force, torque = wrench["wrench"]["force"], wrench["wrench"]["torque"]
        np.testing.assert_allclose([force["x"], force["y"], torque["z"]], expected, atol=1e-12)


def test_diagnostics_tare_and_faults(seen: dict[str, Any]) -> None:
    once = seen["once a second"]["status"]
    assert [one["name"] for one in once] == ["left: bus", "left: thumb", "left: index"]
    assert {pair["key"]: pair["value"] for pair in once[2]["values"]}["NMT state"] == "operational"
    [tare] = seen["tare"]["status"]
    assert (tare["name"], tare["level"]) == ("left: index", 0)
    assert all(np.isnan(one["force"]) for one in seen["unknown"])
    assert seen["wrenches while unknown"] == 0
    assert any(one["name"] == "left: index" and one["level"] == 2 for one in seen["fault"]["status"])
