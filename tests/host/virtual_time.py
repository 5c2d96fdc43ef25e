"""An asyncio loop whose clock jumps to the next due time, and device cores on a canopen.Network in that loop."""

import asyncio
import selectors
from collections.abc import Coroutine, Sequence
from typing import Any, TypeVar

import can
import canopen

from canopen_device.core.node import Device

T = TypeVar("T")


class _Jumping(selectors.DefaultSelector):
    now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready:
            assert timeout is not None, "the loop would wait for ever"
            self.now_s += timeout
        return ready


class VirtualLoop(asyncio.SelectorEventLoop):
    """A loop in which waiting takes no time."""

    def __init__(self) -> None:
        self._clock = _Jumping()
        super().__init__(self._clock)

    def time(self) -> float:
        return self._clock.now_s


def run(work: Coroutine[Any, Any, T]) -> T:
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(work)


class DelayedBus:
    """What canopen.Network needs of a bus: each frame reaches the devices at once, each answer ``delay_s`` later."""

    channel_info = "devices in virtual time"

    def __init__(self, network: canopen.Network, devices: Sequence[Device], delay_s: float) -> None:
        self._network, self._devices, self._delay_s = network, devices, delay_s
        self._loop = asyncio.get_running_loop()
        self.sent: list[tuple[int, bytes]] = []
        network.bus = self  # type: ignore[assignment]
        for device in devices:
            device.step(0)

    def send(self, message: can.Message, _timeout: float | None = None) -> None:
        now_us = round(1e6 * self._loop.time())
        frame = message.arbitration_id, bytes(message.data)
        self.sent.append(frame)
        for device in self._devices:
            answers, _ = device.step(now_us, [frame])
            if answers:
                # All in one call: the loop may exchange calls that are due at the same time.
                self._loop.call_later(self._delay_s, self._receive, answers)

    def _receive(self, frames: list[tuple[int, bytes]]) -> None:
        for can_id, data in frames:
            self._network.notify(can_id, bytearray(data), 0.0)
