"""Deliberate faults in the device: each is found by a case. A suite that finds nothing wrong proves nothing."""

from collections.abc import Callable
from typing import Any, TypeAlias

import pytest

from canopen_conformance.run import FAIL
from canopen_device.core import codes, lss, pdo, sdo_block
from canopen_device.core.codes import SIGNATURE_SAVE
from canopen_device.core.emcy import Emcy
from canopen_device.core.error_control import HeartbeatConsumer, HeartbeatProducer, NodeGuarding
from canopen_device.core.lss import LssSlave
from canopen_device.core.node import Device, Nmt
from canopen_device.core.pdo import Pdo, ReceivePdos
from canopen_device.core.sdo_block import BlockDownload, BlockUpload
from canopen_device.core.sdo_server import SdoServer
from canopen_device.core.storage import Storage
from canopen_device.core.sync import SyncConsumer
from canopen_device.core.tpdo import TransmitPdo
from conformance.fingertip import matching, run_in_process

Injection: TypeAlias = Callable[[pytest.MonkeyPatch], None]


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


def toggle_of_request(self: SdoServer, data: bytes) -> tuple[bytes]:
    """The server believes whatever toggle bit comes."""
    self._toggle = data[0] >> 4 & 1
    return (data,)


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


# fault -> the cases that are to find it, and how it gets into the device
FAULTS: dict[str, tuple[str, Injection]] = {
    "upload toggle not checked": ("sdo_seg*", arguments(SdoServer, "_upload_segment", toggle_of_request)),
    "download toggle not checked": ("sdo_seg*", arguments(SdoServer, "_download_segment", toggle_of_request)),
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
    "any signature stores": ("storage.*", arguments(Storage, "_write_store", lambda _, sub, _v: (sub, SIGNATURE_SAVE))),
    "LSS selects by the vendor": ("lss.*", arguments(LssSlave, "_select", vendor_alone)),
    "LSS takes any node-id": ("lss.*", replaced(lss, "_valid_node_id", lambda _node_id: True)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_found(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pattern, inject = FAULTS[fault]
    inject(monkeypatch)
    assert any(run_in_process(case)[0].verdict == FAIL for case in matching(pattern))
