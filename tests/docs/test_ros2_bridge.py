"""The ROS 2 recipe runs against a stand-in for rclpy, with fingers on a bus; nothing here is ROS 2."""

from __future__ import annotations

import math
import runpy
from pathlib import Path
from typing import Any

import pytest

from docs.ros2_stand_in import FingertipContact, WrenchStamped, install
from host.bus_with_nodes import apply_load, beam_calibration, connected, finger, new_channel
from tipforce.host.network.finger import FingertipClient

BRIDGE = Path(__file__).parents[2] / "docs" / "examples" / "ros2_bridge.py"


def run_bridge(monkeypatch: pytest.MonkeyPatch, load: tuple[float, float, float], *, missing: bool = False) -> Any:
    """The bridge node after ten calls of its timer; fingers 5 (under a load) and 6 (none, or not there)."""
    nodes: list[Any] = []

    def spin(node: Any) -> None:
        nodes.append(node)
        [(period_s, callback)] = node.timers
        assert period_s == pytest.approx(0.05)
        for _ in range(10):
            callback()
        raise KeyboardInterrupt

    channel = new_channel()
    install(monkeypatch, spin, interface="virtual", channel=channel, node_ids=[5, 6], rate_hz=20.0)
    fingers = [finger(5)] if missing else [finger(5), finger(6)]
    with connected(*fingers, channel=channel) as (connection, _):
        for device in fingers:
            FingertipClient(connection.sdo(device.node_id)).apply_calibration(beam_calibration(), store=False)
        apply_load(connection, 5, *load)
        runpy.run_path(str(BRIDGE), run_name="__main__")
    assert nodes[0].destroyed
    return nodes[0]


def test_wrench_and_contact_are_published(monkeypatch: pytest.MonkeyPatch) -> None:
    node = run_bridge(monkeypatch, (4.4, 120.0, 75.0))
    topics = node.publishers_by_topic
    assert set(topics) == {f"~/finger_{n}/{what}" for n in (5, 6) for what in ("wrench", "contact")}
    contact, wrench = (topics[f"~/finger_5/{what}"].messages[-1] for what in ("contact", "wrench"))
    assert (contact.__class__, wrench.__class__) == (FingertipContact, WrenchStamped)
    assert (contact.node_id, contact.contact, contact.calibrated, contact.header.frame_id) == (
        5,
        True,
        True,
        "finger_5",
    )
    assert contact.force == pytest.approx(4.4, abs=0.01)
    assert contact.direction == pytest.approx(math.radians(120.0), abs=0.01)
    assert wrench.wrench.force.x == pytest.approx(4.4 * math.cos(math.radians(120.0)), abs=0.02)
    assert wrench.wrench.force.y == pytest.approx(4.4 * math.sin(math.radians(120.0)), abs=0.02)
    assert wrench.wrench.torque.z == pytest.approx(0.015 * 4.4 * math.sin(math.radians(45.0)), rel=0.01)
    assert wrench.header.stamp.sec > 1_600_000_000


def test_what_is_unknown_is_nan_and_gives_no_wrench(monkeypatch: pytest.MonkeyPatch) -> None:
    topics = run_bridge(monkeypatch, (4.4, 90.0, 45.0)).publishers_by_topic
    unloaded = topics["~/finger_6/contact"].messages[-1]
    assert not unloaded.contact
    assert math.isnan(unloaded.angle)
    assert topics["~/finger_6/wrench"].messages == []


def test_a_finger_that_is_silent_publishes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    node = run_bridge(monkeypatch, (4.4, 90.0, 45.0), missing=True)
    assert node.publishers_by_topic["~/finger_6/contact"].messages == []
    assert "finger 6 does not answer" in node.logger.lines
    assert node.publishers_by_topic["~/finger_5/contact"].messages


def test_the_stand_in_refuses_what_rosidl_refuses() -> None:
    message = FingertipContact()
    for field, value in (("node_id", 256), ("force", 1), ("contact", 1), ("nothing", 0)):
        with pytest.raises(AssertionError):
            setattr(message, field, value)
