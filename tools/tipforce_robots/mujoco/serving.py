"""Fingertips of a MuJoCo model as CANopen nodes on a bus, in simulated time."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from math import isfinite
from typing import TYPE_CHECKING

from canopen_device.core import codes
from canopen_device.running.loop import say_stopped
from canopen_device.running.open_bus import PythonCanPort
from tipforce.errors import InputError
from tipforce_robots.mujoco.twin import Fingertips

if TYPE_CHECKING:
    import can
    import mujoco

    from canopen_device.running.loop import Frame

    Step = Callable[[], object]
    """Advances the model by one time step: ``lambda: mujoco.mj_step(model, data)``, with what the model's user adds."""

_IDLE_S = 0.2  # the longest wait: bounds the time until a stop request is seen
_LONGEST_LAG_S = 0.2
_MOST_FRAMES = 10_000  # at once: a node that sends without end must not stop the simulation


class TwinNodes(AbstractContextManager["TwinNodes"]):
    """``tips`` as nodes on ``bus`` at the time of ``data``, until the block ends. Call ``exchange`` after each step, or
    let ``follow_sync`` (reproducible) or ``follow_clock`` step. ``on_frame`` gets received (COB-ID, data)."""

    def __init__(
        self, tips: Fingertips, data: mujoco.MjData, bus: can.BusABC,
        on_frame: Callable[[int, bytes], object] | None = None,
    ) -> None:  # fmt: skip
        self._tips, self._data, self._on_frame = tips, data, on_frame
        self._port = PythonCanPort(bus)
        self._due_us = 0
        self.exchange()

    def exchange(self, timeout_s: float = 0.0) -> None:
        """Hand the frames received over to the nodes, and send theirs; wait up to ``timeout_s`` for the first one.
        Raises InputError where the time of ``data`` went back without a ``Fingertips.reset``."""
        self._keep_time()
        for _ in range(_MOST_FRAMES):
            if (frame := self._port.receive(timeout_s)) is None:
                break
            self._deliver(frame)
            timeout_s = 0.0

    def follow_sync(self, step: Step, period_s: float, stop: Callable[[], bool]) -> None:
        """Advance the model by ``period_s`` for each SYNC, and sample after it, until ``stop()``. Between SYNCs the
        simulation stands still, and SDO and NMT are served. After a reset of the model the time goes on from there.
        Raises InputError for a period that is not positive, and for a step that does not advance the time."""
        if not (isfinite(period_s) and period_s > 0.0):
            raise InputError(f"period_s = {period_s!r}: allowed is a positive finite number")
        due_s = last_s = self._data.time
        while not stop():
            frame = self._port.receive(_IDLE_S)
            if frame is None:
                continue
            if frame[0] == codes.SYNC_COB_ID:
                due_s += min(0.0, self._data.time - last_s)  # after a reset of the model
                due_s += period_s
                while (last_s := self._data.time) < due_s - 1e-9:
                    step()
                    self._keep_time()
                    if self._data.time == last_s:
                        raise InputError(f"step: the time of data stays at {last_s} s: allowed is one that advances it")
                    due_s += min(0.0, self._data.time - last_s)
            self._deliver(frame)

    def follow_clock(self, step: Step, stop: Callable[[], bool]) -> float:
        """Advance the model with the monotonic clock until ``stop()`` returns true; return the seconds that it lost. A
        simulation that is more than 0.2 s late goes on from there, slower than the clock."""
        start_s, lost_s = time.monotonic() - self._data.time, 0.0
        while not stop():
            before_s = self._data.time
            step()
            start_s += max(0.0, before_s - self._data.time)  # after a reset of the model
            ahead_s = self._data.time - (time.monotonic() - start_s)
            if ahead_s < -_LONGEST_LAG_S:
                start_s -= ahead_s
                lost_s -= ahead_s
            self.exchange(max(0.0, min(ahead_s, _IDLE_S)))
        return lost_s

    def close(self) -> None:
        """Send the last frame of each node, as one that is switched off."""
        say_stopped(self._tips.devices, self._port)

    def __exit__(self, *_: object) -> None:
        self.close()

    def _keep_time(self) -> None:
        now_us = self._tips.at(self._data)
        if self._tips.boot_frames:
            self._port.send(self._tips.boot_frames)
            self._tips.boot_frames.clear()
            self._due_us = now_us
        if self._due_us <= now_us:
            self._step(now_us, [])

    def _deliver(self, frame: Frame) -> None:
        if self._on_frame is not None:
            self._on_frame(*frame)
        self._step(self._tips.at(self._data), [frame])

    def _step(self, now_us: int, frames: list[Frame]) -> None:
        self._due_us = codes.NEVER_US
        for device in self._tips.devices:
            sent, due_us = device.step(now_us, frames)
            self._due_us = min(self._due_us, due_us)
            if sent:
                self._port.send(sent)
            device.requests.clear()
