"""The Industrial I/O source on trees of files: counts as they are, and every trouble a fault with its EMCY."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from canopen_device.core.node import Device
from fingertip.finger import SATURATED, STALE, UNKNOWN, record
from sources.iio_tree import Tree
from tipforce.errors import EnvironmentLackError, InputError
from tipforce.fingertip.calibration import Active
from tipforce.fingertip.node import fingertip_node
from tipforce.sources import iio_sysfs
from tipforce.sources.iio import IioSource, Part
from tipforce.sources.iio_sysfs import PolledDevice

FAULT = 1 << 7
CONVERTER = (16, 2.0, ((2048.0, 4048.0),) * 3)
ENDS = (0, 4095)
SYNC_US = 2000


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


@pytest.fixture
def three(tree: Tree) -> Tree:
    """Three devices with a channel each."""
    for k in range(3):
        tree.add(k, f"0-005{k}", {"voltage": 2048 + 10 * k}, "adc121c")
    return tree


def polled(tree: Tree) -> list[Part]:
    return [PolledDevice(device, iio_sysfs.voltage_channels(device.path)) for device in iio_sysfs.devices(tree.root)]


def source(parts: list[Part], gauges: int = 3, **options: object) -> IioSource:
    return IioSource(parts, gauges, CONVERTER, ENDS, clock=lambda: 0, **options)  # type: ignore[arg-type]


class Talk:
    """A node on a source, operational, with its frames."""

    def __init__(self, given: IioSource) -> None:
        self.source = given
        self.now_us = 1_000_000
        self.frames: list[tuple[int, bytes]] = []
        self.device: Device = fingertip_node(5, given)
        self.step(0x000, b"\x01\x05")

    def step(self, can_id: int = 0x7FF, data: bytes = b"") -> None:
        self.frames += self.device.step(self.now_us, [(can_id, data)])[0]

    def sync(self, count: int = 1, before: Callable[[], None] = lambda: None) -> tuple[int, int, tuple[int, ...]]:
        """SYNCs; status, 2121h and gauges of the last."""
        for _ in range(count):
            self.now_us += SYNC_US
            before()
            self.frames = [frame for frame in self.frames if frame[0] == 0x085]
            self.step(0x080)
        *gauges, status, counter = struct.unpack("<hhhBB", dict(self.frames)[0x185])
        return status, counter, tuple(gauges)

    def idle(self, until_us: int) -> None:
        """Steps when the node wants them, without SYNC."""
        while self.now_us < until_us:
            sent, due_us = self.device.step(self.now_us)
            self.frames += sent
            self.now_us = min(max(due_us, self.now_us + 1), until_us)
        self.step()

    def emcys(self) -> list[tuple[int, int, int]]:
        """(code, detail, cured code) of the EMCYs since the last SYNC or look."""
        found = []
        for can_id, data in self.frames:
            if can_id == 0x085:
                code, _register, first, second = struct.unpack("<HBHHx", data)
                found.append((code, second, first) if code == 0 else (code, first, 0))
        self.frames = []
        return found


def set_raw(tree: Tree, number: int, counts: int, channel: str = "voltage") -> None:
    (tree.root / f"iio:device{number}" / f"in_{channel}_raw").write_text(f"{counts}\n")


# What there is


def test_devices_are_found_by_number_name_label_and_place(tree: Tree) -> None:
    tree.add(0, "0-0050", {"voltage": 1}, "adc121c")
    tree.add(1, "0-0051", {"voltage": 1}, "adc121c", label="tip left")
    tree.add(10, "spi0.1", {"voltage0": 1, "voltage1": 2, "voltage10": 3, "voltage2": 4}, "ad7124-4")
    assert [device.number for device in iio_sysfs.devices(tree.root)] == ["iio:device0", "iio:device1", "iio:device10"]
    for wanted, number in (("device1", 1), ("iio:device1", 1), ("tip left", 1), ("0-0051", 1), ("ad7124-4", 10)):
        assert iio_sysfs.find(wanted, tree.root).number == f"iio:device{number}"
    with pytest.raises(InputError, match=r"matches iio:device0 \(adc121c, 0-0050\); iio:device1 \(adc121c, tip left"):
        iio_sysfs.find("adc121c", tree.root)
    with pytest.raises(EnvironmentLackError, match=r"no such device; allowed: iio:device0 \(adc121c"):
        iio_sysfs.find("nau7802", tree.root)
    with pytest.raises(EnvironmentLackError, match="none: `tipforce doctor`"):
        iio_sysfs.find("nau7802", tree.folder / "absent")
    path = iio_sysfs.find("spi0.1", tree.root).path
    assert iio_sysfs.voltage_channels(path) == ["voltage0", "voltage1", "voltage2", "voltage10"]


def test_scale_of_a_channel_of_its_kind_or_none(tree: Tree) -> None:
    path = tree.add(
        0, "a", {"voltage0": 1, "voltage1": 2, "voltage0-voltage1": 3},
        in_voltage_scale="0.5", in_voltage1_scale="0.25", in_voltage1_offset="-2048",
    )  # fmt: skip
    (path / "in_voltage-voltage_scale").write_text("0.125\n")
    assert [iio_sysfs.attribute(path, name, "scale") for name in ("voltage0", "voltage1", "voltage0-voltage1")] == [
        0.5, 0.25, 0.125,
    ]  # fmt: skip
    assert [iio_sysfs.attribute(path, name, "offset") for name in ("voltage0", "voltage1")] == [None, -2048.0]
    assert iio_sysfs.millivolts(path, "voltage1") == (2 - 2048) * 0.25
    (path / "in_voltage_scale").write_text("x\n")
    with pytest.raises(OSError, match="holds no number"):
        iio_sysfs.attribute(path, "voltage0", "scale")


@pytest.mark.parametrize(
    ("files", "hundredths"),
    [
        ({"in_temp_input": "23456"}, 2346),
        ({"in_temp_raw": "1000", "in_temp_scale": "2.5", "in_temp_offset": "-200"}, 200),
        ({"in_temp0_raw": "-41000"}, -4100),
        ({"in_temp_input": "999999999"}, -0x8000),
    ],
)
def test_temperature_in_hundredths_of_a_degree(tree: Tree, files: dict[str, str], hundredths: int) -> None:
    path = tree.add(0, "a", {"voltage": 1}, **files)
    channel = iio_sysfs.temperature_channel(path)
    assert channel is not None
    assert iio_sysfs.temperature(path, channel) == hundredths
    assert PolledDevice(iio_sysfs.find("a", tree.root), ["voltage"]).temperature() == hundredths


# Polling


def test_readings_are_fresh_once_a_period_and_in_the_order_of_the_gauges(three: Tree) -> None:
    found = source(polled(three)[::-1])
    found.period_us = 1000
    reading = found.read(5000)
    assert reading is not None
    assert reading == ((2068, 2058, 2048), 0, -0x8000)
    assert found.read(5999) is None
    assert found.faults == 0
    assert found.read(6000) is not None


def test_strain_follows_from_the_scaling_of_the_converter(three: Tree) -> None:
    status, counter, gauges = Talk(source(polled(three))).sync()
    assert not status & (STALE | FAULT)
    assert counter == 1
    assert gauges == (0, 50, 100)  # 10 counts are 5 microstrain, in steps of 0.1


def test_a_slow_read_does_not_pile_up_in_a_filter(three: Tree) -> None:
    now = [1_000_000]

    class Slow(PolledDevice):
        def read(self, now_us: int) -> tuple[int, ...] | None:
            now[0] += 3000
            return super().read(now_us)

    parts: list[Part] = [Slow(device, ["voltage"]) for device in iio_sysfs.devices(three.root)]
    found = IioSource(parts, 3, CONVERTER, ENDS, clock=lambda: now[0])
    device = fingertip_node(5, found)
    for index in (0x61A0, 0x61A1):
        assert device.od.writers[index](1, 4) == 0 or index == 0x61A0
    device.od.values[0x61A001] = 1
    device.step(now[0])
    reads = now[0]
    for _ in range(20):
        now[0] += 20_000
        device.step(now[0])
    assert (now[0] - reads - 20 * 20_000) / 9000 <= 20 * 5, "never more than what the time since the last step holds"


def test_a_device_that_is_gone_is_told_at_once_and_taken_up_again(
    three: Tree, caplog: pytest.LogCaptureFixture
) -> None:
    talk = Talk(source(polled(three)))
    talk.sync(3)
    three.remove(1)
    status, counter, gauges = talk.sync()
    assert status & STALE
    assert status & FAULT
    assert counter == 3, "no new sample"
    assert gauges == (UNKNOWN,) * 3
    assert talk.emcys() == [(0x5030, 8, 0)]
    for _ in range(100):
        assert talk.sync()[2] == (UNKNOWN,) * 3
        assert talk.emcys() == []
    three.add(7, "0-0051", {"voltage": 2148})  # another number, the same place
    talk.sync(60)
    status, _, gauges = talk.sync()
    assert not status & (STALE | FAULT)
    assert gauges == (0, 500, 100)
    assert [record.message for record in caplog.records] == [
        "iio:device1: No such file or directory; the node continues when the device is back", "iio:device1: back",
    ]  # fmt: skip


def test_another_device_under_the_old_number_is_not_taken(three: Tree) -> None:
    talk = Talk(source(polled(three)))
    talk.sync()
    three.remove(1)
    three.add(1, "0-0077", {"voltage": 4000})
    for _ in range(100):
        assert talk.sync()[2] == (UNKNOWN,) * 3


def test_a_value_that_is_no_number_is_no_data(three: Tree) -> None:
    talk = Talk(source(polled(three)))
    talk.sync()
    (three.root / "iio:device2/in_voltage_raw").write_text("?\n")
    assert talk.sync()[2] == (UNKNOWN,) * 3
    assert talk.emcys() == [(0x5030, 8, 0)]


def test_without_sync_the_source_is_looked_after_too(three: Tree) -> None:
    talk = Talk(source(polled(three)))
    talk.sync()
    talk.frames = []
    three.remove(0)
    began = talk.now_us
    talk.idle(began + 100_000)
    assert talk.emcys() == [(0x5030, 8, 0)], "within 100 ms"
    three.add(0, "0-0050", {"voltage": 4095})
    talk.idle(began + 400_000)
    assert talk.emcys() == [(0x5010, 1, 0), (0, 8, 0x5030)]
    set_raw(three, 0, 2048)
    counter = talk.sync()[1]
    talk.idle(talk.now_us + 1_000_000)
    assert talk.sync()[1] == counter + 1, "looking alone counts no sample"


def test_before_the_first_sync_there_is_an_emcy_too(three: Tree) -> None:
    parts = polled(three)
    three.remove(0)
    device = fingertip_node(5, source(parts))
    frames, now_us = [], 1_000_000
    while now_us < 1_100_000:
        sent, due_us = device.step(now_us)
        frames += sent
        now_us = max(due_us, now_us + 1)
    assert [data[:2] for can_id, data in frames if can_id == 0x085] == [b"\x30\x50"]


def test_saturation_then_a_broken_wire(three: Tree) -> None:
    talk = Talk(source(polled(three)))
    talk.sync(3)
    set_raw(three, 1, 4095)
    status, _, gauges = talk.sync()
    assert status & SATURATED
    assert not status & FAULT
    assert gauges[1] == 32767
    assert talk.emcys() == [(0x5010, 2, 0)]
    talk.sync(1_000_000 // SYNC_US + 1)
    assert talk.emcys() == [(0x5030, 10, 0)]
    set_raw(three, 1, 2058)
    assert talk.sync(2)[2] == (0, 50, 100)
    assert sorted(talk.emcys()) == [(0, 2, 0x5010), (0, 10, 0x5030)]


def test_a_value_that_stands_still_where_noise_is_known(three: Tree) -> None:
    talk = Talk(source(polled(three)))
    data = record(noise_strain=1e-6)  # two counts
    calibration = talk.device.application.calibration  # type: ignore[union-attr]
    assert calibration is not None
    calibration.active = Active(data, list(struct.unpack(calibration.packing, data)), 3)
    wiggle = iter(range(10_000))

    def move(gauges: tuple[int, ...]) -> Callable[[], None]:
        def set_them() -> None:
            for k in gauges:
                set_raw(three, k, 2048 + next(wiggle) % 7)

        return set_them

    assert not talk.sync(50, move((0, 1, 2)))[0] & FAULT
    count = next(count for count in range(1, 60) if talk.sync(1, move((0, 2)))[0] & FAULT)
    assert count * SYNC_US <= 100_000
    assert talk.emcys() == [(0x5030, 9, 0)]
    assert not talk.sync(1, move((0, 1, 2)))[0] & FAULT


def test_a_supply_out_of_tolerance(three: Tree) -> None:
    off = [False]
    talk = Talk(source(polled(three), supply_fault=lambda: off[0]))
    assert not talk.sync(30)[0] & FAULT
    off[0] = True
    assert talk.sync(50)[0] & FAULT, "within 100 ms"
    assert talk.sync()[2] == (UNKNOWN,) * 3
    off[0] = False
    assert not talk.sync(50)[0] & FAULT
