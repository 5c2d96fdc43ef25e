"""Fingers to ROS 2: each gets ~/finger_N/wrench (geometry_msgs/WrenchStamped) and ~/finger_N/contact.

Written against the message types of ROS 2 and tested with a stand-in for rclpy; it was not run on ROS 2.

    python ros2_bridge.py --ros-args -p channel:=can0 -p node_ids:="[1, 2, 3]" -p rate_hz:=200.0
"""

from __future__ import annotations

import math

import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from tipforce_msgs.msg import FingertipContact

import tipforce
from tipforce.host import PolledHand, Samples

FLAGS = ("contact", "calibrated", "saturated", "stale", "fault")


def contact_message(samples: Samples) -> FingertipContact:
    """The newest sample of a Contact PDO as a message; what the node does not know is NaN."""
    newest = {name: column[-1] for name, column in samples.columns.items()}
    message = FingertipContact()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(samples.t_ns[-1]), 1_000_000_000)
    message.header.frame_id = f"finger_{samples.node_id}"
    message.node_id, message.counter = samples.node_id, int(newest["counter"])
    message.force = float(newest["P"])
    message.direction, message.angle = math.radians(newest["phi"]), math.radians(newest["theta"])
    for name in FLAGS:
        setattr(message, name, bool(newest[name]))
    return message


def wrench_message(contact: FingertipContact, tip_radius_m: float) -> WrenchStamped | None:
    """Force on the tip and its moment about the tip's centre: x along F3, y along F1. None where a value is unknown."""
    P, phi, theta = contact.force, contact.direction, contact.angle
    if not (math.isfinite(P) and math.isfinite(phi) and math.isfinite(theta)):
        return None
    message = WrenchStamped()
    message.header = contact.header
    message.wrench.force.x, message.wrench.force.y = P * math.cos(phi), P * math.sin(phi)
    message.wrench.torque.z = tip_radius_m * P * math.sin(phi - theta)
    return message


class Bridge(Node):  # type: ignore[misc]  # rclpy has no types
    """Asks all fingers by SYNC, ``rate_hz`` times a second, and publishes what they answer."""

    def __init__(self) -> None:
        super().__init__("tipforce")
        default = {
            "interface": "socketcan",
            "channel": "can0",
            "node_ids": [1],
            "rate_hz": 100.0,
            "tip_radius_m": 0.015,
        }
        given = {name: self.declare_parameter(name, value).value for name, value in default.items()}
        self._radius_m = given["tip_radius_m"]
        self._connection = tipforce.open(given["channel"], given["interface"])
        self._hand = PolledHand(self._connection, list(given["node_ids"]))
        self._topics = {
            n: (
                self.create_publisher(WrenchStamped, f"~/finger_{n}/wrench", qos_profile_sensor_data),
                self.create_publisher(FingertipContact, f"~/finger_{n}/contact", qos_profile_sensor_data),
            )
            for n in self._hand.node_ids
        }
        self._hand.start()
        self._period_s = 1.0 / given["rate_hz"]
        self._timer = self.create_timer(self._period_s, self.publish)

    def publish(self) -> None:
        """One SYNC: a contact for each finger that answered, and a wrench where it is known."""
        try:
            row = self._hand.sample(timeout_s=self._period_s)
        except tipforce.TipforceError as error:
            self.get_logger().error(str(error), throttle_duration_sec=1.0)
            return
        for node_id, (wrenches, contacts) in self._topics.items():
            samples = row.messages.get((node_id, "Contact"))
            if samples is None:
                self.get_logger().warning(f"finger {node_id} does not answer", throttle_duration_sec=1.0)
                continue
            contact = contact_message(samples)
            contacts.publish(contact)
            wrench = wrench_message(contact, self._radius_m)
            if wrench is not None:
                wrenches.publish(wrench)

    def destroy_node(self) -> None:
        """Let go of the bus too."""
        self._connection.close()
        super().destroy_node()


def main() -> None:
    """Run until Ctrl-C."""
    rclpy.init()
    bridge = Bridge()
    try:
        rclpy.spin(bridge)
    except KeyboardInterrupt:
        pass
    finally:
        bridge.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
