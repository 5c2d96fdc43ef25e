"""ROS 2 itself, rclpy with Fast DDS, both with default settings, reads a simulated hand: run by tests/ros2.sh."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tools.ros2 import test_loopback


@pytest.fixture(scope="module")
def received(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Any]]]:
    """Messages by topic."""
    folder = str(tmp_path_factory.mktemp("hand"))
    hand = ["env", f"PYTHONPATH={os.pathsep.join(sys.path)}", sys.executable, test_loopback.__file__, folder, "hand"]
    reader = [os.environ["TIPFORCE_ROS_PYTHON"], str(Path(__file__).with_name("rclpy_reader.py")), *hand]
    environment = {
        name: text for name, text in os.environ.items() if not name.startswith(("ROS_", "CYCLONEDDS_", "FASTDDS_"))
    }
    done = subprocess.run(
        ["unshare", "-rn", "sh", "-c", test_loopback.LOOPBACK, "sh", *reader],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found: dict[str, list[dict[str, Any]]] = json.loads(done.stdout)
    return found


def test_wrench_and_contact_of_each_sync(received: dict[str, list[dict[str, Any]]]) -> None:
    contacts, wrenches = (
        {
            (one["header"]["stamp"]["sec"], one["header"]["stamp"]["nanosec"]): one
            for one in received[f"/left/index/{what}"]
        }
        for what in ("contact", "wrench")
    )
    assert len(contacts.keys() & wrenches.keys()) >= 90  # the two subscriptions begin apart
    for stamp in contacts.keys() & wrenches.keys():
        contact, wrench = contacts[stamp], wrenches[stamp]
        assert contact["header"] == wrench["header"]
        assert contact["header"]["frame_id"] == "index_tip"
        assert contact["node_id"] == 2
        force = wrench["wrench"]["force"]
        np.testing.assert_allclose(np.hypot(force["x"], force["y"]), contact["force"], atol=1e-12)
    first = received["/left/index/contact"][0]
    values = [first["force"], *np.degrees([first["direction"], first["angle"]])]
    np.testing.assert_allclose(values, [2.2, -100.0, 70.0], atol=5.0)


def test_diagnostics_with_the_result_of_a_tare(received: dict[str, list[dict[str, Any]]]) -> None:
    status = [one for report in received["/diagnostics"] for one in report["status"]]
    assert {"left: bus", "left: thumb", "left: index"} <= {one["name"] for one in status}
    assert [one["level"] for one in status if one["message"].startswith("tared")] == [0]


def test_a_late_subscription_receives_the_fingertip(received: dict[str, list[dict[str, Any]]]) -> None:
    [tip] = received["/left/index/info"]
    assert (tip["node_id"], tip["name"], tip["gauges"], tip["tip_radius"]) == (2, "index", 3, 0.015)
