"""docs/examples/ros2: packages that ROS 2 would build and launch; what of them can be checked without ROS."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tipforce.host.hand.file import read_hand
from tipforce.shipped_files import shipped_folder
from tipforce_tools.cli.main import command_parser

ROOT = shipped_folder("ros2")
PACKAGES = sorted(path.parent for path in ROOT.glob("*/package.xml"))


def test_the_messages_of_the_package_are_built() -> None:
    text = (ROOT / "tipforce_msgs" / "CMakeLists.txt").read_text()
    built = set(re.findall(r'"(msg/\w+\.msg)"', text))
    assert built == {f"msg/{path.name}" for path in (ROOT / "tipforce_msgs" / "msg").iterdir()}


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda path: path.name)
def test_a_package_has_one_name_and_installs_what_it_has(folder: Path) -> None:
    assert ElementTree.parse(folder / "package.xml").findtext("name") == folder.name
    text = (folder / "CMakeLists.txt").read_text()
    assert f"project({folder.name})" in text
    for installed in re.findall(r"install\(DIRECTORY (.*?) DESTINATION", text):
        assert all((folder / name).is_dir() for name in installed.split())


def test_the_launch_file_runs_the_command_with_its_flags() -> None:
    launch = ElementTree.parse(ROOT / "tipforce_bringup" / "launch" / "hand.launch.xml").getroot()
    defaults = {one.get("name", ""): one.get("default", "") for one in launch.iter("arg")}
    [command] = [one.get("cmd", "") for one in launch.iter("executable")]
    for name, value in defaults.items():
        command = command.replace(f"$(var {name})", value)
    folder = ROOT / "tipforce_bringup"
    words = shlex.split(command.replace("$(find-pkg-share tipforce_bringup)", str(folder)))
    assert words[:2] == ["tipforce", "ros2"]
    args = command_parser("ros2").parse_intermixed_args(words[2:])
    assert (args.namespace, args.allow_tare) == ("/tipforce", False)
    assert [finger.name for finger in read_hand(args.source).finger] == ["thumb", "index"]
