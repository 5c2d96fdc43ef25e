"""The SDO server against a model of its own, under hypothesis; the frame fuzzer, seeded."""

import struct

import pytest
from bench import fuzz
from bench.fuzz_frames import Frame
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from canopen_device.core import codes, storage
from canopen_device.core.node import Device
from canopen_device.core.sdo_block import crc16
from device.tiny import booted
from tipforce.fingertip.calibration import Calibration
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource

FEW = settings(derandomize=True, max_examples=40, stateful_step_count=40, deadline=None)
TIMEOUT_US = 1_000_000
LENGTHS = {0x2000: 1, 0x2001: 2, 0x2002: 4, 0x2006: 9, 0x2009: 4}  # 2005h takes any length
WRITABLE = (0x2000, 0x2001, 0x2002, 0x2005, 0x2006)
objects = st.sampled_from([*WRITABLE, 0x2009])
contents = st.one_of(st.binary(max_size=10), st.binary(max_size=40), st.binary(min_size=885, max_size=900))


def head(command: int, index: int, rest: int = 0) -> bytes:
    return struct.pack("<BHBI", command, index, 0, rest)


class SdoModel(RuleBasedStateMachine):
    """Transfers of every kind, whole or abandoned; the model is a dict of what each object holds."""

    def __init__(self) -> None:
        super().__init__()
        self.talk = booted()
        self.held: dict[int, bytes] = {index: self.read(index) for index in (*WRITABLE, 0x2009)}
        self.open = False

    def ask(self, data: bytes) -> list[bytes]:
        self.talk.step([(0x605, data)])
        return [data for can_id, data in self.talk.take() if can_id == 0x585]

    def read(self, index: int) -> bytes:
        data = self.talk.upload(index)
        assert isinstance(data, bytes)
        return data

    def expected_abort(self, index: int, data: bytes) -> int:
        """What the object says to these bytes."""
        if index not in WRITABLE:
            return codes.READ_ONLY
        length = LENGTHS.get(index, len(data))
        return 0 if len(data) == length else codes.TOO_LONG if len(data) > length else codes.TOO_SHORT

    def check_written(self, index: int, data: bytes, answer: bytes, confirmation: bytes) -> None:
        """The last answer is the confirmation or the right abort, and the model follows."""
        abort = self.expected_abort(index, data)
        if abort:
            assert answer == head(0x80, index, abort)
        else:
            assert answer == confirmation
            self.held[index] = data
        self.open = False

    @rule(index=objects, data=st.binary(min_size=1, max_size=4))
    def expedited(self, index: int, data: bytes) -> None:
        (answer,) = self.ask(head(0x23 | (4 - len(data)) << 2, index)[:4] + data.ljust(4, b"\xaa"))
        self.check_written(index, data, answer, head(0x60, index))

    @rule(index=objects, data=contents, indicated=st.booleans(), stop=st.integers(0, 200))
    def segmented(self, index: int, data: bytes, indicated: bool, stop: int) -> None:
        (answer,) = self.ask(head(0x20 | indicated, index, len(data) if indicated else 0))
        toggle, parts = 0, [data[k : k + 7] for k in range(0, len(data), 7)] or [b""]
        for k, part in enumerate(parts):
            if answer[0] == 0x80:
                break
            if k == stop:
                self.open = True
                return
            command = toggle | (7 - len(part)) << 1 | (k == len(parts) - 1)
            (answer,) = self.ask(bytes((command,)) + part.ljust(7, b"\xaa"))
            toggle ^= 0x10
        self.check_written(index, data, answer, bytes((0x20 | toggle ^ 0x10,)) + bytes(7))

    @rule(index=objects, data=contents, indicated=st.booleans(), lost=st.integers(1, 200), stop=st.integers(0, 200))
    def block(self, index: int, data: bytes, indicated: bool, lost: int, stop: int) -> None:
        """A block download that loses one segment once and resends as it is told."""
        answers = self.ask(head(0xC4 | indicated << 1, index, len(data) if indicated else 0))
        parts, done = [data[k : k + 7] for k in range(0, len(data), 7)] or [b""], 0
        while answers[0][0] != 0x80 and done < len(parts):
            size = answers[0][2] if answers[0][0] == 0xA2 else answers[0][4]
            block = parts[done : done + size]
            answers = []
            for k, part in enumerate(block):
                if done + k == stop:
                    self.drop_block()
                    return
                if k + 1 == lost and k + 1 < len(block):
                    lost = 0
                    continue
                last = done + k == len(parts) - 1
                answers = self.ask(bytes((k + 1 | last << 7,)) + part.ljust(7, b"\xaa"))
                if answers and answers[0][0] == 0x80:
                    break
            if answers[0][0] == 0xA2:
                done += answers[0][1]
        if answers[0][0] != 0x80:
            answers = self.ask(struct.pack("<BH5x", 0xC1 | (7 - len(parts[-1])) << 2, crc16(data)))
        (answer,) = answers
        self.check_written(index, data, answer, b"\xa1" + bytes(7))

    def drop_block(self) -> None:
        """Give a block download up: until it ends, every frame would be a segment of it."""
        assert self.ask(head(0x80, 0)) == []
        self.open = False

    @rule(index=objects, size=st.integers(1, 127), followed=st.sampled_from([0, 1, 2, 3, 5, 126, 127]))
    def block_upload(self, index: int, size: int, followed: int) -> None:
        """The client follows ``followed`` segments of each block, at least one, until the end."""
        data, held = b"", self.held[index]
        (answer,) = self.ask(head(0xA4, index, size))
        assert answer == head(0xC6, index, len(held))
        segments = self.ask(b"\xa3" + bytes(7))
        while segments[0][0] & 0xE3 != 0xC1:
            kept = segments[: max(1, followed)]
            assert [part[0] & 0x7F for part in segments] == list(range(1, len(segments) + 1))
            data += b"".join(part[1:] for part in kept)
            segments = self.ask(bytes((0xA2, len(kept), size, 0, 0, 0, 0, 0)))
        end = segments[0]
        assert data[: len(data) - (end[0] >> 2 & 7)] == held
        assert end[1] | end[2] << 8 == crc16(held)
        assert self.ask(b"\xa1" + bytes(7)) == []
        self.open = False

    @rule(index=objects)
    def upload_begun(self, index: int) -> None:
        """A segmented upload is begun and left; one of up to four bytes is whole already."""
        (answer,) = self.ask(head(0x40, index))
        self.open = not answer[0] & 2
        if self.open:
            assert answer == head(0x41, index, len(self.held[index]))

    @precondition(lambda self: self.open)
    @rule()
    def client_aborts(self) -> None:
        assert self.ask(head(0x80, 0x2005, 0x08000000)) == []
        self.open = False

    @precondition(lambda self: self.open)
    @rule()
    def wrong_toggle(self) -> None:
        (answer,) = self.ask(bytes((0x70,)) + bytes(7)) or (b"\x80",)
        assert answer[0] == 0x80
        self.open = False

    @rule()
    def silence(self) -> None:
        """An open transfer is aborted after a second; without one nothing is said."""
        self.talk.advance(TIMEOUT_US)
        said = [data for can_id, data in self.talk.take() if can_id == 0x585]
        assert [data[0] for data in said] == ([0x80] if self.open else [])
        self.open = False

    @rule(command=st.sampled_from([0x00, 0x60, 0xE0, 0xA1, 0xA2, 0xA3]))
    def stray(self, command: int) -> None:
        """A segment or an end that belongs to nothing; what is open may end by it."""
        if not self.open:
            assert self.ask(head(command, 0x2001)) == [head(0x80, 0x2001, codes.UNKNOWN_COMMAND)]

    @invariant()
    def objects_hold_what_was_written(self) -> None:
        od = self.talk.device.od
        assert {index: od.upload(index, 0) for index in self.held} == self.held


SdoModel.TestCase.settings = FEW
TestSdo = SdoModel.TestCase


def test_random_frames_break_no_invariant() -> None:
    thrown, _, failure = fuzz.rounds(1, range(1, 21), frames=1500, measure=False)
    assert not failure
    assert thrown >= 30_000
    # The memory of a node stays bounded.
    assert fuzz.rounds(2, range(1), frames=1500)[2] == ""


def test_a_late_due_time_is_noticed_and_reduced_to_one_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that dislikes one NMT command: of a whole round the report keeps the frame that shows it."""
    original = Device.step

    def step(self: Device, now_us: int, frames: tuple[Frame, ...] = ()) -> tuple[list[Frame], int]:
        sent, due_us = original(self, now_us, frames)
        return sent, now_us - 1 if any(can_id == 0 and data[:1] == b"\1" for can_id, data in frames) else due_us

    monkeypatch.setattr(Device, "step", step)
    _, _, failure = fuzz.rounds(1, range(1), measure=False)
    assert "due" in failure
    assert len(failure.splitlines()) == 3


def test_an_active_calibration_that_changes_without_a_commit_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    def write(self: Calibration, _sub: int, value: object) -> int:
        assert isinstance(value, bytes)
        self._stage(value)
        self._activate(value)
        return 0

    monkeypatch.setattr(Calibration, "_write_record", write)
    failures = (fuzz.rounds(1, range(k, k + 1), measure=False)[2] for k in range(4))
    assert any("changed without a commit" in failure for failure in failures)


def test_an_exception_is_reported_with_its_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    def receive(_data: bytes) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("canopen_device.core.sync.SyncConsumer.receive", lambda _self, data: receive(data))
    assert "ZeroDivisionError" in fuzz.rounds(1, range(1), measure=False)[2]


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
