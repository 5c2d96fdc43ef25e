"""Who the device is: device type, names, identity, configuration date, EDS, SDO server (CiA 301, 7.5.2)."""

from __future__ import annotations

from canopen_conformance.case import NotApplicableError, Service, check
from canopen_conformance.dut import Dut

case = Service("identity")

READ_ONLY = 0x06010002


@case("CiA 301 7.5.2.1", "1000h is there, an UNSIGNED32, and stays the same")
def device_type(dut: Dut) -> None:
    first = dut.integer("I", 0x1000)
    dut.holds("I", 0x1000, 0, first)


@case("CiA 301 7.5.2.2", "1001h is there, an UNSIGNED8")
def error_register(dut: Dut) -> None:
    dut.integer("B", 0x1001)


@case("CiA 301 7.5.2.3", "1002h is an UNSIGNED32 that cannot be written", needs=((0x1002, 0),))
def status_register(dut: Dut) -> None:
    dut.integer("I", 0x1002)
    dut.refuses("I", 0x1002, 0, 0, READ_ONLY)


@case("CiA 301 7.5.2.8", "{0:04X}h is a text of visible characters", each=[(0x1008,), (0x1009,), (0x100A,)])
def name(dut: Dut, index: int) -> None:
    if not dut.exists(index, 0):
        raise NotApplicableError(f"no object {index:04X}h")
    data = dut.read(index)
    if not data.rstrip(b"\0"):
        raise NotApplicableError(f"{index:04X}h is empty")
    check(not any(not 0x20 <= byte < 0x7F for byte in data.rstrip(b"\0")), "visible characters", data.hex(" "))


@case("CiA 301 7.5.2.8", "{0:04X}h cannot be written", each=[(0x1008,), (0x1009,), (0x100A,)])
def name_constant(dut: Dut, index: int) -> None:
    if not dut.exists(index, 0):
        raise NotApplicableError(f"no object {index:04X}h")
    dut.refuses_bytes(index, 0, b"abcd", READ_ONLY)


@case("CiA 301 7.5.2.21", "1018h has the vendor-ID, and one to four entries")
def identity(dut: Dut) -> None:
    highest = dut.integer("B", 0x1018, 0)
    check(1 <= highest <= 4, "1 to 4 entries", str(highest))
    for sub in range(1, highest + 1):
        if sub == 1 or dut.exists(0x1018, sub):
            dut.integer("I", 0x1018, sub)


@case("CiA 301 7.5.2.21", "1018h:{0} cannot be written", each=[(1,), (2,), (3,), (4,)])
def identity_identity_constant(dut: Dut, sub: int) -> None:
    if not dut.exists(0x1018, sub):
        raise NotApplicableError(f"no 1018h:{sub}")
    dut.refuses("I", 0x1018, sub, 1, READ_ONLY)


@case("CiA 301 7.5.2.23", "1020h:{0} is written and read back", needs=((0x1020, 1), (0x1020, 2)), each=[(1,), (2,)])
def configuration_date(dut: Dut, sub: int) -> None:
    dut.put("I", 0x1020, sub, 0x12345678)
    dut.holds("I", 0x1020, sub, 0x12345678)


@case("CiA 301 7.5.2.23", "1020h is lost with what it speaks of, unless stored", needs=((0x1020, 1),))
def configuration_lost(dut: Dut) -> None:
    before = dut.integer("I", 0x1020, 1)
    dut.put("I", 0x1020, 1, before ^ 0xFF)
    dut.reset()
    dut.holds("I", 0x1020, 1, before)


@case(
    "CiA 301 7.5.2.33",
    "1200h:{0} is the pre-defined COB-ID {1:03X}h + node-id",
    needs=((0x1200, 1), (0x1200, 2)),
    each=[
        (1, 0x600),
        (2, 0x580),
    ],
)
def sdo_server(dut: Dut, sub: int, base: int) -> None:
    dut.holds("I", 0x1200, sub, base + dut.node_id)


@case("CiA 301 7.5.2.33", "1200h:{0} cannot be written", needs=((0x1200, 1), (0x1200, 2)), each=[(1,), (2,)])
def sdo_server_constant(dut: Dut, sub: int) -> None:
    dut.refuses("I", 0x1200, sub, 0x600 + dut.node_id, READ_ONLY)


@case(
    "CiA 301 7.3.3",
    "the COB-ID of TPDO{0} is the pre-defined one, unless it is disabled",
    each=[(1,), (2,), (3,), (4,)],
)
def predefined_tpdo(dut: Dut, number: int) -> None:
    predefined(dut, 0x1800 + number - 1, 0x80 + 0x100 * number)


@case("CiA 301 7.3.3", "the COB-ID of RPDO1 is the pre-defined one, unless it is disabled")
def predefined_rpdo(dut: Dut) -> None:
    predefined(dut, 0x1400, 0x200)


def predefined(dut: Dut, index: int, base: int) -> None:
    """A PDO's default COB-ID."""
    if not dut.exists(index, 1):
        raise NotApplicableError(f"no object {index:04X}h")
    cob_id = dut.integer("I", index, 1)
    if cob_id & 0x7F not in (0, dut.node_id):
        raise NotApplicableError(f"{index:04X}h:01 is configured: {cob_id:08X}h belongs to another node")
    check(cob_id & 0x80000000 or cob_id & 0x7FF == base + dut.node_id, f"{base + dut.node_id:03X}h", f"{cob_id:08X}h")
