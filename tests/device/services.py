"""The tiny device with the objects of EMCY, heartbeat consumer, guarding, TIME and LSS, its EMCY heard; node-id 5."""

from device.conversation import Conversation
from device.tiny import Memory, dictionary
from tipforce.device.node import Device
from tipforce.device.object_dictionary import ADD_NODE_ID, NOT_STORED, ObjectDictionary

VENDOR, PRODUCT, REVISION, SERIAL = 0x11, 0x22334455, 0x00010002, 0x80000001


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


def serving(node_id: int = 5, store: Memory | None = None) -> Conversation:
    """A conversation with a device that has just booted; what it said at boot is taken."""
    device = Device(service_dictionary(node_id), store.save if store else None, store.load if store else None)
    talk = Conversation(device, emcy=True)
    talk.take()
    return talk
