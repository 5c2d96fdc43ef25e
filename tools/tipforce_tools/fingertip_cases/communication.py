"""Beyond the standard: NMT, error control, EMCY, identity, storage, SYNC, TIME and the CAN controller's faults."""

from __future__ import annotations

import struct

from canopen_conformance import steps as do
from canopen_conformance import wire
from canopen_conformance.case import NotApplicableError, Service, check
from canopen_conformance.cases.emcy import HISTORY, INHIBIT, NEEDS, break_sync, clear, cure_error, make_error
from canopen_conformance.cases.error_control import CONSUMER, GUARDING, PRODUCER
from canopen_conformance.cases.identity import ALL, LOAD, VALUE, WRONG_SIGNATURE, restored, store
from canopen_conformance.cases.pdo import INVALID
from canopen_conformance.cases.sync import LENGTH, TIME
from canopen_conformance.dut import Dut
from canopen_conformance.wire import Abort

# fmt: off
# A table: a case is its header, and below it its steps.

nmt = Service("nmt", own=True)
node_guarding = Service("node_guarding", own=True)
error_control = Service("error_control", own=True)
emcy = Service("emcy", own=True)
identity = Service("identity", own=True)
storage = Service("storage", own=True)
sync = Service("sync", own=True)
time = Service("time", own=True)
bus_faults = Service("bus_faults", own=True)


nmt("startup_waits CiA 302-2 1F80h: the node waits for start: bit 2 is set by default", ((0x1F80, 0),),
    do.ask("40 80 1F 00", "43 80 1F 00 04 00 00 00"))
for value in (1, 5, 0x10):
    nmt(f"startup_refused CiA 302-2 1F80h: {value:08X}h asks for what a slave is not: refused", ((0x1F80, 0),),
        do.refuses("I", 0x1F80, 0, value, Abort.INVALID_VALUE), do.holds("I", 0x1F80, 0, 4))
node_guarding("heartbeat_excludes 7.2.8.2.2: with a heartbeat there is no node guarding", GUARDING,
    do.put("H", 0x1017, 0, 5000), lambda dut: dut.send(0x700 + dut.node_id | wire.REMOTE_FLAG), do.no_heartbeat())


@error_control("7.2.8.3.2.2: the boot-up message starts the first period of the default 1017h", PRODUCER)
def first_period(dut: Dut) -> None:
    ms = dut.integer("H", 0x1017)
    dut.forget()
    dut.nmt(wire.RESET_COMMUNICATION)
    boot = dut.boot_up()
    beat = dut.heartbeat("7F", 2 * ms)
    dut.check_ms("boot-up to heartbeat", beat.at_us - boot.at_us, ms)


for value, why in ((0x00800064, "node-id 128"), (0x01700064, "reserved bits"), (0xFF700064, "reserved bits")):
    error_control(f"consumer_value 7.5.2.19: {value:08X}h is refused: {why}", CONSUMER,
        do.refuses("I", 0x1016, 1, value, Abort.INVALID_VALUE))
error_control("behaviour_refused 7.5.2.32: 1029h:1 = 3 is refused", ((0x1029, 1),),
    do.refuses("B", 0x1029, 1, 3, Abort.TOO_HIGH))
emcy("history_full 7.5.2.4: a full history drops the oldest", HISTORY,
    clear, do.repeat(10, make_error, cure_error), do.holds("B", 0x1003, 0, 8), do.read(0x1003, 8))
for command, name in wire.RESETS[::-1]:
    emcy(f"history_reset 7.5.2.4: the history outlives {name}", HISTORY,
        clear, make_error, do.reset(command), do.holds("B", 0x1003, 0, 1))
emcy("queue 7.5.2.18: many messages wait, in their order", INHIBIT,
    do.put("H", 0x1015, 0, 20), do.repeat(12, break_sync, do.send(0x080)),
    do.repeat(12, do.emcy("40 82 *"), do.emcy("00 00 *")))
emcy("collision 7.2.7.1: another node sends this node's heartbeat: EMCY 8150h, once", NEEDS,
    do.repeat(3, lambda dut: dut.send(0x700 + dut.node_id, "05")), do.emcy("50 81 11 *"), do.no_emcy())


@emcy("7.2.7.1: an identifier that a TPDO has left may be another node's", (*NEEDS, (0x1800, 1)))
def no_collision(dut: Dut) -> None:
    cob_id = dut.integer("I", 0x1800, 1)
    dut.nmt(wire.START)
    dut.put("I", 0x1800, 1, cob_id | INVALID)
    dut.send(cob_id & 0x7FF, bytes(8))
    dut.no_emcy()
    dut.put("I", 0x1800, 1, cob_id)
    dut.send(cob_id & 0x7FF, bytes(8))
    dut.emcy("50 81 *")


identity("profile CiA 404 1000h: device profile 404, an analogue input block", (),
    do.holds("I", 0x1000, 0, 0x00020194))


@identity("7.5.2.21: product code: tipforce, the number of gauges is 3 to 8")
def product(dut: Dut) -> None:
    code = dut.integer("I", 0x1018, 2)
    check(code & 0xFFFFFC00 == 0x54500000 and 3 <= code & 0xFF <= 8, "545000nnh to 545003nnh", f"{code:08X}h")


@identity(
    "7.5.2.24: 1021h begins as an EDS does; 1022h says that it is not compressed",
    ((0x1021, 0), (0x1022, 0)),
)
def eds(dut: Dut) -> None:
    dut.ask("40 21 10 00", "41 21 10 00 *")
    first = dut.ask("60", "00 *")
    check(first[1:].startswith(b"["), "[FileInfo]", first[1:].hex(" "))
    dut.request("80 21 10 00 00 00 00 08")
    dut.holds("H", 0x1022, 0, 0)


identity("eds_constant 7.5.2.24: 1021h cannot be written", ((0x1022, 0),),
    do.request("21 21 10 00 04"), do.aborted(0x1021, 0, Abort.READ_ONLY))


COMMUNICATION = ((0x1010, 2), (0x1011, 2), (0x1016, 1))
APPLICATION = ((0x1010, 3), (0x1011, 3), (0x6114, 1))


@storage("7.5.2.13: 1010h:{0} reads 1: the device stores on command", each=[(1,), (2,), (3,), (4,)])
def capability(dut: Dut, sub: int) -> None:
    if dut.try_write(0x1010, sub, struct.pack("<I", LOAD)) not in WRONG_SIGNATURE:
        raise NotApplicableError("the device has nowhere to store")
    dut.holds("I", 0x1010, sub, 1)


storage("application_kept 7.2.8.2.1.6: reset communication leaves the application's parameters", ((0x6114, 1),),
    do.put("I", 0x6114, 1, 777), do.reset(wire.RESET_COMMUNICATION), do.holds("I", 0x6114, 1, 777),
    do.reset(wire.RESET_NODE), do.holds("I", 0x6114, 1, 500))
storage("separate 7.5.2.13: communication and application are stored each for itself", (*COMMUNICATION, *APPLICATION),
    do.within(restored, do.put("I", 0x1016, 1, VALUE), do.put("I", 0x6114, 1, 777), do.run(store, 3),
        do.reset(wire.RESET_NODE), do.holds("I", 0x1016, 1, 0), do.holds("I", 0x6114, 1, 777)), persistent=True)
for sub, communication, application in ((2, 0, 777), (3, VALUE, 500)):
    storage(f"restore_one 7.5.2.14: 1011h:{sub} leaves the other group as it is stored", (*COMMUNICATION, *APPLICATION),
        do.within(restored, do.put("I", 0x1016, 1, VALUE), do.put("I", 0x6114, 1, 777), do.run(store, 1),
            do.put("I", 0x1011, sub, LOAD), do.reset(wire.RESET_NODE), do.holds("I", 0x1016, 1, communication),
            do.holds("I", 0x6114, 1, application)), persistent=True)


@storage("7.5.2.13: a state is not stored: {2}", ALL, persistent=True, each=[
    (0x2130, "H", "the command 2130h", 2, 0), (0x2103, "I", "the expected CRC 2103h:1", 0x12345678, 0),
])
def state(dut: Dut, index: int, kind: str, _name: str, value: int, after: int) -> None:
    sub = 1 if index == 0x2103 else 0
    with restored(dut):
        dut.put(kind, index, sub, value)
        store(dut, 1)
        dut.reset(wire.RESET_NODE)
        dut.holds(kind, index, sub, after)


for value, why in (
    (0x40000080, "this device produces no SYNC"), (0x20000080, "no 29-bit identifier"),
    (0x00000880, "no 29-bit identifier"),
):
    sync(f"refused 7.5.2.5: 1005h = {value:08X}h is refused: {why}", ((0x1005, 0),),
        do.refuses("I", 0x1005, 0, value, Abort.INVALID_VALUE))
sync("length_cured 7.2.7.1: a SYNC of the right length cures 8240h", LENGTH,
    do.repeat(2, do.send(0x080, "01"), do.emcy("40 82 *"), do.send(0x080), do.emcy("00 00 00 *")))
sync("length_once 7.2.7.1: many SYNCs of wrong length are one error", LENGTH,
    do.repeat(5, do.send(0x080, "01")), do.emcy("40 82 *"), do.no_emcy())
for value, why in (
    (0xC0000100, "this device produces no TIME"), (0xA0000100, "no 29-bit identifier"),
    (0x80000900, "no 29-bit identifier"),
):
    time(f"refused 7.5.2.15: 1012h = {value:08X}h is refused: {why}", TIME,
        do.refuses("I", 0x1012, 0, value, Abort.INVALID_VALUE))


CONTROLLER, BUS_OFF, RESTARTED = 0x004, 0x040, 0x100
PASSIVE, OVERFLOW, ACTIVE = "00 30 00 00 00 00 00 00", "00 01 00 00 00 00 00 00", "00 40 00 00 00 00 00 00"
NONE = "00 00 00 00 00 00 00 00"


def report(dut: Dut, error_class: int, data: str = NONE) -> None:
    """An error frame of the controller."""
    dut.send(wire.ERROR_FLAG | error_class, data)


bus_faults("passive 7.2.7.1: error passive: EMCY 8120h once; active again: the cure", (),
    do.run(report, CONTROLLER, PASSIVE), do.run(report, CONTROLLER, PASSIVE), do.emcy("20 81 11 *"), do.no_emcy(),
    do.run(report, CONTROLLER, ACTIVE), do.emcy("00 00 00 *"), error_frames=True)
bus_faults("overrun 7.2.7.1: overrun: EMCY 8110h once, cured when none came for a second", (),
    do.repeat(3, do.run(report, CONTROLLER, OVERFLOW)), do.emcy("10 81 11 *"), do.no_emcy(ms=900),
    do.emcy("00 00 00 *"), error_frames=True)
bus_faults("bus_off 7.2.7.1: bus-off: silent, and EMCY 8140h when it is over", (),
    do.beat(), do.run(report, BUS_OFF), do.forget(), do.no_heartbeat(ms=50), do.run(report, RESTARTED),
    do.emcy("40 81 *"), do.ask("40 00 10 00", "43 00 10 00 *"), error_frames=True)
bus_faults("bus_off_behaviour 7.5.2.32: bus-off in OPERATIONAL: PRE-OPERATIONAL by 1029h", (),
    do.beat(), do.nmt(wire.START), do.state(wire.OPERATIONAL), do.run(report, BUS_OFF), do.run(report, RESTARTED),
    do.state(wire.PRE_OPERATIONAL), error_frames=True)
bus_faults("bus_off_again 7.2.7.1: bus-off twice in a row: both are reported", (),
    do.repeat(2, do.run(report, BUS_OFF), do.sleep(10), do.run(report, RESTARTED), do.emcy("40 81 *")),
    error_frames=True)
