"""A simulated device without a bus: values by name, events, faults; a machine in TOML and its connections."""

import itertools
import math
import struct
import threading
import time
from pathlib import Path

import can
import canopen
import pytest

import tipforce
from canopen_device.eds import Entry
from canopen_device.machine import DeviceApplication, Follows, Ramp, RandomWalk, SimulatedDevice, Sine, recorded
from canopen_device.machine.file import read_machine
from canopen_device.testing import Conversation
from canopen_device.types import Value
from eds.samples import described, pdo, record, text, var
from tipforce.errors import InputError

PRESS = text(
    var("1005", 7, "rw", "0x80"), var("1014", 7, "rw", "$NODEID+0x80"), var("2000", 4, "rw", "7"),
    var("2001", 8, "rw", "0"), var("2002", 9, "rw", "Press"), var("2003", 5, "ro", "0"),
    var("2004", 0x0F, "rw", "00" * 20),
    record("2100", var("2100sub0", 5, "ro", "2"), var("2100sub1", 4), var("2100sub2", 4)),
    pdo(0x1800, "$NODEID+0x180", 255, 0x20000020, inhibit=100), pdo(0x1801, "$NODEID+0x280", 1, 0x20010020),
    pdo(0x1400, "$NODEID+0x200", 255, 0x20000020),
)  # fmt: skip


def press(folder: Path, **given: object) -> Conversation:
    """A conversation with a press, its boot-up heard."""
    talk = Conversation(SimulatedDevice(described(folder, PRESS), **given), emcy=True)  # type: ignore[arg-type]
    talk.take()
    return talk


def test_values_by_index_and_name(tmp_path: Path) -> None:
    device = press(tmp_path).device
    assert device[0x2000] == device["p2000"] == device["2000h"] == device["0x2000:00"] == device[0x2000, 0] == 7
    device["P2002"] = "Grüße"
    assert device[0x2002] == "Grüße"
    device["R2100/P2100sub1"] = -4
    assert device[0x2100, 1] == device["P2100sub1"] == device["r2100:1"] == -4
    assert "P2000" in device
    assert 0x2999 not in device
    for key, message in (
        ("P200", "no object is called 'P200'; close to it: 'P2004'"),
        (0x2005, "no object 0x2005; the nearest are 0x2004"),
        (0x2100, "several entries: write 0x2100:SS, 00, 01, 02"), ((0x2100, 3), "no sub-index 3"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            _ = device[key]
    for key, value, message in (
        (0x2003, 256, "allowed are 0 to 255"),
        (0x2000, 1.5, "allowed are integers"),
        (0x2002, 3, "text"),
        (0x2002, "\u65e5", "allowed is text of Latin-1"),  # it was held as ?
    ):
        with pytest.raises(InputError, match=message):
            device[key] = value
    with pytest.raises(InputError, match="EMCY 74565, 1, 0: allowed are 1 to 0xFFFF"):
        device.raise_emergency(0x12345)


def test_a_change_sends_the_event_driven_pdo_after_its_inhibit_time(tmp_path: Path) -> None:
    talk = press(tmp_path)
    device = talk.device
    talk.say("""\
        > 000#0105
        < 185#07000000
        + 20000
    """)
    device[0x2000] = 9
    talk.step()
    assert talk.sent.pop(0) == (0x185, b"\x09\0\0\0")
    device[0x2000] = 9  # no change
    talk.advance(20_000)
    talk.say("""\
        > 205#0A000000
        < 185#0A000000
        > 605#2300200063000000
        < 585#6000200000000000
        + 9999
        + 1
        < 185#63000000
    """)


class Doubler(DeviceApplication):
    """2100h:2 is twice what is written to 2100h:1; 13 is refused; 2003h counts steps."""

    period_s = 0.1

    def on_write(self, entry: Entry, value: Value) -> int:
        if (entry.index, entry.sub) == (0x2100, 1):
            if value == 13:
                return 0x06090030
            self.device[0x2100, 2] = 2 * int(value)
        return 0

    def step(self, dt_s: float) -> None:
        assert dt_s == pytest.approx(0.1)
        self.device[0x2003] = int(self.device[0x2003]) + 1

    def on_reset(self) -> None:
        self.device[0x2003] = 0


def test_an_application_in_python(tmp_path: Path) -> None:
    talk = press(tmp_path, application=Doubler())
    device = talk.device
    talk.say("""\
        > 605#2300210115000000
        < 585#6000210100000000
        > 605#4000210200000000
        < 585#430021022A000000
        > 605#230021010D000000
        < 585#8000210130000906
    """)
    talk.advance(1_000_000)
    assert device[0x2003] == 10
    talk.step([(0, b"\x81\x05")])
    assert device[0x2003] == 0


def test_signals(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t_s,force\n0,1\n0.5,2.5\n1,4\n")
    signals = {
        0x2000: Ramp(0, 100, 2.0), "P2001": Sine(2.0, 1.0, 4.0), (0x2100, 1): Follows(0x2000, gain=-1.0),
        (0x2100, 2): recorded(tmp_path / "log.csv", "force"), 0x2003: RandomWalk(10, 5.0, 0, 20, 0.1, seed=3),
    }  # fmt: skip
    talk = press(tmp_path, signals=signals)
    device = talk.device
    seen = []
    for _ in range(10):
        talk.advance(100_000)
        seen.append(int(device[0x2003]))
    assert (device[0x2000], device[0x2100, 1], device[0x2100, 2]) == (50, -50, 4)
    assert device[0x2001] == pytest.approx(3.0)
    assert len(set(seen)) > 3
    assert all(0 <= value <= 20 for value in seen)
    talk.advance(3_000_000)
    assert device[0x2000] == 100
    # A SYNC and an SDO upload carry the value of that moment.
    talk.step([(0, b"\x01\x05")])
    talk.sent.clear()
    talk.now_us += 1_003_700
    sent = dict(talk.step([(0x80, b"")]))
    t_s = (talk.now_us - 0) * 1e-6
    assert struct.unpack("<f", sent[0x285])[0] == pytest.approx(1 + 2 * math.sin(math.tau * t_s / 4), abs=1e-5)
    with pytest.raises(InputError, match=r"0x2003:00 'P2003': the signal runs from 0 to 300; UNSIGNED8 holds 0 to 255"):
        press(tmp_path, signals={0x2003: Ramp(0, 300)})
    talk = press(tmp_path, signals={0x2000: Follows("P2001")})
    device = talk.device
    device["P2001"] = math.nan
    device[0x2000] = 7
    talk.advance(100_000)
    assert device[0x2000] == 7  # an integer has no NaN
    talk = press(tmp_path, signals={"P2001": Follows(0x2000, gain=1e38)})
    talk.advance(100_000)
    assert talk.device["P2001"] == pytest.approx(3.4028234663852886e38)  # 7e38 ended the loop of all devices
    with pytest.raises(InputError, match="a signal sets numbers only"):
        press(tmp_path, signals={0x2002: Ramp()})


def test_faults(tmp_path: Path) -> None:
    talk = press(tmp_path)
    device = talk.device
    device.fault("silent")
    talk.say("> 605#4000200000000000")
    device.clear_fault("silent")
    device.fault("slow", delay_s=0.2)
    talk.say("""\
        > 605#4000200000000000
        + 199999
        + 1
        < 585#4300200007000000
    """)
    device.clear_fault("slow")
    device.fault("wrong_toggle")
    talk.say("""\
        > 605#4004200000000000
        < 585#4104200014000000
        > 605#6000000000000000
        < 585#1000000000000000
    """)
    device.clear_fault("wrong_toggle")
    device.fault("emcy", code=0x4210, register=8)
    assert talk.step() == [(0x85, b"\x10\x42\x09\0\0\0\0\0")]
    device.clear_fault("emcy")
    assert [data[:3] for _, data in talk.step()] == [b"\0\0\0"]
    with pytest.raises(InputError, match="allowed are silent, slow, wrong_toggle, emcy"):
        device.fault("loud")
    with pytest.raises(InputError, match="allowed: delay_s"):
        device.fault("slow", ms=1)


MACHINE = """\
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
WALK = '[[device.signal]]\nkind = "random_walk"\nobject = "P2000"\nstep = 1\nlow = 0\nhigh = 9\n'
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
    (tmp_path / "machine.toml").write_text(MACHINE)
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
        ("[[device.fault]]", WALK + "every_s = 1e-320\n[[device.fault]]", "every_s 1e-320: allowed is above 1e-05"),
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
    (folder / "machine.toml").write_text(MACHINE.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_machine(folder / "machine.toml")


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


def test_the_block_begins_when_the_boot_up_is_sent_however_late(monkeypatch: pytest.MonkeyPatch) -> None:
    class SlowBus:
        def send(self, message: can.Message) -> None:
            early.append(block.wait(0.2))
            sent.append(message.arbitration_id)

        def recv(self, timeout_s: float) -> None:
            block.wait(timeout_s)

    block, early, sent = threading.Event(), list[bool](), list[int]()
    hours = itertools.count(3600.0, 3600.0)
    monkeypatch.setattr(time, "monotonic", lambda: next(hours))  # this thread hardly ever runs
    with tipforce.simulated_device("cia402", 5, SlowBus()):
        block.set()
    assert (sent[0], early[0]) == (0x705, False)


def test_an_error_of_an_application_reaches_the_test() -> None:
    class Broken(DeviceApplication):
        def step(self, _dt_s: float) -> None:
            raise RuntimeError("broken on purpose")

    with (
        pytest.raises(RuntimeError, match="broken on purpose"),
        tipforce.simulated_device("cia402", 5, application=Broken()),
    ):
        pass
