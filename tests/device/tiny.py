"""Devices with a dictionary made by hand, as small as each service allows; node-id 5."""

from canopen_device.core.node import Application, Device
from canopen_device.core.object_dictionary import ADD_NODE_ID, ANY_FLOAT, NOT_STORED, RPDO, TPDO, ObjectDictionary
from canopen_device.testing import Conversation, MemoryStore

Value = int | float | str | bytes
Number = int | float | None
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
    """Objects of each kind from 2000h, two TPDOs, two RPDOs, storage."""
    od = ObjectDictionary(node_id)

    def add(
        index: int, sub: int, kind: str, access: str, default: Value = 0,
        flags: int = 0, low: Number = None, high: Number = None,
    ) -> None:  # fmt: skip
        od.add(index, sub, (kind, access, flags, default, low, high))

    add(0x1000, 0, "I", "ro", 0x00020194)
    add(0x1005, 0, "I", "rw", 0x80)
    for index in (0x1010, 0x1011):
        add(index, 0, "B", "const", 3)
        for sub in (1, 2, 3):
            add(index, sub, "I", "rw", 1, NOT_STORED)
    add(0x1017, 0, "H", "rw", 0)
    add(0x1019, 0, "B", "rw", 0, 0, 0, 240)
    add(0x1F80, 0, "I", "rw", 4)
    for number in (0, 1):
        _pdo(od, 0x1400 + number, 0x80000200 + 0x100 * number, 255, ((0x2000, 0, 8), (0x2001, 0, 16)))
        _pdo(od, 0x1800 + number, 0xC0000180 + 0x100 * number, 1 + 254 * number, ((0x2000, 0, 8), (0x2001, 0, 16)))
    both = TPDO | RPDO
    add(0x2000, 0, "B", "rw", 0x11, both)
    add(0x2001, 0, "h", "rw", -2, both)
    add(0x2002, 0, "I", "rw", 0x44332211, both)
    add(0x2003, 0, "f", "rw", 1.5, both)
    add(0x2004, 0, "s", "rw", "")
    add(0x2005, 0, "D", "rw", b"")
    add(0x2006, 0, "D", "rw", bytes(9))
    add(0x2007, 0, "H", "rw", 15, 0, 10, 20)
    add(0x2008, 0, "H", "wo")
    add(0x2009, 0, "I", "ro", 7)
    add(0x200A, 0, "f", "rw", 0.0, ANY_FLOAT)
    add(0x200B, 0, "B", "const", 2)
    add(0x200B, 1, "b", "rw", -1)
    add(0x200B, 2, "i", "rw", -2, both)
    add(0x6000, 0, "H", "rw", 100)
    add(0x6001, 0, "f", "rw", 0.5, 0, 0.0, 2.0)
    od.sizes[0x2006] = 9
    return od


def _pdo(
    od: ObjectDictionary, index: int, cob_id: int, transmission: int, mapped: tuple[tuple[int, int, int], ...]
) -> None:
    tpdo = index >= 0x1800
    words = [index << 16 | sub << 8 | bits for index, sub, bits in mapped]
    od.add(index, 0, ("B", "const", 0, 6, None, None))
    od.add(index, 1, ("I", "rw", ADD_NODE_ID, cob_id, None, None))
    od.add(index, 2, ("B", "rw", 0, transmission, None, None))
    if tpdo:
        od.add(index, 3, ("H", "rw", 0, 0, None, None))
        od.add(index, 5, ("H", "rw", 0, 0, None, None))
        od.add(index, 6, ("B", "rw", 0, 0, None, None))
    od.add(index + 0x200, 0, ("B", "rw", 0, len(words), None, None))
    for sub in range(1, 9):
        od.add(index + 0x200, sub, ("I", "rw", 0, words[sub - 1] if sub <= len(words) else 0, None, None))


def booted(store: MemoryStore | None = None, node_id: int = 5, application: Application | None = None) -> Conversation:
    """A conversation with a device that has just booted, boot-up heard: PRE-OPERATIONAL."""
    store_hooks = (store.save, store.load) if store is not None else (None, None)
    device = Device(dictionary(node_id), *store_hooks)
    device.application = application
    talk = Conversation(device)
    talk.say(f"< 70{node_id:X}#00")
    return talk


def service_dictionary(node_id: int = 5) -> ObjectDictionary:
    """The dictionary of tiny.py and what these services need."""
    od = dictionary(node_id)
    for index, sub, kind, access, flags, default in (
        (0x1001, 0, "B", "ro", 0, 0),
        (0x1003, 0, "B", "rw", NOT_STORED, 0),
        *[(0x1003, sub, "I", "ro", 0, 0) for sub in range(1, 9)],
        (0x1007, 0, "I", "rw", 0, 0),
        (0x100C, 0, "H", "rw", 0, 0),
        (0x100D, 0, "B", "rw", 0, 0),
        (0x1012, 0, "I", "rw", 0, 0x80000100),
        (0x1013, 0, "I", "rw", NOT_STORED, 0),
        (0x1014, 0, "I", "rw", ADD_NODE_ID, 0x80),
        (0x1015, 0, "H", "rw", 0, 0),
        (0x1016, 0, "B", "const", 0, 4),
        *[(0x1016, sub, "I", "rw", 0, 0) for sub in range(1, 5)],
        (0x1018, 0, "B", "const", 0, 4),
        *[(0x1018, sub + 1, "I", "ro", 0, (VENDOR, PRODUCT, REVISION, SERIAL)[sub]) for sub in range(4)],
        (0x1029, 0, "B", "const", 0, 1),
        (0x1029, 1, "B", "rw", 0, 0),
    ):
        od.add(index, sub, (kind, access, flags, default, None, None))
    od.add(0x1400, 5, ("H", "rw", 0, 0, None, None))
    return od


def serving(node_id: int = 5, store: MemoryStore | None = None) -> Conversation:
    """A conversation with a device that has just booted; what it said at boot is taken."""
    device = Device(service_dictionary(node_id), store.save if store else None, store.load if store else None)
    talk = Conversation(device, emcy=True)
    talk.take()
    return talk
