"""The other process of test_loopback, in a network namespace of its own: rosless reads what loopback_hand publishes.

Prints one JSON record of what it saw.
"""

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rosless

from tipforce.samples.reasons import Status
from tipforce.shipped_files import shipped_folder

WAIT_S = 120.0  # far more than on an idle machine
_EMPTY = b"\x00\x01\x00\x00" + bytes(4)  # as rosidl sends it, padded; the encoder of rosless leaves its byte out


def main(folder: str) -> None:
    rosless.register_path(str(shipped_folder("ros2") / "tipforce_msgs"))
    hand = [sys.executable, str(Path(__file__).with_name("loopback_hand.py")), folder]
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
    _until(more, lambda seen: sum(math.isfinite(one.force) for one in seen) >= 60)
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
    found["unknown"] = [_dict(one) for one in [contact.read(timeout=WAIT_S) for _ in range(20)]]
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
    main(sys.argv[1])
