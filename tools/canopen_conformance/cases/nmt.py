"""NMT: transitions, resets, boot-up, what each state allows; heartbeat and node guarding (CiA 301, 7.2.8 and 7.3.2)."""

import struct
from itertools import product

from canopen_conformance import steps as do
from canopen_conformance import wire
from canopen_conformance.case import Service
from canopen_conformance.cases.emcy import break_sync
from canopen_conformance.cases.identity import LOAD, SAVE
from canopen_conformance.cases.pdo import TPDO1, enable_tpdo1, mapped_rpdo1, rpdo_was, set_time
from canopen_conformance.cases.sdo import begin_upload, over
from canopen_conformance.dut import Dut
from canopen_conformance.wire import EMCY, HEARTBEAT, PDO, SDO, Abort

# fmt: off
# A table: a case is its header, and below it its steps.

nmt = Service("nmt")
heartbeat = Service("error_control")
guarding = Service("node_guarding")

PRODUCER = ((0x1017, 0),)
CONSUMER = ((0x1016, 1), (0x1014, 0), (0x1001, 0))
GUARDING = ((0x100C, 0), (0x100D, 0), (0x1017, 0))
WATCHED = 0x70  # a node-id that nobody on the bus is likely to have
NAMES = dict(wire.STATES)
COMMANDS = [
    (wire.START, "start", wire.OPERATIONAL),
    (wire.STOP, "stop", wire.STOPPED),
    (wire.ENTER_PRE_OPERATIONAL, "enter PRE-OPERATIONAL", wire.PRE_OPERATIONAL),
]
TARGETS = [(None, "to this node"), (0, "to all nodes")]

for (target, to), (before, state), (command, name, after) in product(TARGETS, wire.STATES, COMMANDS):
    nmt(f"transition 7.2.8.3.1: {name} in {state}, {to}", PRODUCER,
        do.beat(), do.enter(before), do.nmt(command, target), do.state(after))
for (target, to), (before, state), (command, name) in product(TARGETS, wire.STATES, wire.RESETS):
    nmt(f"reset 7.2.8.3.1: {name} in {state}, {to}: boot-up, then PRE-OPERATIONAL", PRODUCER,
        do.waits_for_start(), do.enter(before), do.forget(), do.nmt(command, target), do.boot_up(), do.beat(),
        do.state(wire.PRE_OPERATIONAL))
start_other = do.late(lambda dut: bytes((wire.START, 0x7D if dut.node_id == 0x7E else 0x7E)))()
for can_id, data, why in (
    (0, start_other, "start of another node"), (0, "", "no data"), (0, "01", "one byte"),
    (0, "01 00 00", "three bytes"), (0, "01 00 00 00 00 00 00 00", "eight bytes"),
    *((0, f"{command:02X} 00", f"command specifier {command}") for command in (0, 3, 127, 131, 255)),
    (wire.EXTENDED_FLAG, "01 00", "start in a 29-bit frame"), (wire.REMOTE_FLAG, "", "a remote frame"),
):
    nmt(f"ignored 7.2.8.3.1: ignored: {why}", PRODUCER,
        do.beat(), do.send(can_id, data), do.state(wire.PRE_OPERATIONAL), do.silence())
nmt("node_id_with_high_bit 7.2.8.3.1: node-id + 128 in the command is not this node", PRODUCER,
    do.beat(), lambda dut: dut.nmt(wire.START, 0x80 | dut.node_id), do.state(wire.PRE_OPERATIONAL))
for command in (wire.RESET_NODE, 130):
    nmt("boot_up_once 7.2.8.3.3: the boot-up message is one byte 00, and one message alone", (),
        do.reset(command), do.silence(HEARTBEAT, ms=10), do.silence())
nmt("boot_up_first 7.2.8.3.3: nothing is sent before the boot-up message", PRODUCER,
    do.enter(wire.OPERATIONAL), do.forget(), do.nmt(wire.RESET_NODE),
    do.silence(*(wire.OF_DEVICE | base for base in (0x80, 0x180, 0x280, 0x380, 0x480, 0x580)), ms=0), do.boot_up())
for before, state in wire.STATES[:2]:
    nmt(f"sdo_served 7.3.2.3: SDO is served in {state}", (),
        do.enter(before), do.ask("40 00 10 00", "43 00 10 00 *"))
nmt("sdo_stopped 7.3.2.3: SDO is not served in STOPPED, and served again after it", (),
    do.nmt(wire.STOP), do.request("40 00 10 00"), do.silence(SDO), do.nmt(wire.ENTER_PRE_OPERATIONAL),
    do.ask("40 00 10 00", "43 00 10 00 *"))
nmt("stop_ends_sdo 7.3.2.3: stop ends an SDO transfer without a word", (),
    begin_upload, do.nmt(wire.STOP), do.request("60"), do.silence(SDO), do.nmt(wire.ENTER_PRE_OPERATIONAL), over)
for before, state in wire.STATES:
    nmt(f"tpdo_by_state 7.3.2.3: a synchronous TPDO in {state}: {'sent' if before == wire.OPERATIONAL else 'silent'}",
        TPDO1,
        enable_tpdo1, do.enter(before), do.send(0x080),
        do.expect(PDO) if before == wire.OPERATIONAL else do.silence(PDO))
nmt("tpdo_leave_and_return 7.3.2.3: TPDOs stop when OPERATIONAL is left, and go on when it is entered again", TPDO1,
    enable_tpdo1,
    *(step for command in (wire.ENTER_PRE_OPERATIONAL, wire.STOP) for step in (
        do.nmt(wire.START), do.send(0x080), do.expect(PDO), do.nmt(command), do.send(0x080), do.silence(PDO))))
for (before, state), does in zip(wire.STATES, ("ignored", "taken"), strict=False):
    nmt(f"rpdo_by_state 7.3.2.3: an RPDO in {state}: {does}", ((0x1013, 0), (0x1400, 1), (0x1600, 0)),
        mapped_rpdo1, set_time, do.enter(before), do.send(PDO, struct.pack("<I", 0x70000000)),
        do.run(rpdo_was, does, 0x70000000))
nmt("emcy_waits 7.3.2.3: an EMCY waits while STOPPED and comes after it", ((0x1014, 0), (0x1016, 1)),
    do.put("I", 0x1016, 1, 0x700000 | 40), do.send(0x770, "05"), do.nmt(wire.STOP), do.silence(EMCY, ms=100),
    do.nmt(wire.ENTER_PRE_OPERATIONAL), do.expect(EMCY, "30 81 *"))
nmt("sync_stopped 7.3.2.3: SYNC is not looked at in STOPPED", ((0x1005, 0), (0x1014, 0)),
    do.nmt(wire.STOP), break_sync, do.nmt(wire.ENTER_PRE_OPERATIONAL), do.silence(EMCY))
nmt("self_start CiA 302-2 1F80h: bit 2 clear and stored: OPERATIONAL by itself after boot-up",
    ((0x1F80, 0), (0x1010, 2), (0x1011, 2), (0x1017, 0)),
    do.waits_for_start(), do.within(do.undone_by(do.put("I", 0x1011, 2, LOAD)),
        do.put("I", 0x1F80, 0, 0), do.put("H", 0x1017, 0, 20), do.put("I", 0x1010, 2, SAVE),
        do.reset(wire.RESET_COMMUNICATION), do.state(wire.OPERATIONAL)), persistent=True)


def watch(dut: Dut, ms: int, node_id: int = WATCHED, sub: int = 1) -> None:
    """Let the device watch a node, which then says its first heartbeat."""
    dut.put("I", 0x1016, sub, node_id << 16 | ms)
    dut.send(0x700 + node_id, "05")


def lost(dut: Dut, within_ms: int = 100) -> None:
    """The device reports a lost heartbeat by EMCY, with generic and communication error in the register."""
    dut.expect(EMCY, lambda d: d[:2] == b"\x30\x81" and d[2] & 0x11 == 0x11, within_ms)


for ms in (20, 50, 110):
    heartbeat(f"period 7.2.8.3.2.2: a heartbeat each {ms} ms", PRODUCER,
        do.put("H", 0x1017, 0, ms, required=True),
        do.each_ms(ms, 3, "three periods of", do.expect(HEARTBEAT, "7F", 2 * ms)))
for after, state in wire.STATES:
    heartbeat(f"heartbeat_state 7.2.8.3.2.2: the heartbeat in {state} carries {after:02X}h", PRODUCER,
        do.beat(), do.enter(after), do.state(after))
heartbeat("producer_off 7.5.2.20: 1017h = 0 ends the heartbeat", PRODUCER,
    do.beat(), do.expect(HEARTBEAT), do.put("H", 0x1017, 0, 0), do.forget(), do.silence(HEARTBEAT, ms=80))
heartbeat("new_period 7.5.2.20: a new period holds from the write on", PRODUCER,
    do.put("H", 0x1017, 0, 5000), do.forget(), do.put("H", 0x1017, 0, 40), do.expect(HEARTBEAT, "7F", 40))
for kind, size in (("B", 1), ("I", 4)):
    heartbeat(f"producer_size 7.5.2.20: {size} bytes for 1017h are refused", PRODUCER,
        do.refuses(kind, 0x1017, 0, 100, Abort.WRONG_LENGTH, Abort.TOO_LONG if size > 2 else Abort.TOO_SHORT))
heartbeat("consumer_read_back 7.5.2.19: 1016h is read back as written", CONSUMER,
    do.put("I", 0x1016, 1, WATCHED << 16 | 1234), do.holds("I", 0x1016, 1, WATCHED << 16 | 1234))
heartbeat("consumer_twice 7.5.2.19: a node-id in two entries is refused with 06040043h", (*CONSUMER, (0x1016, 2)),
    do.put("I", 0x1016, 1, WATCHED << 16 | 1000), do.refuses("I", 0x1016, 2, WATCHED << 16 | 500, Abort.INCOMPATIBLE),
    do.holds("I", 0x1016, 2, 0))
heartbeat("consumer_twice_off 7.5.2.19: the same node-id with time 0 is no second watch", (*CONSUMER, (0x1016, 2)),
    do.put("I", 0x1016, 1, WATCHED << 16 | 1000), do.put("I", 0x1016, 2, WATCHED << 16),
    do.put("I", 0x1016, 1, WATCHED << 16 | 500))
heartbeat("not_before_first 7.2.8.3.2.2: nobody is missed before a first heartbeat", CONSUMER,
    do.put("I", 0x1016, 1, WATCHED << 16 | 20), do.silence(EMCY, ms=100))
heartbeat("lost_heartbeat 7.2.8.2.2.3: a lost heartbeat: EMCY 8130h after the consumer time", CONSUMER,
    do.run(watch, 100), do.after(100, "consumer time", do.expect(EMCY, "30 81 *", 200)))
heartbeat("lost_once 7.2.8.2.2.3: a lost heartbeat is reported once", CONSUMER,
    do.run(watch, 20), lost, do.silence(EMCY, ms=80))
heartbeat("in_time 7.2.8.2.2.3: heartbeats in time: no EMCY; the time runs from the last one", CONSUMER,
    do.run(watch, 150), do.repeat(4, do.silence(EMCY, ms=60), do.send(0x700 + WATCHED, "05")), do.silence(EMCY, ms=60),
    do.run(lost, 200))
heartbeat("returned 7.2.7.1: a heartbeat that returns cures: EMCY 0000h, and 1001h is clear", CONSUMER,
    do.run(watch, 30), lost, do.send(0x700 + WATCHED, "05"), do.expect(EMCY, "00 00 00 *"), do.holds("B", 0x1001, 0, 0))
heartbeat("watched_again 7.2.8.2.2.3: a heartbeat that returned is watched again", CONSUMER,
    do.run(watch, 20), lost, do.send(0x700 + WATCHED, "05"), do.expect(EMCY, "00 00 *"), lost)
for value, before, after in (
    (0, wire.OPERATIONAL, wire.PRE_OPERATIONAL), (1, wire.OPERATIONAL, wire.OPERATIONAL),
    (2, wire.OPERATIONAL, wire.STOPPED), (0, wire.PRE_OPERATIONAL, wire.PRE_OPERATIONAL),
    (0, wire.STOPPED, wire.STOPPED),
):
    heartbeat(f"behaviour 7.5.2.32: 1029h:1 = {value}: a lost heartbeat in {NAMES[before]} leads to {NAMES[after]}",
        (*CONSUMER, (0x1029, 1), (0x1017, 0)),
        do.put("B", 0x1029, 1, value), do.beat(), do.put("I", 0x1016, 1, WATCHED << 16 | 30), do.enter(before),
        do.send(0x700 + WATCHED, "05"), lambda dut: dut.sleep(60 + dut.link.tolerance_ms), do.state(after))
beside = do.late(lambda dut, flag: flag + 0x700 + WATCHED + (flag == 1 and dut.node_id == WATCHED + 1))
for flag, data, why in (
    (0, "05 05", "two bytes"), (0, "", "no data"), (wire.REMOTE_FLAG, "", "a remote frame"),
    (1, "05", "of another node"),
):
    heartbeat(f"no_heartbeat 7.2.8.3.2.2: no heartbeat: {why}", CONSUMER,
        do.put("I", 0x1016, 1, WATCHED << 16 | 20), do.send(beside(flag), data), do.silence(EMCY, ms=80))
heartbeat("four 7.5.2.19: four nodes are watched, each for itself", (*CONSUMER, (0x1016, 4)),
    *(do.run(watch, 200 if sub == 3 else 40, WATCHED + sub, sub) for sub in (1, 2, 3, 4)), do.repeat(3, lost),
    do.send(0x700 + WATCHED + 3, "05"), do.silence(EMCY, ms=50), do.run(lost, 250))
heartbeat("watch_off 7.5.2.19: an entry set to 0 is watched no more", CONSUMER,
    do.run(watch, 60), do.put("I", 0x1016, 1, 0), do.silence(EMCY, ms=120))
heartbeat("lost_then_off 7.5.2.19: a lost node whose entry is set to 0 is an error no more", CONSUMER,
    do.run(watch, 20), lost, do.put("I", 0x1016, 1, 0), do.holds("B", 0x1001, 0, 0))
heartbeat("watch_reset 7.2.8.2.1.6: reset communication ends every watch", CONSUMER,
    do.run(watch, 60), do.reset(wire.RESET_COMMUNICATION), do.silence(EMCY, ms=120))


def guard(dut: Dut, wanted: str) -> None:
    """The guarding master's remote frame, and the answer."""
    dut.send(HEARTBEAT | wire.REMOTE_FLAG)
    dut.expect(HEARTBEAT, wanted)


def life(dut: Dut, guard_ms: int, factor: int) -> None:
    """No heartbeat; this life time."""
    dut.put("H", 0x1017, 0, 0)
    dut.put("H", 0x100C, 0, guard_ms)
    dut.put("B", 0x100D, 0, factor)
    dut.forget()


guarding("toggle 7.2.8.3.2.1: the answer carries the state; the toggle bit starts at 0 and alternates", GUARDING,
    do.run(life, 0, 0), do.repeat(2, do.run(guard, "7F"), do.run(guard, "FF")))
for after, state in wire.STATES[1:]:
    guarding(f"guarding_state 7.2.8.3.2.1: guarding in {state}", GUARDING,
        do.run(life, 0, 0), do.run(guard, "7F"), do.enter(after), do.run(guard, f"{after | 0x80:02X}"),
        do.run(guard, f"{after:02X}"))
guarding("toggle_reset 7.2.8.3.2.1: reset communication sets the toggle bit to 0", GUARDING,
    do.run(life, 0, 0), do.run(guard, "7F"), do.reset(wire.RESET_COMMUNICATION), do.run(life, 0, 0),
    do.run(guard, "7F"))
guarding("life_lost 7.2.8.2.2.2: the life time runs out: EMCY 8130h; the next remote frame cures", GUARDING,
    do.run(life, 30, 2), do.run(guard, "7F"), do.after(60, "life time", do.expect(EMCY, "30 81 *", 120)),
    do.run(guard, "FF"), do.expect(EMCY, "00 00 *"))
guarding("life_in_time 7.2.8.2.2.2: remote frames in time: no life guarding error", GUARDING,
    do.run(life, 50, 3),
    *(step for wanted in ("7F", "FF", "7F") for step in (do.run(guard, wanted), do.silence(EMCY, ms=80))))
for which, guard_ms, factor in (("guard time 0", 0, 3), ("life time factor 0", 20, 0)):
    guarding(f"life_off 7.2.8.2.2.2: no life guarding before the first remote frame, nor with {which}", GUARDING,
        do.run(life, 20, 1), do.silence(EMCY, ms=60), do.run(life, guard_ms, factor), do.run(guard, "7F"),
        do.silence(EMCY, ms=90))
guarding("life_ended 7.5.2.11: guard time set to 0 ends life guarding that runs", GUARDING,
    do.run(life, 60, 1), do.run(guard, "7F"), do.put("H", 0x100C, 0, 0), do.silence(EMCY, ms=120))
guarding("heartbeat_ends_life 7.2.8.2.2: a heartbeat that is switched on ends life guarding that runs", GUARDING,
    do.run(life, 60, 1), do.run(guard, "7F"), do.put("H", 0x1017, 0, 5000), do.silence(EMCY, ms=120))
guarding("life_behaviour 7.5.2.32: life guarding lost in OPERATIONAL: PRE-OPERATIONAL", (*GUARDING, (0x1029, 1)),
    do.put("B", 0x1029, 1, 0), do.run(life, 30, 1), do.nmt(wire.START), do.run(guard, "05"),
    do.expect(EMCY, "30 81 *", 100), do.run(guard, "FF"))
guarding("no_guard 7.2.8.3.2.1: a data frame on the guarding identifier is not answered", GUARDING,
    do.run(life, 0, 0), do.nmt(wire.STOP), do.send(HEARTBEAT), do.silence(HEARTBEAT))
