"""Devices with a dictionary made by hand, as small as each service allows; node-id 5."""

from collections.abc import Iterable
from typing import Any

from canopen_device.core.node import Application, Device
from canopen_device.core.object_dictionary import ADD_NODE_ID, ANY_FLOAT, NOT_STORED, RPDO, TPDO, ObjectDictionary
from canopen_device.testing import Conversation, MemoryStore

VENDOR, PRODUCT, REVISION, SERIAL = 0x11, 0x22334455, 0x00010002, 0x80000001


class Recorder(Application):
    """Notes when the device core calls its application; 2000h is a live value."""

    live = frozenset((0x2000,))

    def __init__(self) -> None:
        self.calls: list[str] = []

    def on_reset(self, now_us: int) -> None:
        self.calls.append(f"reset {now_us}")

    def on_sync(self, now_us: int, _number: int) -> None:
        self.calls.append(f"sync {now_us}")

    def refresh(self, now_us: int) -> None:
        self.calls.append(f"refresh {now_us}")


def dictionary(node_id: int = 5) -> ObjectDictionary:
    """Objects of each kind from 2000h, two TPDOs, two RPDOs, storage; ``service_dictionary`` has more."""
    od = ObjectDictionary(node_id)
    both = TPDO | RPDO
    rows: list[tuple[Any, ...]] = [
        (0x1000, 0, "I", "ro", 0, 0x00020194), (0x1005, 0, "I", "rw", 0, 0x80),
        *[(index, sub, *(("I", "rw", NOT_STORED, 1) if sub else ("B", "const", 0, 3)))
          for index in (0x1010, 0x1011) for sub in range(4)],
        (0x1017, 0, "H", "rw", 0, 0), (0x1019, 0, "B", "rw", 0, 0, 0, 240), (0x1F80, 0, "I", "rw", 0, 4),
        (0x2000, 0, "B", "rw", both, 0x11), (0x2001, 0, "h", "rw", both, -2), (0x2002, 0, "I", "rw", both, 0x44332211),
        (0x2003, 0, "f", "rw", both, 1.5), (0x2004, 0, "s", "rw", 0, ""), (0x2005, 0, "D", "rw", 0, b""),
        (0x2006, 0, "D", "rw", 0, bytes(9)), (0x2007, 0, "H", "rw", 0, 15, 10, 20), (0x2008, 0, "H", "wo", 0, 0),
        (0x2009, 0, "I", "ro", 0, 7), (0x200A, 0, "f", "rw", ANY_FLOAT, 0.0), (0x200B, 0, "B", "const", 0, 2),
        (0x200B, 1, "b", "rw", 0, -1), (0x200B, 2, "i", "rw", both, -2), (0x6000, 0, "H", "rw", 0, 100),
        (0x6001, 0, "f", "rw", 0, 0.5, 0.0, 2.0),
    ]  # fmt: skip
    for number in (0, 1):
        rows += _pdo(0x1400 + number, 0x80000200 + 0x100 * number, 255)
        rows += _pdo(0x1800 + number, 0xC0000180 + 0x100 * number, 1 + 254 * number)
    _add(od, rows)
    od.sizes[0x2006] = 9
    return od


def _add(od: ObjectDictionary, rows: Iterable[tuple[Any, ...]]) -> None:
    """Rows: index, sub-index, type, access, flags, default, and limits where there are some."""
    for index, sub, *row in rows:
        od.add(index, sub, (*row, None, None)[:6])


def _pdo(index: int, cob_id: int, transmission: int) -> list[tuple[Any, ...]]:
    """A PDO that maps 2000h and 2001h."""
    further = [(3, "H"), (5, "H"), (6, "B")] if index >= 0x1800 else []
    words = [0x20000008, 0x20010010, *[0] * 6]
    return [
        (index, 0, "B", "const", 0, 6), (index, 1, "I", "rw", ADD_NODE_ID, cob_id),
        (index, 2, "B", "rw", 0, transmission), *[(index, sub, kind, "rw", 0, 0) for sub, kind in further],
        (index + 0x200, 0, "B", "rw", 0, 2),
        *[(index + 0x200, sub, "I", "rw", 0, word) for sub, word in enumerate(words, 1)],
    ]  # fmt: skip


def booted(store: MemoryStore | None = None, node_id: int = 5, application: Application | None = None) -> Conversation:
    """A conversation with a device that has just booted, boot-up heard: PRE-OPERATIONAL."""
    store_hooks = (store.save, store.load) if store is not None else (None, None)
    device = Device(dictionary(node_id), *store_hooks)
    device.application = application
    talk = Conversation(device)
    talk.say(f"< 70{node_id:X}#00")
    return talk


def service_dictionary(node_id: int = 5) -> ObjectDictionary:
    """The dictionary and what these services need."""
    od = dictionary(node_id)
    _add(od, [
        (0x1001, 0, "B", "ro", 0, 0), (0x1003, 0, "B", "rw", NOT_STORED, 0),
        *[(0x1003, sub, "I", "ro", 0, 0) for sub in range(1, 9)],
        (0x1007, 0, "I", "rw", 0, 0), (0x100C, 0, "H", "rw", 0, 0), (0x100D, 0, "B", "rw", 0, 0),
        (0x1012, 0, "I", "rw", 0, 0x80000100), (0x1013, 0, "I", "rw", NOT_STORED, 0),
        (0x1014, 0, "I", "rw", ADD_NODE_ID, 0x80), (0x1015, 0, "H", "rw", 0, 0),
        (0x1016, 0, "B", "const", 0, 4), *[(0x1016, sub, "I", "rw", 0, 0) for sub in range(1, 5)],
        (0x1018, 0, "B", "const", 0, 4),
        *[(0x1018, sub, "I", "ro", 0, number) for sub, number in enumerate((VENDOR, PRODUCT, REVISION, SERIAL), 1)],
        (0x1029, 0, "B", "const", 0, 1), (0x1029, 1, "B", "rw", 0, 0), (0x1400, 5, "H", "rw", 0, 0),
    ])  # fmt: skip
    return od


def serving(node_id: int = 5, store: MemoryStore | None = None) -> Conversation:
    """A conversation with a device that has just booted; what it said at boot is taken."""
    device = Device(service_dictionary(node_id), store.save if store else None, store.load if store else None)
    talk = Conversation(device, emcy=True)
    talk.take()
    return talk
