"""Beyond the standard: SDO, NMT, error control, EMCY, identity, storage, SYNC, TIME and the CAN controller's faults."""

import struct

from canopen_conformance import steps as do
from canopen_conformance import wire
from canopen_conformance.case import Service, check, need
from canopen_conformance.cases import emcy as special
from canopen_conformance.cases import sdo_block
from canopen_conformance.cases.emcy import HISTORY, INHIBIT, NEEDS, break_sync, clear, cure_error, make_error
from canopen_conformance.cases.identity import ALL, LOAD, VALUE, WRONG_SIGNATURE, restored, store
from canopen_conformance.cases.nmt import CONSUMER, GUARDING, PRODUCER
from canopen_conformance.cases.pdo import TPDO1, disable_pdo, enable_pdo, start_tpdo1
from canopen_conformance.cases.sdo import BEAT, UPLOADED, begin_download, begin_upload, not_written, over, read_all
from canopen_conformance.dut import Dut
from canopen_conformance.wire import EMCY, HEARTBEAT, PDO, SDO, Abort

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
    do.put("H", 0x1017, 0, 5000), do.send(HEARTBEAT | wire.REMOTE_FLAG), do.silence(HEARTBEAT))


@error_control("7.2.8.3.2.2: the boot-up message starts the first period of the default 1017h", PRODUCER)
def first_period(dut: Dut) -> None:
    ms = dut.integer("H", 0x1017)
    dut.forget()
    dut.nmt(wire.RESET_COMMUNICATION)
    boot = dut.boot_up()
    beat = dut.expect(HEARTBEAT, "7F", 2 * ms)
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
    do.repeat(12, do.expect(EMCY, "40 82 *"), do.expect(EMCY, "00 00 *")))
emcy("collision 7.2.7.1: another node sends this node's heartbeat: EMCY 8150h, once", NEEDS,
    do.repeat(3, do.send(HEARTBEAT, "05")), do.expect(EMCY, "50 81 11 *"), do.silence(EMCY))
emcy("no_collision 7.2.7.1: an identifier that a TPDO has left may be another node's", (*NEEDS, *TPDO1),
    start_tpdo1, do.run(disable_pdo, 0x1800), do.send(PDO, bytes(8)), do.silence(EMCY), do.run(enable_pdo, 0x1800),
    do.send(PDO, bytes(8)), do.expect(EMCY, "50 81 *"))
identity("profile CiA 404 1000h: device profile 404, an analogue input block", (),
    do.holds("I", 0x1000, 0, 0x00020194))


@identity("7.5.2.21: product code: tipforce, the number of gauges is 3 to 8")
def product(dut: Dut) -> None:
    code = dut.integer("I", 0x1018, 2)
    check(code & 0xFFFFFC00 == 0x54500000 and 3 <= code & 0xFF <= 8, "545000nnh to 545003nnh", f"{code:08X}h")


identity("eds 7.5.2.24: 1021h begins as an EDS does; 1022h says that it is not compressed", ((0x1021, 0), (0x1022, 0)),
    do.ask("40 21 10 00", "41 21 10 00 *"), do.ask("60", f"00 {ord('['):02X} *"),  # [FileInfo]
    do.abort(0x1021), do.holds("H", 0x1022, 0, 0))
identity("eds_constant 7.5.2.24: 1021h cannot be written", ((0x1022, 0),),
    do.request("21 21 10 00 04"), do.aborted(0x1021, 0, Abort.READ_ONLY))


COMMUNICATION = ((0x1010, 2), (0x1011, 2), (0x1016, 1))
APPLICATION = ((0x1010, 3), (0x1011, 3), (0x6114, 1))


@storage("7.5.2.13: 1010h:{0} reads 1: the device stores on command", each=[(1,), (2,), (3,), (4,)])
def capability(dut: Dut, sub: int) -> None:
    stores = dut.try_write(0x1010, sub, struct.pack("<I", LOAD)) in WRONG_SIGNATURE
    need(stores, "the device has nowhere to store")
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
for index, sub, kind, name, value in (
    (0x2130, 0, "H", "the command 2130h", 2), (0x2103, 1, "I", "the expected CRC 2103h:1", 0x12345678),
):
    storage(f"state 7.5.2.13: a state is not stored: {name}", ALL,
        do.within(restored, do.put(kind, index, sub, value), do.run(store, 1), do.reset(wire.RESET_NODE),
            do.holds(kind, index, sub, 0)), persistent=True)


for value, why in (
    (0x40000080, "this device produces no SYNC"), (0x20000080, "no 29-bit identifier"),
    (0x00000880, "no 29-bit identifier"),
):
    sync(f"refused 7.5.2.5: 1005h = {value:08X}h is refused: {why}", ((0x1005, 0),),
        do.refuses("I", 0x1005, 0, value, Abort.INVALID_VALUE))
sync("length_cured 7.2.7.1: a SYNC of the right length cures 8240h", special.LENGTH,
    do.repeat(2, do.send(0x080, "01"), do.expect(EMCY, "40 82 *"), do.send(0x080), do.expect(EMCY, "00 00 00 *")))
sync("length_once 7.2.7.1: many SYNCs of wrong length are one error", special.LENGTH,
    do.repeat(5, do.send(0x080, "01")), do.expect(EMCY, "40 82 *"), do.silence(EMCY))
for value, why in (
    (0xC0000100, "this device produces no TIME"), (0xA0000100, "no 29-bit identifier"),
    (0x80000900, "no 29-bit identifier"),
):
    time(f"refused 7.5.2.15: 1012h = {value:08X}h is refused: {why}", special.TIME,
        do.refuses("I", 0x1012, 0, value, Abort.INVALID_VALUE))


# Error frames of the controller.
CONTROLLER = wire.ERROR_FLAG | 0x004
passive, active = do.send(CONTROLLER, "00 30 00 00 00 00 00 00"), do.send(CONTROLLER, "00 40 00 00 00 00 00 00")
overflow = do.send(CONTROLLER, "00 01 00 00 00 00 00 00")
bus_off, restarted = do.send(wire.ERROR_FLAG | 0x040, bytes(8)), do.send(wire.ERROR_FLAG | 0x100, bytes(8))
bus_faults("passive 7.2.7.1: error passive: EMCY 8120h once; active again: the cure", (),
    do.repeat(2, passive), do.expect(EMCY, "20 81 11 *"), do.silence(EMCY), active, do.expect(EMCY, "00 00 00 *"),
    error_frames=True)
bus_faults("overrun 7.2.7.1: overrun: EMCY 8110h once, cured when none came for a second", (),
    do.repeat(3, overflow), do.expect(EMCY, "10 81 11 *"), do.silence(EMCY, ms=900),
    do.expect(EMCY, "00 00 00 *"), error_frames=True)
bus_faults("bus_off 7.2.7.1: bus-off: silent, and EMCY 8140h when it is over", (),
    do.beat(), bus_off, do.forget(), do.silence(HEARTBEAT, ms=50), restarted,
    do.expect(EMCY, "40 81 *"), do.ask("40 00 10 00", "43 00 10 00 *"), error_frames=True)
bus_faults("bus_off_behaviour 7.5.2.32: bus-off in OPERATIONAL: PRE-OPERATIONAL by 1029h", (),
    do.beat(), do.nmt(wire.START), do.state(wire.OPERATIONAL), bus_off, restarted, do.state(wire.PRE_OPERATIONAL),
    error_frames=True)
bus_faults("bus_off_again 7.2.7.1: bus-off twice in a row: both are reported", (),
    do.repeat(2, bus_off, do.sleep(10), restarted, do.expect(EMCY, "40 81 *")), error_frames=True)


# --- SDO: expedited, in segments, by blocks

sdo = Service("sdo", own=True)
segmented = Service("sdo_segmented", own=True)
block_upload = Service("sdo_block", own=True)
download = Service("sdo_block_download", own=True)


for index, sub in ((0x2104, 0), (0x2105, 3), (0x6125, 1)):
    sdo(f"write_only 7.2.4.3.17: 06010001h: a read of {index:04X}h:{sub}, which can only be written", (),
        do.request(struct.pack("<BHB", 0x40, index, sub)), do.aborted(index, sub, Abort.WRITE_ONLY))
for index, sub, kind, value in ((0x6114, 1, "I", 99), (0x6112, 1, "B", 0), (0x61A1, 1, "H", 0)):
    sdo(f"value_low 7.2.4.3.17: 06090032h: a value below the limit of {index:04X}h:{sub}", (),
        do.unchanged(((index, sub),), do.refuses(kind, index, sub, value, Abort.TOO_LOW)))


RECORD = ((0x2141, 0),)


segmented("upload_restart 7.2.4.2.5: a new initiate gives up the upload that went on", (),
    begin_upload, do.ask("60", "0. *"), begin_upload, read_all)
segmented("upload_timeout 7.2.4.3.17: a silent client: 05040000h, and the transfer is over", (),
    begin_upload, do.aborted(UPLOADED, 0, Abort.TIMED_OUT, within_ms=1200), over)
segmented("upload_patience 7.2.4.3.17: each request gives the client its time anew", (),
    begin_upload, do.silence(SDO, ms=700), do.ask("60", "0. *"), do.silence(SDO, ms=700),
    do.ask("70", lambda data: data[0] & 0xF0 == 0x10))
for index, size, code in (
    (0x1017, 1, Abort.TOO_SHORT), (0x1017, 3, Abort.TOO_LONG), (0x2141, 5, Abort.TOO_SHORT),
    (0x2141, 0x10000, Abort.TOO_LONG), (0x1017, 0, Abort.TOO_SHORT),
):
    segmented("download_stated 7.2.4.3.3: a stated size that the object cannot have is refused at the initiate", (),
        do.request(struct.pack("<BHBI", 0x21, index, 0, size)), do.aborted(index, 0, code))
for index, sub, code, why in (
    (0x1008, 0, Abort.READ_ONLY, "a read-only object"), (0xFFFF, 0, Abort.NO_OBJECT, "no object"),
    (0x1018, 9, Abort.NO_SUB, "no sub-index"),
):
    segmented(f"download_refused 7.2.4.3.3: refused at the initiate: {why}", (),
        do.request(struct.pack("<BHBI", 0x21, index, sub, 20)), do.aborted(index, sub, code),
        do.ask("00", lambda data: data[0] == 0x80))
segmented("download_restart 7.2.4.2.2: a new initiate gives up the download that went on", BEAT,
    begin_download, do.ask("0C 99", "20"), begin_download, do.ask("0B 34 12", "20"), do.holds("H", 0x1017, 0, 0x1234))
segmented("download_timeout 7.2.4.3.17: a silent client: 05040000h, nothing is written", BEAT,
    not_written(begin_download, do.aborted(0x1017, 0, Abort.TIMED_OUT, within_ms=1200)))
another_record = do.late(lambda dut: bytes(len(dut.read(0x2141)) - 1) + b"\1")()
segmented("download_many 7.2.4.3.4: many segments: a whole record is written and read back", RECORD,
    do.refuses_bytes(0x2141, 0, another_record, 0), do.reads(0x2141, 0, another_record))
LONG = ((0x1021, 0),)
block_upload("acknowledged_too_much 7.2.4.3.14: ackseq beyond what was sent: 05040003h", (),
    sdo_block.begun_upload, do.request("A2 02 7F"), do.aborted(UPLOADED, 0, Abort.SEQUENCE_NUMBER))


def switched(dut: Dut, index: int, switch: int, command: int) -> None:
    """The answer to the initiate of a block upload is this command."""
    answer = sdo_block.initiate(dut, index, 127, switch)
    check(answer[0] == command, f"{command:02X}h", f"{answer[0]:02X}h")


for switch, how, command in ((4, "expedited", 0x43), (255, "expedited", 0x43), (3, "block", 0xC6), (0, "block", 0xC6)):
    block_upload(f"protocol_switch 7.2.4.3.13: protocol switch: 4 bytes and pst {switch} give a {how} upload",
        ((0x1000, 0),),
        do.run(switched, 0x1000, switch, command))
block_upload("protocol_switch_segmented 7.2.4.3.13: protocol switch to a segmented upload", (),
    do.run(switched, 0x1008, 100, 0x41), do.read_segments())


@block_upload("7.2.4.3.14: full blocks of 127 segments", LONG)
def full_block(dut: Dut) -> None:
    dut.ask("40 21 10 00", "41 21 10 00 *")
    dut.data = b"".join(dut.ask("70" if number % 2 else "60")[1:] for number in range(130))
    dut.abort(0x1021)
    sdo_block.initiate(dut, 0x1021, 127)
    dut.request("A3")
    sdo_block.block(dut)
    dut.request("A2 7F 02")
    sdo_block.block(dut, 127, 2)
    dut.abort(0x1021)


block_upload("restart 7.2.4.2.13: an initiate gives up the block upload that went on", (),
    sdo_block.begun_upload, do.ask("40 00 10 00", "43 00 10 00 *"))
for words, why in (
    ("A2 01 7F", "an answer before the start"), ("A1", "an end before the start"),
    ("60", "a segment of another transfer"),
):
    block_upload(f"wrong_command 7.2.4.3.17: {why}: 05040001h", (),
        do.run(sdo_block.begun_upload, False), do.request(words), do.aborted(UPLOADED, 0, Abort.UNKNOWN_COMMAND))
for started, when in ((False, "before the start"), (True, "after a block")):
    block_upload(f"silent_client 7.2.4.3.17: a client that is silent {when}: 05040000h", (),
        do.run(sdo_block.begun_upload, started), do.aborted(UPLOADED, 0, Abort.TIMED_OUT, within_ms=1200))


def begin_record(dut: Dut) -> None:
    """Initiate the block download of a record that is not the present one."""
    dut.data = bytes(len(dut.read(0x2141)) - 1) + b"\1"
    sdo_block.begin_block_download(dut, 0x2141, len(dut.data))


def send(dut: Dut, first: int = 0, *places: slice) -> None:
    """Send the block of the data from segment ``first`` on, or these places of it."""
    block = sdo_block.segments(dut, first)
    for place in places or (slice(None),):
        for segment in block[place]:
            dut.request(segment)


def end_record(dut: Dut, first: int = 0) -> None:
    """The answer to the block from segment ``first`` on, the end of the transfer, and the record that is read back."""
    dut.answer(f"A2 {len(sdo_block.segments(dut, first)):02X} ..")
    sdo_block.end_block_download(dut, dut.data)
    dut.answer("A1")
    dut.reads(0x2141, 0, dut.data)


download("many 7.2.4.3.10: many segments: the whole record is written", RECORD,
    begin_record, send, end_record)
download("lost_segment 7.2.4.3.10: a segment is lost: ackseq names the one before it, and the rest is sent again",
    RECORD,
    begin_record, do.run(send, 0, slice(2), slice(3, None)), do.answer("A2 02 .."), do.run(send, 2),
    do.run(end_record, 2))
download("twice 7.2.4.3.10: a segment that comes twice counts once", RECORD,
    begin_record, do.run(send, 0, slice(2), slice(1, None)), end_record)
all_but_one = do.late(lambda dut: f"A2 {len(sdo_block.segments(dut)) - 1:02X} ..")()
download("lost_last 7.2.4.3.10: the last segment is lost: the server says after a while what it has", RECORD,
    begin_record, do.run(send, 0, slice(-1)), do.answer(all_but_one, within_ms=900), do.run(send, -1),
    do.run(end_record, -1))
download("too_much 7.2.4.3.10: more data than stated: 06070012h, before the end", BEAT,
    do.run(sdo_block.begin_block_download, 0x1017, 2), do.run(sdo_block.segment, 1, bytes(7)),
    do.aborted(0x1017, 0, Abort.TOO_LONG))
for size, code in ((1, Abort.TOO_SHORT), (3, Abort.TOO_LONG), (0xFFFFFFFF, Abort.TOO_LONG)):
    download("refused_size 7.2.4.3.9: a size that the object cannot have is refused at the initiate", BEAT,
        do.request(struct.pack("<BHBI", 0xC6, 0x1017, 0, size)), do.aborted(0x1017, 0, code))
download("silent_client 7.2.4.3.17: a client that is silent during a block: 05040000h", BEAT,
    do.run(sdo_block.begin_block_download, 0x1017, 2), do.answer("A2 00 .. 00 00 00 00 00", within_ms=900),
    do.aborted(0x1017, 0, Abort.TIMED_OUT, within_ms=1200))
download("silent_client 7.2.4.3.17: a client that is silent before the end: 05040000h", BEAT,
    sdo_block.one_segment, do.aborted(0x1017, 0, Abort.TIMED_OUT, within_ms=1200))
download("wrong_end 7.2.4.3.11: no end but another command: 05040001h", BEAT,
    sdo_block.one_segment, do.request("C2"), do.aborted(0x1017, 0, Abort.UNKNOWN_COMMAND))
