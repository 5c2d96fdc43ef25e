"""The frame fuzzer, seeded; a node that starts from any stored bytes."""

import struct

import pytest
from bench import fuzz
from bench.fuzz_frames import Frame
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_device.core import codes, storage
from canopen_device.core.node import Device
from device.tiny import booted
from tipforce.fingertip.calibration import Calibration
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource


def test_random_frames_break_no_invariant() -> None:
    thrown, failure = fuzz.rounds(1, range(1, 21), frames=1500, measure=False)
    assert not failure
    assert thrown >= 30_000
    # The memory of a node stays bounded.
    assert fuzz.rounds(2, range(1), frames=1500)[1] == ""


def test_a_late_due_time_is_noticed_and_reduced_to_one_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that dislikes one NMT command: of a whole round the report keeps the frame that shows it."""
    original = Device.step

    def step(self: Device, now_us: int, frames: tuple[Frame, ...] = ()) -> tuple[list[Frame], int]:
        sent, due_us = original(self, now_us, frames)
        return sent, now_us - 1 if any(can_id == 0 and data[:1] == b"\1" for can_id, data in frames) else due_us

    monkeypatch.setattr(Device, "step", step)
    _, failure = fuzz.rounds(1, range(1), measure=False)
    assert "due" in failure
    assert len(failure.splitlines()) == 3


def test_an_active_calibration_that_changes_without_a_commit_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    def write(self: Calibration, _sub: int, value: object) -> int:
        assert isinstance(value, bytes)
        self._stage(value)
        self._activate(value)
        return 0

    monkeypatch.setattr(Calibration, "_write_record", write)
    failures = (fuzz.rounds(1, range(k, k + 1), measure=False)[1] for k in range(4))
    assert any("changed without a commit" in failure for failure in failures)


def test_an_exception_is_reported_with_its_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    def receive(_data: bytes) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("canopen_device.core.sync.SyncConsumer.receive", lambda _self, data: receive(data))
    assert "ZeroDivisionError" in fuzz.rounds(1, range(1), measure=False)[1]


@settings(derandomize=True, max_examples=150, deadline=None)
@given(st.binary(max_size=60), st.booleans())
def test_any_stored_bytes_leave_a_working_node(blob: bytes, checked: bool) -> None:
    content = storage.with_crc(blob) if checked else blob
    names = ("communication", "application", "calibration", "lss")
    device = fingertip_node(5, SimulatedSource(fuzz.STRAIN_PER_NEWTON), load=dict.fromkeys(names, content).get)
    sent, _ = device.step(0)
    assert sent[0][1] == b"\0" or device.node_id == 255
    device.step(1000, [(0x000, b"\1\0"), (0x080, b"")])


def record(index: int, sub: int, data: bytes) -> bytes:
    return struct.pack("<HBH", index, sub, len(data)) + data


def test_a_stored_string_that_is_no_text_is_passed_over() -> None:
    device = booted().device
    device.od.add(0x6010, 0, ("s", "rw", 0, "name", None, None))
    storage.unpack_settings(device.od, 0x6000, 0x9FFF, record(0x6010, 0, b"\xff\xfe") + record(0x6000, 0, b"\7\0"))
    assert (device.od.get(0x6010), device.od.get(0x6000)) == ("name", 7)


def test_stored_scaling_points_that_make_no_line_give_way_to_the_defaults() -> None:
    store = {"application": storage.with_crc(record(0x6122, 2, struct.pack("<f", 0.0)))}
    device = fingertip_node(5, SimulatedSource(fuzz.STRAIN_PER_NEWTON), load=store.get)
    device.step(0)
    assert device.od.get(0x6122, 2) == 10000.0
    assert device.nmt.state == codes.PRE_OPERATIONAL
