"""Identity of the device (CiA 301, 7.5.2.1 to 7.5.2.33), and its stored parameters (7.5.2.13 and 7.5.2.14)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager

from canopen_conformance import steps as do
from canopen_conformance.case import NotApplicableError, Service, check
from canopen_conformance.cases.pdo import TPDO1, check_mapped
from canopen_conformance.dut import Dut
from canopen_conformance.wire import RESET_COMMUNICATION, RESET_NODE, RESETS, START, Abort

identity = Service("identity")
storage = Service("storage")


identity("device_type 7.5.2.1: 1000h is there, an UNSIGNED32, and stays the same")(do.unchanged("I", 0x1000, 0))
identity("error_register 7.5.2.2: 1001h is there, an UNSIGNED8")(do.integer("B", 0x1001))
identity("status_register 7.5.2.3: 1002h is an UNSIGNED32 that cannot be written", ((0x1002, 0),))(
    do.integer("I", 0x1002), do.refuses("I", 0x1002, 0, 0, Abort.READ_ONLY)
)


NAMES = [(0x1008,), (0x1009,), (0x100A,)]


@identity("7.5.2.8: {0:04X}h is a text of visible characters", lambda index: ((index, 0),), each=NAMES)
def name(dut: Dut, index: int) -> None:
    data = dut.read(index)
    if not data.rstrip(b"\0"):
        raise NotApplicableError(f"{index:04X}h is empty")
    check(not any(not 0x20 <= byte < 0x7F for byte in data.rstrip(b"\0")), "visible characters", data.hex(" "))


identity.each("name_constant 7.5.2.8: {0:04X}h cannot be written", lambda index: ((index, 0),), NAMES)(
    lambda index: do.refuses_bytes(index, 0, b"abcd", Abort.READ_ONLY)
)


@identity("7.5.2.21: 1018h has the vendor-ID, and one to four entries")
def identity_identity(dut: Dut) -> None:
    highest = dut.integer("B", 0x1018, 0)
    check(1 <= highest <= 4, "1 to 4 entries", str(highest))
    for sub in range(1, highest + 1):
        if sub == 1 or dut.exists(0x1018, sub):
            dut.integer("I", 0x1018, sub)


identity.each(
    "identity_constant 7.5.2.21: 1018h:{0} cannot be written", lambda sub: ((0x1018, sub),), [(1,), (2,), (3,), (4,)]
)(lambda sub: do.refuses("I", 0x1018, sub, 1, Abort.READ_ONLY))
identity.each(
    "configuration_date 7.5.2.23: 1020h:{0} is written and read back", ((0x1020, 1), (0x1020, 2)), [(1,), (2,)]
)(lambda sub: (do.put("I", 0x1020, sub, 0x12345678), do.holds("I", 0x1020, sub, 0x12345678)))


identity("configuration_lost 7.5.2.23: 1020h is lost with what it speaks of, unless stored", ((0x1020, 1),))(
    do.unchanged("I", 0x1020, 1, lambda dut: dut.put("I", 0x1020, 1, dut.integer("I", 0x1020, 1) ^ 0xFF), do.reset())
)
identity.each(
    "sdo_server 7.5.2.33: 1200h:{0} is the pre-defined COB-ID {1:03X}h + node-id",
    ((0x1200, 1), (0x1200, 2)),
    [(1, 0x600), (2, 0x580)],
)(lambda sub, base: lambda dut: dut.holds("I", 0x1200, sub, base + dut.node_id))
identity.each("sdo_server_constant 7.5.2.33: 1200h:{0} cannot be written", ((0x1200, 1), (0x1200, 2)), [(1,), (2,)])(
    lambda sub: lambda dut: dut.refuses("I", 0x1200, sub, 0x600 + dut.node_id, Abort.READ_ONLY)
)


def predefined(dut: Dut, index: int, base: int) -> None:
    """A PDO's default COB-ID."""
    if not dut.exists(index, 1):
        raise NotApplicableError(f"no object {index:04X}h")
    cob_id = dut.integer("I", index, 1)
    if cob_id & 0x7F not in (0, dut.node_id):
        raise NotApplicableError(f"{index:04X}h:01 is configured: {cob_id:08X}h belongs to another node")
    check(cob_id & 0x80000000 or cob_id & 0x7FF == base + dut.node_id, f"{base + dut.node_id:03X}h", f"{cob_id:08X}h")


identity.each(
    "predefined_tpdo 7.3.3: the COB-ID of TPDO{0} is the pre-defined one, unless it is disabled",
    (),
    [(1,), (2,), (3,), (4,)],
)(lambda number: do.run(predefined, 0x1800 + number - 1, 0x80 + 0x100 * number))
identity("predefined_rpdo 7.3.3: the COB-ID of RPDO1 is the pre-defined one, unless it is disabled")(
    do.run(predefined, 0x1400, 0x200)
)


SAVE, LOAD = 0x65766173, 0x64616F6C
GROUP = ((0x1010, 1), (0x1011, 1))
WRONG_SIGNATURE = (Abort.NOT_STORED, Abort.GENERAL_ERROR, Abort.INVALID_VALUE)
BOTH = [(0x1010, "store"), (0x1011, "restore")]
ALL = (*GROUP, (0x1016, 1))
VALUE = 0x700000 | 4711  # for 1016h:1, which every default leaves at 0


@contextmanager
def restored(dut: Dut, sub: int = 1) -> Iterator[None]:
    """After it the group is at its defaults again."""
    try:
        yield
    finally:
        dut.put("I", 0x1011, sub, LOAD)


def store(dut: Dut, sub: int) -> None:
    """Store a group; not applicable for a device that has nowhere to store."""
    code = dut.try_write(0x1010, sub, struct.pack("<I", SAVE))
    if code == Abort.HARDWARE_ERROR:
        raise NotApplicableError("the device has nowhere to store")
    check(not code, "parameters stored", f"abort {code:08X}h")


storage.each(
    "wrong_signature 7.5.2.13: {1} with a wrong signature ({2}): 08000020h",
    GROUP,
    [(index, name, signature) for index, name in BOTH for signature in ("evas", "SAVE", "loaf", "abcd")],
)(lambda index, _name, signature: do.refuses_bytes(index, 1, signature.encode(), *WRONG_SIGNATURE))
storage.each(
    "other_signature 7.5.2.13: the signature of the other object is a wrong one",
    GROUP,
    [(0x1010, LOAD), (0x1011, SAVE)],
)(lambda index, signature: do.refuses("I", index, 1, signature, *WRONG_SIGNATURE))
storage.each("size 7.5.2.13: {1}: two bytes are refused by their length", GROUP, BOTH)(
    lambda index, _name: do.refuses("H", index, 1, 0x6173, Abort.TOO_SHORT, Abort.WRONG_LENGTH)
)
storage.each("no_group 7.5.2.13: {1} of a group that is not there: 06090011h", GROUP, BOTH)(
    lambda index, _name: lambda dut: dut.refuses("I", index, dut.integer("B", index, 0) + 1, SAVE, Abort.NO_SUB)
)
storage.each("not_stored 7.5.2.13: what is not stored is lost by {1}", ((0x1016, 1),), RESETS)(
    lambda command, _name: do.unchanged("I", 0x1016, 1, do.put("I", 0x1016, 1, VALUE), do.reset(command))
)


@storage(
    "7.5.2.13: 1010h:{0} stores communication parameters for {2}",
    lambda sub, _command, _name: (*ALL, (0x1010, sub)),
    persistent=True,
    each=[(sub, *command) for sub in (1, 2) for command in RESETS],
)
def stored(dut: Dut, sub: int, command: int, _name: str) -> None:
    with restored(dut):
        dut.put("I", 0x1016, 1, VALUE)
        store(dut, sub)
        dut.put("I", 0x1016, 1, 0)
        dut.reset(command)
        dut.holds("I", 0x1016, 1, VALUE)


@storage(
    "7.5.2.14: 1011h:{0} changes nothing before a reset, then brings the defaults",
    lambda sub: (*ALL, (0x1011, sub)),
    persistent=True,
    each=[(1,), (2,)],
)
def restore(dut: Dut, sub: int) -> None:
    with restored(dut):
        dut.put("I", 0x1016, 1, VALUE)
        store(dut, 1)
        dut.put("I", 0x1011, sub, LOAD)
        dut.holds("I", 0x1016, 1, VALUE)
        dut.reset(RESET_COMMUNICATION if sub == 2 else RESET_NODE)
        dut.holds("I", 0x1016, 1, 0)


@storage("7.5.2.13: PDO parameters are stored, and the PDO works as stored", ((0x1010, 2), *TPDO1), persistent=True)
def stored_pdo(dut: Dut) -> None:
    cob_id = dut.integer("I", 0x1800, 1)
    check_mapped(dut)
    with restored(dut):
        dut.put("I", 0x1800, 1, cob_id | 0x80000000)
        dut.put("B", 0x1800, 2, 1)
        dut.put("I", 0x1800, 1, cob_id & 0x40000000 | 0x3A5)
        store(dut, 2)
        dut.reset(RESET_NODE)
        dut.holds("I", 0x1800, 1, cob_id & 0x40000000 | 0x3A5)
        dut.nmt(START)
        dut.send(0x080)
        dut.expect(0x3A5)
