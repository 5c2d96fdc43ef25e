"""NMT slave: transitions, resets, boot-up, and what each state allows (CiA 301, 7.2.8.2 and 7.3.2)."""

from __future__ import annotations

import struct
from itertools import product

from canopen_conformance import steps as do
from canopen_conformance import wire
from canopen_conformance.case import NotApplicableError, Service
from canopen_conformance.cases.emcy import break_sync
from canopen_conformance.cases.pdo import TIME_U32, TPDO1, enable_tpdo1, mapped_rpdo1, rpdo_was, set_time
from canopen_conformance.dut import Dut

# fmt: off
# A table: a case is its header, and below it its steps.

case = Service("nmt")

HEARTBEAT = ((0x1017, 0),)
COMMANDS = [
    (wire.START, "start", wire.OPERATIONAL),
    (wire.STOP, "stop", wire.STOPPED),
    (wire.ENTER_PRE_OPERATIONAL, "enter PRE-OPERATIONAL", wire.PRE_OPERATIONAL),
]
TARGETS = [(None, "to this node"), (0, "to all nodes")]

for (target, to), (before, state), (command, name, after) in product(TARGETS, wire.STATES, COMMANDS):
    case(f"transition 7.2.8.3.1: {name} in {state}, {to}", HEARTBEAT,
        do.beat(), do.enter(before), do.nmt(command, target), do.state(after))
for (target, to), (before, state), (command, name) in product(TARGETS, wire.STATES, wire.RESETS):
    case(f"reset 7.2.8.3.1: {name} in {state}, {to}: boot-up, then PRE-OPERATIONAL", HEARTBEAT,
        do.waits_for_start(), do.enter(before), do.forget(), do.nmt(command, target), do.boot_up(), do.beat(),
        do.state(wire.PRE_OPERATIONAL))
for can_id, data, why in (
    (0, "01 7E", "start of another node"), (0, "", "no data"), (0, "01", "one byte"), (0, "01 00 00", "three bytes"),
    (0, "01 00 00 00 00 00 00 00", "eight bytes"),
    *((0, f"{command:02X} 00", f"command specifier {command}") for command in (0, 3, 127, 131, 255)),
    (wire.EXTENDED_FLAG, "01 00", "start in a 29-bit frame"), (wire.REMOTE_FLAG, "", "a remote frame"),
):
    case(f"ignored 7.2.8.3.1: ignored: {why}", HEARTBEAT,
        do.beat(), do.send(can_id, data), do.state(wire.PRE_OPERATIONAL), do.silence())
case("node_id_with_high_bit 7.2.8.3.1: node-id + 128 in the command is not this node", HEARTBEAT,
    do.beat(), lambda dut: dut.nmt(wire.START, 0x80 | dut.node_id), do.state(wire.PRE_OPERATIONAL))
for command in (wire.RESET_NODE, 130):
    case("boot_up_once 7.2.8.3.3: the boot-up message is one byte 00, and one message alone", (),
        do.reset(command), do.silence(), do.no_heartbeat(ms=10))


@case("7.2.8.3.3: nothing is sent before the boot-up message", HEARTBEAT)
def boot_up_first(dut: Dut) -> None:
    dut.enter(wire.OPERATIONAL)
    dut.forget()
    dut.nmt(wire.RESET_NODE)
    for can_id in (0x80, 0x180, 0x280, 0x380, 0x480, 0x580):
        dut.silence(can_id + dut.node_id, ms=0)
    dut.boot_up()


for before, state in wire.STATES[:2]:
    case(f"sdo_served 7.3.2.3: SDO is served in {state}", (),
        do.enter(before), do.ask("40 00 10 00", "43 00 10 00 *"))
case("sdo_stopped 7.3.2.3: SDO is not served in STOPPED, and served again after it", (),
    do.nmt(wire.STOP), do.request("40 00 10 00"), do.no_sdo(), do.nmt(wire.ENTER_PRE_OPERATIONAL),
    do.ask("40 00 10 00", "43 00 10 00 *"))


@case("7.3.2.3: stop ends an SDO transfer without a word", ((0x1008, 0),))
def stop_ends_sdo(dut: Dut) -> None:
    if dut.ask("40 08 10 00")[0] & 0xE3 != 0x41:
        raise NotApplicableError("1008h fits into one frame")
    dut.nmt(wire.STOP)
    dut.request("60")
    dut.no_sdo()
    dut.nmt(wire.ENTER_PRE_OPERATIONAL)
    dut.ask("60", lambda data: data[0] == 0x80)


for before, state in wire.STATES:
    case(f"tpdo_by_state 7.3.2.3: a synchronous TPDO in {state}: {'sent' if before == wire.OPERATIONAL else 'silent'}",
        TPDO1,
        do.run(enable_tpdo1, 1), do.enter(before), do.send(0x080),
        do.pdo() if before == wire.OPERATIONAL else do.no_pdo())
case("tpdo_leave_and_return 7.3.2.3: TPDOs stop when OPERATIONAL is left, and go on when it is entered again", TPDO1,
    do.run(enable_tpdo1, 1),
    *(step for command in (wire.ENTER_PRE_OPERATIONAL, wire.STOP) for step in (
        do.nmt(wire.START), do.send(0x080), do.pdo(), do.nmt(command), do.send(0x080), do.no_pdo())))
for (before, state), does in zip(wire.STATES, ("ignored", "taken"), strict=False):
    case(f"rpdo_by_state 7.3.2.3: an RPDO in {state}: {does}", ((0x1013, 0), (0x1400, 1), (0x1600, 0)),
        do.run(mapped_rpdo1, TIME_U32), set_time, do.enter(before), do.send_pdo(struct.pack("<I", 0x70000000)),
        do.run(rpdo_was, does, 0x70000000))
case("emcy_waits 7.3.2.3: an EMCY waits while STOPPED and comes after it", ((0x1014, 0), (0x1016, 1)),
    do.put("I", 0x1016, 1, 0x700000 | 40), do.send(0x770, "05"), do.nmt(wire.STOP), do.no_emcy(ms=100),
    do.nmt(wire.ENTER_PRE_OPERATIONAL), do.emcy("30 81 *"))
case("sync_stopped 7.3.2.3: SYNC is not looked at in STOPPED", ((0x1005, 0), (0x1014, 0)),
    do.nmt(wire.STOP), break_sync, do.nmt(wire.ENTER_PRE_OPERATIONAL), do.no_emcy())


@case("CiA 302-2 1F80h: bit 2 clear and stored: OPERATIONAL by itself after boot-up",
    ((0x1F80, 0), (0x1010, 2), (0x1011, 2), (0x1017, 0)), persistent=True)
def self_start(dut: Dut) -> None:
    dut.waits_for_start()
    try:
        dut.put("I", 0x1F80, 0, 0)
        dut.put("H", 0x1017, 0, 20)
        dut.put("I", 0x1010, 2, 0x65766173)
        dut.reset(wire.RESET_COMMUNICATION)
        dut.state(wire.OPERATIONAL)
    finally:
        dut.put("I", 0x1011, 2, 0x64616F6C)
