"""A simulated device: the device core with its EDS, its values by name, its application, and faults on demand."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial

from canopen_device import types
from canopen_device.core import codes, communication, emcy
from canopen_device.core.node import Application, Device
from canopen_device.eds.description import Description, Entry
from canopen_device.eds.load import Load, Save, core_value, device_of, python_value
from canopen_device.errors import InputError, placed
from canopen_device.machine.signals import Driver, Signal
from canopen_device.types import Value

Frame = tuple[int, bytes]
Key = int | tuple[int, int] | str

_ACYCLIC = 0  # the transmission type of a PDO that is sent on the SYNC after a change
_POLL_US = 10_000  # how soon a change by another thread is sent

SILENT, SLOW, WRONG_TOGGLE, EMCY = "silent", "slow", "wrong_toggle", "emcy"
PARAMETERS: dict[str, dict[str, float]] = {
    SILENT: {}, SLOW: {"delay_s": 0.5}, WRONG_TOGGLE: {}, EMCY: {"code": 0, "register": emcy.GENERIC},
}  # fmt: skip
_SEGMENTS = (0x00, 0x20)  # server responses with a toggle bit: upload segment, download segment
_TOGGLE = 0x10
_MOST_WAITING = 4096


class DeviceApplication:
    """What a simulated device does beyond CANopen; this class does nothing. ``self.device[0x6064] = 100`` sends the
    PDOs that are due. Methods run in the thread of the bus loop and must not wait; an exception ends it."""

    device: SimulatedDevice
    period_s = 0.01
    """``step`` is called so often, and on each SYNC."""

    def on_start(self) -> None:
        """Handle the creation of the device. Raise InputError here if its EDS lacks what the application needs."""

    def on_reset(self) -> None:
        """Handle an NMT reset node, also the first: all values are those of the EDS, or stored ones."""

    def on_write(self, entry: Entry, value: Value) -> int:  # noqa: ARG002
        """Handle a value that a master writes, by SDO or PDO: return 0 to accept it, or an SDO abort code. The value is
        stored after this call. Objects below 2000h belong to CANopen itself and are not reported."""
        return 0

    def on_sync(self) -> None:
        """Handle a SYNC: set the values that its PDOs carry."""

    def step(self, dt_s: float) -> None:
        """Let ``dt_s`` seconds pass."""


class SimulatedDevice:
    """One simulated device. ``device[key]``, as ``Description.find``, also from another thread: a value that is set or
    written sends the event-driven PDOs that map it. Raises InputError for a wrong key or value."""

    def __init__(
        self, description: Description, application: DeviceApplication | None = None,
        signals: Mapping[Key, Signal] | None = None, save: Save | None = None, load: Load | None = None,
    ) -> None:  # fmt: skip
        self.description = description
        self.core = device_of(description, save, load)
        self.faults = Faults(self.core)
        self.application = application or DeviceApplication()
        self.shared = False  # another thread sets values: step more often
        self.bus_options: dict[str, object] = {}
        """Keywords of ``can.Bus`` by which others reach the device, while ``simulated_device`` runs it."""
        self.initial_values: dict[Key, Value] = {}
        """Set again on each NMT reset node."""
        self._lock = threading.RLock()
        self._started_us: int | None = None
        self._drivers = [Driver(self, description.find(key), signal) for key, signal in (signals or {}).items()]
        places = [driver.entry.place for driver in self._drivers]
        twice = next((place for place in places if places.count(place) > 1), None)
        if twice is not None:
            raise InputError(f"{twice}: two signals; an object has one")
        self.core.application = _Bridge(self, self._drivers)
        self.application.device = self
        for index in description.objects:
            if index not in self.core.od.writers and index > communication.LAST:
                self.core.od.writers[index] = self._writer(index)
        self.application.on_start()

    @property
    def node_id(self) -> int:
        """The node-id at present; 255 while LSS has given none."""
        return self.core.node_id

    @property
    def requests(self) -> list[tuple[str, int, int]]:
        """Requests of the device to its bus, see ``Device.requests``."""
        return self.core.requests

    @property
    def now_s(self) -> float:
        """Seconds since the first step."""
        return 0.0 if self._started_us is None else (self.core.now_us - self._started_us) * 1e-6

    def step(self, now_us: int, frames: Iterable[Frame] = ()) -> tuple[list[Frame], int]:
        """Step the device, as ``Device.step`` does; faults drop, delay and change its frames."""
        with self._lock:
            if self._started_us is None:
                self._started_us = now_us
            self.faults.tick(now_us)
            sent, due_us = self.core.step(now_us, self.faults.received(frames))
            sent, fault_due_us = self.faults.sent(now_us, sent)
            due_us = min(due_us, fault_due_us)
            return sent, min(due_us, now_us + _POLL_US) if self.shared else due_us

    def __getitem__(self, key: Key) -> Value:
        with self._lock:
            return self.value(self.description.find(key))

    def __setitem__(self, key: Key, value: Value) -> None:
        with self._lock:
            self.set_value(self.description.find(key), value)

    def __contains__(self, key: Key) -> bool:
        try:
            self.description.find(key)
        except InputError:
            return False
        return True

    def value(self, entry: Entry) -> Value:
        """The present value of an entry."""
        return python_value(entry.letter, self.core.od.get(entry.index, entry.sub))

    def set_value(self, entry: Entry, value: Value) -> None:
        """Set the value of an entry, read-only ones too. Raises InputError for a value that is not of its type."""
        with placed(f"{entry.place} {entry.name!r}"):
            if entry.letter != "s":  # a text outside ASCII is held as Latin-1
                types.encode(entry.letter, value)
            elif not isinstance(value, str) or max(value, default="") > "\xff":
                raise InputError(f"{value!r} is not VISIBLE_STRING: allowed is text of Latin-1")
        key, now = entry.index << 8 | entry.sub, core_value(entry.letter, value)
        if self.core.od.values[key] != now:
            self.core.od.values[key] = now
            self._announce(entry.index, entry.sub)

    def raise_emergency(self, code: int, register: int = emcy.GENERIC, detail: int = 0) -> None:
        """Send an EMCY message and keep the error active, in 1001h and in 1003h. Raises InputError."""
        if not (1 <= code <= 0xFFFF and 0 <= register <= 0xFF and 0 <= detail <= 0xFFFF):
            raise InputError(f"EMCY {code}, {register}, {detail}: allowed are 1 to 0xFFFF, 0 to 0xFF, 0 to 0xFFFF")
        with self._lock:
            self.core.emcy.raise_error(code, register, detail)

    def clear_emergency(self, code: int, detail: int = 0) -> None:
        """End an active error: EMCY 0000h."""
        with self._lock:
            self.core.emcy.cure(code, detail)

    def fault(self, kind: str, **parameters: float) -> None:
        """Start a fault: silent, slow (``delay_s``), wrong_toggle, emcy (``code``, ``register``). Raises InputError."""
        with self._lock:
            self.faults.start(kind, **parameters)

    def clear_fault(self, kind: str) -> None:
        """End a fault. Raises InputError for an unknown one."""
        with self._lock:
            self.faults.end(kind)

    def _announce(self, index: int, sub: int) -> None:
        for number, transmission, keys in self.core.tpdos.mapped():
            if (transmission >= codes.EVENT_DRIVEN or transmission == _ACYCLIC) and (index, sub) in keys:
                self.core.tpdos.request(number)

    def _writer(self, index: int) -> Callable[[int, object], int]:
        def write(sub: int, value: object) -> int:
            entry = self.description.objects[index].entries[sub]
            abort = self.application.on_write(entry, python_value(entry.letter, value))  # type: ignore[arg-type]
            if not abort and self.core.od.values[index << 8 | sub] != value:
                self._announce(index, sub)
            return abort or 0

        return write


class _Bridge(Application):
    def __init__(self, device: SimulatedDevice, drivers: list[Driver]) -> None:
        self._device = device
        self._drivers = drivers
        self.live = frozenset(driver.entry.index for driver in drivers)
        self._last_us = 0
        periods = [driver.signal.period_s for driver in drivers]
        if type(device.application).step is not DeviceApplication.step:
            periods.append(device.application.period_s)
        self._period_us = max(100, int(1e6 * min(periods))) if periods else 0
        self.due_us = 0 if periods else codes.NEVER_US

    def on_reset(self, now_us: int) -> None:
        self._last_us = now_us
        for key, value in self._device.initial_values.items():
            self._device[key] = value
        self._device.application.on_reset()

    def on_sync(self, now_us: int, _number: int) -> None:
        self._advance(now_us)
        self._device.application.on_sync()

    def refresh(self, _now_us: int) -> None:
        for driver in self._drivers:
            driver.apply()

    def expire(self, now_us: int) -> None:
        self._advance(now_us)
        self.due_us = now_us + self._period_us

    def _advance(self, now_us: int) -> None:
        self.refresh(now_us)
        dt_s, self._last_us = (now_us - self._last_us) * 1e-6, now_us
        if self._period_us and dt_s > 0.0:
            self._device.application.step(dt_s)


class Faults:
    """The active faults of one device, and what they do to its frames."""

    def __init__(self, core: Device) -> None:
        self._core = core
        self._active: dict[str, dict[str, float]] = {}
        self._waiting: deque[tuple[int, Frame]] = deque()
        self._planned: list[tuple[int, Callable[[], None]]] = []  # time, and the start or end
        self._origin_us: int | None = None

    def plan(self, kind: str, at_s: float = 0.0, for_s: float | None = None, **parameters: float) -> None:
        """Start a fault at ``at_s``, end it ``for_s`` later (None: never). Raises InputError for a wrong argument."""
        checked(kind, parameters)
        if at_s < 0.0 or (for_s is not None and for_s <= 0.0):
            shown = f"at_s {at_s:g}, for_s {for_s}"
            raise InputError(f"fault {kind}: {shown}: allowed are at_s from 0 on, for_s above 0")
        self._planned.append((int(1e6 * at_s), partial(self.start, kind, **parameters)))
        if for_s is not None:
            self._planned.append((int(1e6 * (at_s + for_s)), partial(self.end, kind)))
        self._planned.sort(key=lambda event: event[0])

    def start(self, kind: str, **parameters: float) -> None:
        """Start a fault. Raises InputError."""
        given = self._active[kind] = checked(kind, parameters)
        if kind == EMCY:
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
            self._planned.pop(0)[1]()

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
