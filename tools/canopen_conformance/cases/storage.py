"""Store and restore of parameters (CiA 301, 7.5.2.13 and 7.5.2.14)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager

from canopen_conformance.case import NotApplicableError, Service, check
from canopen_conformance.dut import RESET_COMMUNICATION, RESET_NODE, Dut
from canopen_conformance.setups import TPDO1, check_mapped

case = Service("storage")

SAVE, LOAD = 0x65766173, 0x64616F6C
WRONG = (0x08000020, 0x08000000, 0x06090030)
BOTH = [(0x1010, "store"), (0x1011, "restore")]
ALL = ((0x1010, 1), (0x1011, 1), (0x1016, 1))
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
    if code == 0x06060000:
        raise NotApplicableError("the device has nowhere to store")
    check(not code, "parameters stored", f"abort {code:08X}h")


@case("CiA 301 7.5.2.13", "{1} with a wrong signature ({2}): 08000020h", needs=((0x1010, 1), (0x1011, 1)), each=[
    (index, name, signature) for index, name in BOTH for signature in ("evas", "SAVE", "loaf", "abcd")
])  # fmt: skip
def wrong_signature(dut: Dut, index: int, _name: str, signature: str) -> None:
    dut.refuses_bytes(index, 1, signature.encode(), *WRONG)


@case("CiA 301 7.5.2.13", "the signature of the other object is a wrong one", needs=((0x1010, 1), (0x1011, 1)), each=[
    (0x1010, LOAD), (0x1011, SAVE),
])  # fmt: skip
def other_signature(dut: Dut, index: int, signature: int) -> None:
    dut.refuses("I", index, 1, signature, *WRONG)


@case("CiA 301 7.5.2.13", "{1}: two bytes are refused by their length", needs=((0x1010, 1), (0x1011, 1)), each=BOTH)
def size(dut: Dut, index: int, _name: str) -> None:
    dut.refuses("H", index, 1, 0x6173, 0x06070013, 0x06070010)


@case("CiA 301 7.5.2.13", "{1} of a group that is not there: 06090011h", needs=((0x1010, 1), (0x1011, 1)), each=BOTH)
def no_group(dut: Dut, index: int, _name: str) -> None:
    dut.refuses("I", index, dut.integer("B", index, 0) + 1, SAVE, 0x06090011)


@case("CiA 301 7.5.2.13", "what is not stored is lost by {1}", needs=((0x1016, 1),), each=[
    (RESET_NODE, "reset node"), (RESET_COMMUNICATION, "reset communication"),
])  # fmt: skip
def not_stored(dut: Dut, command: int, _name: str) -> None:
    before = dut.integer("I", 0x1016, 1)
    dut.put("I", 0x1016, 1, VALUE)
    dut.reset(command)
    dut.holds("I", 0x1016, 1, before)


@case(
    "CiA 301 7.5.2.13",
    "1010h:{0} stores communication parameters for {2}",
    needs=ALL,
    persistent=True,
    each=[
        (sub, command, name)
        for sub in (1, 2)
        for command, name in ((RESET_NODE, "reset node"), (RESET_COMMUNICATION, "reset communication"))
    ],
)
def stored(dut: Dut, sub: int, command: int, _name: str) -> None:
    if not dut.exists(0x1010, sub):
        raise NotApplicableError(f"no 1010h:{sub}")
    with restored(dut):
        dut.put("I", 0x1016, 1, VALUE)
        store(dut, sub)
        dut.put("I", 0x1016, 1, 0)
        dut.reset(command)
        dut.holds("I", 0x1016, 1, VALUE)


@case(
    "CiA 301 7.5.2.14",
    "1011h:{0} changes nothing before a reset, then brings the defaults",
    needs=ALL,
    persistent=True,
    each=[(1,), (2,)],
)
def restore(dut: Dut, sub: int) -> None:
    if not dut.exists(0x1011, sub):
        raise NotApplicableError(f"no 1011h:{sub}")
    with restored(dut):
        dut.put("I", 0x1016, 1, VALUE)
        store(dut, 1)
        dut.put("I", 0x1011, sub, LOAD)
        dut.holds("I", 0x1016, 1, VALUE)
        dut.reset(RESET_COMMUNICATION if sub == 2 else RESET_NODE)
        dut.holds("I", 0x1016, 1, 0)


@case(
    "CiA 301 7.5.2.13",
    "PDO parameters are stored, and the PDO works as stored",
    needs=((0x1010, 2), *TPDO1),
    persistent=True,
)
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
        dut.nmt(1)
        dut.send(0x080)
        dut.expect(0x3A5)
