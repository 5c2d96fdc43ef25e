"""What stands for ROS 2 in the tests: the part of rclpy and of the messages that docs/examples/ros2_bridge.py uses.

Messages behave as those that rosidl generates for Python do: fields are slots, default to zero, and a value of another
type or out of range is an AssertionError. FingertipContact is built from its .msg file.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

MSG = Path(__file__).parents[2] / "docs" / "examples" / "ros2" / "tipforce_msgs" / "msg" / "FingertipContact.msg"
RANGES = {"uint8": (0, 2**8 - 1), "int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1)}
DEFAULTS: dict[str, Any] = {"float64": 0.0, "bool": False, "string": "", **dict.fromkeys(RANGES, 0)}


def message_type(name: str, fields: dict[str, Any]) -> type:
    """A message class; ``fields`` are names of primitive types, or message classes."""

    def init(self: Any) -> None:
        for field, kind in fields.items():
            setattr(self, field, kind() if isinstance(kind, type) else DEFAULTS[kind])

    def check(self: Any, field: str, value: Any) -> None:
        kind = fields.get(field)
        assert kind is not None, f"{name} has no field {field}"
        wanted: Any = kind if isinstance(kind, type) else type(DEFAULTS[kind])
        assert type(value) is wanted, f"{name}.{field}: {value!r} is no {kind}"
        if kind in RANGES and isinstance(value, int):
            low, high = RANGES[kind]
            assert low <= value <= high, f"{name}.{field}: {value!r} is out of range"
        object.__setattr__(self, field, value)

    return type(name, (), {"__slots__": tuple(fields), "__init__": init, "__setattr__": check})


Time = message_type("Time", {"sec": "int32", "nanosec": "uint32"})
Header = message_type("Header", {"stamp": Time, "frame_id": "string"})
Vector3 = message_type("Vector3", {"x": "float64", "y": "float64", "z": "float64"})
Wrench = message_type("Wrench", {"force": Vector3, "torque": Vector3})
WrenchStamped = message_type("WrenchStamped", {"header": Header, "wrench": Wrench})


def from_msg_file(path: Path) -> type:
    """The class of a .msg file: ``type name`` a line, comments behind #."""
    fields: dict[str, Any] = {}
    for line in path.read_text().splitlines():
        words = line.split("#")[0].split()
        if words:
            kind, name = words
            fields[name] = {"std_msgs/Header": Header}.get(kind, kind)
    assert all(isinstance(kind, type) or kind in DEFAULTS for kind in fields.values()), fields
    return message_type(path.stem, fields)


FingertipContact = from_msg_file(MSG)


class Publisher:
    """Keeps what is published; refuses another type than its own, as rclpy does."""

    def __init__(self, kind: type) -> None:
        self.kind = kind
        self.messages: list[Any] = []

    def publish(self, message: Any) -> None:
        """Keep it."""
        assert type(message) is self.kind
        self.messages.append(message)


class Logger:
    """Keeps the lines."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def error(self, line: str, *, throttle_duration_sec: float) -> None:
        """A line."""
        assert throttle_duration_sec > 0
        self.lines.append(line)

    warning = error


class Parameter:
    """Has a value."""

    def __init__(self, value: Any) -> None:
        self.value = value


class Node:
    """rclpy.node.Node, as far as it is used. ``given`` are the parameters of the command line."""

    given: dict[str, Any]

    def __init__(self, name: str) -> None:
        self.name = name
        self.publishers_by_topic: dict[str, Publisher] = {}
        self.timers: list[tuple[float, Callable[[], None]]] = []
        self.logger = Logger()
        self.destroyed = False

    def declare_parameter(self, name: str, value: Any) -> Parameter:
        """The one given, or the default."""
        return Parameter(self.given.get(name, value))

    def create_publisher(self, kind: type, topic: str, qos: object) -> Publisher:
        """A publisher that keeps its messages."""
        assert qos == "sensor data"
        return self.publishers_by_topic.setdefault(topic, Publisher(kind))

    def create_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        """``spin`` calls it."""
        self.timers.append((period_s, callback))

    def get_logger(self) -> Logger:
        """The logger."""
        return self.logger

    def destroy_node(self) -> None:
        """Note it."""
        self.destroyed = True


def install(monkeypatch: pytest.MonkeyPatch, spin: Callable[[Any], None], **parameters: Any) -> None:
    """Make rclpy and the messages importable. ``spin`` gets the node; ``parameters`` are what the user gives."""
    content: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda: None, "try_shutdown": lambda: None, "spin": spin},
        "rclpy.node": {"Node": type("Node", (Node,), {"given": parameters})},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"WrenchStamped": WrenchStamped},
        "tipforce_msgs": {},
        "tipforce_msgs.msg": {"FingertipContact": FingertipContact},
    }
    for name, members in content.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
