"""A CiA 402 drive: states, profile and cyclic position and velocity, homing (CiA 402-2); in increments and seconds."""

import math

from canopen_device.core.codes import INVALID_VALUE
from canopen_device.core.emcy import GENERIC, PROFILE
from canopen_device.eds.description import Entry
from canopen_device.errors import InputError
from canopen_device.machine.device import DeviceApplication
from canopen_device.types import Value

ERROR_CODE, CONTROL, STATUS, QUICK_STOP_OPTION = 0x603F, 0x6040, 0x6041, 0x605A
MODE, MODE_SHOWN, POSITION, VELOCITY = 0x6060, 0x6061, 0x6064, 0x606C
TARGET_POSITION, HOME_OFFSET, POSITION_LIMIT = 0x607A, 0x607C, 0x607D
PROFILE_VELOCITY, PROFILE_ACCELERATION, PROFILE_DECELERATION, QUICK_STOP_DECELERATION = 0x6081, 0x6083, 0x6084, 0x6085
HOMING_METHOD, HOMING_SPEED, TARGET_VELOCITY, SUPPORTED_MODES = 0x6098, 0x6099, 0x60FF, 0x6502

PROFILE_POSITION, PROFILE_VELOCITY_MODE, HOMING, CYCLIC_POSITION, CYCLIC_VELOCITY = 1, 3, 6, 8, 9
_MODES = (0, PROFILE_POSITION, PROFILE_VELOCITY_MODE, HOMING, CYCLIC_POSITION, CYCLIC_VELOCITY)
_NEEDED = (CONTROL, STATUS, MODE, MODE_SHOWN, POSITION)

# States, as bits 0 to 3, 5 and 6 of the statusword (CiA 402-2, 8.4.2).
SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED = 0x40, 0x21, 0x23, 0x27
QUICK_STOP, FAULT_REACTION, FAULT = 0x07, 0x0F, 0x08
_MOVING = (ENABLED, QUICK_STOP, FAULT_REACTION)
# Controlword bits.
_SWITCH_ON, _VOLTAGE, _NO_QUICK_STOP, _ENABLE, _START, _AT_ONCE, _RELATIVE, _RESET, _HALT = (1 << k for k in range(9))
# Statusword bits beyond the state.
_VOLTAGE_ON, _REMOTE, _REACHED, _LIMIT, _MODE_BIT = 1 << 4, 1 << 9, 1 << 10, 1 << 11, 1 << 12

_MOST_PARTS = 500
"""Of a step that came late: bounds its time after the process was stopped."""
_CURRENT_POSITION = (35, 37)  # homing methods that move nothing
_DEFAULTS = {
    PROFILE_VELOCITY: 10_000, PROFILE_ACCELERATION: 100_000, PROFILE_DECELERATION: 100_000,
    QUICK_STOP_DECELERATION: 1_000_000,
}  # fmt: skip


class Drive(DeviceApplication):
    """A drive with one axis. ``fail`` makes it fault; 6040h bit 7 resets the fault."""

    period_s = 0.002

    def on_start(self) -> None:
        """Check the EDS. Raises InputError if an object is missing without which there is no drive."""
        entries = {index: self.device.description.entry(index, 0) for index in _NEEDED}
        missing = [f"{index:04X}h" for index, entry in entries.items() if entry is None or entry.type.python is not int]
        if missing:
            shown = ", ".join(missing)
            raise InputError(f"{self.device.description.path}: no drive (CiA 402): without integers at {shown}")
        self._restart()

    def _restart(self) -> None:
        self.state = SWITCH_ON_DISABLED
        self.position = self.velocity = self._target = 0.0
        self._next: float | None = None  # a set-point that waits for the end of the present one
        self._control = self._code = 0
        self._acknowledged = self._homed = self._homing = self._limited = False

    def on_reset(self) -> None:
        """Start at position 0, in SWITCH ON DISABLED."""
        self._restart()
        self._publish()

    def fail(self, code: int = 0x2310, register: int = PROFILE) -> None:
        """Fault with an error code of CiA 402 (default: over-current): decelerate, then state FAULT, EMCY, 603Fh."""
        if self.state in (FAULT, FAULT_REACTION):
            return
        self._code = code
        self.device.raise_emergency(code, register | GENERIC)
        self._put(ERROR_CODE, code)
        self.state = FAULT_REACTION if self.state in (ENABLED, QUICK_STOP) else FAULT
        self._publish()

    def on_write(self, entry: Entry, value: Value) -> int:
        """Handle the controlword and the mode of operation."""
        if entry.index == CONTROL and isinstance(value, int):
            self._command(value)
            self._publish()
        elif entry.index == MODE and isinstance(value, int):
            modes = int(self._get(SUPPORTED_MODES))
            if value not in _MODES or (value and modes and not modes >> (value - 1) & 1):
                return INVALID_VALUE
            if value != self._mode():
                self._target, self._next = self.position, None
                self._acknowledged = self._homed = self._homing = False
            self._put(MODE_SHOWN, value)
            self._publish()
        return 0

    def step(self, dt_s: float) -> None:
        """Move the axis."""
        mode = self._mode() if self.state == ENABLED else 0
        if self.state in _MOVING:
            self._move(mode, dt_s)
        if self.velocity == 0.0 and self.state == FAULT_REACTION:
            self.state = FAULT
        if self.velocity == 0.0 and self.state == QUICK_STOP and not self._stays():
            self.state = SWITCH_ON_DISABLED
        if self.state not in _MOVING:
            self.velocity = 0.0
        self._publish()

    def _command(self, word: int) -> None:
        rising = word & ~self._control
        self._control = word
        if self.state == FAULT:
            if rising & _RESET:
                self.device.clear_emergency(self._code)
                self._code = 0
                self._put(ERROR_CODE, 0)
                self.state = SWITCH_ON_DISABLED
            return
        if self.state == FAULT_REACTION:
            return
        before = self.state
        self.state = self._after(word)
        if self.state == ENABLED:
            if before != ENABLED:
                self._target, self._next = self.position, None
                self._acknowledged = False
            self._set_point(word, rising)

    def _stays(self) -> bool:
        """Return whether the drive stays in QUICK STOP ACTIVE when it stands still (605Ah)."""
        return self._get(QUICK_STOP_OPTION, 2) in (5, 6, 7, 8)

    def _after(self, word: int) -> int:
        state = self.state
        if not word & _VOLTAGE:
            return SWITCH_ON_DISABLED
        if not word & _NO_QUICK_STOP:
            return QUICK_STOP if state in (ENABLED, QUICK_STOP) else SWITCH_ON_DISABLED
        if state == QUICK_STOP:
            return ENABLED if word & _ENABLE and word & _SWITCH_ON and self._stays() else QUICK_STOP
        if not word & _SWITCH_ON:
            return READY
        if state == SWITCH_ON_DISABLED:
            return state
        return ENABLED if word & _ENABLE else SWITCHED_ON

    def _set_point(self, word: int, rising: int) -> None:
        mode = self._mode()
        if mode == PROFILE_POSITION:
            if rising & _START:
                base = self._target if word & _RELATIVE else 0.0
                target = self._limit(base + self._get(TARGET_POSITION))
                if word & _AT_ONCE or self._arrived():
                    self._target, self._next = target, None
                else:
                    self._next = target
                self._acknowledged = True
            elif not word & _START:
                self._acknowledged = self._next is not None
        elif mode == HOMING and rising & _START:
            self._homed, self._homing = False, True
            if self._get(HOMING_METHOD) in _CURRENT_POSITION:
                self._end_homing()

    def _move(self, mode: int, dt_s: float) -> None:
        slow_down = self._get(PROFILE_DECELERATION)
        if self.state != ENABLED:
            self._run_at(0.0, self._get(QUICK_STOP_DECELERATION), dt_s)
        elif mode == CYCLIC_POSITION:
            target = self._limit(self._get(TARGET_POSITION))
            self.velocity, self.position = (target - self.position) / dt_s, target
        elif mode == CYCLIC_VELOCITY:
            self._run_at(self._get(TARGET_VELOCITY), math.inf, dt_s)
        elif mode == 0 or self._control & _HALT:
            self._run_at(0.0, slow_down, dt_s)
        elif mode == PROFILE_VELOCITY_MODE:
            self._run_at(self._get(TARGET_VELOCITY), self._get(PROFILE_ACCELERATION), dt_s)
        elif mode == PROFILE_POSITION:
            self._approach(self._target, self._get(PROFILE_VELOCITY), dt_s)
            if self._next is not None and self._arrived():
                self._target, self._next = self._next, None
                self._acknowledged = bool(self._control & _START)
        elif self._homing:
            self._approach(0.0, self._get(HOMING_SPEED, self._get(PROFILE_VELOCITY)), dt_s)
            if self.position == 0.0 and self.velocity == 0.0:
                self._end_homing()

    def _run_at(self, velocity: float, acceleration: float, dt_s: float) -> None:
        before, most = self.velocity, acceleration * dt_s
        self.velocity = velocity if abs(velocity - before) <= most else before + math.copysign(most, velocity - before)
        wanted = self.position + 0.5 * (before + self.velocity) * dt_s
        self.position = self._limit(wanted)
        if self.position != wanted:
            self.velocity = 0.0

    def _approach(self, target: float, speed: float, dt_s: float) -> None:
        """Follow a trapezoidal profile to ``target``, in parts: a step that came late would go far beyond it."""
        parts = min(max(math.ceil(dt_s / self.period_s), 1), _MOST_PARTS)
        part_s, slow_down = dt_s / parts, max(self._get(PROFILE_DECELERATION), 1.0)
        step = slow_down * part_s
        for _ in range(parts):
            left = target - self.position
            # The velocity from which the rest of the way, less that of this step, is enough to stop.
            fastest = step * (math.sqrt(0.25 + 2.0 * abs(left) / (step * part_s)) - 0.5)
            wanted = math.copysign(min(speed, fastest), left)
            rate = self._get(PROFILE_ACCELERATION) if abs(wanted) > abs(self.velocity) else 4.0 * slow_down
            self._run_at(wanted, max(rate, 1.0), part_s)
            if abs(target - self.position) < 0.5 and abs(self.velocity) <= 2.0 * step:
                self.position, self.velocity = target, 0.0

    def _arrived(self) -> bool:
        return self.velocity == 0.0 and self.position == self._target

    def _end_homing(self) -> None:
        self.position, self.velocity = float(self._get(HOME_OFFSET)), 0.0
        self._target = self.position
        self._homed, self._homing = True, False

    def _limit(self, position: float) -> float:
        low, high = self._get((POSITION_LIMIT, 1)), self._get((POSITION_LIMIT, 2))
        inside = min(max(position, low), high) if low < high else position
        self._limited = inside != position
        return inside

    def _publish(self) -> None:
        self._put(POSITION, round(self.position))
        self._put(VELOCITY, round(self.velocity))
        mode = self._mode() if self.state == ENABLED else 0
        reached, mode_bit = False, mode in (CYCLIC_POSITION, CYCLIC_VELOCITY)  # the drive follows the command
        if mode == PROFILE_POSITION:
            reached, mode_bit = self._arrived() and self._next is None, self._acknowledged
        elif mode == PROFILE_VELOCITY_MODE:
            reached, mode_bit = self.velocity == self._get(TARGET_VELOCITY), self.velocity == 0.0
        elif mode == HOMING:
            reached, mode_bit = not self._homing, self._homed
        bits = ((self._limited, _LIMIT), (reached, _REACHED), (mode_bit, _MODE_BIT))
        self._put(STATUS, self.state | _REMOTE | _VOLTAGE_ON | sum(bit for is_set, bit in bits if is_set))

    def _mode(self) -> int:
        return int(self._get(MODE_SHOWN))

    def _get(self, key: int | tuple[int, int], default: float = 0.0) -> float:
        """Return a number; where the EDS has no such object, or 0 in one that must not be 0, a default."""
        index, sub = key if isinstance(key, tuple) else (key, 0)
        described = self.device.description
        entry = (None if sub else described.entry(index, 1)) or described.entry(index, sub)
        value = default if entry is None else self.device.value(entry)
        number = float(value) if isinstance(value, int | float) and math.isfinite(value) else default
        return number or float(_DEFAULTS.get(index, 0))

    def _put(self, index: int, value: int) -> None:
        entry = self.device.description.entry(index, 0)
        if entry is not None and entry.type.python in (int, float):
            low, high = entry.type.limits or (value, value)
            self.device.set_value(entry, min(max(value, low), high))
