"""Start a node from the settings in board.py: the common part of both main programs."""

from . import board
from .app import Clock, Firmware
from .flash import FileSlots, FlashStore
from .source import Gauges

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .can_port import CanPort


def node(port: "CanPort") -> Firmware:
    """Return the node on this board with this controller."""
    gauges = Gauges(board.chips(), board.COUNTS_PER_MICROSTRAIN)  # type: ignore[no-untyped-call]
    return Firmware(board.NODE_ID, gauges, port, FlashStore(FileSlots(board.FOLDER)), board.serial(), Clock())


def run(port: "CanPort") -> None:
    """Run the node until power-off, with the watchdog if it is enabled."""
    firmware = node(port)
    if not board.WATCHDOG_MS:
        firmware.run()
    from machine import WDT

    firmware.run(feed=WDT(timeout=board.WATCHDOG_MS).feed)
