"""SdoChannel against real nodes: values, aborts, lost and damaged answers, many threads."""

import asyncio
import itertools
import struct
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any, cast

import can
import pytest

from canopen_device.core import codes
from host.bus_with_nodes import FaultyBus, connected, finger
from tipforce.dictionary import objects as od
from tipforce.dictionary.entries import Entry
from tipforce.errors import EnvironmentLackError, InputError, NoResponseError, SdoAbortError
from tipforce.host.network import sdo as module
from tipforce.host.network.bus import Bus
from tipforce.host.network.sdo import LONGEST_WAIT_S, Exchange, Request, SdoChannel

NODE = 5
ANSWER = 0x580 + NODE
TIMEOUT_S = 0.4  # a loaded machine responds in this time; a node repeats the response to a block after 0.5 s


@pytest.fixture(scope="module")
def shared() -> Iterator[tuple[Bus, FaultyBus]]:
    with connected(finger(NODE), timeout_s=TIMEOUT_S) as both:
        yield both


@pytest.fixture
def connection(shared: tuple[Bus, FaultyBus]) -> Iterator[Bus]:
    connection, bus = shared
    channel = connection.sdo(NODE)
    retries = channel.retries
    bus.sent.clear()
    yield connection
    bus.fault = lambda message: message
    channel.retries = retries


@pytest.fixture
def bus(shared: tuple[Bus, FaultyBus]) -> FaultyBus:
    return shared[1]


Fault = Callable[[can.Message], can.Message | None]


def at_answer(number: int, change: Fault) -> Fault:
    """Apply ``change`` to one SDO answer, counted from 0, leave the others."""
    answers = itertools.count()
    return lambda message: change(message) if message.arbitration_id == ANSWER and next(answers) == number else message


def lost(message: can.Message) -> can.Message | None:
    return None if message.arbitration_id == ANSWER else message


def with_data(message: can.Message, data: bytes) -> can.Message:
    return can.Message(
        timestamp=message.timestamp, arbitration_id=message.arbitration_id, data=data, is_extended_id=False
    )


def test_values_of_every_kind(connection: Bus) -> None:
    sdo = connection.sdo(NODE)
    assert sdo.read(od.IDENTITY_SERIAL) == 1000 + NODE
    assert sdo.read(od.DEVICE_NAME)  # a string: more than four bytes, segmented
    assert len(sdo.read(od.CALIBRATION_ACTIVE_RECORD)) == 158
    sdo.write(od.HEARTBEAT_PRODUCER_MS, 500)
    assert sdo.read(od.HEARTBEAT_PRODUCER_MS) == 500
    sdo.write(od.CALIBRATION_OFFSET[2], 1.5e-6)
    assert sdo.read(od.CALIBRATION_OFFSET[2]) == pytest.approx(1.5e-6, rel=1e-6)
    record = bytes(range(100)) + bytes(58)
    sdo.write(od.CALIBRATION_STAGED_RECORD, record)
    assert sdo.read(od.CALIBRATION_STAGED_RECORD) == record


@pytest.mark.parametrize(
    ("entry", "value", "code", "text"),
    [
        (Entry[int](0x3000, 0, "B", "nothing", "rw", ""), 1, 0x06020000, "0x3000:00"),
        (od.CALIBRATION_ACTIVE_CRC, 1, 0x06010002, "write of 0x2103:03"),
        (od.CALIBRATION_LOCK, 2, 0x06090031, "write of 0x2105:02"),
        (od.CALIBRATION_STAGED_RECORD, b"", 0x06070013, "write of 0x2141:00"),
        (od.CALIBRATION_STAGED_RECORD, bytes(159), 0x06070012, "write of 0x2141:00"),
        (od.CALIBRATION_STAGED_RECORD, bytes(157), 0x06070013, "write of 0x2141:00"),
    ],
)
def test_an_abort_names_place_code_and_meaning(
    connection: Bus, bus: FaultyBus, entry: Entry[Any], value: int | bytes, code: int, text: str
) -> None:
    with pytest.raises(SdoAbortError) as caught:
        connection.sdo(NODE).write(entry, value)
    assert caught.value.code == code
    assert "node 5 (0x05)" in str(caught.value)
    assert f"abort 0x{code:08X}, " in str(caught.value)
    assert text in str(caught.value)
    place = struct.pack("<HB", entry.index, entry.sub)
    starts = [data for can_id, data in bus.sent if can_id == 0x600 + NODE and data[1:4] == place]
    assert len(starts) == 1, "an abort is an answer, so nothing is tried again"


@pytest.mark.parametrize(
    "damage",
    [
        lost,
        lambda message: with_data(message, b""),
        lambda message: with_data(message, bytes(message.data[:1])),
        lambda message: with_data(message, b"\x80\x18\x10\x04"),  # an abort without its code
        lambda message: with_data(message, bytes(message.data[:3])),
        lambda message: with_data(message, b"\xff" * 8),
        lambda message: with_data(message, b"\x43\x00\x10\x00\0\0\0\0"),  # the answer to another question
    ],
    ids=["lost", "empty", "one byte", "half an abort", "three bytes", "nonsense", "another object"],
)
def test_one_bad_answer_is_made_good_by_a_retry(connection: Bus, bus: FaultyBus, damage: Fault) -> None:
    sdo = connection.sdo(NODE)
    sdo.retries = 1
    bus.fault = at_answer(0, damage)
    assert sdo.read(od.IDENTITY_SERIAL) == 1000 + NODE
    bus.fault = at_answer(0, damage)
    sdo.write(od.HEARTBEAT_PRODUCER_MS, 700)
    assert sdo.read(od.HEARTBEAT_PRODUCER_MS) == 700


@pytest.mark.parametrize("answer", range(4))
def test_a_segmented_transfer_survives_a_loss_anywhere(connection: Bus, bus: FaultyBus, answer: int) -> None:
    sdo = connection.sdo(NODE)
    sdo.retries = 1
    record = bytes(range(16)) + bytes(142)
    bus.fault = at_answer(answer, lost)
    sdo.write(od.CALIBRATION_STAGED_RECORD, record)
    bus.fault = at_answer(answer, lost)
    assert sdo.read(od.CALIBRATION_STAGED_RECORD) == record


@pytest.mark.parametrize(("retries", "tries"), [(0, "1 try"), (2, "3 tries")])
def test_no_answer_at_all(connection: Bus, bus: FaultyBus, retries: int, tries: str) -> None:
    sdo = connection.sdo(NODE)
    sdo.retries = retries
    bus.fault = lost
    with pytest.raises(NoResponseError) as caught:
        sdo.read(od.IDENTITY_SERIAL)
    assert str(caught.value) == (
        f"node 5 (0x05), read of 0x1018:04: no response after {tries} of {TIMEOUT_S} s; "
        "check its power, bus, bit rate and node-id; `tipforce scan` lists nodes"
    )
    requests = [data for can_id, data in bus.sent if can_id == 0x600 + NODE and data[0] == 0x40]
    assert len(requests) == retries + 1
    with pytest.raises(NoResponseError, match=r"write of 0x1017:00: no response"):
        sdo.write(od.HEARTBEAT_PRODUCER_MS, 100)
    bus.fault = lambda message: message
    assert sdo.read(od.IDENTITY_SERIAL) == 1000 + NODE


def test_answers_that_never_fit_are_no_silence(connection: Bus, bus: FaultyBus) -> None:
    sdo = connection.sdo(NODE)
    sdo.retries = 1
    bus.fault = lambda message: with_data(message, b"\x43\x00\x10\x00\0\0\0\0")  # as to somebody else's question
    for transfer in (lambda: sdo.read(od.IDENTITY_SERIAL), lambda: sdo.write(od.HEARTBEAT_PRODUCER_MS, 700)):
        with pytest.raises(NoResponseError, match=r"no valid response in 2 tries, the last: .*another SDO client"):
            transfer()


def test_a_late_answer_is_not_taken_for_the_next_one(connection: Bus, bus: FaultyBus) -> None:
    """The answer to a request that was given up arrives before the answer to the next request."""
    sdo = connection.sdo(NODE)
    sdo.retries = 0
    bus.fault = lost
    with pytest.raises(NoResponseError):
        sdo.read(od.IDENTITY_SERIAL)
    bus.fault = lambda message: message
    connection.buffer.clear()
    stale = struct.pack("<BHBI", 0x43, 0x1018, 4, 1000 + NODE)
    with can.Bus(interface="virtual", channel=bus.channel_id) as other:
        other.send(can.Message(arbitration_id=ANSWER, data=stale, is_extended_id=False))
    connection.wait_for({ANSWER}, 10.0)
    assert sdo.read(od.IDENTITY_PRODUCT) == 0x54500103


def test_a_wrong_length_is_an_error_not_a_value(connection: Bus, bus: FaultyBus) -> None:
    wrong = struct.pack("<BHBI", 0x4F, 0x1018, 4, 7)  # each response: a retry must not find the right one
    bus.fault = lambda m: with_data(m, wrong) if m.arbitration_id == ANSWER else m
    with pytest.raises(InputError, match=r"identity\.serial \(0x1018:04\): 1 bytes \(07\) for UNSIGNED32: allow"):
        connection.sdo(NODE).read(od.IDENTITY_SERIAL)


def test_a_value_that_does_not_fit_sends_nothing(connection: Bus, bus: FaultyBus) -> None:
    with pytest.raises(InputError, match=r"heartbeat\.producer_ms \(0x1017:00\): 70000 .* allowed are 0 to 65535"):
        connection.sdo(NODE).write(od.HEARTBEAT_PRODUCER_MS, 70000)
    assert not bus.sent


def test_a_bus_that_refuses_is_named(connection: Bus, bus: FaultyBus, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_message: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError(f"transmit queue is full {timeout or ''}")

    monkeypatch.setattr(bus, "send", refuse)
    with pytest.raises(EnvironmentLackError, match=r"node 5 .*the bus refused the frame: transmit queue is full"):
        connection.sdo(NODE).read(od.IDENTITY_SERIAL)
    with pytest.raises(EnvironmentLackError, match=r"frame 0x080: the bus refused it: transmit queue is full"):
        connection.sync()


def staged(sdo: SdoChannel, count: int) -> bool:
    sdo.write(od.CALIBRATION_STAGED_RECORD, bytes((count,)) * 36 + bytes(122))
    return True


READS: tuple[Callable[[SdoChannel, int], bool], ...] = (
    lambda sdo, _: sdo.read(od.IDENTITY_SERIAL) == 1000 + NODE,
    lambda sdo, _: sdo.read(od.IDENTITY_PRODUCT) == 0x54500103,
    lambda sdo, _: sdo.read(od.DEVICE_TYPE) == sdo.read(od.DEVICE_TYPE),
    lambda sdo, _: sdo.read(od.IDENTITY_REVISION) == sdo.read(od.IDENTITY_REVISION),
)
DOMAINS = (staged, *[lambda sdo, _: len(sdo.read(od.CALIBRATION_ACTIVE_RECORD)) == 158] * 3)


@pytest.mark.parametrize(("transfers", "rounds"), [(READS, 100), (DOMAINS, 20)], ids=["short", "segmented"])
def test_four_threads_at_once(
    connection: Bus, transfers: tuple[Callable[[SdoChannel, int], bool], ...], rounds: int
) -> None:
    """canopen's own client gives 28 to 58 errors here (docs/dependencies.md); no frames of two transfers mix."""
    wrong: list[object] = []

    def work(transfer: Callable[[SdoChannel, int], bool]) -> None:
        for count in range(rounds):
            try:
                if not transfer(connection.sdo(NODE), count):
                    wrong.append(transfer)
            except Exception as error:
                wrong.append(error)

    with ThreadPoolExecutor(len(transfers)) as pool:
        pool.map(work, transfers)
    assert not wrong


def test_a_thread_and_a_task_take_turns_in_the_order_of_their_requests(connection: Bus, bus: FaultyBus) -> None:
    sdo = connection.sdo(NODE)
    sdo.retries = 1
    bus.fault = at_answer(0, lost)  # the thread waits for a response: the task for the thread
    thread = threading.Thread(target=lambda: sdo.read(od.DEVICE_NAME))
    thread.start()
    while not bus.sent:
        pass
    assert asyncio.run(sdo.read_async(od.IDENTITY_SERIAL)) == 1000 + NODE
    thread.join()
    requests = [data[:4] for _, data in bus.sent]
    assert requests.index(b"\x40\x18\x10\x04") == len(requests) - 1, "after all of the name"


def test_a_transfer_that_ends_between_two_looks_is_not_waited_for_longer_than_a_lock_can(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its next step is due never; a thread that waits for it at that moment must not end with OverflowError."""
    ended = SimpleNamespace(
        ended=True, abort_code=None, failure=None, data=b"", step=lambda _now_us, _response: ([], codes.NEVER_US)
    )
    monkeypatch.setattr(module, "Upload", lambda *_: ended)
    channel = SimpleNamespace(node_id=5, now_us=lambda: 0, deadline_s=1.0, timeout_s=0.5)
    exchange = Exchange(cast(SdoChannel, channel), Request(0x1000, 0))
    exchange.step()
    assert exchange.left_s <= LONGEST_WAIT_S
    assert exchange.done.exception(exchange.left_s) is None
