"""`tipforce ros2`: what it refuses, and how it finds domain and namespace, before DDS starts."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest

from tipforce.errors import InputError
from tipforce_robots.ros2 import dds
from tipforce_tools.cli.main import main


def test_a_missing_package_is_one_line_with_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = importlib.util.find_spec
    absent: Any = lambda name, *rest: None if name == "cyclonedds" else found(name, *rest)  # noqa: E731
    monkeypatch.setattr("tipforce_tools.ros2.find_spec", absent)
    assert main(["ros2"]) == 2
    assert capsys.readouterr().err == "tipforce: ros2 needs cyclonedds: `pip install 'tipforce[ros2]'`\n"


def test_the_domain_and_the_range_are_those_of_ros() -> None:
    assert [dds.domain_id(None, {}), dds.domain_id(None, {"ROS_DOMAIN_ID": "42"}), dds.domain_id(3, {})] == [0, 42, 3]
    assert dds.domain_id(3, {"ROS_DOMAIN_ID": "42"}) == 3
    for bad in ("-1", "233", "robot"):
        with pytest.raises(InputError, match=f"ROS_DOMAIN_ID {bad}: allowed are 0 to 232"):
            dds.domain_id(None, {"ROS_DOMAIN_ID": bad})
    assert [dds.loopback_only(one) for one in (
        {}, {"ROS_LOCALHOST_ONLY": "0"}, {"ROS_LOCALHOST_ONLY": "1"}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_LOCALHOST_ONLY": "1"},
    )] == [False, False, True, True, False]  # fmt: skip


def test_the_configuration_keeps_that_of_the_user() -> None:
    wanted = "<IgnoreTypeInformation>1.15</IgnoreTypeInformation>"  # that of Fast DDS
    uri, local = {"CYCLONEDDS_URI": "file:///a.xml"}, {"ROS_LOCALHOST_ONLY": "1"}
    assert wanted in dds.configuration({})
    assert "127.0.0.1" not in dds.configuration({})
    first, *rest = dds.configuration(uri | local).split(",")
    assert wanted in first
    assert rest[0] == "file:///a.xml"  # of two values the later one counts
    assert "127.0.0.1" in rest[1]
    assert [dds.configuration(one, cyclone_version=0) for one in ({}, uri)] == ["", "file:///a.xml"]


def test_names_are_absolute() -> None:
    assert [dds.namespace(one) for one in ("/", "", "left", "/robot/left/")] == ["", "", "/left", "/robot/left"]
