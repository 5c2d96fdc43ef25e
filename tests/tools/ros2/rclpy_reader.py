"""The other process of test_rclpy, run by the Python of ROS 2: rclpy with default settings reads what a hand publishes.

Arguments: the command of the hand. Prints one JSON record of the messages by topic."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import Empty
from tipforce_msgs.msg import Contact, Fingertip

WAIT_S = 60.0  # far more than on an idle machine
_KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def main(hand: list[str]) -> None:
    rclpy.init()
    node = rclpy.create_node("reader")
    messages: dict[str, list[Any]] = {}

    def subscribe(topic: str, kind: Any, quality: Any) -> list[Any]:
        kept = messages.setdefault(topic, [])
        node.create_subscription(kind, topic, lambda message: kept.append(_plain(message)), quality)
        return kept

    with subprocess.Popen(hand, stdin=subprocess.PIPE, text=True, stdout=sys.stderr) as process:
        wrenches = subscribe("/left/index/wrench", WrenchStamped, qos_profile_sensor_data)
        contacts = subscribe("/left/index/contact", Contact, qos_profile_sensor_data)
        reports = subscribe("/diagnostics", DiagnosticArray, 10)
        _spin(node, lambda: len(wrenches) >= 100 and len(contacts) >= 100 and len(reports) >= 2)
        late = subscribe("/left/index/info", Fingertip, _KEPT)
        _spin(node, lambda: bool(late))
        tare = node.create_publisher(Empty, "/left/index/tare", 10)
        _spin(node, lambda: tare.get_subscription_count() > 0)
        tare.publish(Empty())
        _spin(node, lambda: any("tare" in status["message"] for one in reports for status in one["status"]))
        process.communicate("end\n")
    print(json.dumps(messages))


def _spin(node: Any, enough: Callable[[], bool]) -> None:
    """Take messages until there are enough, or for a bounded time: the test says what is missing."""
    end_s = time.monotonic() + WAIT_S
    while not enough() and time.monotonic() < end_s:
        rclpy.spin_once(node, timeout_sec=0.1)


def _plain(value: Any) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return value[0]
    return [_plain(one) for one in value] if hasattr(value, "__len__") and not isinstance(value, str) else value


if __name__ == "__main__":
    main(sys.argv[1:])
