"""LSS slave: switch state, configure, inquire, identify (CiA 305). All cases select the device by its identity, so that
other slaves stay as they are; two switch all of them to configuration and back (switch state global)."""

import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from canopen_conformance import steps as do
from canopen_conformance.case import NotApplicableError, Service, check, need
from canopen_conformance.dut import Dut
from canopen_conformance.wire import RESET_COMMUNICATION, RESET_NODE, STOP

# fmt: off
# A table: a case is its header, and below it its steps.

case = Service("lss", standard="CiA 305")
numbered = Service("lss_identify", standard="CiA 305")
unnumbered = Service("lss_unconfigured", standard="CiA 305")

IDENTITY = ((0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4))
MASTER, SLAVE = 0x7E5, 0x7E4
SELECTIVE, IDENTIFY = 0x40, 0x46  # the first request of each
UNCONFIGURED, START_SCAN = 255, 0x80
OTHER_ID = 0x5D
PARTS = ("vendor-ID", "product code", "revision number", "serial number")


def say(dut: Dut, service: int, *data: int, number: int | None = None) -> None:
    """One LSS request: the service, then bytes or one UNSIGNED32."""
    content = bytes((service, *data)) if number is None else struct.pack("<BI", service, number)
    dut.send(MASTER, content + bytes(8 - len(content)))


def say_each(dut: Dut, first: int, numbers: Sequence[int], parts: Iterable[int] | None = None) -> None:
    """A request for each part; those of IDENTIFY: vendor, product, revision and serial number from, to."""
    for part in range(len(numbers)) if parts is None else parts:
        say(dut, first + part, number=numbers[part])


waiting = do.run(say, 0x04, 0)  # switches all slaves to the waiting state
then_waiting = do.undone_by(waiting)
own = do.late(lambda dut: dut.identity)()
other = do.late(lambda dut, part: [number ^ (k == part) for k, number in enumerate(dut.identity)])


def slave_answer(dut: Dut, wanted: bytes | None = None) -> bytes:
    """The answer of the slave; without one the case is not applicable."""
    answer = dut.heard(SLAVE)
    if answer is None:
        raise NotApplicableError("no LSS slave")
    check(wanted in (None, answer.data), (wanted or b"").hex(" "), answer.data.hex(" "))
    return answer.data


@contextmanager
def configuring(dut: Dut) -> Iterator[None]:
    """Configuration state within, waiting state after; not applicable without LSS."""
    say_each(dut, SELECTIVE, dut.identity)
    data = slave_answer(dut)
    check(data[0] == 0x44, "7E4#44...", data.hex(" "))
    with then_waiting(dut):
        yield


def in_configuration(dut: Dut) -> bool:
    """Whether the device answers what only the configuration state answers."""
    say(dut, 0x5E)
    return dut.heard(SLAVE, 30) is not None


case("global_configuration 6.3.1: switch state global, configuration: inquiries are answered", IDENTITY,
    do.within(then_waiting, do.run(say, 0x04, 1), do.run(say, 0x5E), slave_answer))
case("global_waiting 6.3.1: switch state global, waiting: inquiries are not answered", IDENTITY,
    do.within(configuring), do.run(say, 0x5E), do.silence(SLAVE))
for mode in (2, 255):
    case(f"global_mode 6.3.1: switch state global with mode {mode} does nothing", IDENTITY,
        do.run(say, 0x04, mode), do.run(say, 0x5E), do.silence(SLAVE))


case("selective 6.3.2: switch state selective: answer 44h, then configuration", IDENTITY,
    do.run(say_each, SELECTIVE, own), do.within(then_waiting,
        do.run(slave_answer, b"\x44" + bytes(7)), do.run(say, 0x5E), do.expect(SLAVE)))
for part, name in enumerate(PARTS):
    case(f"selective_other 6.3.2: switch state selective with another {name}: silence", IDENTITY,
        do.run(say_each, SELECTIVE, other(part)), do.run(say, 0x5E), do.silence(SLAVE))
case("selective_incomplete 6.3.2: switch state selective without its first request: silence", IDENTITY,
    do.run(say_each, SELECTIVE, own, range(1, 4)), do.silence(SLAVE))
case("selective_order 6.3.2: switch state selective in another order: silence", IDENTITY,
    do.run(say_each, SELECTIVE, own, (3, 2, 1, 0)), do.silence(SLAVE))
case("selective_again 6.3.2: after a wrong selection the right one selects", IDENTITY,
    do.run(say_each, SELECTIVE, other(1)), do.silence(SLAVE, ms=5), do.within(configuring))
told_part = do.late(lambda dut, part: struct.pack("<BIxxx", 0x5A + part, dut.identity[part]).hex())
told_id = do.late(lambda dut: f"5E {dut.node_id:02X} 00 00 00 00 00 00")()
for part, name in enumerate(PARTS):
    case(f"inquire 6.5: inquire {name}", IDENTITY,
        do.within(configuring, do.run(say, 0x5A + part), do.expect(SLAVE, told_part(part))))
case("inquire_node_id 6.5: inquire node-id", IDENTITY,
    do.within(configuring, do.run(say, 0x5E), do.expect(SLAVE, told_id)))
for service in (0x5A, 0x5D, 0x5E):
    case("inquire_waiting 6.5: an inquiry in the waiting state is not answered", IDENTITY,
        do.run(say, service), do.silence(SLAVE))
for service in (0x00, 0x60, 0xFF):
    case("unknown 6.5: an unknown service is not answered", IDENTITY,
        do.within(configuring, do.run(say, service), do.silence(SLAVE)))
for size in (0, 1, 7):
    case(f"length 6.2: a request of {size} bytes is passed over", IDENTITY,
        do.within(configuring, do.send(MASTER, (b"\x5e" + bytes(7))[:size]), do.silence(SLAVE)))
case("reset 6.2: reset communication leads back to the waiting state", IDENTITY,
    do.within(configuring, do.reset(RESET_COMMUNICATION), do.run(say, 0x5E), do.silence(SLAVE)))


case("stopped CiA 301 7.3.2.3: LSS is served in STOPPED, and nothing else is", IDENTITY,
    lambda dut: dut.identity, do.nmt(STOP), do.within(configuring, do.run(say, 0x5E), do.expect(SLAVE, told_id)))
for node_id in (0, 128, 200, 254):
    case(f"node_id_refused 6.4.1: configure node-id {node_id}: out of range, error 1", IDENTITY,
        do.within(configuring, do.run(say, 0x11, node_id), do.expect(SLAVE, "11 01 00 00 00 00 00 00")))

own_id_again = do.undone_by(do.run(say, 0x11, do.late(lambda dut: dut.node_id)()))
for node_id in (1, 127, 255):
    case(f"node_id_taken 6.4.1: configure node-id {node_id}: taken, and not in use before a reset", IDENTITY,
        do.within(configuring, do.within(own_id_again,
            do.run(say, 0x11, node_id), do.expect(SLAVE, "11 00 00 00 00 00 00 00"),
            do.ask("40 00 10 00", "43 00 10 00 *"))), persistent=True)


@contextmanager
def renumbered(dut: Dut, node_id: int) -> Iterator[None]:
    """The device with this node-id, or without one, from a reset on; with its own after."""
    old = dut.node_id
    with configuring(dut):
        say(dut, 0x11, node_id)
        answer = dut.expect(SLAVE).data
    check(node_id == UNCONFIGURED or not answer[1], "the node-id to be taken", answer.hex(" "))
    need(not answer[1], "node-id 255 is refused")
    try:
        dut.nmt(RESET_COMMUNICATION)
        dut.node_id = node_id
        yield
    finally:  # whatever node-id it has now
        waiting(dut)
        say_each(dut, SELECTIVE, dut.identity)
        dut.heard(SLAVE)
        say(dut, 0x11, old)
        dut.heard(SLAVE)
        dut.forget()
        waiting(dut)  # a device without a node-id boots now
        if dut.node_id != UNCONFIGURED:
            dut.nmt(RESET_COMMUNICATION)
        dut.node_id = old
        dut.boot_up()


def follows(dut: Dut, index: int, sub: int, base: int) -> None:
    """Check that an identifier, if the device has it, follows the node-id."""
    if dut.exists(index, sub):
        dut.holds("I", index, sub, base + dut.node_id)


case("node_id_changed 6.4.1: the new node-id is in use after reset communication", IDENTITY,
    do.within(partial(renumbered, node_id=OTHER_ID), do.boot_up(), do.ask("40 00 10 00", "43 00 10 00 *"),
        do.run(follows, 0x1014, 0, 0x80), do.run(follows, 0x1200, 1, 0x600)), persistent=True)
for table, index, error in (*((0, index, 0) for index in (0, 2, 3, 4, 8)), (0, 5, 1), (0, 10, 1), (1, 0, 1)):
    case(f"bit_timing 6.4.2: configure bit timing, table {table}, index {index}: error {error}", IDENTITY,
        do.within(configuring, do.run(say, 0x13, table, index), do.expect(SLAVE, f"13 {error:02X} *"),
            do.run(say, 0x13, 0, 0)), persistent=True)
case("store 6.4.3: store configuration: error 0", IDENTITY,
    do.within(configuring, do.run(say, 0x17), do.expect(SLAVE, "17 00 00 00 00 00 00 00", 2000)), persistent=True)
for service, value in ((0x11, OTHER_ID), (0x13, 0), (0x17, 0)):
    case("configure_waiting 6.4: configuration services in the waiting state do nothing", IDENTITY,
        do.run(say, service, value), do.silence(SLAVE), do.reset(RESET_COMMUNICATION))


@do.late
def ranges(dut: Dut, part: int = 0, step: int = 0) -> list[int]:
    """The six numbers that this device alone fits, with a step more of one part."""
    numbers = [dut.identity[k] for k in (0, 1, 2, 2, 3, 3)]
    numbers[part] += step
    need(0 <= numbers[part] <= 0xFFFFFFFF, "the identity lies at the end of the range")
    return numbers


numbered("identified 6.6.1: identify remote slave: a device in the ranges answers 4Fh", IDENTITY,
    do.run(say_each, IDENTIFY, ranges()), do.run(slave_answer, b"\x4f" + bytes(7)))
widest = do.late(lambda dut: [*dut.identity[:2], 0, 0xFFFFFFFF, 0, 0xFFFFFFFF])()
numbered("identified_in_range 6.6.1: identify remote slave: the ends of the ranges may lie apart", IDENTITY,
    do.run(say_each, IDENTIFY, widest), slave_answer)
for part, step, name in (
    (0, 1, "the vendor-ID"), (1, 1, "the product code"), (2, 1, "a revision from above"),
    (3, -1, "a revision to below"), (4, 1, "a serial number from above"), (5, -1, "a serial number to below"),
):
    numbered(f"not_identified 6.6.1: identify remote slave: {name} is not this device's: silence", IDENTITY,
        do.run(say_each, IDENTIFY, ranges(part, step)), do.silence(SLAVE))
numbered("identify_order 6.6.1: identify remote slave in another order: silence", IDENTITY,
    do.run(say_each, IDENTIFY, ranges(), (5, 4, 3, 2, 1, 0)), do.silence(SLAVE))
numbered("configured 6.6.3: identify non-configured remote slave: a device with a node-id is silent", (),
    do.run(say, 0x4C), do.silence(SLAVE))
numbered("configured_fastscan 6.6.4: fastscan: a device with a node-id is silent", (),
    do.run(say, 0x51, 0, 0, 0, 0, 0x80), do.silence(SLAVE))


@contextmanager
def unconfigured(dut: Dut) -> Iterator[None]:
    """The device without a node-id within, with its own after."""
    with renumbered(dut, UNCONFIGURED):
        dut.sleep(10)
        dut.forget()
        yield


def scan(dut: Dut, number: int, bit: int, part: int, following: int) -> bool:
    """One request of fastscan; whether a device says yes."""
    dut.send(MASTER, bytes((0x51,)) + number.to_bytes(4, "little") + bytes((bit, part, following)))
    return dut.heard(SLAVE, 20) is not None


def scanned(dut: Dut, answered: bool, number: int, bit: int, part: int, following: int) -> None:
    """Check whether the device answers a request of fastscan."""
    said = [f"{'an answer' if yes else 'silence'} to {number:08X}h in part {part}" for yes in (answered, not answered)]
    check(scan(dut, number, bit, part, following) == answered, *said)


@unnumbered("6.3.2: without a node-id: no boot-up, no answer to NMT and SDO", IDENTITY, persistent=True)
def silent(dut: Dut) -> None:
    old = dut.node_id
    with unconfigured(dut):
        for command in (1, RESET_NODE):
            dut.send(0x000, bytes((command, 0)))
        dut.send(0x600 + old, "40 00 10 00 00 00 00 00")
        dut.silence(0x580 + old, 0x700 + old, 0x80 + old, 0x700 + UNCONFIGURED)


unnumbered("identify 6.6.3: identify non-configured remote slave: answer 50h", IDENTITY,
    do.within(unconfigured, do.run(say, 0x4C), do.expect(SLAVE, "50 00 00 00 00 00 00 00")), persistent=True)


unnumbered("inquire 6.5: inquire node-id: 255", IDENTITY,
    do.within(unconfigured, do.within(configuring, do.run(say, 0x5E), do.expect(SLAVE, told_id))), persistent=True)


@unnumbered("6.4.1: a node-id is given: boot-up as soon as configuration is left", IDENTITY, persistent=True)
def boots(dut: Dut) -> None:
    old = dut.node_id
    with unconfigured(dut):
        with configuring(dut):
            say(dut, 0x11, old)
            dut.expect(SLAVE, "11 00 *")
            dut.silence(0x700 + old, ms=10)
        dut.expect(0x700 + old, "00", 5000)
        dut.node_id = old
        dut.ask("40 00 10 00", "43 00 10 00 *")


def start_scan(dut: Dut) -> None:
    """Begin fastscan; not applicable for a device without it."""
    need(scan(dut, 0, START_SCAN, 0, 0), "no fastscan")


@unnumbered("6.6.4: fastscan finds all 128 bits and leads to configuration", IDENTITY, persistent=True)
def fastscan(dut: Dut) -> None:
    with unconfigured(dut):
        start_scan(dut)
        numbers = []
        for part in range(4):
            number = 0
            for bit in range(31, -1, -1):
                if not scan(dut, number, bit, part, part):
                    number |= 1 << bit
            # The number is complete: confirm it, and go on to the next one, after the last to the first.
            scanned(dut, True, number, 0, part, (part + 1) % 4)
            numbers.append(number)
        check(numbers == dut.identity, str(dut.identity), str(numbers))
        check(in_configuration(dut), "the configuration state", "no answer to an inquiry")


changed = do.late(lambda dut, part, bits=0: dut.identity[part] ^ bits)
for part, name in enumerate(PARTS[:2]):
    unnumbered(f"fastscan_other 6.6.4: fastscan with another {name}: silence", IDENTITY,
        do.within(unconfigured, start_scan, do.repeat(part, do.run(scanned, True, changed(0), 0, 0, 1)),
            do.run(scanned, False, changed(part, 0x100), 0, part, part)), persistent=True)
unnumbered("fastscan_order 6.6.4: fastscan of a part that is not its turn: silence", IDENTITY,
    do.within(unconfigured, start_scan, do.run(scanned, False, changed(2), 0, 2, 3)), persistent=True)
unnumbered("fastscan_configuring 6.6.4: fastscan in the configuration state: silence", IDENTITY,
    do.within(unconfigured, do.within(configuring, do.run(scanned, False, 0, START_SCAN, 0, 0))), persistent=True)
