"""Beyond the standard: NMT, error control, EMCY, identity, storage, SYNC, TIME and the CAN controller's faults."""

from __future__ import annotations

import struct

from canopen_conformance.case import NotApplicableError, Service, check
from canopen_conformance.cases.emcy import HISTORY, INHIBIT, NEEDS, break_sync, clear, cure_error, make_error
from canopen_conformance.cases.error_control import CONSUMER, GUARDING, PRODUCER
from canopen_conformance.cases.identity import ALL, LOAD, VALUE, WRONG_SIGNATURE, restored, store
from canopen_conformance.cases.pdo import INVALID
from canopen_conformance.cases.sync import LENGTH, TIME
from canopen_conformance.dut import Dut
from canopen_conformance.wire import (
    ERROR_FLAG,
    OPERATIONAL,
    PRE_OPERATIONAL,
    REMOTE_FLAG,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    Abort,
)

nmt = Service("nmt", own=True)
node_guarding = Service("node_guarding", own=True)
error_control = Service("error_control", own=True)
emcy = Service("emcy", own=True)
identity = Service("identity", own=True)
storage = Service("storage", own=True)
sync = Service("sync", own=True)
time = Service("time", own=True)
bus_faults = Service("bus_faults", own=True)


@nmt("CiA 302-2 1F80h", "the node waits for start: bit 2 is set by default", needs=((0x1F80, 0),))
def startup_waits(dut: Dut) -> None:
    dut.ask("40 80 1F 00", "43 80 1F 00 04 00 00 00")


@nmt(
    "CiA 302-2 1F80h",
    "{0:08X}h asks for what a slave is not: refused",
    needs=((0x1F80, 0),),
    each=[(1,), (5,), (0x10,)],
)
def startup_refused(dut: Dut, value: int) -> None:
    dut.refuses("I", 0x1F80, 0, value, Abort.INVALID_VALUE)
    dut.holds("I", 0x1F80, 0, 4)


@node_guarding("CiA 301 7.2.8.2.2", "with a heartbeat there is no node guarding", needs=GUARDING)
def heartbeat_excludes(dut: Dut) -> None:
    dut.put("H", 0x1017, 0, 5000)
    dut.send(0x700 + dut.node_id | REMOTE_FLAG)
    dut.silence(0x700 + dut.node_id)


@error_control(
    "CiA 301 7.2.8.3.2.2", "the boot-up message starts the first period of the default 1017h", needs=PRODUCER
)
def first_period(dut: Dut) -> None:
    ms = dut.integer("H", 0x1017)
    dut.forget()
    dut.nmt(RESET_COMMUNICATION)
    boot = dut.boot_up()
    beat = dut.expect(0x700 + dut.node_id, "7F", 2 * ms)
    dut.check_ms("boot-up to heartbeat", beat.at_us - boot.at_us, ms)


@error_control("CiA 301 7.5.2.19", "{0:08X}h is refused: {1}", needs=CONSUMER, each=[
    (0x00800064, "node-id 128"), (0x01700064, "reserved bits"), (0xFF700064, "reserved bits"),
])  # fmt: skip
def consumer_value(dut: Dut, value: int, _why: str) -> None:
    dut.refuses("I", 0x1016, 1, value, Abort.INVALID_VALUE)


@error_control("CiA 301 7.5.2.32", "1029h:1 = 3 is refused", needs=((0x1029, 1),))
def behaviour_refused(dut: Dut) -> None:
    dut.refuses("B", 0x1029, 1, 3, Abort.TOO_HIGH)


@emcy("CiA 301 7.5.2.4", "a full history drops the oldest", needs=HISTORY)
def history_full(dut: Dut) -> None:
    clear(dut)
    for _ in range(10):
        make_error(dut)
        cure_error(dut)
    dut.holds("B", 0x1003, 0, 8)
    dut.read(0x1003, 8)


@emcy("CiA 301 7.5.2.4", "the history outlives {1}", needs=HISTORY, each=[
    (RESET_COMMUNICATION, "reset communication"), (RESET_NODE, "reset node"),
])  # fmt: skip
def history_reset(dut: Dut, command: int, _name: str) -> None:
    clear(dut)
    make_error(dut)
    dut.reset(command)
    dut.holds("B", 0x1003, 0, 1)


@emcy("CiA 301 7.5.2.18", "many messages wait, in their order", needs=INHIBIT)
def queue(dut: Dut) -> None:
    dut.put("H", 0x1015, 0, 20)
    for _ in range(12):
        break_sync(dut)
        dut.send(0x080)
    for _ in range(12):
        dut.expect(0x80 + dut.node_id, "40 82 *")
        dut.expect(0x80 + dut.node_id, "00 00 *")


@emcy("CiA 301 7.2.7.1", "another node sends this node's heartbeat: EMCY 8150h, once", needs=NEEDS)
def collision(dut: Dut) -> None:
    for _ in range(3):
        dut.send(0x700 + dut.node_id, "05")
    dut.expect(0x80 + dut.node_id, "50 81 11 *")
    dut.silence(0x80 + dut.node_id)


@emcy("CiA 301 7.2.7.1", "an identifier that a TPDO has left may be another node's", needs=(*NEEDS, (0x1800, 1)))
def no_collision(dut: Dut) -> None:
    cob_id = dut.integer("I", 0x1800, 1)
    dut.nmt(START)
    dut.put("I", 0x1800, 1, cob_id | INVALID)
    dut.send(cob_id & 0x7FF, bytes(8))
    dut.silence(0x80 + dut.node_id)
    dut.put("I", 0x1800, 1, cob_id)
    dut.send(cob_id & 0x7FF, bytes(8))
    dut.expect(0x80 + dut.node_id, "50 81 *")


@identity("CiA 404 1000h", "device profile 404, an analogue input block")
def profile(dut: Dut) -> None:
    dut.holds("I", 0x1000, 0, 0x00020194)


@identity("CiA 301 7.5.2.21", "product code: tipforce, the number of gauges is 3 to 8")
def product(dut: Dut) -> None:
    code = dut.integer("I", 0x1018, 2)
    check(code & 0xFFFFFC00 == 0x54500000 and 3 <= code & 0xFF <= 8, "545000nnh to 545003nnh", f"{code:08X}h")


@identity(
    "CiA 301 7.5.2.24",
    "1021h begins as an EDS does; 1022h says that it is not compressed",
    needs=((0x1021, 0), (0x1022, 0)),
)
def eds(dut: Dut) -> None:
    dut.ask("40 21 10 00", "41 21 10 00 *")
    first = dut.ask("60", "00 *")
    check(first[1:].startswith(b"["), "[FileInfo]", first[1:].hex(" "))
    dut.request("80 21 10 00 00 00 00 08")
    dut.holds("H", 0x1022, 0, 0)


@identity("CiA 301 7.5.2.24", "1021h cannot be written", needs=((0x1022, 0),))
def eds_constant(dut: Dut) -> None:
    dut.request("21 21 10 00 04")
    dut.aborted(0x1021, 0, Abort.READ_ONLY)


COMMUNICATION = ((0x1010, 2), (0x1011, 2), (0x1016, 1))
APPLICATION = ((0x1010, 3), (0x1011, 3), (0x6114, 1))


@storage("CiA 301 7.5.2.13", "1010h:{0} reads 1: the device stores on command", each=[(1,), (2,), (3,), (4,)])
def capability(dut: Dut, sub: int) -> None:
    if dut.try_write(0x1010, sub, struct.pack("<I", LOAD)) not in WRONG_SIGNATURE:
        raise NotApplicableError("the device has nowhere to store")
    dut.holds("I", 0x1010, sub, 1)


@storage("CiA 301 7.2.8.2.1.6", "reset communication leaves the application's parameters", needs=((0x6114, 1),))
def application_kept(dut: Dut) -> None:
    dut.put("I", 0x6114, 1, 777)
    dut.reset(RESET_COMMUNICATION)
    dut.holds("I", 0x6114, 1, 777)
    dut.reset(RESET_NODE)
    dut.holds("I", 0x6114, 1, 500)


@storage(
    "CiA 301 7.5.2.13",
    "communication and application are stored each for itself",
    needs=(*COMMUNICATION, *APPLICATION),
    persistent=True,
)
def separate(dut: Dut) -> None:
    with restored(dut):
        dut.put("I", 0x1016, 1, VALUE)
        dut.put("I", 0x6114, 1, 777)
        store(dut, 3)
        dut.reset(RESET_NODE)
        dut.holds("I", 0x1016, 1, 0)
        dut.holds("I", 0x6114, 1, 777)


@storage(
    "CiA 301 7.5.2.14",
    "1011h:{0} leaves the other group as it is stored",
    needs=(*COMMUNICATION, *APPLICATION),
    persistent=True,
    each=[(2, 0, 777), (3, VALUE, 500)],
)
def restore_one(dut: Dut, sub: int, communication: int, application: int) -> None:
    with restored(dut):
        dut.put("I", 0x1016, 1, VALUE)
        dut.put("I", 0x6114, 1, 777)
        store(dut, 1)
        dut.put("I", 0x1011, sub, LOAD)
        dut.reset(RESET_NODE)
        dut.holds("I", 0x1016, 1, communication)
        dut.holds("I", 0x6114, 1, application)


@storage("CiA 301 7.5.2.13", "a state is not stored: {2}", needs=ALL, persistent=True, each=[
    (0x2130, "H", "the command 2130h", 2, 0), (0x2103, "I", "the expected CRC 2103h:1", 0x12345678, 0),
])  # fmt: skip
def state(dut: Dut, index: int, kind: str, _name: str, value: int, after: int) -> None:
    sub = 1 if index == 0x2103 else 0
    with restored(dut):
        dut.put(kind, index, sub, value)
        store(dut, 1)
        dut.reset(RESET_NODE)
        dut.holds(kind, index, sub, after)


@sync(
    "CiA 301 7.5.2.5",
    "1005h = {0:08X}h is refused: {1}",
    needs=((0x1005, 0),),
    each=[
        (0x40000080, "this device produces no SYNC"),
        (0x20000080, "no 29-bit identifier"),
        (0x00000880, "no 29-bit identifier"),
    ],
)
def refused(dut: Dut, value: int, _why: str) -> None:
    dut.refuses("I", 0x1005, 0, value, Abort.INVALID_VALUE)


@sync("CiA 301 7.2.7.1", "a SYNC of the right length cures 8240h", needs=LENGTH)
def length_cured(dut: Dut) -> None:
    for _ in range(2):
        dut.send(0x080, "01")
        dut.expect(0x80 + dut.node_id, "40 82 *")
        dut.send(0x080)
        dut.expect(0x80 + dut.node_id, "00 00 00 *")


@sync("CiA 301 7.2.7.1", "many SYNCs of wrong length are one error", needs=LENGTH)
def length_once(dut: Dut) -> None:
    for _ in range(5):
        dut.send(0x080, "01")
    dut.expect(0x80 + dut.node_id, "40 82 *")
    dut.silence(0x80 + dut.node_id)


@time(
    "CiA 301 7.5.2.15",
    "1012h = {0:08X}h is refused: {1}",
    needs=TIME,
    each=[
        (0xC0000100, "this device produces no TIME"),
        (0xA0000100, "no 29-bit identifier"),
        (0x80000900, "no 29-bit identifier"),
    ],
)
def time_refused(dut: Dut, value: int, _why: str) -> None:
    dut.refuses("I", 0x1012, 0, value, Abort.INVALID_VALUE)


CONTROLLER, BUS_OFF, RESTARTED = 0x004, 0x040, 0x100
PASSIVE, OVERFLOW, ACTIVE = "00 30 00 00 00 00 00 00", "00 01 00 00 00 00 00 00", "00 40 00 00 00 00 00 00"
NONE = "00 00 00 00 00 00 00 00"


def report(dut: Dut, error_class: int, data: str = NONE) -> None:
    """An error frame of the controller."""
    dut.send(ERROR_FLAG | error_class, data)


@bus_faults("CiA 301 7.2.7.1", "error passive: EMCY 8120h once; active again: the cure", error_frames=True)
def passive(dut: Dut) -> None:
    report(dut, CONTROLLER, PASSIVE)
    report(dut, CONTROLLER, PASSIVE)
    dut.expect(0x80 + dut.node_id, "20 81 11 *")
    dut.silence(0x80 + dut.node_id)
    report(dut, CONTROLLER, ACTIVE)
    dut.expect(0x80 + dut.node_id, "00 00 00 *")


@bus_faults("CiA 301 7.2.7.1", "overrun: EMCY 8110h once, cured when none came for a second", error_frames=True)
def overrun(dut: Dut) -> None:
    for _ in range(3):
        report(dut, CONTROLLER, OVERFLOW)
    dut.expect(0x80 + dut.node_id, "10 81 11 *")
    dut.silence(0x80 + dut.node_id, ms=900)
    dut.expect(0x80 + dut.node_id, "00 00 00 *")


@bus_faults("CiA 301 7.2.7.1", "bus-off: silent, and EMCY 8140h when it is over", error_frames=True)
def bus_off(dut: Dut) -> None:
    dut.beat()
    report(dut, BUS_OFF)
    dut.forget()
    dut.silence(0x700 + dut.node_id, ms=50)
    report(dut, RESTARTED)
    dut.expect(0x80 + dut.node_id, "40 81 *")
    dut.ask("40 00 10 00", "43 00 10 00 *")


@bus_faults("CiA 301 7.5.2.32", "bus-off in OPERATIONAL: PRE-OPERATIONAL by 1029h", error_frames=True)
def bus_off_behaviour(dut: Dut) -> None:
    dut.beat()
    dut.nmt(START)
    dut.state(OPERATIONAL)
    report(dut, BUS_OFF)
    report(dut, RESTARTED)
    dut.state(PRE_OPERATIONAL)


@bus_faults("CiA 301 7.2.7.1", "bus-off twice in a row: both are reported", error_frames=True)
def bus_off_again(dut: Dut) -> None:
    for _ in range(2):
        report(dut, BUS_OFF)
        dut.sleep(10)
        report(dut, RESTARTED)
        dut.expect(0x80 + dut.node_id, "40 81 *")
