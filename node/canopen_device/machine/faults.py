"""Faults of a simulated device on its bus: silent, slow, wrong SDO toggle bits, emergencies."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from canopen_device.core import codes
from canopen_device.core.emcy import GENERIC
from canopen_device.core.node import Device
from canopen_device.errors import InputError

Frame = tuple[int, bytes]

SILENT, SLOW, WRONG_TOGGLE, EMCY = "silent", "slow", "wrong_toggle", "emcy"
PARAMETERS: dict[str, dict[str, float]] = {
    SILENT: {}, SLOW: {"delay_s": 0.5}, WRONG_TOGGLE: {}, EMCY: {"code": 0, "register": GENERIC},
}  # fmt: skip
_SEGMENTS = (0x00, 0x20)  # server responses with a toggle bit: upload segment, download segment
_TOGGLE = 0x10
_MOST_WAITING = 4096


class Faults:
    """The active faults of one device, and what they do to its frames."""

    def __init__(self, core: Device) -> None:
        self._core = core
        self._active: dict[str, dict[str, float]] = {}
        self._waiting: deque[tuple[int, Frame]] = deque()
        self._planned: list[tuple[int, str, dict[str, float] | None]] = []  # time, kind, parameters of a start
        self._origin_us: int | None = None

    def plan(self, kind: str, at_s: float = 0.0, for_s: float | None = None, **parameters: float) -> None:
        """Start a fault at ``at_s``, and end it after ``for_s`` seconds (None: never).

        Raises InputError for an unknown kind or parameter, and a time before 0.
        """
        checked(kind, parameters)
        if at_s < 0.0 or (for_s is not None and for_s <= 0.0):
            shown = f"at_s {at_s:g}, for_s {for_s}"
            raise InputError(f"fault {kind}: {shown}: allowed are at_s from 0 on, for_s above 0")
        self._planned.append((int(1e6 * at_s), kind, parameters))
        if for_s is not None:
            self._planned.append((int(1e6 * (at_s + for_s)), kind, None))
        self._planned.sort(key=lambda event: event[0])

    def start(self, kind: str, **parameters: float) -> None:
        """Start a fault. Raises InputError."""
        self._active[kind] = checked(kind, parameters)
        if kind == EMCY:
            given = self._active[kind]
            self._core.emcy.raise_error(int(given["code"]), int(given["register"]))

    def end(self, kind: str) -> None:
        """End a fault. Raises InputError for an unknown kind."""
        checked(kind, {} if kind != EMCY else {"code": 1})
        ended = self._active.pop(kind, None)
        if ended is not None and kind == EMCY:
            self._core.emcy.cure(int(ended["code"]))

    def tick(self, now_us: int) -> None:
        """Start and end what is planned up to now."""
        if not self._planned:
            return
        if self._origin_us is None:
            self._origin_us = now_us
        while self._planned and self._origin_us + self._planned[0][0] <= now_us:
            _, kind, parameters = self._planned.pop(0)
            if parameters is None:
                self.end(kind)
            else:
                self.start(kind, **parameters)

    def received(self, frames: Iterable[Frame]) -> Iterable[Frame]:
        """Return the frames that the device hears."""
        return () if SILENT in self._active else frames

    def sent(self, now_us: int, frames: list[Frame]) -> tuple[list[Frame], int]:
        """Return the frames that reach the bus now, and when the next one is due."""
        if not self._active and not self._waiting and not self._planned:
            return frames, codes.NEVER_US
        response = codes.SDO_RESPONSE_BASE + self._core.node_id
        ready: list[Frame] = []
        for frame in frames:
            if SILENT in self._active:
                continue
            if frame[0] == response and WRONG_TOGGLE in self._active and frame[1][0] & 0xE0 in _SEGMENTS:
                frame = (frame[0], bytes((frame[1][0] ^ _TOGGLE,)) + frame[1][1:])  # noqa: PLW2901
            if frame[0] == response and SLOW in self._active and len(self._waiting) < _MOST_WAITING:
                self._waiting.append((now_us + int(1e6 * self._active[SLOW]["delay_s"]), frame))
                continue
            ready.append(frame)
        while self._waiting and self._waiting[0][0] <= now_us:
            ready.append(self._waiting.popleft()[1])
        due_us = self._waiting[0][0] if self._waiting else codes.NEVER_US
        if self._planned and self._origin_us is not None:
            due_us = min(due_us, self._origin_us + self._planned[0][0])
        return ready, due_us


def checked(kind: str, parameters: dict[str, float]) -> dict[str, float]:
    """Return the parameters of a fault with their defaults. Raises InputError."""
    if kind not in PARAMETERS:
        raise InputError(f"fault {kind!r}: allowed are {', '.join(PARAMETERS)}")
    unknown = set(parameters) - set(PARAMETERS[kind])
    if unknown:
        allowed = ", ".join(PARAMETERS[kind]) or "none"
        raise InputError(f"fault {kind}: parameter {min(unknown)!r}; allowed: {allowed}")
    complete = {**PARAMETERS[kind], **parameters}
    if kind == SLOW and not 0.0 < complete["delay_s"] < 3600.0:
        raise InputError(f"fault slow: delay_s {complete['delay_s']}: allowed is above 0, below 3600")
    if kind == EMCY and not (1 <= complete["code"] <= 0xFFFF and 0 <= complete["register"] <= 0xFF):
        shown = f"code {complete['code']}, register {complete['register']}"
        raise InputError(f"fault emcy: {shown}: allowed are 1 to 0xFFFF, 0 to 0xFF")
    return complete
