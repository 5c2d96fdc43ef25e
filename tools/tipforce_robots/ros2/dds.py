"""Topics of ROS 2 on DDS by Eclipse Cyclone DDS. ``/hand/thumb/wrench`` is ``rt/hand/thumb/wrench`` in DDS, its type
``geometry_msgs/msg/WrenchStamped`` is ``geometry_msgs::msg::dds_::WrenchStamped_``."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Literal

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from tipforce.errors import EnvironmentLackError, InputError
from tipforce_robots.ros2.cdr import fields_of

Profile = Literal["sensor data", "events", "static"]

HIGHEST_DOMAIN = 232
"""The ports of higher domains are over 65535 (DDSI-RTPS 2.5, 9.6.2.3)."""
_ACK_NS = 100_000_000  # a reliable writer waits for a slow reader at most so long
# Cyclone DDS asks a reader of Fast DDS for the minimal object of its type and receives the complete one: they never
# match if the type has a sequence. Without information about types they match by the type's name.
_FAST_DDS = (
    '<CycloneDDS><Domain id="any"><Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>'
    "</Domain></CycloneDDS>"
)
_LOOPBACK = (
    '<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>'
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers>"
    '<Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)
_SEQUENCE: Any = types.sequence
_ARRAY: Any = types.array
_PRIMITIVES: dict[str, Any] = {
    "bool": bool, "string": str, "byte": types.uint8, "char": types.uint8,
    **{name: getattr(types, name) for name in (
        "uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float32", "float64"
    )},
}  # fmt: skip


class RosDomain:
    """One participant in a ROS 2 domain. Raises EnvironmentLackError if DDS does not start."""

    def __init__(self, domain: int, environment: Mapping[str, str] = os.environ) -> None:
        try:
            self._domain = Domain(domain, configuration(environment))
            self._participant: Any = DomainParticipant(domain)
        except DDSException as error:
            uri = environment.get("CYCLONEDDS_URI")
            advice = f"check CYCLONEDDS_URI ({uri})" if uri else "is there a network interface that is up?"
            raise EnvironmentLackError(f"DDS does not start in domain {domain}: {error.msg}; {advice}") from None

    def publisher(self, topic: str, kind: str, profile: Profile) -> RosPublisher:
        """Return a publisher of ``kind`` on the ROS topic ``topic``, an absolute name."""
        return RosPublisher(self._participant, topic, kind, profile)

    def subscription(self, topic: str, kind: str) -> Callable[[], int]:
        """Return a function that returns how many messages of ``kind`` have arrived since its last call."""
        dds_topic: Any = Topic(self._participant, f"rt{topic}", idl_type(kind))
        reader: Any = DataReader(self._participant, dds_topic, quality("events"))
        return lambda: sum(bool(sample.sample_info.valid_data) for sample in reader.take(N=100))


class RosPublisher:
    """Publishes messages that are serialised already."""

    def __init__(self, participant: Any, topic: str, kind: str, profile: Profile) -> None:
        struct = idl_type(kind)
        self._writer: Any = DataWriter(participant, Topic(participant, f"rt{topic}", struct), quality(profile))
        # The type with a ``message`` in place of its fields: bytes that are written as they are.
        methods = {"__init__": lambda _self: None, "serialize": lambda self, **_options: self.message}
        self._sample: Any = type(struct.__name__, (struct,), methods)()

    def publish(self, message: bytes, t_ns: int) -> None:
        """Write one message with its source time. Raises EnvironmentLackError if DDS fails."""
        self._sample.message = message
        try:
            self._writer.write(self._sample, t_ns)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:  # a reliable reader does not keep up: it loses messages
                raise EnvironmentLackError(f"DDS: {error.msg}") from None

    @property
    def readers(self) -> int:
        """Number of matched subscriptions."""
        return len(self._writer.get_matched_subscriptions())


def domain_id(given: int | None, environment: Mapping[str, str] = os.environ) -> int:
    """Return the domain: ``given``, else ROS_DOMAIN_ID, else 0. Raises InputError."""
    text = environment.get("ROS_DOMAIN_ID") or "0"
    name, value = ("--domain", str(given)) if given is not None else ("ROS_DOMAIN_ID", text)
    if not value.isdecimal() or int(value) > HIGHEST_DOMAIN:
        raise InputError(f"{name} {value}: allowed are 0 to {HIGHEST_DOMAIN}")
    return int(value)


def loopback_only(environment: Mapping[str, str]) -> bool:
    """Return whether ROS 2 stays on this machine: ROS_AUTOMATIC_DISCOVERY_RANGE, else ROS_LOCALHOST_ONLY."""
    wanted = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    return wanted.upper() == "LOCALHOST" if wanted else environment.get("ROS_LOCALHOST_ONLY", "0") == "1"


def configuration(environment: Mapping[str, str]) -> str:
    """Return Cyclone DDS' configuration, the user's CYCLONEDDS_URI in the middle: of two values the later one wins."""
    local = _LOOPBACK if loopback_only(environment) else ""
    return ",".join(filter(None, (_FAST_DDS, environment.get("CYCLONEDDS_URI", ""), local)))


def namespace(text: str) -> str:
    """Return an absolute namespace without a slash at its end. Raises InputError for one that ROS 2 would refuse."""
    absolute = "/" + text.strip("/")
    if absolute == "/" or re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", absolute):
        return "" if absolute == "/" else absolute
    raise InputError(f"--namespace {text!r}: allowed are letters, digits and _, parts separated by /")


def quality(profile: Profile) -> Qos:
    """Return the quality of service: that of rclcpp's SensorDataQoS; reliable; reliable and kept for late readers."""
    durability = Policy.Durability.TransientLocal if profile == "static" else Policy.Durability.Volatile
    sensor = profile == "sensor data"
    reliability = Policy.Reliability.BestEffort if sensor else Policy.Reliability.Reliable(_ACK_NS)
    depth = {"sensor data": 5, "events": 10, "static": 1}[profile]
    representation = Policy.DataRepresentation(use_cdrv0_representation=True)
    return Qos(reliability, durability, Policy.History.KeepLast(depth), representation)


@cache
def idl_type(kind: str) -> type[IdlStruct]:
    """Return the DDS type of a message, built from its definition."""
    package, _, name = kind.split("/")
    annotations: dict[str, Any] = {}
    for field in fields_of(kind):
        value = idl_type(field.kind) if "/" in field.kind else _PRIMITIVES[field.kind]
        if field.size != 1:
            value = _SEQUENCE[value] if field.size is None else _ARRAY[value, field.size]
        annotations[field.name] = value
    return make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", annotations)
