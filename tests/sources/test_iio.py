"""Kernel ADCs (Industrial I/O): configuration, single readings, and the buffer of a trigger."""

import contextlib
import logging
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fingertip.finger import SATURATED, STALE, UNKNOWN, Finger, record
from sources.iio_tree import Tree
from tipforce import EnvironmentLackError, InputError
from tipforce.fingertip import fingertip_node
from tipforce.fingertip.calibration import Active
from tipforce.sources import IioSource, iio_sysfs
from tipforce.sources.iio_sysfs import BufferedDevice, PolledDevice, ScanType, TimestampError

FAULT = 1 << 7
CONVERTER = (16, 2.0, ((2048.0, 4048.0),) * 3)
ENDS = (0, 4095)
SYNC_US = 2000


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


@pytest.fixture
def three(tree: Tree) -> Tree:
    for k in range(3):
        tree.add(k, f"0-005{k}", {"voltage": 2048 + 10 * k}, "adc121c")
    return tree


def polled(tree: Tree) -> list[PolledDevice]:
    return [PolledDevice(device, iio_sysfs.voltage_channels(device.path)) for device in iio_sysfs.devices(tree.root)]


def source(parts: list[PolledDevice], gauges: int = 3, **options: object) -> IioSource:
    return IioSource(parts, gauges, CONVERTER, ENDS, clock=lambda: 0, **options)  # type: ignore[arg-type]


class Talk(Finger):
    def __init__(self, given: IioSource) -> None:
        super().__init__(fingertip_node(5, given), given, emcy=True)

    def syncs(self, count: int = 1, before: Callable[[], None] = lambda: None) -> tuple[int, int, tuple[int, ...]]:
        """Status, counter and gauges of the last of several SYNCs; ``before`` is called before each."""
        for _ in range(count):
            before()
            pdos = self.sync(SYNC_US)
        return pdos.status, pdos.counter, pdos.gauges

    def emcys(self) -> list[tuple[int, int, int]]:
        found = [struct.unpack("<HxHHx", data) for can_id, data in self.take() if can_id == 0x085]
        return [(code, first, 0) if code else (0, second, first) for code, first, second in found]


def set_raw(tree: Tree, number: int, counts: int, channel: str = "voltage") -> None:
    (tree.root / f"iio:device{number}" / f"in_{channel}_raw").write_text(f"{counts}\n")


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
    assert PolledDevice(iio_sysfs.find("a", tree.root), ["voltage1"]).quantity("voltage1") == (2 - 2048) * 0.25
    (path / "in_voltage_scale").write_text("x\n")
    with pytest.raises(OSError, match="holds no number"):
        iio_sysfs.attribute(path, "voltage0", "scale")


@pytest.mark.parametrize(
    ("files", "hundredths"),
    [
        ({"in_temp_input": "23456"}, 2346),
        ({"in_temp_raw": "1000", "in_temp_scale": "2.5", "in_temp_offset": "-200"}, 200),
        ({"in_temp0_raw": "-41000"}, -4100), ({"in_temp_input": "999999999"}, -0x8000),
    ],
)  # fmt: skip
def test_temperature_in_hundredths_of_a_degree(tree: Tree, files: dict[str, str], hundredths: int) -> None:
    tree.add(0, "a", {"voltage": 1}, **files)
    assert PolledDevice(iio_sysfs.find("a", tree.root), ["voltage"]).temperature() == hundredths


def test_readings_are_fresh_once_a_period_and_in_the_order_of_the_gauges(three: Tree) -> None:
    found = source(polled(three)[::-1])
    found.period_us = 1000
    assert found.read(5000) == ((2068, 2058, 2048), 0, -0x8000)
    assert found.read(5999) is None
    assert found.faults == 0
    assert found.read(6000) is not None


def test_a_slow_read_does_not_pile_up_in_a_filter(three: Tree) -> None:
    now = [1_000_000]

    class Slow(PolledDevice):
        def read(self, now_us: int) -> tuple[int, ...] | None:
            now[0] += 3000
            return super().read(now_us)

    parts: list[PolledDevice] = [Slow(device, ["voltage"]) for device in iio_sysfs.devices(three.root)]
    device = fingertip_node(5, IioSource(parts, 3, CONVERTER, ENDS, clock=lambda: now[0]))
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
    talk.syncs(3)
    three.remove(1)
    status, counter, gauges = talk.syncs()
    assert status & STALE
    assert status & FAULT
    assert counter == 3, "no new sample"
    assert gauges == (UNKNOWN,) * 3
    assert talk.emcys() == [(0x5030, 8, 0)]
    for _ in range(100):
        assert talk.syncs()[2] == (UNKNOWN,) * 3
        assert talk.emcys() == []
    three.add(7, "0-0051", {"voltage": 2148})  # another number, the same place
    talk.syncs(60)
    status, _, gauges = talk.syncs()
    assert not status & (STALE | FAULT)
    assert gauges == (0, 500, 100)
    assert [record.message for record in caplog.records] == [
        "iio:device1: No such file or directory; the node continues when the device is back", "iio:device1: back",
    ]  # fmt: skip


def test_another_device_under_the_old_number_is_not_taken(three: Tree) -> None:
    talk = Talk(source(polled(three)))
    talk.syncs()
    three.remove(1)
    three.add(1, "0-0077", {"voltage": 4000})
    for _ in range(100):
        assert talk.syncs()[2] == (UNKNOWN,) * 3


def test_a_value_that_is_no_number_is_no_data(three: Tree) -> None:
    talk = Talk(source(polled(three)))
    talk.syncs()
    (three.root / "iio:device2/in_voltage_raw").write_text("?\n")
    assert talk.syncs()[2] == (UNKNOWN,) * 3
    assert talk.emcys() == [(0x5030, 8, 0)]


def test_without_sync_the_source_is_looked_after_too(three: Tree) -> None:
    talk = Talk(source(polled(three)))
    talk.syncs()
    three.remove(0)
    talk.advance(100_000)
    assert talk.emcys() == [(0x5030, 8, 0)], "within 100 ms"
    three.add(0, "0-0050", {"voltage": 4095})
    talk.advance(300_000)
    assert talk.emcys() == [(0x5010, 1, 0), (0, 8, 0x5030)]
    set_raw(three, 0, 2048)
    counter = talk.syncs()[1]
    talk.advance(1_000_000)
    assert talk.syncs()[1] == counter + 1, "looking alone counts no sample"


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
    talk.syncs(3)
    set_raw(three, 1, 4095)
    status, _, gauges = talk.syncs()
    assert status & SATURATED
    assert not status & FAULT
    assert gauges[1] == 32767
    assert talk.emcys() == [(0x5010, 2, 0)]
    talk.syncs(1_000_000 // SYNC_US + 1)
    assert talk.emcys() == [(0x5030, 10, 0)]
    set_raw(three, 1, 2058)
    assert talk.syncs(2)[2] == (0, 50, 100)  # 10 counts are 5 microstrain, in steps of 0.1
    assert sorted(talk.emcys()) == [(0, 2, 0x5010), (0, 10, 0x5030)]


def test_a_value_that_stands_still_where_noise_is_known(three: Tree) -> None:
    talk = Talk(source(polled(three)))
    data = record(noise_strain=1e-6)  # two counts
    calibration = talk.device.application.calibration
    assert calibration is not None
    calibration.active = Active(data, list(struct.unpack(calibration.packing, data)), 3)
    wiggle = iter(range(10_000))

    def move(gauges: tuple[int, ...]) -> Callable[[], None]:
        def set_them() -> None:
            for k in gauges:
                set_raw(three, k, 2048 + next(wiggle) % 7)

        return set_them

    assert not talk.syncs(50, move((0, 1, 2)))[0] & FAULT
    count = next(count for count in range(1, 60) if talk.syncs(1, move((0, 2)))[0] & FAULT)
    assert count * SYNC_US <= 100_000
    assert talk.emcys() == [(0x5030, 9, 0)]
    assert not talk.syncs(1, move((0, 1, 2)))[0] & FAULT


def test_a_scale_that_changes_makes_the_counts_unknown(three: Tree, caplog: pytest.LogCaptureFixture) -> None:
    """A gain that another program sets, or that is at its default again after the device was away."""
    scale = three.root / "iio:device1/in_voltage_scale"
    scale.write_text("0.5\n")
    talk = Talk(source(polled(three)))
    assert not talk.syncs(3)[0] & FAULT
    scale.write_text("64.0\n")
    assert talk.syncs(1_000_000 // SYNC_US)[2] == (UNKNOWN,) * 3
    three.remove(1)
    three.add(7, "0-0051", {"voltage": 2148}, in_voltage_scale="1.0")
    assert talk.syncs(60)[2] == (UNKNOWN,) * 3
    (three.root / "iio:device7/in_voltage_scale").write_text("0.5\n")
    assert talk.syncs(60)[2] == (0, 500, 100)
    assert "voltage scale is 64.0, was 0.5" in caplog.records[0].message


def test_a_supply_out_of_tolerance(three: Tree) -> None:
    off = [False]
    talk = Talk(source(polled(three), supply_fault=lambda: off[0]))
    assert not talk.syncs(30)[0] & FAULT
    off[0] = True
    assert talk.syncs(50)[0] & FAULT, "within 100 ms"
    assert (talk.get("H", 0x2124), talk.get("h", 0x2122)) == (0x800, UNKNOWN)  # no sensor of temperature
    assert talk.syncs()[2] == (UNKNOWN,) * 3
    off[0] = False
    assert not talk.syncs(50)[0] & FAULT


@given(
    st.booleans(), st.booleans(), st.sampled_from([8, 16, 32, 64]), st.data(),
)  # fmt: skip
def test_any_scan_type_is_read_back(big: bool, signed: bool, storage: int, data: st.DataObject) -> None:
    bits = data.draw(st.integers(2, storage))
    shift = data.draw(st.integers(0, storage - bits))
    kind = ScanType(big, signed, bits, storage, shift)
    value = data.draw(st.integers(*kind.ends))
    rubbish = data.draw(st.integers(0, (1 << storage) - 1)) & ~(((1 << bits) - 1) << shift)
    stored = rubbish | (value & (1 << bits) - 1) << shift
    scan = b"\xaa" * 8 + stored.to_bytes(storage // 8, "big" if big else "little")
    assert iio_sysfs.value_of(scan, 8, kind) == value


def test_scan_layout_follows_index_and_alignment() -> None:
    u12, s24 = ScanType(False, False, 12, 16, 0), ScanType(True, True, 24, 32, 8)
    stamp = ScanType(False, True, 64, 64, 0)
    types = [("timestamp", 9, stamp), ("voltage2", 4, s24), ("voltage0", 1, u12)]
    assert iio_sysfs.layout_of(types, ["voltage2", "voltage0"]) == (16, ((4, s24), (0, u12)), (8, stamp))


class Capture:
    def __init__(self, tree: Tree, stamped: bool = True, trigger: str = "timer") -> None:
        self.path = tree.add(0, "spi0.0", {"voltage0": 0, "voltage1": 0, "voltage2": 0}, "ad7124", "be:s24/32>>8")
        self.fifo = tree.add_buffer(self.path, stamped)
        device = iio_sysfs.find("device0", tree.root)
        self.device = BufferedDevice(device, ["voltage2", "voltage0"], trigger, tree.dev)
        self.stamped = stamped
        self.writer = self.fifo.open("wb", buffering=0)

    def text(self, name: str) -> str:
        return (self.path / name).read_text().strip()

    def put(self, stamp_us: int, first: int, last: int) -> bytes:
        scan = struct.pack(">ii", first << 8, last << 8)
        return scan + (struct.pack("<q", 1000 * stamp_us) if self.stamped else b"")

    def source(self) -> IioSource:
        """A source that has read a scan."""
        found = IioSource([self.device], 2, (24, 1.0), (-(1 << 23), (1 << 23) - 1), clock=lambda: 0)
        self.writer.write(self.put(1000, 1, 2))
        assert found.read(1_000_000) is not None
        return found

    def close(self) -> None:
        self.device.close()
        self.writer.close()


@pytest.fixture
def capture(tree: Tree) -> Iterator[Capture]:
    with contextlib.closing(Capture(tree)) as capture:
        yield capture


def test_a_capture_is_set_up_as_the_kernel_wants_it(capture: Capture) -> None:
    names = ("voltage0", "voltage1", "voltage2", "timestamp")
    assert [capture.text(f"scan_elements/in_{name}_en") for name in names] == ["1", "0", "1", "1"]
    assert capture.text("current_timestamp_clock") == "monotonic"
    assert capture.text("trigger/current_trigger") == "timer"
    assert capture.text("buffer/enable") == "1"
    capture.close()
    assert capture.text("buffer/enable") == "0"


def test_scans_come_once_each_and_not_before_their_time(capture: Capture) -> None:
    assert capture.device.read(10_000) is None
    whole = b"".join(capture.put(1000 * k, -k, k) for k in range(1, 6))
    capture.writer.write(whole[:40])  # two scans and a half
    assert capture.device.read(1500) == (1, -1)
    assert capture.device.read(1500) is None
    capture.writer.write(whole[40:])
    assert capture.device.read(4000) == (4, -4)
    assert capture.device.read(9000) == (5, -5)


def test_without_time_stamps_the_newest_scan_counts(tree: Tree) -> None:
    capture = Capture(tree, stamped=False)
    capture.writer.write(b"".join(capture.put(0, -k, k) for k in range(300)))
    assert capture.device.read(0) == (299, -299)
    capture.close()


def test_time_stamps_that_do_not_increase_are_frozen(capture: Capture) -> None:
    found = capture.source()
    for stamp_us in (1000, 1000, 900):
        capture.writer.write(capture.put(stamp_us, 3, 4))
        assert found.read(1_000_500) is None
        assert found.faults == 1 << 9
        assert found.look(1_000_600) == 1 << 9
    capture.writer.write(capture.put(901, 5, 6))
    assert found.read(1_001_000) == ((6, 5), 0, -0x8000)
    assert found.faults == 0
    with pytest.raises(TimestampError):
        capture.device._take(capture.put(901, 0, 0))


def test_a_buffer_that_falls_silent_is_no_data_within_100_ms(capture: Capture) -> None:
    found = capture.source()
    assert (found.read(1_080_000), found.faults) == (None, 0)
    assert (found.read(1_100_000), found.faults) == (None, 1 << 8)
    capture.writer.write(capture.put(2000, 1, 2))
    assert found.read(1_101_000) is not None
    assert found.faults == 0


def test_a_buffer_whose_device_is_pulled_out_and_comes_back(
    capture: Capture, tree: Tree, caplog: pytest.LogCaptureFixture
) -> None:
    found = capture.source()
    tree.remove(0)
    assert (found.read(1_001_000), found.faults) == (None, 1 << 8)
    capture.fifo.unlink()
    path = tree.add(3, "spi0.0", {"voltage0": 0, "voltage1": 0, "voltage2": 0}, "ad7124", "be:s24/32>>8")
    fifo = tree.add_buffer(path)
    assert found.read(1_102_000) is None
    with fifo.open("wb", buffering=0) as writer:
        writer.write(capture.put(500, 7, 8))
        assert found.read(1_103_000) == ((8, 7), 0, -0x8000)
    assert (path / "buffer/enable").read_text() == "1"
    assert [entry.levelno for entry in caplog.records] == [logging.WARNING] * 2


def test_triggers_by_name_and_the_devices_own(tree: Tree) -> None:
    tree.add(2, "a", {"voltage": 1}, "nau7802")
    own, timer = tree.add_trigger(0, "nau7802-dev2"), tree.add_trigger(1, "tipforce")
    assert iio_sysfs.triggers(tree.root) == {"nau7802-dev2": own, "tipforce": timer}
    assert iio_sysfs.own_trigger(iio_sysfs.find("device2", tree.root), tree.root) == "nau7802-dev2"
    configfs = tree.folder / "hrtimer"
    with pytest.raises(EnvironmentLackError, match="modprobe iio-trig-hrtimer"):
        iio_sysfs.make_hrtimer("tipforce", 500.0, tree.root, configfs)
    configfs.mkdir()
    assert iio_sysfs.make_hrtimer("tipforce", 500.0, tree.root, configfs) == "tipforce"
    assert (configfs / "tipforce").is_dir()
    assert (timer / "sampling_frequency").read_text() == "500"
    iio_sysfs.make_hrtimer("tipforce", 0.5, tree.root, configfs)
    assert (timer / "sampling_frequency").read_text() == "0.5"
