"""EDS and DCF texts for tests: a header, and objects written shortly."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from device.conversation import Conversation
from tipforce.device.node import Device
from tipforce.eds import Description, read_eds
from tipforce.eds.load import device_of

INFO = """\
[FileInfo]
FileName=any.eds
EDSVersion=4.0
[DeviceInfo]
VendorName=Anyone
VendorNumber=0x12
ProductName=Device
LSS_Supported=1
BaudRate_500=1
"""
MANDATORY = """\
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
[1001]
ParameterName=Error register
ObjectType=0x7
DataType=0x0005
AccessType=ro
[1018]
ParameterName=Identity
ObjectType=0x9
SubNumber=2
[1018sub0]
ParameterName=Highest
DataType=0x0005
AccessType=ro
DefaultValue=1
[1018sub1]
ParameterName=Vendor
DataType=0x0007
AccessType=ro
DefaultValue=0x12
"""


def var(name: str, data_type: int, access: str = "rw", default: str = "", **more: str) -> str:
    """The section of one entry: ``name`` is 2000 or 2000sub1; ``more`` are further keys."""
    keys = {
        "ParameterName": f"P{name}", "ObjectType": "0x7", "DataType": f"0x{data_type:04X}", "AccessType": access,
        "DefaultValue": default, "PDOMapping": "1", **more,
    }  # fmt: skip
    return f"[{name}]\n" + "".join(f"{key}={value}\n" for key, value in keys.items())


def record(index: str, *subs: str, code: str = "0x9") -> str:
    """A RECORD of entries from ``var``; SubNumber counts them."""
    return f"[{index}]\nParameterName=R{index}\nObjectType={code}\nSubNumber={len(subs)}\n" + "".join(subs)


def pdo(index: int, cob_id: str, kind: int, *mapped: int, event_ms: int = 0, inhibit: int = 0) -> str:
    """A PDO: both parameter objects."""
    parameter, mapping = f"{index:04X}", f"{index + 0x200:04X}"
    return record(
        parameter, var(f"{parameter}sub0", 5, "const", "5"), var(f"{parameter}sub1", 7, "rw", cob_id),
        var(f"{parameter}sub2", 5, "rw", str(kind)), var(f"{parameter}sub3", 6, "rw", str(inhibit)),
        var(f"{parameter}sub5", 6, "rw", str(event_ms)),
    ) + record(
        mapping, var(f"{mapping}sub0", 5, "rw", str(len(mapped))),
        *(var(f"{mapping}sub{k:X}", 7, "rw", f"0x{word:08X}") for k, word in enumerate(mapped, 1)), code="0x8",
    )  # fmt: skip


def text(*sections: str, info: str = INFO, mandatory: str = MANDATORY) -> str:
    """A whole EDS, with its object lists."""
    objects = mandatory + "".join(sections)
    indices = [name for name in re.findall(r"(?m)^\[([0-9A-F]{4})\]$", objects) if name >= "1000"]
    own = [name for name in indices if name in ("1000", "1001", "1018")]
    made = [name for name in indices if "2000" <= name < "6000"]
    lists = (("Mandatory", own), ("Manufacturer", made), ("Optional", [n for n in indices if n not in own + made]))
    return info + "".join(_list(f"{kind}Objects", names) for kind, names in lists) + objects


def _list(name: str, indices: list[str]) -> str:
    lines = "".join(f"{k}=0x{index}\n" for k, index in enumerate(indices, 1))
    return f"[{name}]\nSupportedObjects={len(indices)}\n{lines}"


def described(folder: Path, content: str | bytes, node_id: int | None = 5, name: str = "any.eds") -> Description:
    """The description of a text."""
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_eds(path, node_id)


class Talk(Conversation):
    """A conversation with a device from its EDS, node-id 5."""

    def __init__(self, found: Description, store: dict[str, bytes] | None = None) -> None:
        def save(group: str, data: bytes) -> bool:
            if store is not None:
                store[group] = data
            return store is not None

        self.description = found
        device: Device = device_of(found, save if store is not None else None, None if store is None else store.get)
        super().__init__(device)
        self.sent.clear()

    def ask(self, data: bytes) -> bytes:
        """One SDO request, and its answer."""
        sent = [frame[1] for frame in self.step([(0x605, data.ljust(8, b"\0"))]) if frame[0] == 0x585]
        self.sent.clear()
        return sent[0]

    def read(self, index: int, sub: int = 0) -> bytes | int:
        """Upload: the bytes, or the abort code."""
        first = self.ask(struct.pack("<BHB", 0x40, index, sub))
        if first[0] == 0x80:
            return int.from_bytes(first[4:], "little")
        if first[0] & 2:
            return first[4 : 8 - (first[0] >> 2 & 3)]
        data, toggle, last = b"", 0x60, 0
        while not last:
            part = self.ask(bytes((toggle,)))
            data += part[1 : 8 - (part[0] >> 1 & 7)]
            last, toggle = part[0] & 1, toggle ^ 0x10
        return data

    def write(self, index: int, sub: int, data: bytes) -> int:
        """Download: 0, or the abort code."""
        if 0 < len(data) <= 4:
            answer = self.ask(struct.pack("<BHB", 0x23 | 4 - len(data) << 2, index, sub) + data)
        else:
            answer = self.ask(struct.pack("<BHBI", 0x21, index, sub, len(data)))
            for offset in range(0, max(len(data), 1), 7):
                if answer[0] == 0x80:
                    break
                part = data[offset : offset + 7]
                command = (offset // 7 & 1) << 4 | 7 - len(part) << 1 | (offset + 7 >= len(data))
                answer = self.ask(bytes((command,)) + part)
        return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0

    def start(self) -> None:
        """NMT start; what the PDOs send then is dropped."""
        self.step([(0, b"\x01\x05")])
        self.sent.clear()
