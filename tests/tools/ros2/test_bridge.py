"""The bridge without DDS: what it publishes of a log is what `tipforce decode` says of the same frames."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rosless

from tipforce.errors import InputError
from tipforce.host.logs.reader import open_log
from tipforce.shipped_files import shipped_folder
from tipforce.watching.feeds import FrameFeed
from tipforce.watching.frame_sources import LogSource
from tipforce.watching.watcher import Finger
from tipforce_robots.ros2 import cdr
from tipforce_robots.ros2.bridge import PERIOD_NS, Bridge
from tipforce_tools.cli.main import main
from tools.decode.logs import START_US, decode, log_lines, number, rows_of, write_log

EMCY = "(1700000000.100010) vcan0 085#3050100000000000"
NODES = (1, 5)


class Topics:
    """In place of a RosDomain: keeps the messages by topic."""

    def __init__(self) -> None:
        self.kinds: dict[str, tuple[str, str]] = {}
        self.messages: dict[str, list[tuple[int, Any]]] = {}

    def publisher(self, topic: str, kind: str, profile: str) -> Any:
        """Return a publisher that keeps what it gets."""
        kept = self.messages.setdefault(topic, [])
        self.kinds[topic] = kind, profile

        class Kept:
            def publish(self, message: bytes, t_ns: int) -> None:
                kept.append((t_ns, rosless.decode(kind, message)))

        return Kept()


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rosless.register_path(str(shipped_folder("ros2") / "tipforce_msgs"))
    lines = log_lines(600, NODES, loss=0.0)
    place = next(k for k, line in enumerate(lines) if line > EMCY)
    return write_log(tmp_path_factory.mktemp("bridge") / "run.log", [*lines[:place], EMCY, *lines[place:]])


def published(log: Path, *fingers: Finger) -> tuple[Topics, list[dict[str, Any]]]:
    topics: Any = Topics()
    events: list[dict[str, Any]] = []
    with open_log(log) as reader:
        feed = FrameFeed(LogSource(reader, math.inf, PERIOD_NS), Finger, 3, fingers)
        bridge = Bridge(feed, topics, "/tipforce", False)
        while not feed.ended:
            events += bridge.step()
        bridge.report(feed.now_ns())
    return topics, events


def test_the_wrenches_of_a_log_are_those_of_decode(log: Path) -> None:
    topics, _ = published(log)
    assert decode(log, "-o", log.with_suffix(".csv"), "--signals", "P,phi,theta") == 0
    rows = rows_of(log.with_suffix(".csv"))
    for node in NODES:
        expected = {}
        for row in rows:
            values = [number(row[name]) for name in ("P_N", "phi_deg", "theta_deg")]
            if row["node"] == str(node) and None not in values:
                P, phi, theta = values[0] or 0.0, *(math.radians(value or 0.0) for value in values[1:])
                sync_us = round(float(row["t_s"]) * 1e6) // 1000 * 1000  # the log has a SYNC every millisecond
                expected[sync_us * 1000] = P * math.cos(phi), P * math.sin(phi), 0.015 * P * math.sin(phi - theta)
        found = {}
        for t_ns, message in topics.messages[f"/tipforce/finger_{node}/wrench"]:
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == t_ns
            found[t_ns] = message.wrench.force.x, message.wrench.force.y, message.wrench.torque.z
        assert found.keys() == expected.keys()
        assert 450 < len(found) < 600
        np.testing.assert_allclose([found[t] for t in expected], list(expected.values()), atol=1e-9)
        contacts = [message for _, message in topics.messages[f"/tipforce/finger_{node}/contact"]]
        assert [contact.number for contact in contacts] == list(range(600))
        assert len(contacts[0].microstrain) == 3


def test_topics_types_and_profiles(log: Path) -> None:
    topics, events = published(log, Finger(1, "thumb"))
    assert topics.kinds == {
        "/diagnostics": (cdr.DIAGNOSTICS, "events"),
        **{
            f"/tipforce/{name}/{what}": profile
            for name in ("thumb", "finger_5")
            for what, profile in (
                ("wrench", (cdr.WRENCH, "sensor data")),
                ("contact", (cdr.CONTACT, "sensor data")),
                ("info", (cdr.FINGERTIP, "static")),
            )
        },
    }
    [event] = events
    assert (event["name"], event["level"], event["hardware_id"]) == ("tipforce: finger_5", 2, "node 5")
    reports = [message for _, message in topics.messages["/diagnostics"] if len(message.status) == 3]
    assert [one.name for one in reports[-1].status] == ["tipforce: bus", "tipforce: thumb", "tipforce: finger_5"]
    assert START_US < topics.messages["/diagnostics"][0][0] // 1000 < START_US + 3_000_000


def test_the_command_publishes_a_log(
    log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    topics = Topics()
    monkeypatch.setattr("tipforce_robots.ros2.dds.RosDomain", lambda _domain: topics)
    assert main(["ros2", str(log), "--speed", "inf", "--nodes", "5", "--namespace", "left", "--json"]) == 0
    out, err = capsys.readouterr()
    count = len(topics.messages["/left/finger_5/wrench"])
    assert json.loads(out) == {"rows": 600, "wrenches": {"finger_5": count}}
    assert f"600 rows, {count} wrenches of 1 finger published" in err
    assert "left: finger_5: emcy: " in err


def test_two_fingers_of_one_name_are_refused(log: Path) -> None:
    with pytest.raises(InputError, match="fingers 1 and 5: both are ring_1 in ROS 2; rename one"):
        published(log, Finger(1, "ring 1"), Finger(5, "ring-1"))
