"""SdoChannel with asyncio, in virtual time: many nodes at once, cancellation, the total deadline, blocks."""

import asyncio
import struct
from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple

import can
import canopen
import pytest

from host.bus_with_nodes import finger
from host.virtual_time import DelayedBus, run
from tipforce.dictionary import objects as od
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import resolve
from tipforce.errors import NoResponseError, SdoAbortError
from tipforce.host import apply_configuration_async, verify_configuration_async
from tipforce.host.configuration.configuration_file import Configuration
from tipforce.host.network.sdo import SdoChannel

DELAY_S = 0.005
HAND = range(1, 16)


def settings(node_id: int) -> Configuration:
    """A remapped PDO, and for some fingers one object more than for others."""
    values: dict[str, Any] = {
        "0x1017:00": 500 + node_id, "0x1800:01": 0x40000180 + node_id, "0x1A00:00": 2, "0x1A00:01": 0x71300710,
        "0x1A00:02": 0x21200008,
    }  # fmt: skip
    if node_id % 3 == 0:
        values["0x1019:00"] = 240
    entries = [(resolve(name, 3), value) for name, value in values.items()]
    return {(entry.index, entry.sub): (entry, value) for entry, value in entries}


def channel(network: canopen.Network, node_id: int, **options: Any) -> SdoChannel:
    return SdoChannel(network, node_id, clock=asyncio.get_running_loop().time, **options)


async def configured(nodes: list[int]) -> float:
    """Configure and verify these of 15 fingers at once; return the time that it took in seconds."""
    network = canopen.Network()
    DelayedBus(network, [finger(node_id) for node_id in HAND], DELAY_S)
    loop = asyncio.get_running_loop()

    async def one(sdo: SdoChannel) -> None:
        wanted = settings(sdo.node_id)
        await apply_configuration_async(sdo, wanted)
        assert await verify_configuration_async(sdo, wanted) == []
        assert len(await sdo.read_async(od.CALIBRATION_ACTIVE_RECORD)) == 158

    async with asyncio.TaskGroup() as group:
        for node_id in nodes:
            group.create_task(one(channel(network, node_id)))
    return loop.time()


def test_15_fingers_are_configured_in_the_time_of_the_slowest() -> None:
    alone_s = [run(configured([node_id])) for node_id in HAND]
    together_s = run(configured(list(HAND)))
    assert together_s == pytest.approx(max(alone_s), abs=DELAY_S / 10)
    assert sum(alone_s) > 14 * together_s * 0.9
    assert len(set(alone_s)) == 2, "some have one object more: a write, and two reads"


class Talk(NamedTuple):
    sdo: SdoChannel
    bus: Any


def with_node_5(
    kind: type[DelayedBus] = DelayedBus, delay_s: float = DELAY_S, **options: Any
) -> Callable[[Callable[[Talk], Coroutine[Any, Any, None]]], Callable[[], None]]:
    """Make a test of a coroutine, in virtual time."""

    def test_of(test: Callable[[Talk], Coroutine[Any, Any, None]]) -> Callable[[], None]:
        async def work() -> None:
            network = canopen.Network()
            bus = kind(network, [finger(5)], delay_s)
            await test(Talk(channel(network, 5, **options), bus))

        return lambda: run(work())

    return test_of


@with_node_5(delay_s=0.1)
async def test_a_cancelled_transfer_is_aborted_and_gives_its_turn_back(talk: Talk) -> None:
    first = asyncio.create_task(talk.sdo.read_async(od.DEVICE_NAME))
    second = asyncio.create_task(talk.sdo.read_async(od.DEVICE_NAME))
    third = asyncio.create_task(talk.sdo.read_async(od.IDENTITY_SERIAL))
    await asyncio.sleep(0.15)
    first.cancel()
    second.cancel()
    assert await third == 1005
    aborts = [data for _, data in talk.bus.sent if data[0] == 0x80]
    assert aborts == [struct.pack("<BHBI", 0x80, 0x1008, 0, 0x08000000)]
    with pytest.raises(asyncio.CancelledError):
        await first


def test_a_silent_node_costs_its_tries_and_an_abort_none() -> None:
    async def work() -> None:
        network = canopen.Network()
        DelayedBus(network, [finger(5)], DELAY_S)
        loop = asyncio.get_running_loop()
        with pytest.raises(NoResponseError, match=r"node 9 .* no response after 3 tries of 0\.5 s"):
            await channel(network, 9).read_async(od.DEVICE_TYPE)
        assert loop.time() == pytest.approx(1.5, abs=1e-3)
        with pytest.raises(SdoAbortError, match="0x06020000"):
            await channel(network, 5).read_async(Entry[int](0x3000, 0, "B", "", "", ""))
        assert loop.time() == pytest.approx(1.5 + DELAY_S, abs=1e-3)

    run(work())


class Trickle(DelayedBus):
    """A server that answers each request of a segment with one byte, later, for ever."""

    def send(self, message: Any, _timeout: float | None = None) -> None:
        command = message.data[0]
        if command == 0x40:
            answer = b"\x40" + bytes(message.data[1:4]) + bytes(4)
        elif command & 0xEF == 0x60:
            answer = bytes((command & 0x10 | 6 << 1, 0x55)) + bytes(6)
        else:
            return
        self._loop.call_later(self._delay_s, self._network.notify, 0x585, bytearray(answer), 0.0)


@with_node_5(Trickle, 0.4, deadline_s=7.0)
async def test_a_server_that_always_answers_in_time_meets_the_deadline(talk: Talk) -> None:
    with pytest.raises(NoResponseError, match=r"the last: the transfer exceeded its deadline"):
        await talk.sdo.read_async(od.DEVICE_NAME)
    assert asyncio.get_running_loop().time() == pytest.approx(7.0, abs=1e-3)


class ShortQueue(DelayedBus):
    """A bus whose transmit queue takes eight frames a millisecond."""

    refused = 0
    _queued = 0

    def send(self, message: Any, _timeout: float | None = None) -> None:
        if self._queued == 8:
            self.refused += 1
            raise can.CanOperationError("Transmit buffer full")
        self._queued += 1
        self._loop.call_later(0.001, self._sent)
        super().send(message)

    def _sent(self) -> None:
        self._queued -= 1


@with_node_5(ShortQueue)
async def test_a_full_transmit_queue_delays_a_block(talk: Talk) -> None:
    """The queue of a SocketCAN interface holds ten frames, a block has up to 127."""
    record = bytes(range(100)) + bytes(58)
    await talk.sdo.write_async(od.CALIBRATION_STAGED_RECORD, record)
    assert talk.bus.refused > 0
    assert await talk.sdo.read_async(od.CALIBRATION_STAGED_RECORD) == record
    assert talk.sdo.has_blocks


class Late(DelayedBus):
    """Answers take longer than the half second after which a node acknowledges the part of a block that it has."""

    def send(self, message: Any, _timeout: float | None = None) -> None:
        super().send(message)
        if message.data[0] >> 5 == 6:
            self._loop.call_later(0.5, self._expire)

    def _expire(self) -> None:
        answers = [frame for device in self._devices for frame in device.step(round(1e6 * self._loop.time()))[0]]
        self._loop.call_later(self._delay_s, self._receive, answers)


@with_node_5(Late, delay_s=0.6, timeout_s=5.0, retries=0)
async def test_a_block_that_is_sent_twice_because_its_start_was_late_is_written(talk: Talk) -> None:
    """The node aborts each segment of the second one; those aborts are not of the transfer without blocks."""
    record = bytes(158)
    await talk.sdo.write_async(od.CALIBRATION_STAGED_RECORD, record)
    assert await talk.sdo.read_async(od.CALIBRATION_STAGED_RECORD) == record


class NoBlocks(DelayedBus):
    def send(self, message: Any, _timeout: float | None = None) -> None:
        if message.data[0] >> 5 in (5, 6):
            self.sent.append((message.arbitration_id, bytes(message.data)))
            abort = b"\x80" + bytes(message.data[1:4]) + struct.pack("<I", 0x05040001)
            self._loop.call_later(self._delay_s, self._network.notify, 0x585, bytearray(abort), 0.0)
        else:
            super().send(message)


@with_node_5(NoBlocks)
async def test_a_node_without_blocks_is_asked_for_segments_from_then_on(talk: Talk) -> None:
    for _ in range(2):
        record = await talk.sdo.read_async(od.CALIBRATION_ACTIVE_RECORD)
        await talk.sdo.write_async(od.CALIBRATION_STAGED_RECORD, record)
    starts = [data[0] for _, data in talk.bus.sent if data[0] in (0xA4, 0xC6, 0x40, 0x21)]
    assert starts == [0xA4, 0x40, 0x21, 0x40, 0x21]
