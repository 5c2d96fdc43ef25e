"""The behaviour of a simulated device, written in Python: override what your device does."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from canopen_device.eds.description import Entry
    from canopen_device.machine.device import SimulatedDevice
    from canopen_device.types import Value


class DeviceApplication:
    """What a simulated device does beyond CANopen. Every method may be overridden; this class does nothing.

    ``self.device`` is the device: ``self.device[0x6064] = 100`` sets a value and sends the PDOs that are due on it.
    The methods run in the thread of the bus loop and must not wait; an exception ends the loop.
    """

    device: SimulatedDevice
    period_s = 0.01
    """``step`` is called so often, and on each SYNC."""

    def on_start(self) -> None:
        """Handle the creation of the device. Raise InputError here if its EDS lacks what the application needs."""

    def on_reset(self) -> None:
        """Handle an NMT reset node, also the first: all values are those of the EDS, or stored ones."""

    def on_write(self, entry: Entry, value: Value) -> int:  # noqa: ARG002
        """Handle a value that a master writes, by SDO or PDO: return 0 to accept it, or an SDO abort code.

        The value is stored after this call. Objects below 2000h belong to CANopen itself and are not reported.
        """
        return 0

    def on_sync(self) -> None:
        """Handle a SYNC: set the values that its PDOs carry."""

    def step(self, dt_s: float) -> None:
        """Let ``dt_s`` seconds pass."""
