"""`tipforce ros2` beside a simulated hand, read by rosless in a process of this file; both in a network namespace."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rosless

import tipforce
from tipforce import Status
from tipforce.shipped_files import shipped_folder
from tools.rig import exit_code, in_namespace

LOOPBACK = 'ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && exec "$@"'
WAIT_S = 120.0  # far more than on an idle machine
_EMPTY = b"\x00\x01\x00\x00" + bytes(4)  # as rosidl sends it, padded; the encoder of rosless leaves its byte out


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    # ROS_LOCALHOST_ONLY: the configuration that users choose for one machine.
    words = (sys.executable, __file__, tmp_path_factory.mktemp("ros2"))
    done = in_namespace(LOOPBACK, *words, ROS_DOMAIN_ID="7", ROS_LOCALHOST_ONLY="1")
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


HAND = """
bus = { interface = "virtual", channel = "ros2" }
hand = { sync_hz = 50 }
finger = [{ name = "thumb", node_id = 1 }, { name = "index", node_id = 2 }]
"""
LOADS = {1: (4.4, -90.0, 80.0), 2: (2.2, -100.0, 70.0)}


def run_hand(folder: Path) -> int:
    """A simulated hand and `tipforce ros2` on its bus, until stdin says end; it also obeys: fault NODE NAME."""

    def obey(bus: tipforce.SimulatedBus) -> None:
        for line in sys.stdin:
            what, *rest = line.split()
            if what == "fault":
                bus.inject_fault(int(rest[0]), rest[1])
            elif what == "end":
                signal.raise_signal(signal.SIGTERM)  # SIGINT is ignored in what a shell runs in the background

    (folder / "hand.toml").write_text(HAND)
    with tipforce.simulated_hand(len(LOADS), LOADS, interface="virtual", channel="ros2") as bus:
        threading.Thread(target=obey, args=(bus,), daemon=True).start()
        return exit_code(f"ros2 {folder}/hand.toml --allow-tare --namespace left --seconds 300")


def read_hand(folder: str) -> None:
    """Print one JSON record of what rosless reads of run_hand."""
    rosless.register_path(str(shipped_folder("ros2") / "tipforce_msgs"))
    hand = [sys.executable, __file__, folder, "hand"]
    with subprocess.Popen(hand, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            found = _watch(process)
        finally:
            _say(process, "end")
            error = process.communicate(timeout=WAIT_S)[1]
    print(json.dumps({**found, "stderr": error, "code": process.returncode}))


def _watch(process: subprocess.Popen[str]) -> dict[str, Any]:
    node = rosless.Node(7)
    topics = _until(lambda: _topics(node), lambda found: "/left/index/tare" in found and "/diagnostics" in found)
    diagnostics = node.subscribe("/diagnostics", reliability="reliable", depth=100)
    wrench, contact = (node.subscribe(f"/left/index/{what}", depth=1000) for what in ("wrench", "contact"))
    late = node.subscribe("/left/index/info", reliability="reliable", durability="transient_local")
    refused = node.subscribe("/left/index/wrench", reliability="reliable")
    found: dict[str, Any] = {"topics": topics, "info": _dict(late.read(timeout=WAIT_S))}
    contacts: list[Any] = []

    def more() -> list[Any]:
        contacts.append(contact.read(timeout=WAIT_S))
        return contacts

    _until(more, lambda seen: len(seen) >= 10)
    _all(refused)  # the reader takes what arrives before it has compared the qualities of service
    _until(more, lambda seen: sum(np.isfinite(one.force) for one in seen) >= 60)
    found["contacts"] = [_dict(one) for one in contacts]
    wrenches = {one["header"]["stamp"]["nanosec"]: one for one in _all(wrench)}
    found["wrenches"] = [wrenches.get(one["header"]["stamp"]["nanosec"]) for one in found["contacts"]]
    found["refused"] = len(_all(refused))
    # Three events can arrive together, too: only the report of a period begins with the rows of the bus.
    report = _until(lambda: diagnostics.read(timeout=WAIT_S), lambda one: one.status[0].values[0].key == "rows")
    found["once a second"] = _dict(report)

    tare = node.advertise("/left/index/tare", "std_msgs/msg/Empty")

    def ask() -> Any:  # again, because the first message can precede the match of the subscription
        tare.send_payload(_EMPTY)
        return diagnostics.read(timeout=WAIT_S)

    found["tare"] = _dict(_until(ask, lambda one: one.status[0].message.startswith("tared")))
    _say(process, "fault 2 silent")
    found["fault"] = _dict(_until(lambda: diagnostics.read(timeout=WAIT_S), lambda one: _worst(one) == 2))
    # On a loaded machine a diagnosis can precede the contacts that were sent before the fault.
    _until(lambda: contact.read(timeout=WAIT_S), lambda one: bool(one.status & Status.FAULT))
    _until(lambda: contact.read(timeout=WAIT_S), lambda one: bool(one.status & Status.FAULT))
    _all(wrench)
    found["unknown"] = [_dict(contact.read(timeout=WAIT_S)) for _ in range(20)]
    found["wrenches while unknown"] = len(_all(wrench))
    return found


def _topics(node: rosless.Node) -> dict[str, str]:
    time.sleep(0.1)
    return {topic.name: topic.type_name for topic in node.graph().topics}


def _until(read: Callable[[], Any], enough: Callable[[Any], bool]) -> Any:
    end_s, found = time.monotonic() + WAIT_S, None
    while time.monotonic() < end_s:
        found = read()
        if found is not None and enough(found):
            return found
    raise TimeoutError(f"line {enough.__code__.co_firstlineno}: not seen within {WAIT_S:g} s; the last was {found}")


def _worst(message: Any) -> int:
    return max(int(status.level) for status in message.status)


def _all(subscription: Any) -> list[dict[str, Any]]:
    found = []
    while (one := subscription.read(timeout=0.0)) is not None:
        found.append(_dict(one))
    return found


def _dict(message: Any) -> Any:
    if isinstance(message, rosless.Message):
        return {name: _dict(value) for name, value in message.to_dict().items()}
    if isinstance(message, dict):
        return {name: _dict(value) for name, value in message.items()}
    return [_dict(one) for one in message] if hasattr(message, "__len__") and not isinstance(message, str) else message


def _say(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


if __name__ == "__main__":
    if sys.argv[2:]:
        sys.exit(run_hand(Path(sys.argv[1])))
    read_hand(sys.argv[1])
