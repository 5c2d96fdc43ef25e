"""Buffered capture on trees of files: set-up, scans, time stamps, and a device that goes and comes back."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sources.iio_tree import Tree
from tipforce.errors import EnvironmentLackError
from tipforce.sources import iio_sysfs
from tipforce.sources.iio import IioSource
from tipforce.sources.iio_buffer import (
    BufferedDevice,
    TimestampError,
    layout_of,
    make_hrtimer,
    own_trigger,
    triggers,
    value_of,
)
from tipforce.sources.iio_sysfs import ScanType


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


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
    assert value_of(b"\xaa" * 8 + stored.to_bytes(storage // 8, "big" if big else "little"), 8, kind) == value


def test_scan_layout_follows_index_and_alignment() -> None:
    u12, s24, stamp = (
        ScanType(False, False, 12, 16, 0),
        ScanType(True, True, 24, 32, 8),
        ScanType(False, True, 64, 64, 0),
    )
    found = layout_of([("timestamp", 9, stamp), ("voltage2", 4, s24), ("voltage0", 1, u12)], ["voltage2", "voltage0"])
    assert found == (16, ((4, s24), (0, u12)), (8, stamp))


class Capture:
    """A buffered device whose scans the test writes."""

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

    def close(self) -> None:
        self.device.close()
        self.writer.close()


def test_a_capture_is_set_up_as_the_kernel_wants_it(tree: Tree) -> None:
    capture = Capture(tree)
    names = ("voltage0", "voltage1", "voltage2", "timestamp")
    assert [capture.text(f"scan_elements/in_{name}_en") for name in names] == ["1", "0", "1", "1"]
    assert capture.text("current_timestamp_clock") == "monotonic"
    assert capture.text("trigger/current_trigger") == "timer"
    assert capture.text("buffer/enable") == "1"
    capture.close()
    assert capture.text("buffer/enable") == "0"


def test_scans_come_once_each_and_not_before_their_time(tree: Tree) -> None:
    capture = Capture(tree)
    assert capture.device.read(10_000) is None
    whole = b"".join(capture.put(1000 * k, -k, k) for k in range(1, 6))
    capture.writer.write(whole[:40])  # two scans and a half
    assert capture.device.read(1500) == (1, -1)
    assert capture.device.read(1500) is None
    capture.writer.write(whole[40:])
    assert capture.device.read(4000) == (4, -4)
    assert capture.device.read(9000) == (5, -5)
    capture.close()


def test_without_time_stamps_the_newest_scan_counts(tree: Tree) -> None:
    capture = Capture(tree, stamped=False)
    capture.writer.write(b"".join(capture.put(0, -k, k) for k in range(300)))
    assert capture.device.read(0) == (299, -299)
    capture.close()


def test_time_stamps_that_do_not_increase_are_frozen(tree: Tree) -> None:
    capture = Capture(tree)
    found = IioSource([capture.device], 2, (24, 1.0), (-(1 << 23), (1 << 23) - 1), clock=lambda: 0)
    capture.writer.write(capture.put(1000, 1, 2))
    assert found.read(1_000_000) is not None
    for stamp_us in (1000, 1000, 900):
        capture.writer.write(capture.put(stamp_us, 3, 4))
        assert found.read(1_000_500) is None
        assert found.faults == 1 << 9
        assert found.look(1_000_600) == 1 << 9
    capture.writer.write(capture.put(901, 5, 6))
    reading = found.read(1_001_000)
    assert reading is not None
    assert (reading.counts, reading.faults, found.faults) == ((6, 5), 0, 0)
    with pytest.raises(TimestampError):
        capture.device._take(capture.put(901, 0, 0))
    capture.close()


def test_a_buffer_that_falls_silent_is_no_data_within_100_ms(tree: Tree) -> None:
    capture = Capture(tree)
    found = IioSource([capture.device], 2, (24, 1.0), (-(1 << 23), (1 << 23) - 1), clock=lambda: 0)
    capture.writer.write(capture.put(1000, 1, 2))
    assert found.read(1_000_000) is not None
    assert (found.read(1_080_000), found.faults) == (None, 0)
    assert (found.read(1_100_000), found.faults) == (None, 1 << 8)
    capture.writer.write(capture.put(2000, 1, 2))
    assert found.read(1_101_000) is not None
    assert found.faults == 0
    capture.close()


def test_a_buffer_whose_device_is_pulled_out_and_comes_back(tree: Tree, caplog: pytest.LogCaptureFixture) -> None:
    capture = Capture(tree)
    found = IioSource([capture.device], 2, (24, 1.0), (-(1 << 23), (1 << 23) - 1), clock=lambda: 0)
    capture.writer.write(capture.put(1000, 1, 2))
    assert found.read(1_000_000) is not None
    tree.remove(0)
    assert (found.read(1_001_000), found.faults) == (None, 1 << 8)
    capture.fifo.unlink()
    path = tree.add(3, "spi0.0", {"voltage0": 0, "voltage1": 0, "voltage2": 0}, "ad7124", "be:s24/32>>8")
    fifo = tree.add_buffer(path)
    assert found.read(1_102_000) is None
    with fifo.open("wb", buffering=0) as writer:
        writer.write(capture.put(500, 7, 8))
        reading = found.read(1_103_000)
    assert reading is not None
    assert reading.counts == (8, 7)
    assert (path / "buffer/enable").read_text() == "1"
    assert [entry.levelno for entry in caplog.records] == [logging.WARNING] * 2
    capture.close()


def test_a_device_without_a_buffer_says_so(tree: Tree) -> None:
    tree.add(0, "a", {"voltage": 1})
    with pytest.raises(
        EnvironmentLackError, match=r"iio:device0 \(adc, a\): buffered capture cannot be set up: .*poll"
    ):
        BufferedDevice(iio_sysfs.find("device0", tree.root), ["voltage"], "timer", tree.dev)


def test_triggers_by_name_and_the_devices_own(tree: Tree) -> None:
    tree.add(2, "a", {"voltage": 1}, "nau7802")
    own, timer = tree.add_trigger(0, "nau7802-dev2"), tree.add_trigger(1, "tipforce")
    assert triggers(tree.root) == {"nau7802-dev2": own, "tipforce": timer}
    assert own_trigger(iio_sysfs.find("device2", tree.root), tree.root) == "nau7802-dev2"
    configfs = tree.folder / "hrtimer"
    with pytest.raises(EnvironmentLackError, match="modprobe iio-trig-hrtimer"):
        make_hrtimer("tipforce", 500.0, tree.root, configfs)
    configfs.mkdir()
    assert make_hrtimer("tipforce", 500.0, tree.root, configfs) == "tipforce"
    assert (configfs / "tipforce").is_dir()
    assert (timer / "sampling_frequency").read_text() == "500"
