"""What the services of a device share that act at a time of their own."""

from . import codes

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device


class Timed:
    """A service: the device calls ``expire`` at ``due_us``, and looks at all due times only after one was changed."""

    _due_us = codes.NEVER_US

    def __init__(self, device: "Device") -> None:
        self._device = device

    @property
    def due_us(self) -> int:
        """When ``expire`` is to be called; NEVER_US for never."""
        return self._due_us

    @due_us.setter
    def due_us(self, due_us: int) -> None:
        if due_us != self._due_us:
            self._due_us = due_us
            self._device.is_rescheduled = True

    def expire(self, now_us: int) -> None:
        """Do what is due."""
        raise NotImplementedError
