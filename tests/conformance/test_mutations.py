"""Deliberate faults in the device: each is noticed by a case; and what the standard permits is no failure."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias
from unittest.mock import Mock

import can
import pytest

from canopen_conformance.case import Case, CheckError
from canopen_conformance.dut import Dut
from canopen_conformance.run import FAIL, NOT_APPLICABLE, PASS, run_on
from canopen_conformance.run import run_in_process as run_on_core
from canopen_conformance.wire import BusLink, CoreLink
from canopen_device.core import codes, lss, pdo, sdo_block
from canopen_device.core.emcy import Emcy
from canopen_device.core.error_control import HeartbeatConsumer, HeartbeatProducer, NodeGuarding
from canopen_device.core.lss import LssSlave
from canopen_device.core.node import Device, Nmt
from canopen_device.core.pdo import Pdo, ReceivePdos, TransmitPdo
from canopen_device.core.sdo_block import BlockDownload, BlockUpload
from canopen_device.core.sdo_server import SdoServer
from canopen_device.core.storage import Storage
from canopen_device.core.sync import SyncConsumer
from canopen_device.eds.load import device_of
from canopen_device.testing import MemoryStore
from conformance.fingertip import all_cases, matching, run_in_process
from conformance.minimal import MinimalDevice
from device.tiny import service_dictionary
from eds.samples import described, record, text, var
from tipforce.fingertip import channels

Sent = list[tuple[int, bytes]]
NODE_ID = 5
Injection: TypeAlias = Callable[[pytest.MonkeyPatch], None]
FOREIGN = [case for case in all_cases() if not case.own]
# The standard demands segmented transfer of an SDO server (7.2.4.1); this one has none, and that is to be found.
LACKING = "sdo_segmented."


class SelfStarting:
    """The device core with a dictionary of its own, behind these traits."""

    def __init__(self, reset_us: int = 0) -> None:
        od = service_dictionary(NODE_ID)
        for index, sub, kind, default in ((0x1F80, 0, "I", 0), (0x1A00, 0, "B", 0), (0x1600, 0, "B", 0)):
            od.add(index, sub, (kind, "rw", 0, default, None, None))
        for mapping in (0x1600, 0x1A00):
            for sub in range(1, 9):
                od.add(mapping, sub, ("I", "rw", 0, 0, None, None))
        od.add(0x1800, 6, ("B", "rw", 0, 0, 0, 240))
        store = MemoryStore()
        self._device = Device(od, store.save, store.load)
        self._reset_us = reset_us
        self._resetting: Sent = []
        self._boots_us = 0
        self.resets = 0

    def step(self, now_us: int, frames: Sent = ()) -> tuple[Sent, int]:  # type: ignore[assignment]
        if self._resetting:
            if now_us < self._boots_us:
                return [], self._boots_us
            frames, self._resetting = self._resetting, []
        elif any(frame in ((0, b"\x81\x05"), (0, b"\x81\x00")) for frame in frames):
            self.resets += 1
            if self._reset_us:
                self._resetting, self._boots_us = frames, now_us + self._reset_us
                return [], self._boots_us
        refused = [frame for frame in frames if self._refused(frame)]
        sent, due_us = self._device.step(now_us, [frame for frame in frames if frame not in refused])
        code = codes.INVALID_VALUE.to_bytes(4, "little")
        return [*sent, *((0x580 + NODE_ID, b"\x80" + data[1:4] + code) for _, data in refused)], due_us

    def _refused(self, frame: tuple[int, bytes]) -> bool:
        """Return whether the frame enables a PDO that maps nothing."""
        can_id, data = frame
        if can_id != 0x600 + NODE_ID or len(data) != 8 or data[0] >> 5 != 1 or not data[0] & 2 or data[3] != 1:
            return False
        index = data[1] | data[2] << 8
        is_pdo = 0x1400 <= index <= 0x15FF or 0x1800 <= index <= 0x19FF
        return is_pdo and not data[7] & 0x80 and not self._device.od.integer(index + 0x200, 0)


def replaced(owner: Any, name: str, value: Any) -> Injection:
    """Another method, function or number in place of the right one."""
    return lambda patch: patch.setattr(owner, name, value)


def arguments(owner: type, method: str, change: Callable[..., tuple[Any, ...]]) -> Injection:
    """A method gets other arguments than it was called with."""
    original = getattr(owner, method)
    return replaced(owner, method, lambda self, *given: original(self, *change(self, *given)))


def forced(owner: type, method: str, attribute: str, value: Any) -> Injection:
    """An attribute is set before a method runs."""
    original = getattr(owner, method)

    def patched(self: Any, *given: Any) -> Any:
        setattr(self, attribute, value)
        return original(self, *given)

    return replaced(owner, method, patched)


def toggle_of_request(specifier: int) -> Injection:
    """The server believes whatever toggle bit comes with these segments."""

    def believed(server: SdoServer, data: bytes) -> tuple[bytes]:
        if data[0] >> 5 == specifier:
            server._toggle = data[0] >> 4 & 1
        return (data,)

    return arguments(SdoServer, "receive", believed)


def always_pre_operational(self: HeartbeatProducer, now_us: int) -> None:
    """A heartbeat that has stopped to follow the state."""
    self._device.send(0x700 + self._device.node_id, b"\x7f")
    self.due_us = now_us + 1000 * self._device.od.integer(0x1017)


def routes_of_every_state(self: Device, routes_changed: Any = Device.routes_changed) -> None:
    """SDO and SYNC in STOPPED as well."""
    routes_changed(self)
    self._routes[0x080] = self.sync.receive
    self._routes[0x600 + self.node_id] = self.sdo.receive


def oldest_first(self: Emcy, sub: int) -> int:
    """1003h the wrong way round."""
    return self._history[-sub] if sub else len(self._history)


def cut_to_length(self: SyncConsumer, data: bytes) -> tuple[bytes]:
    """A SYNC of any length will do."""
    return (data[: 1 if self._device.od.integer(0x1019) else 0],)


def vendor_alone(self: LssSlave, part: int, number: int) -> tuple[int, int]:
    """Three of the four numbers are taken for right."""
    return part, self._identity(part) if part else number


NARROW_FORMS = tuple((form, channels.MAX_I16, unknown) for form, _, unknown in channels._FORMS)

# fault -> the cases that are to find it, and how it gets into the device
FAULTS: dict[str, tuple[str, Injection]] = {
    "upload toggle not checked": ("sdo_seg*", toggle_of_request(3)),
    "download toggle not checked": ("sdo_seg*", toggle_of_request(0)),
    "wrong abort code for read-only": ("sdo.*", replaced(codes, "READ_ONLY", 0x06010000)),
    "no CRC check": ("sdo_block_d*", forced(BlockDownload, "_end", "_with_crc", False)),
    "CRC of another polynomial": ("sdo_block.*", replaced(sdo_block, "crc16", lambda data, _crc=0: sum(data) & 0xFFFF)),
    "ackseq not looked at": ("sdo_block.*", arguments(BlockUpload, "_acknowledged", lambda s, _, n: (s._sent, n))),
    "no SDO time-out": ("sdo*", replaced(SdoServer, "wait", lambda _self: None)),
    "heartbeat always PRE-OPERATIONAL": ("error_*", replaced(HeartbeatProducer, "expire", always_pre_operational)),
    "lost heartbeats not reported": ("error_*", forced(HeartbeatConsumer, "expire", "_deadlines", {})),
    "guarding toggle stands still": ("node_g*", forced(NodeGuarding, "receive", "_toggle", 0)),
    "SDO and SYNC in STOPPED": ("nmt.*", replaced(Device, "routes_changed", routes_of_every_state)),
    "NMT frames of any length": ("nmt.*", arguments(Nmt, "receive", lambda _, data: ((data + b"\0\0")[:2],))),
    "node-id of NMT not looked at": ("nmt.*", arguments(Nmt, "receive", lambda _, d: (d[:1] + bytes(len(d[1:])),))),
    "no boot-up message": ("nmt.*", replaced(Nmt, "boot", lambda self: self.enter(127))),
    "SYNC length not checked": ("sync.*", arguments(SyncConsumer, "receive", cut_to_length)),
    "every SYNC sends": ("tpdo.*", replaced(TransmitPdo, "on_sync", lambda _self, _counter: True)),
    "128 bits in a PDO": ("pdo_par*", replaced(pdo, "MAX_BYTES", 16)),
    "COB-ID moves while valid": ("pdo_par*", forced(Pdo, "_check_cob_id", "valid", False)),
    "restricted identifiers taken": ("pdo_par*", replaced(codes, "restricted", lambda _can_id: False)),
    "short RPDOs taken": ("rpdo.*", arguments(ReceivePdos, "receive", lambda _, i, data: (i, (data + bytes(8))[:8]))),
    "EMCY without inhibit time": ("emcy.*", forced(Emcy, "schedule", "_free_us", 0)),
    "errors never cured": ("emcy.*", replaced(Emcy, "cure", lambda *_: None)),
    "oldest error first": ("emcy.*", replaced(Emcy, "_read_history", oldest_first)),
    "any signature stores": ("storage.*", arguments(Storage, "_write_command", lambda _, sub, _v, s: (sub, s, s))),
    "LSS selects by the vendor": ("lss.*", arguments(LssSlave, "_select", vendor_alone)),
    "9130h as narrow as 7130h": ("profile_404.overload*", replaced(channels, "_FORMS", NARROW_FORMS)),
    "LSS takes any node-id": ("lss.*", replaced(lss, "_valid_node_id", lambda _node_id: True)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_found(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pattern, inject = FAULTS[fault]
    inject(monkeypatch)
    assert any(run_in_process(case)[0].verdict == FAIL for case in matching(pattern))


def test_no_case_fails() -> None:
    failed = {}
    verdicts = []
    for case in FOREIGN:
        result, _ = run_in_process(case, SelfStarting())
        verdicts.append(result.verdict)
        if result.verdict == FAIL:
            failed[case.name] = "\n".join([result.reason, *result.log[-6:]])
    assert not failed, "\n\n".join(f"{name}: {text}" for name, text in failed.items())
    assert verdicts.count(PASS) > 250


def test_a_short_history_and_a_fast_heartbeat_are_no_failures(tmp_path: Path) -> None:
    history = record("1003", var("1003sub0", 5, default="0"), var("1003sub1", 7, "ro"), code="0x8")
    beats = record("1016", var("1016sub0", 5, "ro", "1"), var("1016sub1", 7), code="0x8")
    emcy, heartbeat = var("1014", 7, default="$NODEID+0x80"), var("1017", 6, default="50")
    device = device_of(described(tmp_path, text(history, beats, emcy, heartbeat)))
    for case in [*matching("nmt.boot_up_once*"), *matching("emcy.history*")]:
        assert run_in_process(case, device)[0].verdict != FAIL, case.name


def on_one_device(cases: list[Case], reset_us: int) -> tuple[list[str], float, int]:
    """Run cases in sequence as on a bus; return the verdicts, the time in seconds and the number of node resets."""
    device = SelfStarting(reset_us)
    link = CoreLink(device)
    dut = Dut(link, NODE_ID)
    dut.measure_resets()
    return [result.verdict for result in run_on(dut, cases, persistent=False)], 1e-6 * link.now_us(), device.resets


def test_a_slow_reset_does_not_cost_minutes() -> None:
    fast, fast_s, _ = on_one_device(FOREIGN, 0)
    slow, slow_s, resets = on_one_device(FOREIGN, 3_000_000)
    assert slow == fast
    assert FAIL not in fast
    assert resets < 12, "the cases about it, and one to measure"
    assert slow_s - fast_s < 40


def test_cases_that_only_read_share_one_reset() -> None:
    _, _, resets = on_one_device(matching("identity.*"), 0)
    assert resets < len(matching("identity.*")) / 4


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("nmt.reset.1", "the device enters OPERATIONAL by itself after its boot-up"),
        ("pdo_parameters.moved.1", "1800h:01 does not take 40000390h (abort 06090030h)"),
        ("sync.moved", "TPDO1 maps no object"),
    ],
)
def test_the_reason_names_what_the_device_refuses(name: str, reason: str) -> None:
    result, _ = run_in_process(matching(name)[0], SelfStarting())
    assert (result.verdict, result.reason) == (NOT_APPLICABLE, reason)


@pytest.mark.parametrize(("constant_ms", "passed", "failed"), [(0, 80, range(1, 20)), (100, 40, [0])])
def test_minimal_device_never_crashes_a_case(constant_ms: int, passed: int, failed: Sequence[int]) -> None:
    """Without segments, and with a constant 1017h, whose cases of a download do not apply."""
    verdicts = []
    for case in all_cases():
        result, _link = run_in_process(case, MinimalDevice(constant_ms))
        verdicts.append(result.verdict)
        if result.verdict == NOT_APPLICABLE:
            assert result.reason
        else:
            right = result.verdict == PASS or case.name.startswith(LACKING)
            assert right, "\n".join([case.name, result.reason, *result.log])
            assert not case.own, f"{case.name}: a case of the fingertip ran on a foreign device"
    assert verdicts.count(PASS) > passed
    assert verdicts.count(NOT_APPLICABLE) > 300
    assert verdicts.count(FAIL) in failed


def test_another_node_is_never_the_device() -> None:
    for node_id, name in ((126, "nmt.ignored.1"), (113, "error_control.no_heartbeat.4")):
        assert run_on_core(matching(name)[0], Device(service_dictionary(node_id)), node_id)[0].verdict == PASS


@pytest.mark.parametrize("service", [0x080, 0x180, 0x580, 0x7E4])
@pytest.mark.parametrize(("to", "byte", "on"), [(0, b"", 8), (2, b"", 8), (4, b"\xff", 5)])
def test_short_frames(service: int, to: int, byte: bytes, on: int, monkeypatch: pytest.MonkeyPatch) -> None:
    step = Device.step

    def changed(*given: Any) -> tuple[Sent, int]:
        sent, due_us = step(*given)
        return [(i, data[:to] + byte + data[on:] if service in (i, i & 0x780) else data) for i, data in sent], due_us

    monkeypatch.setattr(Device, "step", changed)
    assert FAIL in [run_in_process(case)[0].verdict for case in all_cases()[::7]] or to


def endless(now_us: int, frames: Sent = ()) -> tuple[Sent, int]:  # type: ignore[assignment]
    sent = [(0x585, bytes((data[0] & 0x10 if data[0] & 0x20 else 0x41, *data[1:]))) for i, data in frames if i]
    return [*sent, (0x705, b"\x7f")], now_us + 10_000


@pytest.mark.parametrize("run", [Dut.reset, lambda dut: dut.read(0x1008)])
def test_what_has_no_end_ends_a_case(run: Callable[[Dut], object], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("canopen_conformance.dut._MOST_SEGMENTS", 100)
    link, babbling = CoreLink(Mock(step=endless)), BusLink(Mock(recv=lambda _timeout_s: can.Message()))
    link.tolerance_ms = 20
    with pytest.raises(CheckError):
        run(Dut(link, NODE_ID))
    assert babbling.receive(babbling.now_us() - 2_000_000) is None


def test_a_frame_that_came_in_time_is_read_however_long_the_suite_stood_still(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, waiting = [100], [can.Message(arbitration_id=0x585, data=bytes(8), is_extended_id=False)]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_s[0] * 10**9)
    link = BusLink(Mock(recv=lambda _timeout_s: waiting.pop() if waiting else None))
    until_us = link.now_us() + 200_000
    now_s[0] += 60
    assert [link.receive(until_us) is None for _ in range(2)] == [False, True]
