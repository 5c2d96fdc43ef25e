"""A machine in TOML, the command line, and the connections of a simulated device to buses."""

from __future__ import annotations

from pathlib import Path

import can
import canopen
import pytest

import tipforce
from canopen_device.machine import DeviceApplication
from canopen_device.machine.file import read_machine
from eds.samples import text, var
from tipforce.errors import InputError
from tipforce_tools.cli.main import main

PRESS = """\
[[device]]
eds = "press.eds"
node_id = 7
application = "press.py:Press"
[device.values]
P2000 = 3
"0x2002" = "0A0B"
[[device.signal]]
kind = "ramp"
object = "P2001"
start = 0
end = 100
duration_s = 1
[[device.fault]]
kind = "silent"
at_s = 2.0
for_s = 1.0
[[device]]
eds = "cia402"
node_id = 8
"""
SECOND = '[[device.signal]]\nkind = "follows"\nsource = "P2000"\n'
APPLICATION = """\
from canopen_device.machine import DeviceApplication

class Press(DeviceApplication):
    def on_reset(self):
        self.device[0x2003] = 9

class Needy(DeviceApplication):
    def __init__(self, force): ...
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "press.eds").write_text(text(var("2000", 5), var("2001", 6), var("2002", 0x0A), var("2003", 5)))
    (tmp_path / "press.py").write_text(APPLICATION)
    (tmp_path / "machine.toml").write_text(PRESS)
    return tmp_path


def test_a_machine_has_its_devices(folder: Path) -> None:
    press, drive = read_machine(folder / "machine.toml")
    press.step(0)
    assert (press.node_id, drive.node_id) == (7, 8)
    assert [press[0x2000 + k] for k in (0, 2, 3)] == [3, b"\x0a\x0b", 9]
    press.step(500_000)
    assert press[0x2001] == 50
    for now_us, answers in ((1_900_000, 1), (2_100_000, 0), (3_100_000, 1)):
        assert len(press.step(now_us, [(0x607, bytes.fromhex("4000200000000000"))])[0]) == answers
    assert drive.application.__class__.__name__ == "Drive"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("press.eds", "none.eds", r"device\[1\]: .*none.eds: No such file"),
        ("node_id = 8", "node_id = 7", "node-id 7: two devices have it"),
        ("node_id = 8", "", "names no node-id"),
        ('"ramp"', '"rmap"', r"device\[1\].signal\[1\].kind is 'rmap'; did you mean ramp"),
        ("duration_s = 1", "duration_s = 0", "duration_s 0.0: allowed is above 0"),
        ("end = 100", "end = 1e9", "UNSIGNED16 holds 0 to 65535"),
        ("P2001", "P20", r"device\[1\]: press.eds: no object is called 'P20'; close to it"),
        ("P2000 = 3", "P2000 = 300", "300 does not fit UNSIGNED8"),
        ("press.py:Press", "press.py:Other", "no subclass of DeviceApplication called 'Other'"),
        ("press.py:Press", "no.py:Press", "allowed are cia402, and FILE:CLASS"),
        ('"silent"', '"slow"', "delay_s is missing"),
        ("at_s = 2.0", "at_s = -2.0", r"device\[1\]: fault silent: at_s -2, for_s 1.0: allowed are at_s from 0 on"),
        ("press.py:Press", "press.py:Needy", r"press.py: TypeError: .*missing 1 required positional argument"),
        ("[[device.fault]]", SECOND + 'object = "P2001"\n[[device.fault]]', "'P2001': two signals; an object has one"),
        ("[[device.fault]]", SECOND + "object = 0x2001\n[[device.fault]]", "0x2001:00: two signals"),
    ],
)
def test_what_is_wrong_is_named(folder: Path, old: str, new: str, message: str) -> None:
    (folder / "machine.toml").write_text(PRESS.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_machine(folder / "machine.toml")


def test_the_command_refuses_what_does_not_fit(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    eds, bus = str(folder / "press.eds"), ["-i", "virtual", "-c", "x"]
    for words, said in (
        ([eds], "names no node-id"), ([eds, eds, "--node-id", "5"], "1 for 2 files"),
        ([eds, eds, "--node-id", "5,6,7"], "3 for 2"),
        ([eds, "--node-id", "5", "--set", "P2000"], "the form is OBJECT=VALUE"),
        ([eds, "--node-id", "5,6", "--set", "P2000=1"], "several nodes; write ID:OBJECT=VALUE"),
        ([eds, "--node-id", "5", "--set", "9:P2000=1"], "no node 9 here"),
        ([str(folder / "machine.toml"), "--node-id", "5"], "a machine in TOML stands alone"),
    ):  # fmt: skip
        assert main(["simulate", *words, *bus]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize("given", ["bus", "network", "tipforce", "options", "nothing"])
def test_a_device_joins_the_bus_of_its_master(given: str) -> None:
    options = {"interface": "virtual", "channel": f"machine-{given}"}
    network = canopen.Network()
    network.connect(**options)
    bus: object = {"bus": network.bus, "network": network, "options": options, "nothing": None}.get(given)
    if given == "tipforce":
        bus = opened = tipforce.open(can.Bus(**options))  # type: ignore[arg-type]
    with tipforce.simulated_device("cia402", 9, bus) as drive:
        if given == "nothing":
            network.disconnect()
            network.connect(**drive.bus_options)
        assert network.add_node(9, canopen.ObjectDictionary()).sdo.upload(0x1000, 0) == b"\x92\x01\x02\0"
    network.disconnect()
    if given == "tipforce":
        opened.close()


def test_an_error_of_an_application_reaches_the_test() -> None:
    class Broken(DeviceApplication):
        def step(self, _dt_s: float) -> None:
            raise RuntimeError("broken on purpose")

    with (
        pytest.raises(RuntimeError, match="broken on purpose"),
        tipforce.simulated_device("cia402", 5, application=Broken()),
    ):
        pass
