"""LSS slave: switch state, configure, inquire, identify (CiA 305). All cases select the device by its identity, so that
other slaves stay as they are; two switch all of them to configuration and back (switch state global)."""

import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from canopen_conformance import steps as do
from canopen_conformance.case import NotApplicableError, Service, check
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


def identity(dut: Dut) -> list[int]:
    """1018h:1-4."""
    return [dut.integer("I", 0x1018, sub) for sub in (1, 2, 3, 4)]


def say_each(dut: Dut, first: int, numbers: Iterable[tuple[int, int]]) -> None:
    """A request for each (part, number); those of IDENTIFY: vendor, product, revision and serial number from, to."""
    for part, number in numbers:
        say(dut, first + part, number=number)


def select(dut: Dut, numbers: list[int]) -> None:
    """The four requests of "switch state selective"."""
    say_each(dut, SELECTIVE, enumerate(numbers))


waiting = do.run(say, 0x04, 0)  # switches all slaves to the waiting state


def slave_answer(dut: Dut) -> bytes:
    """The answer of the slave; without one the case is not applicable."""
    answer = dut.heard(SLAVE)
    if answer is None:
        raise NotApplicableError("no LSS slave")
    return answer.data


@contextmanager
def configuring(dut: Dut, numbers: list[int] | None = None) -> Iterator[list[int]]:
    """Configuration state within, waiting state after; not applicable without LSS. Yields the identity."""
    own = identity(dut) if numbers is None else numbers
    select(dut, own)
    data = slave_answer(dut)
    check(data[0] == 0x44, "7E4#44...", data.hex(" "))
    try:
        yield own
    finally:
        waiting(dut)


def in_configuration(dut: Dut) -> bool:
    """Whether the device answers what only the configuration state answers."""
    say(dut, 0x5E)
    return dut.heard(SLAVE, 30) is not None


@case("6.3.1: switch state global, configuration: inquiries are answered", IDENTITY)
def global_configuration(dut: Dut) -> None:
    say(dut, 0x04, 1)
    answered = in_configuration(dut)
    waiting(dut)
    if not answered:
        raise NotApplicableError("no LSS slave")


case("global_waiting 6.3.1: switch state global, waiting: inquiries are not answered", IDENTITY,
    do.within(configuring), do.run(say, 0x5E), do.silence(SLAVE))
for mode in (2, 255):
    case(f"global_mode 6.3.1: switch state global with mode {mode} does nothing", IDENTITY,
        do.run(say, 0x04, mode), do.run(say, 0x5E), do.silence(SLAVE))


@case("6.3.2: switch state selective: answer 44h, then configuration", IDENTITY)
def selective(dut: Dut) -> None:
    select(dut, identity(dut))
    data = slave_answer(dut)
    configured = in_configuration(dut)
    waiting(dut)
    check(data == b"\x44" + bytes(7) and configured, "44h and the configuration state", data.hex(" "))


other = do.late(lambda dut, part: [number ^ (k == part) for k, number in enumerate(identity(dut))])
for part, name in enumerate(PARTS):
    case(f"selective_other 6.3.2: switch state selective with another {name}: silence", IDENTITY,
        do.run(select, other(part)), do.run(say, 0x5E), do.silence(SLAVE))
case("selective_incomplete 6.3.2: switch state selective without its first request: silence", IDENTITY,
    lambda dut: say_each(dut, SELECTIVE, list(enumerate(identity(dut)))[1:]), do.silence(SLAVE))
case("selective_order 6.3.2: switch state selective in another order: silence", IDENTITY,
    lambda dut: say_each(dut, SELECTIVE, reversed(list(enumerate(identity(dut))))), do.silence(SLAVE))


@case("6.3.2: after a wrong selection the right one selects", IDENTITY)
def selective_again(dut: Dut) -> None:
    numbers = identity(dut)
    select(dut, [numbers[0], numbers[1] ^ 1, *numbers[2:]])
    dut.silence(SLAVE, ms=5)
    with configuring(dut, numbers):
        pass


@case("6.5: inquire {1}", IDENTITY, each=list(enumerate(PARTS)))
def inquire(dut: Dut, part: int, _name: str) -> None:
    with configuring(dut) as own:
        say(dut, 0x5A + part)
        dut.expect(SLAVE, struct.pack("<BIxxx", 0x5A + part, own[part]).hex())


case("inquire_node_id 6.5: inquire node-id", IDENTITY,
    do.within(configuring, do.run(say, 0x5E), lambda dut: dut.expect(SLAVE, f"5E {dut.node_id:02X} 00 00 00 00 00 00")))
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


@case("CiA 301 7.3.2.3: LSS is served in STOPPED, and nothing else is", IDENTITY)
def stopped(dut: Dut) -> None:
    own = identity(dut)
    dut.nmt(STOP)
    with configuring(dut, own):
        say(dut, 0x5E)
        dut.expect(SLAVE, f"5E {dut.node_id:02X} *")


for node_id in (0, 128, 200, 254):
    case(f"node_id_refused 6.4.1: configure node-id {node_id}: out of range, error 1", IDENTITY,
        do.within(configuring, do.run(say, 0x11, node_id), do.expect(SLAVE, "11 01 00 00 00 00 00 00")))


@case("6.4.1: configure node-id {0}: taken, and not in use before a reset", IDENTITY, persistent=True, each=[
    (1,), (127,), (255,),
])
def node_id_taken(dut: Dut, node_id: int) -> None:
    with configuring(dut):
        try:
            say(dut, 0x11, node_id)
            dut.expect(SLAVE, "11 00 00 00 00 00 00 00")
            dut.ask("40 00 10 00", "43 00 10 00 *")
        finally:
            say(dut, 0x11, dut.node_id)


@case("6.4.1: the new node-id is in use after reset communication", IDENTITY, persistent=True)
def node_id_changed(dut: Dut) -> None:
    old = dut.node_id
    with configuring(dut) as own:
        say(dut, 0x11, OTHER_ID)
        dut.expect(SLAVE, "11 00 *")
    try:
        dut.nmt(RESET_COMMUNICATION)
        dut.node_id = OTHER_ID
        dut.boot_up()
        dut.ask("40 00 10 00", "43 00 10 00 *")
        if dut.exists(0x1014, 0):
            dut.holds("I", 0x1014, 0, 0x80 + OTHER_ID)
        if dut.exists(0x1200, 1):
            dut.holds("I", 0x1200, 1, 0x600 + OTHER_ID)
    finally:
        restore_node_id(dut, own, old)


def restore_node_id(dut: Dut, own: list[int], node_id: int) -> None:
    """Give the device its own node-id back, whatever it has now, and hear it boot."""
    waiting(dut)
    select(dut, own)
    dut.heard(SLAVE)
    say(dut, 0x11, node_id)
    dut.heard(SLAVE)
    dut.forget()
    waiting(dut)  # a device without a node-id boots now
    if dut.node_id != UNCONFIGURED:
        dut.nmt(RESET_COMMUNICATION)
    dut.node_id = node_id
    dut.boot_up()


for table, index, error in (*((0, index, 0) for index in (0, 2, 3, 4, 8)), (0, 5, 1), (0, 10, 1), (1, 0, 1)):
    case(f"bit_timing 6.4.2: configure bit timing, table {table}, index {index}: error {error}", IDENTITY,
        do.within(configuring, do.run(say, 0x13, table, index), do.expect(SLAVE, f"13 {error:02X} *"),
            do.run(say, 0x13, 0, 0)), persistent=True)
case("store 6.4.3: store configuration: error 0", IDENTITY,
    do.within(configuring, do.run(say, 0x17), do.expect(SLAVE, "17 00 00 00 00 00 00 00", 2000)), persistent=True)
for service, value in ((0x11, OTHER_ID), (0x13, 0), (0x17, 0)):
    case("configure_waiting 6.4: configuration services in the waiting state do nothing", IDENTITY,
        do.run(say, service, value), do.silence(SLAVE), do.reset(RESET_COMMUNICATION))


def ranges(own: list[int]) -> list[int]:
    """The six numbers that this device alone fits."""
    return [own[0], own[1], own[2], own[2], own[3], own[3]]


@numbered("6.6.1: identify remote slave: a device in the ranges answers 4Fh", IDENTITY)
def identified(dut: Dut) -> None:
    say_each(dut, IDENTIFY, enumerate(ranges(identity(dut))))
    data = slave_answer(dut)
    check(data == b"\x4f" + bytes(7), "4F and zeros", data.hex(" "))


widest = do.late(lambda dut: enumerate([*identity(dut)[:2], 0, 0xFFFFFFFF, 0, 0xFFFFFFFF]))
numbered("identified_in_range 6.6.1: identify remote slave: the ends of the ranges may lie apart", IDENTITY,
    do.run(say_each, IDENTIFY, widest()), slave_answer)


@numbered("6.6.1: identify remote slave: {2} is not this device's: silence", IDENTITY, each=[
    (0, 1, "the vendor-ID"), (1, 1, "the product code"), (2, 1, "a revision from above"),
    (3, -1, "a revision to below"), (4, 1, "a serial number from above"), (5, -1, "a serial number to below"),
])
def not_identified(dut: Dut, part: int, step: int, _name: str) -> None:
    numbers = ranges(identity(dut))
    numbers[part] += step
    if not 0 <= numbers[part] <= 0xFFFFFFFF:
        raise NotApplicableError("the identity lies at the end of the range")
    say_each(dut, IDENTIFY, enumerate(numbers))
    dut.silence(SLAVE)


numbered("identify_order 6.6.1: identify remote slave in another order: silence", IDENTITY,
    lambda dut: say_each(dut, IDENTIFY, reversed(list(enumerate(ranges(identity(dut)))))), do.silence(SLAVE))
numbered("configured 6.6.3: identify non-configured remote slave: a device with a node-id is silent", (),
    do.run(say, 0x4C), do.silence(SLAVE))
numbered("configured_fastscan 6.6.4: fastscan: a device with a node-id is silent", (),
    do.run(say, 0x51, 0, 0, 0, 0, 0x80), do.silence(SLAVE))


@contextmanager
def unconfigured(dut: Dut) -> Iterator[list[int]]:
    """The device without a node-id within, with its own after; yields its identity."""
    old = dut.node_id
    with configuring(dut) as own:
        say(dut, 0x11, UNCONFIGURED)
        answer = dut.expect(SLAVE).data
    if answer[1]:
        raise NotApplicableError("node-id 255 is refused")
    dut.nmt(RESET_COMMUNICATION)
    dut.sleep(10)
    dut.forget()
    dut.node_id = UNCONFIGURED
    try:
        yield own
    finally:
        restore_node_id(dut, own, old)


def scan(dut: Dut, number: int, bit: int, part: int, following: int) -> bool:
    """One request of fastscan; whether a device says yes."""
    dut.send(MASTER, bytes((0x51,)) + number.to_bytes(4, "little") + bytes((bit, part, following)))
    return dut.heard(SLAVE, 20) is not None


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


@unnumbered("6.5: inquire node-id: 255", IDENTITY, persistent=True)
def lss_unconfigured_inquire(dut: Dut) -> None:
    with unconfigured(dut) as own, configuring(dut, own):
        say(dut, 0x5E)
        dut.expect(SLAVE, "5E FF *")


@unnumbered("6.4.1: a node-id is given: boot-up as soon as configuration is left", IDENTITY, persistent=True)
def boots(dut: Dut) -> None:
    old = dut.node_id
    with unconfigured(dut) as own:
        with configuring(dut, own):
            say(dut, 0x11, old)
            dut.expect(SLAVE, "11 00 *")
            dut.silence(0x700 + old, ms=10)
        dut.expect(0x700 + old, "00", 5000)
        dut.node_id = old
        dut.ask("40 00 10 00", "43 00 10 00 *")


def start_scan(dut: Dut) -> None:
    """Begin fastscan; not applicable for a device without it."""
    if not scan(dut, 0, START_SCAN, 0, 0):
        raise NotApplicableError("no fastscan")


@unnumbered("6.6.4: fastscan finds all 128 bits and leads to configuration", IDENTITY, persistent=True)
def fastscan(dut: Dut) -> None:
    with unconfigured(dut) as own:
        start_scan(dut)
        numbers = []
        for part in range(4):
            number = 0
            for bit in range(31, -1, -1):
                if not scan(dut, number, bit, part, part):
                    number |= 1 << bit
            # The number is complete: confirm it, and go on to the next one, after the last to the first.
            check(scan(dut, number, 0, part, (part + 1) % 4), f"an answer to {number:08X}h in part {part}", "silence")
            numbers.append(number)
        check(numbers == own, str(own), str(numbers))
        check(in_configuration(dut), "the configuration state", "no answer to an inquiry")


@unnumbered("6.6.4: fastscan with another {1}: silence", IDENTITY, persistent=True, each=[
    (0, "vendor-ID"), (1, "product code"),
])
def fastscan_other(dut: Dut, part: int, _name: str) -> None:
    with unconfigured(dut) as own:
        start_scan(dut)
        check(not part or scan(dut, own[0], 0, 0, 1), "an answer to the vendor-ID", "silence")
        answers = scan(dut, own[part] ^ 0x100, 0, part, part)
        check(not answers, "silence", "an answer to a number that is not the device's")


@unnumbered("6.6.4: fastscan of a part that is not its turn: silence", IDENTITY, persistent=True)
def fastscan_order(dut: Dut) -> None:
    with unconfigured(dut) as own:
        start_scan(dut)
        check(not scan(dut, own[2], 0, 2, 3), "silence", "an answer to the third number before the first")


@unnumbered("6.6.4: fastscan in the configuration state: silence", IDENTITY, persistent=True)
def fastscan_configuring(dut: Dut) -> None:
    with unconfigured(dut) as own, configuring(dut, own):
        check(not scan(dut, 0, START_SCAN, 0, 0), "silence", "an answer")
    waiting(dut)
