"""Identity of the device (CiA 301, 7.5.2.1 to 7.5.2.33), and its stored parameters (7.5.2.13 and 7.5.2.14)."""

import struct
from itertools import product

from canopen_conformance import steps as do
from canopen_conformance.case import Service, check, need
from canopen_conformance.cases.pdo import TPDO1, check_mapped, disable_pdo, move_pdo
from canopen_conformance.cases.sdo import NAMES
from canopen_conformance.dut import Dut
from canopen_conformance.wire import RESET_COMMUNICATION, RESET_NODE, RESETS, START, Abort

# fmt: off
# A table: a case is its header, and below it its steps.

identity = Service("identity")
storage = Service("storage")
SERVER = ((0x1200, 1), (0x1200, 2))


identity("device_type 7.5.2.1: 1000h is there, an UNSIGNED32, and stays the same", (),
    do.integer("I", 0x1000), do.unchanged(((0x1000, 0),)))
identity("error_register 7.5.2.2: 1001h is there, an UNSIGNED8", (),
    do.integer("B", 0x1001))
identity("status_register 7.5.2.3: 1002h is an UNSIGNED32 that cannot be written", ((0x1002, 0),),
    do.integer("I", 0x1002), do.refuses("I", 0x1002, 0, 0, Abort.READ_ONLY))


def visible(dut: Dut, index: int) -> None:
    """The text of an object has visible characters alone; not applicable to an empty one."""
    data = dut.read(index)
    text = data.rstrip(b"\0")
    need(text, f"{index:04X}h is empty")
    check(all(0x20 <= byte < 0x7F for byte in text), "visible characters", data.hex(" "))


for index in NAMES:
    identity(f"name 7.5.2.8: {index:04X}h is a text of visible characters", ((index, 0),), do.run(visible, index))
    identity(f"name_constant 7.5.2.8: {index:04X}h cannot be written", ((index, 0),),
        do.refuses_bytes(index, 0, b"abcd", Abort.READ_ONLY))


@identity("7.5.2.21: 1018h has the vendor-ID, and one to four entries")
def identity_identity(dut: Dut) -> None:
    highest = dut.integer("B", 0x1018, 0)
    check(1 <= highest <= 4, "1 to 4 entries", str(highest))
    for sub in range(1, highest + 1):
        if sub == 1 or dut.exists(0x1018, sub):
            dut.integer("I", 0x1018, sub)


for sub in (1, 2, 3, 4):
    identity(f"identity_constant 7.5.2.21: 1018h:{sub} cannot be written", ((0x1018, sub),),
        do.refuses("I", 0x1018, sub, 1, Abort.READ_ONLY))
for sub in (1, 2):
    identity(f"configuration_date 7.5.2.23: 1020h:{sub} is written and read back", ((0x1020, 1), (0x1020, 2)),
        do.put("I", 0x1020, sub, 0x12345678), do.holds("I", 0x1020, sub, 0x12345678))
identity("configuration_lost 7.5.2.23: 1020h is lost with what it speaks of, unless stored", ((0x1020, 1),),
    do.unchanged(((0x1020, 1),), lambda dut: dut.put("I", 0x1020, 1, dut.integer("I", 0x1020, 1) ^ 0xFF), do.reset()))
for sub, base in ((1, 0x600), (2, 0x580)):
    identity(f"sdo_server 7.5.2.33: 1200h:{sub} is the pre-defined COB-ID {base:03X}h + node-id", SERVER,
        do.run(lambda dut, sub, base: dut.holds("I", 0x1200, sub, base + dut.node_id), sub, base))
    identity(f"sdo_server_constant 7.5.2.33: 1200h:{sub} cannot be written", SERVER,
        do.run(lambda dut, sub: dut.refuses("I", 0x1200, sub, 0x600 + dut.node_id, Abort.READ_ONLY), sub))


def predefined(dut: Dut, index: int, base: int) -> None:
    """A PDO's default COB-ID."""
    need(dut.exists(index, 1), f"no object {index:04X}h")
    cob_id = dut.integer("I", index, 1)
    own = cob_id & 0x7F in (0, dut.node_id)
    need(own, f"{index:04X}h:01 is configured: {cob_id:08X}h belongs to another node")
    check(cob_id & 0x80000000 or cob_id & 0x7FF == base + dut.node_id, f"{base + dut.node_id:03X}h", f"{cob_id:08X}h")


for number in (1, 2, 3, 4):
    identity(f"predefined_tpdo 7.3.3: the COB-ID of TPDO{number} is the pre-defined one, unless it is disabled", (),
        do.run(predefined, 0x1800 + number - 1, 0x80 + 0x100 * number))
identity("predefined_rpdo 7.3.3: the COB-ID of RPDO1 is the pre-defined one, unless it is disabled", (),
    do.run(predefined, 0x1400, 0x200))


SAVE, LOAD = 0x65766173, 0x64616F6C
GROUP = ((0x1010, 1), (0x1011, 1))
WRONG_SIGNATURE = (Abort.NOT_STORED, Abort.GENERAL_ERROR, Abort.INVALID_VALUE)
BOTH = [(0x1010, "store"), (0x1011, "restore")]
ALL = (*GROUP, (0x1016, 1))
VALUE = 0x700000 | 4711  # for 1016h:1, which every default leaves at 0
restored = do.undone_by(do.put("I", 0x1011, 1, LOAD))  # after it all parameters are at their defaults again


def store(dut: Dut, sub: int) -> None:
    """Store a group; not applicable for a device that has nowhere to store."""
    code = dut.try_write(0x1010, sub, struct.pack("<I", SAVE))
    need(code != Abort.HARDWARE_ERROR, "the device has nowhere to store")
    check(not code, "parameters stored", f"abort {code:08X}h")


for (index, name), word in product(BOTH, ("evas", "SAVE", "loaf", "abcd")):
    storage(f"wrong_signature 7.5.2.13: {name} with a wrong signature ({word}): 08000020h", GROUP,
        do.refuses_bytes(index, 1, word.encode(), *WRONG_SIGNATURE))
for index, signature in ((0x1010, LOAD), (0x1011, SAVE)):
    storage("other_signature 7.5.2.13: the signature of the other object is a wrong one", GROUP,
        do.refuses("I", index, 1, signature, *WRONG_SIGNATURE))
for index, name in BOTH:
    storage(f"size 7.5.2.13: {name}: two bytes are refused by their length", GROUP,
        do.refuses("H", index, 1, 0x6173, Abort.TOO_SHORT, Abort.WRONG_LENGTH))
    storage(f"no_group 7.5.2.13: {name} of a group that is not there: 06090011h", GROUP,
        do.between("B", index, 0, 1, 0xFE),
        do.run(lambda dut, index: dut.refuses("I", index, dut.integer("B", index, 0) + 1, SAVE, Abort.NO_SUB), index))
for command, name in RESETS:
    storage(f"not_stored 7.5.2.13: what is not stored is lost by {name}", ((0x1016, 1),),
        do.unchanged(((0x1016, 1),), do.put("I", 0x1016, 1, VALUE), do.reset(command)))


for sub, (command, name) in product((1, 2), RESETS):
    storage(f"stored 7.5.2.13: 1010h:{sub} stores communication parameters for {name}", (*ALL, (0x1010, sub)),
        do.within(restored, do.put("I", 0x1016, 1, VALUE), do.run(store, sub), do.put("I", 0x1016, 1, 0),
            do.reset(command), do.holds("I", 0x1016, 1, VALUE)), persistent=True)
for sub, command in ((1, RESET_NODE), (2, RESET_COMMUNICATION)):
    storage(f"restore 7.5.2.14: 1011h:{sub} changes nothing before a reset, then brings the defaults",
        (*ALL, (0x1011, sub)),
        do.within(restored, do.put("I", 0x1016, 1, VALUE), do.run(store, 1), do.put("I", 0x1011, sub, LOAD),
            do.holds("I", 0x1016, 1, VALUE), do.reset(command), do.holds("I", 0x1016, 1, 0)), persistent=True)
storage("stored_pdo 7.5.2.13: PDO parameters are stored, and the PDO works as stored", ((0x1010, 2), *TPDO1),
    check_mapped, do.within(restored,
        do.run(disable_pdo, 0x1800), do.put("B", 0x1800, 2, 1), do.run(move_pdo, 0x1800),
        do.unchanged(((0x1800, 1), (0x1800, 2)), do.run(store, 2), do.reset(RESET_NODE)),
        do.nmt(START), do.send(0x080), do.expect(0x390)), persistent=True)
