"""`tipforce node`: what its flags make; --source from its words to scaled readings or a recording, or what to do."""

import errno
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import pytest

from canopen_device.core.node import Device
from sources.iio_tree import Tree
from tipforce.dictionary.eds import eds_text
from tipforce.fingertip.source import Source
from tipforce.sources import iio_sysfs
from tipforce.sources.layout_file import layout_text, read_bridge, read_layout
from tipforce_tools.doctor.machine import iio_checks
from tools.rig import run_node, source_of


def test_defaults(devices: list[Device], capsys: pytest.CaptureFixture[str], channel: str) -> None:
    with can.Bus(channel, interface="virtual") as bus:
        assert run_node(channel=channel) == 0
        last = bus.recv(0)
        assert last is not None
        assert (last.arbitration_id, bytes(last.data)) == (0x705, b"\4"), "it says that it stopped"
    (device,) = devices
    assert (device.node_id, device.step(0)[0][0]) == (5, (0x705, b"\0"))
    assert device.od.get(0x1018, 4) == 5, "the serial number is the node-id"
    assert device.od.get(0x1021) == eds_text(3, simulated=True).encode()
    source = source_of(device)
    assert (source.noise_microstrain, source.load, source.offset_microstrain) == (0.5, (0.0, 0.0, 0.0), [0.0] * 3)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("node 5 (0x05): layout I, ")
    assert err.endswith("node 5 (0x05): stopped\n")


def test_flags(devices: list[Device], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "node.json"
    words = "--layout III --serial 77 --noise 0 --offset -1,2,3.5 --load -4.4,90,-60 --seed 3 -q --store"
    assert run_node(*words.split(), store) == 0
    source = source_of(devices[0])
    assert devices[0].od.get(0x1018, 4) == 77
    assert source.offset_microstrain == [-1.0, 2.0, 3.5]
    assert source.load == (-4.4, 90.0, -60.0)
    assert capsys.readouterr() == ("", "")


POINTS = 'points = ["K_H", "S_H", "U"]\n'
BRIDGE = f"""{POINTS}[bridge]
kind = "full"
gauge_factor = 2.0
excitation_volts = 5.0
gain = 100.0
zero_volts = 2.5
"""
NINE = f"{BRIDGE}count_range = [0, 9]\n"
WRONG = [
    ("iio:a,b", NINE + "volts_per_count = 1e300", "0 and 1000 microstrain are 2.5e-300 and"),
    *(("iio:a,b", NINE + f'supply = "{one}"', f"'{one}': allowed is one") for one in ("a/voltage0,b", "ip:x/b", "a")),
    ("iio:", BRIDGE, "--source iio:: allowed are sim, iio:DEVICE"), ("iio:x/", BRIDGE, "no such device"),
    ("iio:,", BRIDGE, "'' is not a device"), ("iio:ip:/adc", BRIDGE, "'ip:/adc' is not a device"),
    ("iio:device0/voltage7", BRIDGE, "no channel 'voltage7'; it has voltage0, voltage1"),
    ("iio:device0", BRIDGE, "2 channels (iio:device0/voltage0, iio:device0/voltage1), but layout"),
    ("iio:device0,device0/voltage1", BRIDGE, "a channel is named twice"),
    ("iio:device0,device1", BRIDGE, "the range of counts is 0 to 4095, 0 to 255; all gauges need one range"),
    ("iio:device0,device2", BRIDGE, "the driver does not state its range of counts"),
    ("iio:device0,device1", POINTS, "need a [bridge] table"),
    ("iio:device0,device1", BRIDGE.replace("100.0", "0"), "[bridge] gain = 0"),
    ("iio:device0,device1", BRIDGE.replace("100.0", "nan"), "[bridge] gain = nan"),
    ("iio:device0,device1", BRIDGE.replace("5.0", "-5.0"), "excitation_volts = -5.0: allowed is a positive"),
    ("iio:device0,device1", BRIDGE + "count_range = [5, 5]\n", "[bridge] count_range = [5, 5]"),
    ("iio:device0,device1", BRIDGE.replace("100.0", "[1, 2]") + "count_range = [0, 255]\n", "2 numbers for 3 gauges"),
    ("iio:device0,device1", BRIDGE.replace("gain =", "gane ="), "bridge.gane: no such key; did you mean gain?"),
    ("iio:device0,device1", BRIDGE.replace("100.0", "'x'"), "bridge.gain is 'x': expected float | array, got str"),
    ("iio:device0,device1", BRIDGE + "colour = 1\n", "bridge.colour: no such key; allowed: kind, gauge_factor"),
    ("iio:device0,device3", BRIDGE, "has no voltage channel"),
]  # fmt: skip


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Tree:
    found = Tree(tmp_path)
    monkeypatch.setattr(iio_sysfs, "ROOT", found.root)
    monkeypatch.setattr(iio_sysfs, "HRTIMER", tmp_path / "no-configfs")
    return found


def layout(folder: Path, text: str) -> Path:
    path = folder / "finger.toml"
    path.write_text(text)
    return path


Started = Callable[..., tuple[Device, Any]]
Refused = Callable[..., str]


@pytest.fixture
def started(devices: list[Device]) -> Started:
    """Run a node with a layout and a source; the device and its gauges."""

    def run(layout: object, source: str, *words: object) -> tuple[Device, Any]:
        assert run_node("-q", "--layout", layout, "--source", source, *words) == 0
        return devices[-1], source_of(devices[-1])

    return run


@pytest.fixture
def refused(devices: list[Device], capsys: pytest.CaptureFixture[str]) -> Refused:
    """Run a node with a layout and a source that must be refused before it runs; what is said."""

    def run(layout: object, source: str, *words: object) -> str:
        before = len(devices)
        assert (run_node("-q", "--layout", layout, "--source", source, *words), len(devices)) == (2, before)
        return capsys.readouterr().err

    return run


# Industrial I/O


def test_scaling_follows_from_scale_offset_and_bridge(tree: Tree, started: Started) -> None:
    tree.add(0, "spi0.0", {"voltage0": 0, "voltage1": 0, "voltage2": 0}, "ad7799", "be:u24/32>>8",
             in_voltage_scale="0.000298023223877", in_voltage1_offset="-8388608")  # fmt: skip
    device, source = started(layout(tree.folder, BRIDGE), "iio:ad7799")
    assert device.od.get(0x1018, 2) == 0x54500203, "24 bits, not simulated"
    per_microstrain = 100.0 * 2.0e-6 * 5.0 / 0.298023223877e-6  # gain * k * V, a full bridge, over volts per count
    zero = [2.5 / 0.298023223877e-6 + offset for offset in (0.0, 8388608.0, 0.0)]
    for sub in (1, 2, 3):
        assert device.od.get(0x6120, sub) == pytest.approx(zero[sub - 1], rel=1e-7)
        assert device.od.get(0x6122, sub) == pytest.approx(zero[sub - 1] + 1000 * per_microstrain, rel=1e-7)
        assert device.od.get(0x6123, sub) == 1000.0
    assert (source.count_min, source.count_max) == (0, (1 << 24) - 1)
    device.step(0)
    eds = device.od.get(0x1021)
    assert isinstance(eds, bytes)
    stated = re.search(r"\[6120sub2\][^\[]*DefaultValue=(\S+)", eds.decode())
    assert stated is not None
    assert float(stated[1]) == pytest.approx(zero[1], rel=1e-7), "1021h says the same"


def test_several_devices_channels_and_a_gain_each(tree: Tree, started: Started) -> None:
    tree.add(0, "0-0050", {"voltage0": 5, "voltage1": 6}, bits="le:s16/16>>0", in_voltage_scale="0.1")
    tree.add(1, "0-0051", {"voltage": 7}, bits="le:s16/16>>0", in_voltage_scale="0.2")
    text = BRIDGE.replace("gain = 100.0", "gain = [100.0, -100.0, 50.0]").replace("2.5", "0.0")
    device, source = started(layout(tree.folder, text), "iio:device0/voltage1,iio:device0/voltage0,0-0051")
    assert device.od.get(0x1018, 2) == 0x54500003, "16 bits"
    assert [device.od.get(0x6122, sub) for sub in (1, 2, 3)] == pytest.approx([10_000, -10_000, 2500])
    assert counts(source, 0) == [(6, 5, 7)]


def test_a_supply_that_is_measured(tree: Tree, started: Started) -> None:
    path = tree.add(0, "a", {"voltage0": 5, "voltage1": 6, "voltage2": 7, "voltage3": 2500}, in_voltage_scale="1.0")
    text = BRIDGE + 'supply = "device0/voltage3"\nsupply_divider = 2.0\n'
    _, source = started(layout(tree.folder, text), "iio:device0/voltage0,device0/voltage1,device0/voltage2")
    for millivolts, faults in ((2500, 0), (2620, 0), (2630, 1 << 11), (2370, 1 << 11)):
        (path / "in_voltage3_raw").write_text(str(millivolts))
        source._supply_us = -1_000_000
        source._conversion = -1
        reading = source.read(0)
        assert reading is not None
        assert reading.faults == faults, millivolts
    tree.remove(0)
    tree.add(4, "a", {"voltage3": 2500}, in_voltage_scale="1.0")  # it is back under another number
    assert [source._supply_fault(), source._supply_fault()] == [True, False]


def test_without_a_scale_the_table_must_state_volts_per_count(
    tree: Tree, started: Started, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    tree.add(0, "a", {"voltage0": 1, "voltage1": 1, "voltage2": 1})
    path = layout(tree.folder, BRIDGE)
    said = refused(path, "iio:a")
    assert "device0/voltage0: the driver states no scale; state the converter's step" in said

    def refuse(_path: Path, _channel: str, name: str) -> float | None:
        if name == "scale":
            raise OSError(errno.EINVAL, "Invalid argument")
        return -1000.0

    monkeypatch.setattr(iio_sysfs, "attribute", refuse)
    said = refused(path, "iio:a")
    assert "does not state its scale (Invalid argument: no regulator)" in said
    assert "[bridge] volts_per_count" in said
    path.write_text(BRIDGE + "volts_per_count = 0.001\n")
    assert started(path, "iio:a")[0].od.get(0x6122, 1) == 2500 + 1000 + 1000


@pytest.mark.parametrize(("words", "text", "message"), WRONG)
def test_what_does_not_fit_is_said(tree: Tree, refused: Refused, words: str, text: str, message: str) -> None:
    tree.add(0, "a", {"voltage0": 1, "voltage1": 1}, in_voltage_scale="1")
    tree.add(1, "b", {"voltage": 1}, bits="le:u8/8>>0", in_voltage_scale="1")
    tree.add(2, "c", {"voltage": 1}, bits="", in_voltage_scale="1")
    tree.add(3, "d", {}, bits="")
    assert message in refused(layout(tree.folder, text), words)


def test_capture_by_a_trigger_that_is_not_there(tree: Tree, started: Started, refused: Refused) -> None:
    tree.add(0, "a", {"voltage0": 1, "voltage1": 1, "voltage2": 1}, in_voltage_scale="1")
    path = layout(tree.folder, BRIDGE)
    assert "--trigger t0: no such trigger; there are none" in refused(path, "iio:a", "--trigger", "t0")
    assert "modprobe iio-trig-hrtimer" in refused(path, "iio:a", "--capture", "buffer")
    tree.add_trigger(0, "adc-dev0")
    assert started(path, "iio:a")[1].read(0) is not None, "a trigger, but no buffer: polled, and said"
    assert "buffered capture cannot be set up" in refused(path, "iio:a", "--capture", "buffer")


def test_the_bridge_table_is_the_node_s_alone(tmp_path: Path) -> None:
    path = layout(tmp_path, BRIDGE)
    assert read_bridge("I") is None
    assert read_bridge(str(path)) is not None
    assert "bridge" not in layout_text(*read_layout(str(path)))


class Gone:
    @property
    def value(self) -> str:
        raise OSError(errno.ETIMEDOUT, "Connection timed out")


def test_a_remote_board_by_a_stand_in_for_pylibiio(
    tree: Tree, started: Started, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    """pylibiio itself needs libiio and a board with iiod: here its classes are played by a few lines."""
    up = [True]

    def channel(name: str, **attributes: str) -> SimpleNamespace:
        attrs = {key: SimpleNamespace(value=text) for key, text in attributes.items()}
        return SimpleNamespace(id=name, output=False, attrs=attrs)

    gauges = [channel(f"voltage{k}", raw=str(10 * k), scale="0.5", offset="-3") for k in (0, 1, 2)]
    board = SimpleNamespace(name="adc", id="iio:device0", channels=[*gauges, channel("temp", raw="100", scale="250")])

    def set_timeout(timeout_ms: int) -> None:
        assert timeout_ms < 100

    def context(uri: str) -> SimpleNamespace:
        if not up[0]:
            raise OSError(errno.ECONNREFUSED, "Connection refused")
        assert uri == "ip:board"
        return SimpleNamespace(devices=[board], set_timeout=set_timeout, find_device={"adc": board}.get)

    path = layout(tree.folder, BRIDGE + "count_range = [0, 4095]\n")
    monkeypatch.setitem(sys.modules, "iio", None)
    assert "pip install 'tipforce[iio]'" in refused(path, "iio:ip:board/adc")
    monkeypatch.setitem(sys.modules, "iio", SimpleNamespace(Context=context))
    assert "no such device; allowed: adc" in refused(path, "iio:ip:board/dac")
    device, source = started(path, "iio:ip:board/adc")
    source.parts[0].reopen()  # the node closed it when it ended
    assert source.read(1_000_000) == ((0, 10, 20), 0, 2500)
    assert device.od.get(0x6120, 1) == 5000 + 3
    no_number = SimpleNamespace(value="?")  # does not end the node
    for raw, up[0], now_us in ((Gone(), True, 1_001_000), (Gone(), False, 1_200_000), (no_number, True, 1_300_500)):
        gauges[1].attrs["raw"] = raw
        assert (source.read(now_us), source.faults) == (None, 1 << 8)
    gauges[1].attrs["raw"] = SimpleNamespace(value="11")
    assert (counts(source, 1_500_000), source.faults) == ([(0, 11, 20)], 0)
    up[0] = False
    assert "check that iiod runs there: `iio_info -u ip:board`" in refused(path, "iio:ip:board/adc")


def counts(source: Source, *times_us: int) -> list[tuple[int, ...] | None]:
    readings = [source.read(now_us) for now_us in times_us]
    return [None if reading is None else tuple(reading.counts) for reading in readings]


# tipforce doctor


def test_doctor_lists_converters_and_what_they_lack(tree: Tree) -> None:
    tree.add(0, "0-0050", {"voltage": 2}, "adc121c")
    tree.add(1, "spi0.0", {"voltage0": 1, "voltage1": 2}, "ad7124", in_voltage_scale="1")
    tree.add(2, "x", {"voltage0": 1}, "odd", bits="", in_voltage_scale="1")
    (tree.root / "iio:device2/in_voltage0_raw").write_text("?")
    found = list(iio_checks(tree.root, tree.dev, tree.folder / "absent"))
    assert [(check.topic, check.state) for check in found] == [
        ("ADC iio:device0", "ok"), ("ADC iio:device0", "note"), ("ADC iio:device1", "ok"), ("ADC iio:device2", "ok"),
        ("ADC iio:device2", "note"), ("ADC iio:device2", "note"), ("ADC trigger", "note"),
    ]  # fmt: skip
    assert found[0].finding == "iio:device0 (adc121c, 0-0050): voltage, 12 bits"
    assert found[0].next_step == "--source iio:0-0050"
    assert "volts_per_count" in found[1].next_step
    assert "modprobe iio-trig-hrtimer" in found[-1].next_step
    tree.add_trigger(0, "t")
    assert list(iio_checks(tree.root, tree.dev, tree.folder / "absent"))[-1].next_step == "--trigger NAME"
    assert list(iio_checks(tree.root, tree.dev, tree.folder))[-1].finding == "timer triggers are available"
    tree.add_trigger(1, "ad7124-dev1")
    assert list(iio_checks(tree.root, tree.dev))[-1].finding == "data-ready triggers: ad7124-dev1"


def test_doctor_without_converters(tree: Tree, monkeypatch: pytest.MonkeyPatch) -> None:
    (check,) = iio_checks(tree.root)
    assert (check.topic, check.state) == ("ADC", "note")
    assert "new_device" in check.next_step
    (check,) = iio_checks(tree.folder / "absent")
    assert "modprobe industrialio" in check.next_step
    monkeypatch.setattr(sys, "platform", "darwin")
    (check,) = iio_checks()
    assert check.state == "note"


def test_a_recording_in_csv(tmp_path: Path, started: Started) -> None:
    path = tmp_path / "session.csv"
    path.write_text("t_s,SG1,SG2,SG3,P_N\n1,1.04,-2,3,0\n1.5,4,5,9999,0\n")
    _, source = started("I", f"replay:{path}", "--speed", "2", "--loop")
    first = (10, -20, 30)
    assert counts(source, 0, 249_999, 250_000, 500_000) == [first, None, (40, 50, 32767), first]
    assert counts(started("I", f"replay:{path}", "--bits", "24")[1], 0) == [(2662, -5120, 7680)]


def test_a_recording_of_candump(tmp_path: Path, started: Started, refused: Refused) -> None:
    path = tmp_path / "log.txt"
    lines = (
        "(1.000000) can0 185#0A00ECFF1E000201",  # 1.0, -2.0, 3.0 microstrain, calibrated
        "(1.001000) can0 185#0A00ECFF1E000A01",  # stale: nothing new
        "(1.002000) can0 185#FF7F0180008002",  # too short for its mapping
        "(1.003000) can0 185#FF7F018005000602",  # saturated at both ends
        "(1.003500) can0 185#0A00ECFF1E000603",  # saturated inside: the flag does not say which gauge
        "(1.004000) can0 186#0100010001000201",
    )
    path.write_text("\n".join(lines) + "\n")
    assert f"contains gauges of the nodes 5, 6; choose one: {path}@5" in refused("I", f"replay:{path}")
    _, source = started("I", f"replay:{path}@5")
    assert counts(source, 0, 1500, 3000, 3500) == [(10, -20, 30), None, (32767, -32768, 5), None]
    assert counts(started("I", f"replay:{path}@5", "--bits", "24")[1], 0, 3000)[1] == (0x7FFFFF, -0x800000, 1280)
    assert "a positive number up to 1e9" in refused("I", f"replay:{path}@5", "--speed", "1e300")
