"""EDS and DCF texts for tests: a header, and objects written shortly."""

import re
from pathlib import Path

from canopen_device.eds import Description, read_eds
from canopen_device.eds.load import device_of
from canopen_device.testing import Conversation, MemoryStore

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


MANDATORY = (
    var("1000", 7, "ro", "0x00020192") + var("1001", 5, "ro")
    + record("1018", var("1018sub0", 5, "ro", "1"), var("1018sub1", 7, "ro", "0x12", ParameterName="Vendor"))
)  # fmt: skip


def pdo(index: int, cob_id: str, kind: int, *mapped: int, event_ms: int = 0, inhibit: int = 0) -> str:
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
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_eds(path, node_id)


def sound(folder: Path, content: str | bytes, node_id: int | None = 5, name: str = "any.eds") -> Description:
    """The same of a text in which nothing is wrong."""
    found = described(folder, content, node_id, name)
    assert found.warnings == []
    return found


class Talk(Conversation):
    """A conversation with a device from its EDS, node-id 5, its boot-up heard."""

    def __init__(self, description: Description, store: MemoryStore | None = None) -> None:
        hooks = (store.save, store.load) if store else (None, None)
        super().__init__(device_of(description, *hooks))
        self.take()
